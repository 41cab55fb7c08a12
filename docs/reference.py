"""Writes pages out of the program, commands.md, commands/*.md, names.md, settings.md and fields.md,
and model-cards.md out of docs/cards: `python docs/reference.py`. Tests hold the pages to it.

Examples are not written here: each is a command of another page, which the tests run.
"""

import inspect
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer import Context
from typer.main import get_command

from harness.cli import app
from harness.cli.commands import panels
from harness.cli.terminal import attributes
from harness.coordination.named_points import POINTS
from harness.coordination.part_settings import PARTS, more_parts, part_of_settings, typed_settings
from harness.core import extensions
from harness.parsing.parse import Repair, Status
from harness.runs import decisions, formats, records
from harness.runs.difficulty import Layout
from harness.runs.metrics import METRICS
from harness.runs.records import roles
from harness.runs.timers import TIMERS
from harness.world.outcome import End

DOCS = Path(__file__).parent
PAGE = DOCS / "commands.md"
GROUPS = DOCS / "commands"  # a page for each group
GROUP_HEAD = """\
# harness {}

Written by `python docs/reference.py`, as [all commands](../commands.md) are.
"""
TREE = """\
```{{toctree}}
:hidden:

{}
```
"""
NAMES_PAGE = DOCS / "names.md"
HEAD = """\
# Commands

Written by `python docs/reference.py` out of the program, which says the same with `--help`. Bad input is one
line on stderr and exit code 2; all codes are in [a table](answers.md#exit-codes).
"""  # noqa: E501
SHARED = """\
## Shared options

Options with one meaning in several commands. Each command below names those that it has, in brackets with its
default where defaults differ.
"""  # noqa: E501
NAMES_HEAD = """\
# Names: statuses, repairs and metrics

Written by `python docs/reference.py` out of the program. [Answers](answers.md) says how a text gets its status, [Comparing two
runs](comparing.md) how metrics are compared.
"""  # noqa: E501
METRICS_HEAD = """\
Names are those of `summary.csv`. Metrics of answers have one for each role: {}. *Only* names the kind of run that has a
metric: frozen (`harness eval`) or closed-loop (`harness drive`).
"""  # noqa: E501
SETTINGS_PAGE = DOCS / "settings.md"
SETTINGS_HEAD = """\
# Settings of a condition

Written by `python docs/reference.py` out of the program. [Operating points](operating-points.md) says how they work together,
and which pages have more: `--condition 6g:window_s=0.3` sets one, `harness study sweep RUN --over window_s` tries several values.
Defaults are those of `v2x` and `6g`, which have their losses and latencies in a profile. A name ends in its unit.
"""  # noqa: E501
FIELDS_PAGE = DOCS / "fields.md"
FIELDS_HEAD = """\
# Fields of a run's files

Written by `python docs/reference.py` out of the records by which the program reads these files. [File formats](files.md) says
what each file is for, the [glossary](glossary.md) what the terms mean. Times end in `_s` or `_ms`, distances in `_m`; a share is 0
to 1. *None* and *unknown* are `null` in JSON and Parquet and an empty cell in CSV, *unset* is no key; *frozen* and *closed loop*
name the kind of run that has a value. `ACTION` stands for each meta-action, `N` for the helpers' places, from 1.
"""  # noqa: E501
RUN_HEAD = """\
## run.json

On other pages: [how a model is asked](answers.md#four-answer-modes), what a server
[states](servers.md#other-weights-under-the-same-name) of itself, [prices](models.md#a-card-of-your-own),
[device profiles](latency.md#devices).
"""  # noqa: E501
SUMMARY_HEAD = """\
## summary.csv and `run.summary`

What each metric means: [Names](names.md#metrics).
"""
DIFFICULTY_HEAD = """\
## difficulty.csv

The `adjusted_` rows of `summary.csv` follow from it:
[Adjusted for difficulty](comparing.md#adjusted-for-difficulty).
"""
EPISODES_HEAD = """\
## episodes.csv and `run.episodes`

On other pages: [outcomes](success.md#outcomes),
[conflicts in time](success-details.md#conflicts-in-time).
"""
JOURNEYS_HEAD = """\
### `run.agents`

A row for each agent of an episode, with its `condition`, `seed` and `episode`, where [several vehicles decide](agents.md).
`gave_way` says whether it lost the most time.
"""  # noqa: E501
DECISIONS_HEAD = """\
## decisions.parquet and `run.decisions`

In closed loop several episodes may share a decision point. Only where something fills them are
there {}
and columns of energy.
"""
ANSWERS_HEAD = """\
## answers.jsonl and `run.answers`

A line is an answer of the ego, a helper, one that is shown nothing (`blind`), or to a fusion call (`merge`), one for each set of
messages that any condition and seed delivers. The table has `intent_ACTION` in place of `intent`, `v2+v4` in `heard`, `risk`,
`evidence`, `recommended_maneuver` and `confidence` in place of `message`, and `turns`, `first_status` and `first_raw` in place of
`first`. It adds `episode`, `step` and `danger`, and where several vehicles decide `decider`.
"""  # noqa: E501
ATTRIBUTION_HEAD = """\
## attribution.json

What `harness study attribute` [left out](stability.md#attribution).
"""
CARDS = DOCS / "cards"
CARDS_PAGE = DOCS / "model-cards.md"
CARDS_HEAD = """\
# Cards to copy

Written by `python docs/reference.py` out of the cards in `docs/cards/`. Nobody has run these models in this project, so they are
no models of the harness yet. Names, licences, sizes and times are what others published: the comment of each card says who.

Copy a card to `models/` in the folder of your project, which `harness init` makes. Then its name is a [model](models.md)
like any other, and a run made while the card still shipped runs again with it. Where pip put the cards, the error
line of `harness model check qwen3-8b` says.
"""  # noqa: E501
TEXTS_HEAD = """\
## Models that read texts

`context_tokens` may be less than a model reads. Gemma 4, Ministral 3 and Qwen3.5 also take pictures, which these cards do not
send.
"""  # noqa: E501
SEE_HEAD = """\
## Models that see

`[vision]` has the size of a model's pictures, and what their tokens are counted by. On llama.cpp the projector is a file
beside the weights. They answer [image prompts](prompts.md#image-prompts). The hub was not asked about them.
"""  # noqa: E501
DECIDE_HEAD = """\
## Decision models

They answer with [`--answer decision`](models.md#decision-models), by a server at port 8080 with `POST /v1/systemone`: start it as
the card's comment says, and mend what differs. A `cited` time counts with
[`--latency card`](latency.md#where-inference-times-come-from). Clef and d1 also take pictures, which these cards do not send.
"""  # noqa: E501
TABLE = r"^ *{}\b[^\n]* = {{\n(.*?)^ *}}$"  # in code, to its closing brace
ENTRY = r'((?:^ +# .*\n)*)^ +"(\w+)": [^#\n]+(?:  # (.*))?$'
# meaning and default
HELP = r"(.*?)(?: \[?(?:[Dd]efault: )?((?<=efault: ).*?|(?<=\[)required)[.\]]?)?"


def pages() -> list[Path]:
    """The documents whose commands are run, in the order in which examples are looked for."""
    top = [DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"]
    written = {PAGE, *GROUPS.glob("*.md")}
    return [*top, *sorted(page for page in DOCS.rglob("*.md") if page not in written)]


def blocks(page: Path) -> list[tuple[str, str]]:
    """A page's blocks of `console` and `python`, each with its language, in order."""
    return re.findall(
        r"^```(console|python)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL
    )


def typed(block: str) -> list[tuple[str, str]]:
    """What a console block has a reader type, each with what it shows below;
    a backslash joins two lines.
    """
    lines = re.split(r"^\$ ", block.replace("\\\n", ""), flags=re.MULTILINE)[1:]
    return [(line, shown) for line, _, shown in (each.partition("\n") for each in lines)]


def all_typed() -> list[str]:
    """What the documents have a reader type, line by line."""
    found = [block for page in pages() for language, block in blocks(page) if language == "console"]
    return [line for block in found for line, _ in typed(block)]


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """All commands that do something, each with what is typed for it."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
    for name, each in (inner or {}).items():
        yield from commands(each, f"{path} {name}")


def parameters(command: Any) -> Iterator[tuple[str, str, str]]:
    """A command's arguments and options but `--help`:
    what is typed, its meaning, and its default.
    """
    context = Context(command)
    for parameter in command.get_params(context):
        name, text = parameter.get_help_record(context) or ("--help", "")
        if name != "--help":
            yield name, *re.fullmatch(HELP, " ".join(text.split())).groups("")


def shared(found: list[tuple[str, Any]]) -> dict[str, tuple[str, set[str]]]:
    """Options that several commands have:
    by what is typed, the meaning that most have, and its defaults.
    """
    meanings: dict[str, dict[str, list[str]]] = {}
    for name, meaning, default in (each for _, command in found for each in parameters(command)):
        if name.startswith("-"):
            meanings.setdefault(name, {}).setdefault(meaning, []).append(default)
    most = {
        name: max(each.items(), key=lambda item: len(item[1])) for name, each in meanings.items()
    }
    return {name: (each, {*has}) for name, (each, has) in sorted(most.items()) if len(has) > 1}


def section(path: str, command: Any, example: str, common: dict[str, tuple[str, set[str]]]) -> str:
    """A command's purpose, its arguments and options with their defaults, and an example."""
    usage = " ".join([path, *command.collect_usage_pieces(Context(command))])
    own, named = [], []
    flags = [name.split()[0] for name in common]
    for name, meaning, default in parameters(command):
        usual, defaults = common.get(name, ("", {default}))
        if meaning != usual:
            own.append(_item(name, meaning, default))
            continue
        flag = name.split()[0]
        shown = f"`{flag if flags.count(flag) == 1 else name}`"
        named.append(f"{shown} ({_plain(default)})" if default and len(defaults) > 1 else shown)
    if named:
        own.append(f"- [shared]({to_shared(path)}): {', '.join(named)}")
    lines = [f"## {path}", "", command.help, "", "```text", usage, "```", "", *own, ""]
    return "\n".join([*lines, "```console", f"$ {example}", "```", ""])


def group(path: str) -> str:
    """The word of a command's group, such as `study`; none for a command by itself."""
    _, word, *rest = path.split()
    return word if rest else ""


def to_shared(path: str) -> str:
    """Where the shared options are, for a command's page."""
    return "../commands.md#shared-options" if group(path) else "#shared-options"


def shared_section(common: dict[str, tuple[str, set[str]]]) -> str:
    """What options mean that several commands have."""
    items = (
        _item(name, meaning, *defaults if len(defaults) == 1 else ("",))
        for name, (meaning, defaults) in common.items()
    )
    return "\n".join([SHARED, *items, ""])


def overview(found: list[tuple[str, Any]]) -> str:
    """Every command with the first sentence of its purpose, in the groups of `--help`."""
    lines = ["| command | what it does |", "|---|---|"]
    for panel, names in panels().items():
        lines.append(f"| **{panel}** | |")
        for path, command in found:
            if path.split()[1] in names:
                purpose = _plain(re.split(r"\.\s", command.help)[0].rstrip("."))
                page = f"commands/{group(path)}.md" if group(path) else ""
                lines.append(f"| [{path}]({page}#{path.replace(' ', '-')}) | {purpose} |")
    return "\n".join([*lines, ""])


def reference() -> dict[Path, str]:
    """The pages' texts by their files: the first has all commands in a table."""
    lines = [" ".join(line.partition(" #")[0].split()) for line in all_typed()]
    found = list(commands(get_command(app), "harness"))
    # A command without an example ends this here: the documents have to show each of them.
    examples = {
        path: next(line for line in lines if f"{line} ".startswith(f"{path} ")) for path, _ in found
    }
    common = shared(found)
    sections: dict[str, list[str]] = {}
    for path, command in found:
        text = section(path, command, examples[path], common)
        sections.setdefault(group(path), []).append(text)
    alone = sections.pop("")
    tree = TREE.format("\n".join(f"commands/{word}" for word in sections))
    pages = {PAGE: "\n".join([HEAD, overview(found), tree, shared_section(common), *alone])}
    for word, texts in sections.items():
        head = GROUP_HEAD.format(word)
        pages[GROUPS / f"{word}.md"] = "\n".join([head, *texts])
    return pages


def names() -> str:
    """The page of what statuses, repairs and metrics are called, and mean."""
    suffixes = [f"_{role}" for role in roles()]
    others = tuple(suffix for suffix in suffixes if suffix != "_ego")
    statuses = [(f"`{status}`", _plain(status.meaning)) for status in Status]
    repairs = [(f"`{repair}`", _plain(repair.meaning)) for repair in Repair]
    metrics = [
        (f"`{name}`", _plain(metric.meaning), metric.better, metric.world or "")
        for name, metric in METRICS.of_harness.items()
        if not name.endswith(others)
    ]
    metrics_head = METRICS_HEAD.format(", ".join(f"`{suffix}`" for suffix in suffixes))
    sections = [
        ("## Statuses\n", _table([("status", "meaning"), *statuses])),
        ("## Repairs\n", _table([("repair", "meaning"), *repairs])),
        (
            f"## Metrics\n\n{metrics_head}",
            _table([("metric", "meaning", "better", "only"), *metrics]),
        ),
    ]
    return "\n".join([NAMES_HEAD, *("\n".join(section) for section in sections)])


def settings() -> str:
    """The page of the settings of a condition, with their defaults."""
    kinds, part_of = {**PARTS, **more_parts()}, part_of_settings()
    rows = []
    for name in typed_settings():
        meaning = attributes(kinds[part_of[name]])[name]
        rows.append(
            (f"`{name}`", _default(POINTS["v2x"].setting(name)), _plain(meaning.rstrip(".")))
        )
    return f"{SETTINGS_HEAD}\n{_table([('setting', 'default', 'meaning'), *rows])}"


def _default(value: Any) -> str:
    words = {None: "none", "": "none", False: "false"}
    return f"{value:g}" if type(value) in (int, float) else words.get(value, f"`{value}`")


def fields() -> str:
    """The page of what the keys and columns of a run's files mean, by the comments beside them."""
    from harness.extensions.studies.attribution.record import Attribution, LeftOut

    optional = ", ".join(f"`{name}`" for name in decisions.OPTIONAL)
    sections = {
        RUN_HEAD: run_keys(),
        "### `world` of a frozen run\n": meanings(records.FrozenScenes),
        "### `world` of a closed-loop run\n": meanings(records.ClosedLoop),
        "### An entry of `channels`\n": meanings(records.ChannelRecord),
        "### `latency`\n": meanings(records.Latency),
        "### An entry of `answer_times`\n": meanings(records.Times),
        "### An entry of `cost`\n": meanings(records.Cost),
        SUMMARY_HEAD: meanings(records.Variant, records.Score),
        DIFFICULTY_HEAD: meanings(Layout),
        EPISODES_HEAD: meanings(records.Variant, records.Episode),
        JOURNEYS_HEAD: meanings(End),
        DECISIONS_HEAD.format(optional): decision_columns(),
        ANSWERS_HEAD: meanings(records.Answer),
        "### `first`\n": meanings(records.FirstTurn),
        ATTRIBUTION_HEAD: meanings(Attribution),
        "### An entry of `left_out`\n": meanings(LeftOut),
    }
    texts = [FIELDS_HEAD]
    for head, each in sections.items():
        rows = [(f"`{name}`", _plain(meaning.rstrip("."))) for name, meaning in each.items()]
        texts.append(f"{head}\n{_table([('name', 'meaning'), *rows])}")
    return "\n".join(texts)


def meanings(*kinds: type) -> dict[str, str]:
    """What the fields of records mean, by the names that files have for them; a field without a
    comment ends this here.
    """
    found: dict[str, str] = {}
    for kind in kinds:
        comments = attributes(kind)
        tag = kind.__struct_config__.tag
        if tag:
            found[kind.__struct_config__.tag_field] = f"`{tag}`"
        for name, in_file in zip(
            kind.__struct_fields__, kind.__struct_encode_fields__, strict=True
        ):
            found[in_file] = comments[name]
    return found


def run_keys() -> dict[str, str]:
    """What the keys of run.json mean; what settings of extensions opened stands among them."""
    found = meanings(records.Manifest)
    del found["beside"]
    settings = extensions.beside()
    for name in formats.BESIDE.values():
        _, *behind = extensions.in_order([name])
        for each in behind:
            purpose = re.split(r"\.\s", settings[each].help)[0]
            found[each] = f"what the setting of this name names: {purpose}"
    return found


def decision_columns() -> dict[str, str]:
    """What the columns of a table of decisions mean, those that timers add with them."""
    comments = attributes(records.Decision) | entry_comments(decisions, "COLUMNS")
    found = {name: comments[name] for name in decisions.COLUMNS}
    for timer in TIMERS.values():
        added = entry_comments(type(timer), "adds")
        found |= {name: added[name] for name in timer.adds}
    of_actions = entry_comments(decisions, "OF_ACTIONS")
    found |= {f"{name}_ACTION": of_actions[name] for name in decisions.OF_ACTIONS}
    of_messages = attributes(records.Message) | entry_comments(decisions, "OF_MESSAGES")
    return found | {f"{name}_N": of_messages[name] for name in decisions.OF_MESSAGES}


def entry_comments(source: Any, table: str) -> dict[str, str]:
    """The comments beside or above the entries of a table in a module or a class, by their keys."""
    text = inspect.getsource(source)
    entries = re.search(TABLE.format(table), text, re.MULTILINE | re.DOTALL)[1]
    found = re.findall(ENTRY, entries, re.MULTILINE)
    return {
        name: beside or " ".join(above.replace("#", " ").split())
        for above, name, beside in found
        if above or beside
    }


def cards() -> str:
    """The page of the cards to copy, each with what its file says of it and who published that."""
    rows: dict[str, list[tuple[str, ...]]] = {TEXTS_HEAD: [], SEE_HEAD: [], DECIDE_HEAD: []}
    for file in sorted(CARDS.glob("*.toml")):
        text = file.read_text()
        card = tomllib.loads(text)
        decides = card["engine"] == "systemone"
        head = DECIDE_HEAD if decides else SEE_HEAD if "vision" in card else TEXTS_HEAD
        comment = _plain(" ".join(re.findall(r"^# (\w.*)", text, re.MULTILINE)))
        link = f"[{file.stem}](cards/{file.name})"
        rows[head].append((link, _plain(card["description"]), card["licence"], comment))
    columns = ("card", "what it is", "licence", "who says so")
    sections = (f"{head}\n{_table([columns, *each])}" for head, each in rows.items())
    return "\n".join([CARDS_HEAD, *sections])


def _table(rows: list[tuple[str, ...]]) -> str:
    """Rows as a table of Markdown, of which the first is its head."""
    rule = ("---",) * len(rows[0])
    lines = [" | ".join(row) for row in (rows[0], rule, *rows[1:])]
    return "".join(f"| {line} |\n" for line in lines)


def _item(name: str, meaning: str, default: str) -> str:
    stated = (
        f" Default: {default}." if default not in ("", "required") else " Required." * bool(default)
    )
    return f"- `{name}`: {_plain(meaning + stated)}"


def _plain(text: str) -> str:
    return re.sub(r"([<>|*\[\]])", r"\\\1", " ".join(text.split()))


if __name__ == "__main__":
    GROUPS.mkdir(exist_ok=True)
    for file, text in reference().items():
        file.write_text(text)
    NAMES_PAGE.write_text(names())
    SETTINGS_PAGE.write_text(settings())
    FIELDS_PAGE.write_text(fields())
    CARDS_PAGE.write_text(cards())
