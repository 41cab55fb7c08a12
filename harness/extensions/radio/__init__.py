"""Give vehicles physical radios, whose losses follow from where they are, and messages the sizes of
the standards; list and check radios.
"""

from harness.core.extensions import Extension

_HERE = "harness.extensions.radio"

EXTENSION = Extension(
    name="radio",
    commands={
        "radio list": f"{_HERE}.commands:list_channels",
        "radio show": f"{_HERE}.commands:show",
        "radio check": f"{_HERE}.commands:check",
        "radio crowd": f"{_HERE}.commands:crowd",
        "radio messages": f"{_HERE}.messages_command:command",
    },
    groups={"radio": "List radios, show or check one; show what messages take."},
    panels={"radio": "More"},
    spellings={"channel": "radio"},
    adds={
        "channel_models": {
            "its-g5": f"{_HERE}.its_g5:ItsG5",
            "lte-v2x-mode4": f"{_HERE}.lte_mode4:LteMode4",
            "nr-v2x-mode2": f"{_HERE}.nr_mode2:NrMode2",
            "trace": f"{_HERE}.trace:from_profile",
        },
        "encodings": {"etsi": f"{_HERE}.messages:ETSI", "sae": f"{_HERE}.messages:SAE"},
    },
)
