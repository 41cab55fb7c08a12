"""State every command: what is typed for it, the function behind it, and how it was typed before."""

# The function behind each command, as `module:function` of this package. A module alone stands for its
# function `command`.
COMMANDS = {
    "init": "init",
    "eval": "eval",
    "drive": "drive",
    "compare": "compare",
    "report": "report",
    "view": "view",
    "study sweep": "sweep",
    "study trust": "trust",
    "study schedule compare": "schedule:compare",
    "study schedule learn": "schedule:learn",
    "study grid": "grid",
    "study twins": "twins",
    "study attribute": "attribute",
    "study fidelity": "fidelity",
    "study paper": "campaign:paper",
    "study closed-loop": "campaign:closed_loop",
    "run ls": "runs:ls",
    "run history": "runs:history",
    "run merge": "runs:merge",
    "run export": "runs:export",
    "run video": "runs:video",
    "model list": "model:list_models",
    "model pull": "model:pull",
    "model check": "model:check",
    "model parity": "model:parity",
    "model distill": "distill",
    "model doctor": "doctor",
    "model device list": "device:list_devices",
    "model device show": "device:show",
    "model device check": "device:check",
    "model device measure": "device:measure",
    "prompt list": "prompt:list_prompts",
    "prompt show": "prompt:show",
    "prompt check": "prompt:check",
    "prompt compare": "prompt:compare",
    "prompt examples": "prompt:examples",
    "prompt release": "prompt:release",
    "prompt parse": "parse",
    "dataset build": "dataset:build",
    "dataset check": "dataset:check",
    "dataset show": "dataset:show",
    "dataset rank": "dataset:rank_drivers",
    "dataset scenario list": "scenario:list_scenarios",
    "dataset scenario show": "scenario:show",
    "dataset scenario drive": "scenario:drive",
    "dataset scenario audit": "scenario:audit",
    "radio list": "radio:list_channels",
    "radio show": "radio:show",
    "radio check": "radio:check",
    "radio crowd": "radio:crowd",
}

GROUPS = {
    "study": "Vary settings: sweeps, attacks, schedules, grids, twins.",
    "study schedule": "Compare schedules (whom to ask, and when), or learn one.",
    "run": "List finished runs; merge, export or film them.",
    "model": "List, download, test and train models; list on-board computers.",
    "model device": "List on-board computers, show or check one, or measure energy.",
    "prompt": "List prompt versions; show, check, compare or release them.",
    "dataset": "Build, check, show and rank frozen datasets; list scenarios.",
    "dataset scenario": "List scenarios, show one, drive or audit it.",
    "radio": "List radios, show one, or check one against published curves.",
}

# The panels of the first screen.
PANELS = {
    "Evaluate": ("init", "eval", "drive"),
    "Look at results": ("compare", "report", "view"),
    "More": ("study", "run", "model", "prompt", "dataset", "radio"),
}

# Spellings of 0.2 and what replaces them; they work until 0.4.0, with a note.
OLD = {
    "sweep": "study sweep",
    "trust": "study trust",
    "schedule": "study schedule",
    "grid": "study grid",
    "twins": "study twins",
    "attribute": "study attribute",
    "fidelity": "study fidelity",
    "campaign": "study",
    "ls": "run ls",
    "history": "run history",
    "merge": "run merge",
    "export": "run export",
    "video": "run video",
    "parity": "model parity",
    "distill": "model distill",
    "device": "model device",
    "parse": "prompt parse",
    "prompt diff": "prompt compare",
    "prompt lock": "prompt release",
    "scenario check": "dataset scenario drive",
    "scenario": "dataset scenario",
    "channel": "radio",
}

# Short for a command of a group, for good and without a note.
SHORT = {"doctor": "model doctor"}
