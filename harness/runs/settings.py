"""State the settings of an evaluation as a user types them:
one record for commands and a run's file.

Each field of `Settings` is an option of `harness eval` or `harness drive`,
with its help and its panel there.
"""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from inspect import isfunction
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

from msgspec import Meta, Struct, structs, to_builtins

from harness.core import extensions
from harness.core.at_once import AtOnce, at_once_of
from harness.core.config import convert, toml
from harness.core.errors import UserError, in_range, printable, sayable, unknown
from harness.core.extensions import Setting, setting_of_run, tables_of_settings
from harness.core.plugins import say_once
from harness.core.resources import DATASET, card_to_copy, names
from harness.core.seeds import LAST_SEED
from harness.runs import formats
from harness.runs.formats import EXTENSIONS

FILE = "run.toml"
COMMANDS = {"frozen": "eval", "closed-loop": "drive"}  # by the world's kind
MOST_SEEDS = 1000

CONDITIONS, EPISODES, ANSWERS = "Conditions", "Episodes", "How models answer"
HELPERS, ENGINE, LATENCY, OUTPUT = "Helpers", "Engines and servers", "Latency", "Output"
OF_EXTENSION = "Extension "  # and its name: the heading of the options that it adds


# What of a setting is the same when a stopped run resumes: itself, what it opens (a run states
# that), or nothing.
ITSELF, OPENED, NOTHING = "itself", "opened", "nothing"
ONLY_TYPED = ("server", "answers")  # settings that no file gives, since a stranger may have made it


def option(
    text: str,
    panel: str = "",
    only: str = "",
    listed: bool = False,
    same: str = ITSELF,
    compared: bool = True,
) -> Meta:
    """Describe a setting of `Settings` as metadata of its field.

    Args:
        text: the help of its command-line option.
        panel: the heading that the help stands below; empty for the first.
        only: the world that alone has the setting, `frozen` or `closed-loop`; empty for both.
        listed: whether it is a text of names with commas, and its option may be repeated.
        same: what of it must be equal when a stopped run resumes: the value (`ITSELF`), what it
            names, such as a model's weights (`OPENED`), or `NOTHING`.
        compared: whether a comparison of two runs reports it.
    """
    in_command = {"help": text, "panel": panel, "only": only, "listed": listed}
    return Meta(extra={**in_command, "same": same, "compared": compared})


class FrozenSettings(Struct, frozen=True, kw_only=True, tag_field="kind", tag="frozen"):
    """Hold the settings of a frozen run's episodes: the dataset, and which of it to use.

    A frozen run is on recorded scenes.
    """

    dataset: Annotated[
        str,
        option(
            "Name of a shipped dataset, a dataset's folder, or suite:NAME for several datasets at "
            "once."
        ),
    ] = DATASET
    limit: Annotated[
        int | None, option("Use only this many episodes, from the first. Default: all.")
    ] = None


class DriveSettings(Struct, frozen=True, kw_only=True, tag_field="kind", tag="closed-loop"):
    """Hold the settings of a closed-loop run's episodes: the scenario and its layouts.

    In closed loop a simulator plays the episodes.
    """

    scenario: Annotated[
        str | None,
        option(
            "Scenario to drive; NAME:beacon_loss=0.3 changes its beacons. Default: "
            "occluded-intersection, with the scenes of occluded-intersection-v3."
        ),
    ] = None
    episodes: Annotated[
        int | None,
        option(
            "Number of layouts to drive. Default: as many as the scenario's shipped dataset has."
        ),
    ] = None
    first_seed: Annotated[
        int | None,
        option(
            "Layout seed of the first episode. Default: that of the scenario's shipped dataset.",
            EPISODES,
        ),
    ] = None


class Settings(Struct, frozen=True, kw_only=True):
    """Hold all settings of an evaluation as plain values, as a run's `run.toml` does.

    They are checked where they are used: `resolve.spec` opens what they name.
    """

    model: Annotated[
        str,
        option(
            "Model: a card name (`harness model list` shows them), a checkpoint directory, a "
            ".gguf file, a hub id, the URL of a server such as http://127.0.0.1:8080/v1, or "
            "replay:RUN, which scores the stored answers of a run again.",
            same=OPENED,
        ),
    ] = "proxy"
    engine: Annotated[
        str | None,
        option(
            "Engine to run the model on, such as llama-cpp, if its card names several. Default: "
            "its main one.",
            ENGINE,
            same=OPENED,
            compared=False,
        ),
    ] = None
    prompt: Annotated[
        str | None,
        option(
            "Prompt version; `harness prompt list` shows them. Default: the scenario's usual one.",
            same=OPENED,
        ),
    ] = None
    world: FrozenSettings | DriveSettings = FrozenSettings()
    seeds: Annotated[
        str,
        option(
            "Channel seeds: 0:5 means 0 to 4; 3,7,9 is a list. Every episode is scored with each "
            "seed.",
            same=OPENED,
            compared=False,
        ),
    ] = "0:5"
    condition: Annotated[
        tuple[str, ...],
        option(
            "Condition to score: an operating point such as single-local, v2x or 6g, or one with "
            "changed settings: 6g:consensus=ego-prompt. Repeatable. Default: all operating points.",
            same=OPENED,
            compared=False,
        ),
    ] = ()
    answer: Annotated[
        str,
        option(
            "How the model answers. json: free text with a JSON object. constrained: decoding "
            "allows only what fits the schema. readout: the intent is read from the probabilities "
            "of one letter per action. decision: the same of a typed question, which decision "
            "models answer.",
            same=OPENED,
        ),
    ] = "json"
    answers: Annotated[
        str | None,
        option(
            "File of answers that another program wrote, a JSON line each; --model is then the "
            "name of what answered. Questions that it lacks are written to questions.jsonl in "
            "--out: answer them, add them to the file, and type the same command again.",
            ANSWERS,
            "frozen",
            same=OPENED,
        ),
    ] = None
    thinking: Annotated[bool, option("Ask the model to think before it answers.", same=OPENED)] = (
        False
    )
    image: Annotated[
        str,
        option(
            "Which picture an image prompt shows: own (the viewer's), blank, another (another "
            "scene's), or none (text only).",
            ANSWERS,
            same=OPENED,
        ),
    ] = "own"
    letters: Annotated[
        str | None,
        option(
            "How the letters of a readout or decision are read. raw: once. cyclic: averaged over "
            "as many orders of the list as there are actions, so that none is preferred. Default: "
            "the card's, or cyclic.",
            ANSWERS,
            same=OPENED,
        ),
    ] = None
    flip: Annotated[
        bool,
        option(
            "Ask each readout or decision once more with the list of actions reversed, and count "
            "how often the likeliest action changes. It changes no decision.",
            ANSWERS,
            same=OPENED,
        ),
    ] = False
    sums: Annotated[
        str,
        option(
            "What becomes of an answer in json whose only fault is that its numbers do not sum to "
            "1. refuse: it failed. divide: they are divided by their sum, and the summary counts "
            "it as divided.",
            ANSWERS,
            same=OPENED,
        ),
    ] = "refuse"
    batch_size: Annotated[
        AtOnce,
        option(
            "Number of prompts in one batch; with a served model, of requests to each server at "
            "once, or auto: as many as it takes well.",
            ENGINE,
            compared=False,
        ),
    ] = 8
    server: Annotated[
        tuple[str, ...],
        option(
            "Base URL of a server of the model, such as http://gpu-1:8000/v1; replaces the "
            "card's. Repeat it to spread the requests over several servers.",
            ENGINE,
            same=NOTHING,
        ),
    ] = ()
    device: Annotated[
        str | None,
        option(
            "Where the model runs: cpu, cuda or cuda:N; with llama-cpp cpu or gpu. Default: a GPU "
            "if there is one.",
            ENGINE,
            same=NOTHING,
        ),
    ] = None
    dtype: Annotated[
        str | None,
        option(
            "Number format of the weights: float32, bfloat16 or auto. Default: the card's.", ENGINE
        ),
    ] = None
    temperature: Annotated[
        float, option("Sampling temperature, 0 to 2; 0 is greedy decoding.", ANSWERS, "frozen")
    ] = 0.0
    sampling_seed: Annotated[
        int, option("Seed of the sampling; needs a --temperature above 0.", ANSWERS, "frozen")
    ] = 0
    latency: Annotated[
        str | None,
        option(
            "Inference time of one answer: paper (145 ms), card (what the card states), measured "
            "(batch 1 on this machine, which must be idle), or seconds: "
            "ego=0.2,helper=0.1,fusion=0.3. Default: card, or paper if the card states none.",
            LATENCY,
        ),
    ] = None
    ask: Annotated[
        str,
        option(
            "Which helpers answer. used: those whose answer some condition uses. all: every "
            "helper in every scene, which gives the same decisions and lets other conditions be "
            "scored later without the model.",
            HELPERS,
            compared=False,
        ),
    ] = "used"
    ties: Annotated[
        str | None,
        option(
            "Which of equally likely actions the ego takes. drawn: one by chance, with the same "
            "draws for every condition, prompt and model. first: the most careful. Default: "
            "drawn, or as in the run that is replayed.",
            CONDITIONS,
        ),
    ] = None
    tag: Annotated[
        tuple[str, ...], option("Label to find the run by later. Repeatable.", OUTPUT, same=NOTHING)
    ] = ()
    # what extensions add, by the name of the option
    extensions: dict[str, str | int | float | bool | tuple[str, ...]] = {}


class Option(NamedTuple):
    """Describe a command-line option, made from a field of the settings.

    `path` is its place in `run.toml`, `name` that of the parameter, `kind` its Python type,
    `default` its value if it is not typed, and `panel` the heading of its `help`. `listed` says
    whether it may be typed several times, `same` what of it must be equal when a stopped run
    resumes, and `compared` whether a comparison of two runs reports it. `models` says that it names
    models, `is_added` that an extension adds it.
    """

    path: tuple[str, ...]  # the names of the table and the key in `run.toml`
    name: str  # as a parameter: batch_size
    kind: Any  # str, int, float, bool, list[str], or a function of what is typed
    default: Any  # the value if it is not typed
    help: str  # its help on the command line
    panel: str  # the heading that the help stands below
    listed: bool  # whether it may be typed several times, which are joined by commas
    same: str  # what is the same when a stopped run resumes: `ITSELF`, `OPENED` or `NOTHING`
    compared: bool  # whether a comparison of two runs tells it
    models: bool = False  # whether its value names models
    is_added: bool = False  # whether an extension adds it

    @property
    def is_parsed(self) -> bool:
        return isfunction(self.kind)

    @property
    def flag(self) -> str:
        return "--" + self.name.replace("_", "-")

    @property
    def off(self) -> str:
        """Return what is typed to turn a yes-or-no option off, such as `--no-flip`."""
        return "--no-" + self.name.replace("_", "-")

    def of(self, settings: Any) -> Any:
        if self.is_added:
            return settings.extensions.get(self.name, self.default)
        for name in self.path:
            settings = getattr(settings, name)
        return settings

    def words(self, value: Any) -> list[str]:
        """Return the command-line arguments that give the option `value`; none for None.

        They are the option's name and the value, once for each value of a list.
        """
        if isinstance(value, bool):
            return [self.flag if value else self.off]
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        return [word for part in values for word in (self.flag, str(part))]


def options(world: type[Struct]) -> list[Option]:
    """Return the options of a command, in the order of fields; extensions' last.

    `world` is `FrozenSettings` for `harness eval` and `DriveSettings` for `harness drive`. An
    option of an extension that says which of the core's it stands behind follows that one.
    """
    by_path = {".".join(each.path): each for each in core_options(world)}
    declared, last, kind = list[Option](), list[Option](), str(world.__struct_config__.tag)
    beside = extensions.beside()
    names_beside = {setting.path(name): name for name, setting in beside.items()}
    for path in extensions.in_order(by_path):
        if path in by_path:
            declared.append(by_path[path])
            continue
        name = names_beside[path]
        if beside[name].only in ("", kind):
            declared.append(_added(name, beside[name], tuple(path.split("."))))
    for name, setting in of_extensions().items():
        if name not in beside and setting.only in ("", kind):
            last.append(_added(name, setting, (EXTENSIONS, name)))
    return [*declared, *last]


def _added(name: str, setting: Setting, path: tuple[str, ...]) -> Option:
    """Return the option of a setting that an extension adds, below the extension's name."""
    owners = extensions.extensions().values()
    panel = next(OF_EXTENSION + owner.name for owner in owners if name in owner.settings)
    kind = list[str] if setting.kind is tuple else setting.kind
    shape = (kind, setting.default, setting.help, panel, setting.listed, ITSELF, True)
    return Option(path, name, *shape, models=setting.models, is_added=True)


def core_options(world: type[Struct]) -> list[Option]:
    """Return the options of a command, in the order of fields, without those of extensions.

    `world` is `FrozenSettings` for `harness eval` and `DriveSettings` for `harness drive`.
    """
    return [*_options(Settings, str(world.__struct_config__.tag), {"world": world})]


def of_extensions() -> dict[str, Setting]:
    """Return the settings of runs that extensions add, by name.

    One that has the name of a setting of the core is left out.
    """
    joined = extensions.joined(HELP, "settings")
    return {name: setting for name, setting in joined.items() if name not in HELP}


def _options(
    kind: type[Struct], only: str, tables: Mapping[str, type[Struct]], table: str = ""
) -> Iterator[Option]:
    hints = get_type_hints(kind, include_extras=True)
    for field in structs.fields(kind):
        if field.name in tables:
            yield from _options(tables[field.name], only, {}, field.name)
            continue
        if field.name == EXTENSIONS:
            continue
        plain, meta = get_args(hints[field.name])
        if meta.extra["only"] in ("", only):
            path = (table, field.name) if table else (field.name,)
            facts = [meta.extra[key] for key in ("help", "panel", "listed", "same", "compared")]
            each = Option(path, field.name, _kind(plain), field.default, *facts)
            yield each._replace(models=field.name == "model")


def _kind(plain: Any) -> Any:
    if plain == AtOnce:
        return at_once_of
    if isinstance(plain, UnionType):
        plain = get_args(plain)[0]
    return list[str] if get_origin(plain) is tuple else plain


def kind_of(settings: Settings) -> str:
    """Return the kind of world: `frozen` (recorded scenes) or `closed-loop` (a simulator)."""
    return str(settings.world.__struct_config__.tag)


WORLDS: dict[str, type[FrozenSettings] | type[DriveSettings]] = {
    "frozen": FrozenSettings,
    "closed-loop": DriveSettings,
}
HELP = {each.name: each.help for world in WORLDS.values() for each in core_options(world)}
# The settings that open nothing, and are the same when a stopped run resumes.
PLAIN = dict.fromkeys(
    each.name
    for world in WORLDS.values()
    for each in core_options(world)
    if len(each.path) == 1 and each.same == ITSELF
)

# What a comparison of two runs tells, by the key in `run.toml`; of worlds it tells the scenes.
COMPARED = dict.fromkeys(
    each.path[0]
    for world in WORLDS.values()
    for each in core_options(world)
    if each.compared and each.same != NOTHING and each.path[0] != "world"
) | {EXTENSIONS: None}


def changed(settings: Settings, given: Mapping[str, Any]) -> Settings:
    """Return settings with some values replaced: `given` has the new ones by name of the option.

    Raises UserError for a value of a wrong type.
    """
    tables: dict[str, Any] = to_builtins(settings)
    for each in options(type(settings.world)):
        if each.name not in given:
            continue
        if each.is_added:
            tables[EXTENSIONS][each.name] = given[each.name]
        else:
            table = tables if len(each.path) == 1 else tables[each.path[0]]
            table[each.path[-1]] = given[each.name]
    return convert(formats.gathered(tables), Settings, "settings")


def deciding(settings: Settings) -> Settings:
    """Return the settings that must be equal when a stopped run resumes.

    All others, such as tags and the addresses of servers, are set to their defaults, so that two
    results can be compared.
    """
    declared = options(type(settings.world))
    free = {option.name: option.default for option in declared if option.same == NOTHING}
    return structs.replace(settings, **free)


def words(settings: Settings) -> tuple[str, ...]:
    """Return the command line that gives these settings: `harness`, `eval` or `drive`, and options.

    Options at their default and `--out` are left out.
    """
    typed: list[str] = []
    for option in options(type(settings.world)):
        value = option.of(settings)
        if value != option.default:
            typed += option.words(value)
    return ("harness", COMMANDS[kind_of(settings)], *typed)


def difference(before: Settings, now: Settings) -> tuple[str, str]:
    """Return the options in which a stopped run and the command typed now differ, as two texts.

    They are as typed `before` and `now`. Those that may differ when a run resumes are left out;
    both texts are empty for different commands.
    """
    if type(before.world) is not type(now.world):
        return "", ""
    typed_before, typed_now = list[str](), list[str]()
    for option in options(type(now.world)):
        old, new = option.of(before), option.of(now)
        if old != new and option.same != NOTHING:
            typed_before.append(" ".join(option.words(old)) or f"no {option.flag}")
            typed_now.append(" ".join(option.words(new)) or f"no {option.flag}")
    return " ".join(typed_before), " ".join(typed_now)


def of_words(typed: Sequence[str]) -> Settings:
    """Return the settings that a command line gives, for the `command` that a run states.

    `typed` has its words, the program's name first. Raises UserError if `words` would write the
    settings otherwise.
    """
    try:
        kind = next(kind for kind, command in COMMANDS.items() if command == typed[1])
        flags = {flag: each for each in options(WORLDS[kind]) for flag in (each.flag, each.off)}
        given: dict[str, Any] = {}
        rest = iter(typed[2:])
        for flag in rest:
            option = flags[flag]
            if option.kind is bool:
                given[option.name] = flag == option.flag
            elif option.kind == list[str]:
                given[option.name] = [*given.get(option.name, ()), next(rest)]
            else:
                given[option.name] = option.kind(next(rest))
    except (IndexError, KeyError, StopIteration, ValueError):
        raise UserError(f"{printable(' '.join(typed))} is no command of a run") from None
    return changed(Settings(world=WORLDS[kind]()), given)


def text_of(settings: Settings) -> str:
    """Return the text of a `run.toml` with every setting that has a value, defaults included."""
    beside = [word for words in _only_typed(settings).values() for word in words]
    again = _again(settings, Path(FILE), beside)
    lines = [f"# The settings of a run. `{again}` runs it again; an option beside it wins."]
    tables: dict[str, list[str]] = {"": []}
    for option in options(type(settings.world)):
        value = option.of(settings)
        *table, key = option.path
        rows = tables.setdefault("".join(table), [])
        if value not in (None, ()):
            rows.append(f"{key} = {_toml(value)}")
    tables["world"].insert(0, f"kind = {_toml(kind_of(settings))}")
    for name, rows in tables.items():
        if name and rows:
            lines.append(f"\n[{name}]")
        lines += rows
    return "\n".join(lines) + "\n"


def _again(settings: Settings, file: Path, beside: Sequence[str]) -> str:
    """Return the command that runs a file of settings, with what is typed beside it."""
    return printable(shlex.join(["harness", COMMANDS[kind_of(settings)], str(file), *beside]), 2000)


def _only_typed(settings: Settings) -> dict[str, list[str]]:
    """Return what a file names and only a user may, as words by option:
    models that are no cards, servers.

    A replay reads another run's answers and opens none.
    """
    named: dict[str, list[str]] = {}
    for each in options(type(settings.world)):
        value = each.of(settings)
        is_label = each.name == "model" and bool(settings.answers)
        if each.models and not is_label:
            models = filter(None, map(str.strip, (value or "").split(",")))
            allowed = all(model.startswith("replay:") or _is_card(model) for model in models)
        else:
            allowed = each.name not in ONLY_TYPED or not value
        if not allowed:
            named[each.name] = each.words(value)
    return named


def _toml(value: Any) -> str:
    # JSON writes what TOML reads, except that TOML wants DEL escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def read(file: Path, world: type[Struct], given: Mapping[str, Any]) -> Settings:
    """Return the settings of a `run.toml`, or of a run's folder, with typed options `given` on top.

    `world` is `FrozenSettings` for `harness eval` and `DriveSettings` for `harness drive`; `given`
    has values by name of the option. A file may come from a stranger, so it may name models by
    their files (cards), prompts, datasets, what extensions open and runs to replay, but no other
    model to open and no server to ask. Raises UserError if it cannot be read, is of another
    command, or names what only a user may.
    """
    sayable("settings", file.name)
    place, file = file, file / FILE if file.is_dir() else file
    where = f"settings {printable(file)}"
    if not file.exists():
        if _is_dataset(str(place)):
            words = printable(shlex.join(["harness", "eval", "--dataset", str(place)]), 2000)
            raise UserError(f"{printable(place)} is a dataset, and no settings; type `{words}`")
        if (address := re.match(r"(https?):/+(.+)", str(place))) is not None:
            raise UserError(
                f"{printable(place)} is a server, and no settings; give its address with --model: "
                f"{address[1]}://{printable(address[2], 200)}"
            )
        if _is_card(str(place)) or str(place).startswith("replay:"):
            command = COMMANDS[str(world.__struct_config__.tag)]
            words = printable(shlex.join(["harness", command, "--model", str(place)]), 2000)
            raise UserError(f"{printable(place)} is a model, and no settings; type `{words}`")
        raise UserError(
            f"{where}: there is no such file; give a {FILE} or the folder of a run that has one, "
            "which runs have since 0.3; for another, type the command in its run.json"
        )
    tables = _placed(toml(file, where), world, where)
    file_settings = convert(formats.gathered(tables), Settings, where)
    settings = changed(_as_driven(file_settings, file.parent), given)
    if not isinstance(settings.world, world):
        raise UserError(f"{where} are of `harness {COMMANDS[kind_of(settings)]}`; type that")
    check_extensions(settings, where)
    if file.name == FILE and (file.parent / "run.json").is_file():
        _say_otherwise(changed(file_settings, given), file, given)
    typed_only = {name: words for name, words in _only_typed(settings).items() if name not in given}
    if typed_only:
        flag, value, *_ = beside = [word for words in typed_only.values() for word in words]
        for model in value.split(","):
            if lost := card_to_copy(model.strip()):
                raise UserError(f"{where}: {lost}")
        reasons = {
            "--server": "is a server, and a file asks none",
            "--answers": "is a file of answers, and a file opens no other",
        }
        reason = reasons.get(flag, "is none of your cards, and a file opens no other model")
        what = f"{printable(value)} {reason}"
        raise UserError(
            f"{where}: {what} by itself; if you want it, type `{_again(settings, file, beside)}`"
        )
    return settings


def _is_dataset(name: str) -> bool:
    """Return whether `--dataset` would take a text: a folder, a name that ships, or a suite's."""
    from harness.dataset.load import find
    from harness.dataset.suites import datasets

    with suppress(UserError):
        return all((find(each) / "manifest.json").is_file() for each in datasets(name))
    return False


def otherwise(folder: Path, made_with: Settings) -> str | None:
    """Return a sentence if a folder's `run.toml` has other settings than its run was made with.

    `made_with` are the settings in the run's `run.json`. None if the file agrees, or is missing.
    """
    file = folder / FILE
    if not file.exists():
        return None
    where = f"settings {printable(file)}"
    try:
        tables = _placed(toml(file, where), type(made_with.world), where)
        file_settings = convert(formats.gathered(tables, of_run=True), Settings, where)
        before, now = difference(made_with, file_settings)
    except UserError as error:
        return f"{error}."
    if before == now:
        return None
    return f"{FILE} has {printable(now)}, and run.json beside it has {printable(before)}."


def _say_otherwise(settings: Settings, file: Path, given: Mapping[str, Any]) -> None:
    """Say on stderr what a run's file states otherwise than its `run.json`."""
    from harness.runs.folder import read as run_of

    with suppress(UserError):  # who needs the run says what is wrong with it
        made_with = changed(run_of(file.parent).manifest.settings, given)
        before, now = difference(made_with, settings)
        if before != now:
            say_once(
                f"settings {printable(file)}: it has {printable(now)}, and run.json beside it has "
                f"{printable(before)}; {FILE} is taken"
            )


def check_extensions(settings: Settings, where: str) -> None:
    """Raise UserError if settings of extensions are unknown, of a wrong type or of another command.

    `where` names the file or option that states them, for the error.
    """
    known_settings = of_extensions()
    names = {each.name for each in options(type(settings.world)) if each.is_added}
    for name, value in settings.extensions.items():
        if name not in known_settings:
            nearest = get_close_matches(name, names, n=1)
            suggestion = f"; did you mean {nearest[0]!r}?" if nearest else ""
            raise UserError(
                f"{where}: {printable(name)} is a setting of an extension that is not installed; "
                f"install that, or leave the setting out{suggestion}"
            )
        if name not in names:
            command = f"harness {COMMANDS[kind_of(settings)]}"
            raise UserError(f"{where}: {name} is no setting of `{command}`; leave it out")
        setting = known_settings[name]
        kind, place = setting.kind, setting.path(name)
        if type(value) is not kind and not (kind is float and type(value) is int):
            allowed = "a list of texts" if kind is tuple else kind.__name__
            raise UserError(f"{where}: {place} = {printable(repr(value))}; allowed: {allowed}")


def _placed(tables: dict[str, Any], world: type[Struct], where: str) -> dict[str, Any]:
    """Return the tables of a file, with the kind of episodes that its command has,
    if it states none.

    Raises UserError if an option stands outside of its table, or if a key is unknown.
    """
    kind = str(world.__struct_config__.tag)
    keys_by_table = {"": {*Settings.__struct_fields__}, "world": {"kind"}}
    for each in options(world):
        table, *inner = each.path
        for key in {each.name, each.flag.removeprefix("--")} & tables.keys() if inner else ():
            raise UserError(
                f"{where}: {key} stands in a table; write {inner[0]} below a line [{table}] instead"
            )
        keys_by_table[""].add(table)
        is_there = _is_in(tables.get(table) if inner else tables, each.path[-1])
        if is_there and table != EXTENSIONS and _is_in(tables.get(EXTENSIONS), each.name):
            raise UserError(
                f"{where}: {'.'.join(each.path)} stands by name in [{EXTENSIONS}], too; leave one "
                "of both out"
            )
        if inner and table != EXTENSIONS:  # whose keys `check_extensions` looks at
            keys_by_table.setdefault(table, set()).add(inner[0])
    section = tables.get("world", {})
    if not isinstance(section, dict):
        return tables
    if section.get("kind", kind) == kind:
        for table, keys in keys_by_table.items():
            _refuse_unknown(tables, table, keys, where)
    return {**tables, "world": {"kind": kind, **section}}


def _is_in(table: Any, key: str) -> bool:
    return isinstance(table, dict) and key in table


def _refuse_unknown(tables: dict[str, Any], table: str, keys: set[str], where: str) -> None:
    """Raise UserError for a key in a table of a file that is none of `keys`, nor an extension's."""
    place = f" [{table}]" if table else ""
    section = tables.get(table, {}) if table else tables
    if not isinstance(section, dict):
        value = printable(repr(section))
        raise UserError(f"{where}: {table} = {value}; allowed: a table")
    for key in section:
        is_added = any(map(setting_of_run, (key, f"{table}.{key}")))
        if key not in keys and not is_added and (table or key not in tables_of_settings()):
            raise unknown(f"key in {where}{place}", key, keys)


def _as_driven(settings: Settings, run: Path) -> Settings:
    """Return settings whose scenario states the scenes that a run has,
    if it is the run's and does not.

    The first runs with such a file name it barely, by a name that has come to mean other scenes.
    """
    from harness.runs.folder import read as run_of
    from harness.runs.records import ClosedLoop
    from harness.world import scenarios
    from harness.world.parameters import SCENES

    name, typed = scenarios.split(getattr(settings.world, "scenario", None) or "")
    missing = [key for key in SCENES if f"{key}=" not in (typed or "")]
    if not (missing and scenarios.is_here(name) and (run / "run.json").is_file()):
        return settings
    world = run_of(run).manifest.world
    if not isinstance(world, ClosedLoop) or world.scenario["name"] != name:
        return settings
    scenario = scenarios.of_manifest(name, world.scenario["parameters"])
    scenes = [
        f"{key}={getattr(scenario.parameters, key)}" for key in missing if key in scenario.dials
    ]
    return changed(
        settings, {"scenario": f"{name}:{','.join([*([typed] if typed else []), *scenes])}"}
    )


def _is_card(model: str) -> bool:
    return model.partition(":")[0] in names("models")


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as `0:5`, which is 0 to 4, or `3,7,9`.

    Raises UserError for any other text, or more than `MOST_SEEDS` seeds.
    """
    start, colon, stop = text.partition(":")
    try:
        # A range is counted before it is made: 0:99999999999 would not fit into memory.
        most = int(start) + MOST_SEEDS + 1 if colon else 0
        seeds = tuple(
            range(int(start), min(int(stop), most)) if colon else map(int, text.split(","))
        )
    except ValueError:
        seeds = ()
    if not colon and len(seeds) == 1 and seeds != (0,):
        n, end = (printable(at, 20) for at in (seeds[0], seeds[0] + 1))
        raise UserError(
            f"--seeds {n}: give 0:{n} for seeds from 0 on, or {n}:{end} for seed {n} alone"
        )
    if not 0 < len(seeds) <= MOST_SEEDS:
        raise UserError(
            f"--seeds {printable(text)}: give a range such as 0:5, or a list such as 3,7,9, "
            f"of {MOST_SEEDS} seeds at most"
        )
    for seed in (min(seeds), max(seeds)):
        in_range("--seeds", seed, 0, LAST_SEED)
    return seeds
