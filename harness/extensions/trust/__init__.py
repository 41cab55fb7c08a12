"""Let some helpers lie or fail, guard what the ego hears, and study both together."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.trust"

EXTENSION = Extension(
    name="trust",
    commands={"study trust": f"{_HERE}.command:command"},
    spellings={"trust": "study trust"},
    studies={"trust": "trust"},
    kinds={"attacks": "what liars say"},
    settings={
        "attack": Setting(
            tuple,
            (),
            "Beside each condition with a channel, also score it under attack: liar:share=1/3 "
            "makes a third of the helpers lie; liar+spoof combines two attacks. `harness study "
            "trust --help` lists them. Repeatable.",
            behind=("condition",),
        )
    },
    adds={
        "counterparts": {"attack": f"{_HERE}.part:setting_of"},
        "parts": {"trust": f"{_HERE}.part:Guard"},
        "python": {"Attack": f"{_HERE}.attacks:Attack", "Turn": f"{_HERE}.attacks:Turn"},
    },
)
