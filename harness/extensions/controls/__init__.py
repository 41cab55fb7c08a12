"""Take from messages what helpers see, as controls do: of what helps the ego, what is left?"""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.controls"

EXTENSION = Extension(
    name="controls",
    settings={
        "control": Setting(
            tuple,
            (),
            "Beside each condition with a channel, also score a control. shuffled-messages: the "
            "ego hears the helpers of another layout. no-messages: every message is lost. blind: "
            "the helpers see nothing. Repeatable.",
            behind=("condition",),
            only="frozen",
        )
    },
    adds={
        "parts": {"messages": f"{_HERE}.part:Controlled"},
        "counterparts": {"control": f"{_HERE}.part:setting_of"},
    },
)
