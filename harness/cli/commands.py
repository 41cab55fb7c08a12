"""State every command of the core: what is typed, the function behind it,
and how it was typed before.

Extensions add to each of these tables.
"""

from collections.abc import Mapping

from harness.core.extensions import extensions, joined

# The function behind each command, as `module:function` of this package. A module alone stands for
# its function `command`.
COMMANDS = {
    "init": "init",
    "eval": "eval",
    "drive": "drive",
    "compare": "compare",
    "plan": "plan",
    "report": "report",
    "study sweep": "sweep",
    "run ls": "runs:ls",
    "run check": "runs:check",
    "run merge": "runs:merge",
    "run export": "export",
    "model list": "model:list_models",
    "model pull": "model:pull",
    "prompt list": "prompt:list_prompts",
    "prompt show": "prompt:show",
    "prompt compare": "prompt:compare",
    "prompt release": "prompt:release",
    "prompt parse": "parse",
    "dataset build": "dataset:build",
    "dataset check": "dataset:check",
    "dataset show": "dataset:show",
    "dataset export": "dataset:export",
    "dataset rank": "dataset:rank_drivers",
    "dataset scenario list": "scenario:list_scenarios",
    "dataset scenario show": "scenario:show",
    "dataset scenario drive": "scenario:drive",
}

GROUPS = {
    "study": "Vary settings of finished runs.",
    "run": "List finished runs; check, merge or export them.",
    "model": "List and download models.",
    "prompt": "List prompts; show, compare, release them; parse answers.",
    "dataset": "Build, check, show, rank, export datasets; list scenarios.",
    "dataset scenario": "List scenarios, show or drive one.",
}

# The panels of the first screen.
PANELS = {
    "Evaluate": ("init", "eval", "drive"),
    "Look at results": ("compare", "report"),
    "More": ("plan", "study", "run", "model", "prompt", "dataset"),
}

# Spellings of 0.2 and what replaces them; they work until 0.5.0, with a note.
OLD = {
    "sweep": "study sweep",
    "ls": "run ls",
    "merge": "run merge",
    "export": "run export",
    "parse": "prompt parse",
    "prompt diff": "prompt compare",
    "prompt lock": "prompt release",
    "scenario check": "dataset scenario drive",
    "scenario": "dataset scenario",
}


def commands() -> Mapping[str, str]:
    """Return the place of each command's function, those of extensions included.

    The key is what is typed, such as `run ls`, and the value a text `module:function`, which is
    imported once the command is typed.
    """
    return joined(COMMANDS, "commands")


def groups() -> Mapping[str, str]:
    """Return the help text of each group of commands by its name, those of extensions included."""
    return joined(GROUPS, "groups")


def spellings() -> Mapping[str, str]:
    """Return the present words of each renamed command, by its old spelling, which still works."""
    return joined(OLD, "spellings")


def short() -> Mapping[str, str]:
    """Return the whole command that each permanent short form stands for, by the short form.

    Only extensions have any.
    """
    return joined({}, "short")


def panels() -> Mapping[str, tuple[str, ...]]:
    """Return the headings of the first help screen, with the commands or groups below each.

    A heading is a key; its value has the names in order.
    """
    words = {panel: list(names) for panel, names in PANELS.items()}
    for extension in extensions().values():
        for word, panel in extension.panels.items():
            words.setdefault(panel, []).append(word)
    return {panel: tuple(dict.fromkeys(names)) for panel, names in words.items()}
