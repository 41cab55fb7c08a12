"""Give every vehicle a computer: what an answer takes there in time, energy and memory."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.devices"

EXTENSION = Extension(
    name="devices",
    commands={
        "model device list": f"{_HERE}.commands:list_devices",
        "model device show": f"{_HERE}.commands:show",
        "model device check": f"{_HERE}.commands:check",
        "model device measure": f"{_HERE}.commands:measure",
    },
    groups={"model device": "List on-board computers, show or check one, or measure energy."},
    spellings={"device": "model device"},
    settings={
        "device_profile": Setting(
            str,
            None,
            "Computer in every vehicle, such as agx-orin (`harness model device list`). It times "
            "each answer by its tokens; use it instead of --latency.",
            behind=("latency",),
        ),
        "device_model": Setting(
            str,
            None,
            "With --device-profile: model whose row of the profile times all answers. Default: "
            "the model that gave the answer.",
            behind=("latency",),
        ),
    },
    adds={
        "timers": {"device": f"{_HERE}.timer:TIMER"},
        "metrics": {
            "energy_j": f"{_HERE}.metrics:ENERGY",
            "helpers_j": f"{_HERE}.metrics:HELPERS",
            "radio_mj": f"{_HERE}.metrics:RADIO",
            "waiting_j": f"{_HERE}.metrics:WAITING",
        },
        "panels": {"energy": f"{_HERE}.page:PANEL"},
        "caveats": {"device": f"{_HERE}.page:caveats"},
        "notes": {"energy": f"{_HERE}.page:notes"},
    },
)
