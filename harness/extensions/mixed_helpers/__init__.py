"""Let helpers have another model, prompt or answer mode than the ego, and compare such pairs."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.mixed_helpers"

EXTENSION = Extension(
    name="mixed_helpers",
    commands={"study grid": f"{_HERE}.grid.command:command"},
    spellings={"grid": "study grid"},
    studies={"grid": "grid"},
    settings={
        "helper_model": Setting(
            str,
            None,
            "Model of the helpers. Several, such as a,b,c, are assigned to the helpers in turn. "
            "Repeatable. Default: the ego's model.",
            behind=("prompt",),
            place="helpers.model",
            listed=True,
            models=True,
        ),
        "helper_prompt": Setting(
            str,
            None,
            "Prompt version of the helpers. Default: the ego's prompt.",
            behind=("prompt",),
            place="helpers.prompt",
        ),
        "helper_answer": Setting(
            str,
            None,
            "How the helpers answer, as --answer says. Default: like the ego.",
            behind=("prompt",),
            place="helpers.answer",
        ),
        "helper_thinking": Setting(
            bool,
            None,
            "Ask the helpers to think before they answer. Default: like the ego.",
            behind=("prompt",),
            place="helpers.thinking",
        ),
    },
    adds={"agents": {"helper": f"{_HERE}.agents:HELPERS"}},
)
