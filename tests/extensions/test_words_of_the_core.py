"""The core's texts: no code, docstring, comment or page of it names what an extension has."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.cli.commands import COMMANDS, GROUPS, OLD
from harness.coordination.contents import CONTENTS
from harness.coordination.part_settings import more_parts
from harness.coordination.rules import RULES
from harness.coordination.schedules import SCHEDULES
from harness.core.extensions import Extension, control_settings, extensions
from harness.extensions.trust.part import DEFENCES
from harness.radio.profiles import CHANNELS

HARNESS = Path(__file__).parents[2] / "harness"
WORD = re.compile(r"[a-z][a-z0-9]*(?:-[a-z0-9]+)*")
IMPORTS = re.compile(r"^ *from [a-z_.]+ import", re.MULTILINE)  # no command `dataset import`
BETWEEN = re.compile(r"""["'`#\s]+|//""")  # marks of quotation, comments and ends of lines

# Names of extensions that the core has for something of its own.
ORDINARY = {
    "agents": "those who decide, and what answers for a vehicle",
    "always": "at every time",
    "attack": "what an attacker does",
    "attribute": "of a Python object",
    "benchmark": "what a published dataset is tagged as",
    "both": "two things",
    "budget": "of a prompt's tokens, of a template's steps, and of questions",
    "calibration": "how far probabilities are what they say, a metric",
    "channel": "what carries messages, a kind of plug-ins",
    "closed-loop": "the world that is driven, beside the frozen one",
    "contents": "what messages hold, and suites and pages",
    "control": "one of the controls, a variate, and of characters and tokens",
    "controls": "conditions beside which a gain is compared",
    "coverage": "of risk by confidence, and of intervals",
    "danger": "a vehicle that comes against the ego",
    "deadline": "until when a reply is of use",
    "decide": "what vehicles do",
    "device": "where an engine runs a model, and what is no file",
    "devices": "meters' of a machine, and the folder of their files",
    "energy": "of a bit, of what meters count, and what a timer may say of decisions",
    "env": "of highway-env, and a variable of the shell",
    "environment": "one of highway-env, and a variable of the shell",
    "environments": "those of highway-env",
    "etsi": "whose standards are cited",
    "examples": "what a prompt shows as earlier turns",
    "failures": "episodes and answers that failed",
    "grid": "the values of a sweep, and the episodes of a run by seed",
    "helper": "a vehicle that the ego may ask, a role",
    "helper_answer": "in which form a prompt asks helpers to answer",
    "import": "of Python, and what reads files in",
    "history": "of a browser's tab",
    "inspect": "Python's module",
    "learn": "a verb",
    "looks": "a verb, and what a run states of when a rule looked at it",
    "margin": "of pages, pictures and gaps",
    "measure": "a verb, and what is measured",
    "media": "a rule of style sheets",
    "messages": "what vehicles send each other, and what a model is sent",
    "notes": "what is kept beside a scene, and Python's of an exception",
    "objects": "what sensors report, a kind of what messages hold, and JSON's",
    "only": "an adverb",
    "oracle": "a bound on schedules",
    "pack": "what is sent to another process",
    "paper": "the one whose method this is",
    "promise": "what rules guarantee, and JavaScript's",
    "proxy": "the rule that stands for a model",
    "random": "of draws",
    "reaction": "of a human, in seconds",
    "read-outs": "of a policy from a model's probabilities",
    "recording": "what layouts may be cut from, and what a card denies",
    "repeats": "a verb, and evaluations alike",
    "risk": "an answer's level, and errors by confidence",
    "roads": "what lanes are on",
    "roadside": "what the paper's 6G may have beside the road, a second path",
    "rounds": "of messages on a channel, and of numbers",
    "sample": "what is drawn of many",
    "schedules": "a kind of plug-ins, and the folder of their files",
    "seeds": "of layouts, channels and sampling",
    "serve": "what a server does with a model",
    "stream": "of text, or of messages that any part may have sent unasked",
    "streams": "the same",
    "sumo": "an extra, of packages",
    "tells": "a verb",
    "text": "what is read and written",
    "trace": "of a matrix",
    "tracker": "of a process's resources, and what may delete a folder",
    "transmissions": "messages that are sent",
    "trust": "how far a rule, or a loader of weights, trusts what it is given",
    "verify": "the check of a dataset",
    "view": "what a vehicle sees",
}
# Messages, help and starter files that lead on to a command, which says whose it is where it is
# gone.
LEADS_ON = {
    ("backends/llama_cpp/backend.py", "model check"),
    ("cli/dataset.py", "study fidelity"),
    ("cli/starter/README.md", "model doctor"),
    ("cli/starter/models/my-model.toml", "model check"),
    ("coordination/parts.py", "study schedule"),
    ("evaluate/spec.py", "prompt examples"),
    ("evaluate/timing.py", "model check"),
    ("prompts/examples.py", "prompt examples"),
    ("report/caveats.py", "study fidelity"),
    ("report/compare/pair.py", "study fidelity"),
    ("report/scripts/decision.js", "harness view"),
    ("report/scripts/decision.js", "run video"),
}
# Old folders of a study had this file in place of its manifest, and are listed.
OLD_FOLDERS = {("runs/listing.py", "fidelity")}


def typed(extension: Extension) -> set[str]:
    """Return what is typed for an extension's commands, older spellings and groups included."""
    return {*extension.commands, *extension.groups, *extension.spellings, *extension.short}


def read(extension: Extension) -> set[str]:
    """Return the names of the shipped channel files that state a model of an extension."""
    models = extension.adds.get("channel_models", {})
    files = (HARNESS.parent / "channels").glob("*.toml")
    return {file.stem for file in files if CHANNELS.profile(file.stem).model in models}


def names(extension: Extension) -> set[str]:
    """Return every single word that an extension gives a thing."""
    given = {extension.name, *extension.settings, *extension.studies}
    words = {word for path in typed(extension) for word in path.split()}
    added = {name for table in extension.adds.values() for name in table}
    return given | words | added | read(extension)


def phrases(extension: Extension) -> Iterator[str]:
    """Yield what is said of an extension in several words, and the marks of its studies."""
    for command in typed(extension):
        yield command if " " in command else f"harness {command}"
    for setting in extension.settings:
        yield from (setting, setting.replace("_", "-"), setting.replace("_", " "))
    for option in extension.adds.get("options", {}):
        yield from (option, option.replace("_", "-"))
    for kind in extension.studies:
        yield f"{kind}.json"
    for text in ("extension {}", "extensions.{}", "extensions/{}"):
        yield text.format(extension.name)


def words_of_the_core() -> set[str]:
    """Return the words of its commands, and of its kinds of plug-ins that extensions add to."""
    commands = {word for path in (*COMMANDS, *GROUPS, *OLD) for word in path.split()}
    rooms = {path.name for path in HARNESS.iterdir()}
    kinds = {
        kind.removesuffix("s") for extension in extensions().values() for kind in extension.adds
    }
    return commands | rooms | kinds


def texts() -> Iterator[tuple[str, str]]:
    """Yield the core's files, each with its text in small letters."""
    for file in sorted(HARNESS.rglob("*")):
        path = file.relative_to(HARNESS)
        if file.is_file() and path.parts[0] != "extensions" and file.suffix not in (".pyc", ".csv"):
            parted = re.sub("(?<=[a-z])(?=[A-Z])", "_", file.read_text())
            yield path.as_posix(), parted.lower()


def found() -> Iterator[tuple[str, str]]:
    """Yield each file of the core with a name in it that is an extension's."""
    ours = set().union(*map(names, extensions().values())) - words_of_the_core()
    spoken = sorted(
        {phrase for extension in extensions().values() for phrase in phrases(extension)}
    )
    said = re.compile(rf"\b({'|'.join(map(re.escape, spoken))})\b")
    for path, text in texts():
        for name in {*WORD.findall(text)} & ours:
            yield path, name
        for phrase in said.findall(BETWEEN.sub(" ", IMPORTS.sub("", text))):
            yield path, phrase


@pytest.mark.slow
def test_the_core_names_nothing_of_an_extension() -> None:
    there = set(found())
    words = {(path, word) for path, command in LEADS_ON for word in command.split()}
    others = there - LEADS_ON - words - OLD_FOLDERS
    assert not {(path, name) for path, name in others if name not in ORDINARY}
    assert there >= LEADS_ON | OLD_FOLDERS
    assert {name for _, name in there} >= set(ORDINARY), "a word that is no exception any more"


# What plays a decision, and the words that it has for other things.
LOOP = (
    "coordination/coordinate.py",
    "coordination/exchange.py",
    "coordination/named_points.py",
    "coordination/operating_point.py",
    "coordination/part_settings.py",
    "evaluate/answer_arrays.py",
    "evaluate/asking.py",
    "evaluate/requests.py",
    "evaluate/spec.py",
    "evaluate/walk.py",
)
OF_STREAMS = (
    "coordination/operating_point.py",
    "coordination/part_settings.py",
    "evaluate/asking.py",
    "evaluate/requests.py",
    "evaluate/walk.py",
)
OTHER_THINGS = {
    ("coordination/coordinate.py", "messages"): "what a rule fuses",
    ("coordination/operating_point.py", "objects"): "whether a call shows what is in the graph",
    ("coordination/operating_point.py", "rounds"): "of helpers, which load a channel",
    ("coordination/named_points.py", "text"): "of a condition",
    ("coordination/operating_point.py", "text"): "of a message's key",
    ("coordination/part_settings.py", "messages"): "whose changes parts know",
    ("coordination/part_settings.py", "text"): "of a message's key",
    ("evaluate/spec.py", "objects"): "what a prompt shows",
    ("evaluate/spec.py", "text"): "of a prompt",
    ("evaluate/walk.py", "objects"): "of the world, which lists them",
    ("evaluate/walk.py", "text"): "of a reply, in bytes",
    ("coordination/exchange.py", "messages"): "how many were sent",
    ("evaluate/asking.py", "messages"): "of a chat, whose length bounds its tokens",
    ("coordination/operating_point.py", "messages"): "what is done to those of a fusion call",
    ("evaluate/spec.py", "messages"): "what a prompt shows",
    **{(path, "stream"): "what any part may have sent unasked" for path in OF_STREAMS},
}


def said_in(tree: ast.AST) -> Iterator[str]:
    """Yield names, attributes, parameters, imports and words of strings, but for docstrings."""
    bodies = [node.body for node in ast.walk(tree) if hasattr(node, "body")]
    firsts = [body[0] for body in bodies if isinstance(body, list) and body]
    docstrings = {id(first.value) for first in firsts if isinstance(first, ast.Expr)}
    for node in ast.walk(tree):
        value = node.value if isinstance(node, ast.Constant) else None
        if isinstance(value, str) and id(node) not in docstrings:
            yield from WORD.findall(value)
        for field in ("id", "attr", "arg", "name", "module"):
            yield from (getattr(node, field, None) or "").split(".")


def test_what_plays_a_decision_names_no_part_of_an_extension() -> None:
    """Neither settings, nor questions to helpers, controls, contents, rules or schedules."""
    kinds = more_parts().values()
    settings = {setting for kind in kinds for setting in kind.__struct_fields__}
    questions = {question.name for kind in kinds for question in kind.questions}
    controls = {setting.partition("=")[2] for setting in control_settings().values()}
    contents = set(CONTENTS) - CONTENTS.built_in.keys()
    schedules = set(SCHEDULES) - SCHEDULES.built_in.keys()
    rules = set(RULES) - RULES.built_in.keys()
    theirs = settings | questions | controls | set(DEFENCES) | contents | rules | schedules
    named = {
        (path, word)
        for path in LOOP
        for word in theirs.intersection(said_in(ast.parse((HARNESS / path).read_text())))
    }
    assert named == set(OTHER_THINGS)
