"""Look at a model, a prompt or this machine before a run, with fixed questions and timings."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="checkups",
    commands={
        "model check": "harness.extensions.checkups.model_commands:check",
        "model parity": "harness.extensions.checkups.model_commands:parity",
        "model doctor": "harness.extensions.checkups.doctor:command",
        "prompt check": "harness.extensions.checkups.prompt_command:check",
    },
    spellings={"parity": "model parity"},
    short={"doctor": "model doctor"},
    adds={"caveats": {"read-outs": "harness.extensions.checkups.read_outs:caveats"}},
)
