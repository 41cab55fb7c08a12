"""Options that several commands have, and the options of an evaluation,
which its settings state.
"""

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Context, Option, echo

from harness.core import resources
from harness.core.errors import UserError, printable
from harness.core.extensions import owner_of_plugin
from harness.runs import settings as stated
from harness.runs.settings import HELP

if TYPE_CHECKING:
    from collections.abc import Iterable

    from harness.backends.base import AnswerMode
    from harness.backends.card import Card
    from harness.core import parallel, shards
    from harness.dataset.load import Dataset as Frozen  # Dataset is an option here
else:  # typer takes any text; what is evaluated says which are allowed
    AnswerMode = str

_RAY = "or a Ray cluster: ray, ray://HOST:PORT or ray:HOST:PORT."

Runs = Annotated[
    list[Path], Argument(help="One or more folders of finished runs.", metavar="RUN...")
]
Reports = Annotated[Path, Argument(metavar="DIR", help="Folder that holds the runs.")]
Model = Annotated[
    str,
    Option(
        help="Model: a card name (`harness model list` shows "
        "them), a checkpoint directory, a .gguf "
        "file, a "
        "hub id, or the URL of a server."
    ),
]
RunModel = Annotated[
    list[str] | None,
    Option(
        "--model",
        help="The run's model, where it is none of your cards: a checkpoint directory, a .gguf "
        "file, a hub "
        "id or a URL. Nothing that only a run names is opened or asked. Repeatable, for several "
        "models.",
    ),
]
Scenario = Annotated[
    str, Argument(help="Scenario name; `harness dataset scenario list` shows them.")
]
Engine = Annotated[str | None, Option(help=HELP["engine"])]
Prompt = Annotated[str, Option(help="Prompt version; `harness prompt list` shows them.")]
ScenarioPrompt = Annotated[str | None, Option(help=HELP["prompt"])]
RunSeeds = Annotated[
    str | None, Option("--seeds", help="Channel seeds, such as 0:5 or 3,7,9. Default: the run's.")
]
RunLatency = Annotated[
    str,
    Option(
        "--latency", help="Inference time of one answer: run (as in the run) or paper (145 ms)."
    ),
]
NoModel = Annotated[
    bool,
    Option(
        "--no-model",
        help="Never ask the model: leave out episodes that reach a decision point without a stored "
        "answer.",
    ),
]
RunsDataset = Annotated[
    Path | None,
    Option(
        "--dataset",
        help="Folder of the run's dataset, if it has moved. Default: where the run states, or by "
        "its name.",
    ),
]
Dataset = Annotated[str, Option(help="Name of a shipped dataset, or a dataset's folder.")]
Seeds = Annotated[str, Option(help=HELP["seeds"])]
Agents = Annotated[
    str | None,
    Option(
        help="Who decides: ego, all, or the share of the others that do, as 0.5. Default: ego.",
        rich_help_panel=stated.EPISODES,
    ),
]
FirstSeed = Annotated[int, Option(help="Layout seed of the first episode; the others follow.")]
Thinking = Annotated[bool, Option("--thinking", help=HELP["thinking"])]
Answer = Annotated[AnswerMode, Option(help=HELP["answer"])]
NUMBER_OR_AUTO = "INTEGER|auto"
# Typed as `at_once_of` reads it.
BatchSize = Annotated[str, Option(metavar=NUMBER_OR_AUTO, help=HELP["batch_size"])]
Device = Annotated[str | None, Option(help=HELP["device"])]
Dtype = Annotated[str | None, Option(help=HELP["dtype"])]
Latency = Annotated[str | None, Option(help=HELP["latency"])]
Workers = Annotated[str, Option(metavar="WHO", help=f"Number of worker processes, {_RAY}")]
ModelWorkers = Annotated[
    str,
    Option(
        metavar="WHO",
        help=f"Number of worker processes, each of which loads the model, {_RAY}",
        rich_help_panel=stated.ENGINE,
    ),
]
RuleWorkers = Annotated[
    str | None,
    Option(
        metavar="WHO",
        help=f"Number of worker processes, {_RAY} For rules such as proxy, and for processes that "
        "ask "
        "servers; used on more than 256 layouts, and for the report of more than 5376 scenes. "
        "Default: 2, of "
        "servers 1.",
        rich_help_panel=stated.ENGINE,
    ),
]
PageWorkers = Annotated[
    str,
    Option(
        metavar="WHO", help=f"Number of worker processes, {_RAY} Used on more than 5376 scenes."
    ),
]


def _say_report(context: Context, is_typed: bool) -> bool:
    if is_typed and not context.resilient_parsing:
        echo(
            f"harness: `harness {context.info_name} --full` is now `harness report RUN --full`; "
            "the old spelling works until 0.5.0",
            err=True,
        )
    return is_typed


FullPage = Annotated[
    bool,
    Option(
        "--full",
        help="Write prompts that no model reads, and every decision's camera pictures, into the "
        "page too.",
    ),
]
# Of a command whose page `harness report` writes again, until 0.5.0.
OldFullPage = Annotated[bool, Option("--full", hidden=True, callback=_say_report)]
Unreachable = Annotated[
    bool,
    Option("--unreachable", help="Keep a dataset in which no course reaches the goal."),
]
Shard = Annotated[
    str | None,
    Option(
        metavar="I/N",
        help="Do only part I of N, such as 3/16; `harness run merge` joins the parts. auto/N takes "
        "I from "
        "the task number of a Slurm or Kubernetes job.",
        rich_help_panel=stated.EPISODES,
    ),
]
NoCache = Annotated[
    bool,
    Option(
        "--no-cache",
        help="Ask the model again, even for answers that an earlier run stored.",
        rich_help_panel=stated.ENGINE,
    ),
]
DryRun = Annotated[
    bool,
    Option(
        "--dry-run",
        help="Only render the prompts and count requests and tokens. With --out of `harness eval`, "
        "write the questions to questions.jsonl there for another program; else write nothing.",
        rich_help_panel=stated.OUTPUT,
    ),
]
Tokenizer = Annotated[
    Path | None,
    Option(
        help="With --dry-run: tokenizer to count with: a tokenizer.json, its folder, or a GGUF "
        "file. "
        "Default: the model's.",
        rich_help_panel=stated.OUTPUT,
    ),
]
Json = Annotated[bool, Option("--json", help="Print the result as JSON.")]
_QUIET = "Print only errors, and the JSON of --json."
Quiet = Annotated[bool, Option("--quiet", help=_QUIET)]
QuietOutput = Annotated[bool, Option("--quiet", help=_QUIET, rich_help_panel=stated.OUTPUT)]
Verbose = Annotated[
    bool,
    Option(
        "--verbose",
        help="Print every table and note, which the page has as well.",
        rich_help_panel=stated.OUTPUT,
    ),
]
Pictures = Annotated[bool, Option("--pictures", help="Also write the figures as SVG, PDF and PNG.")]


def takes(
    world: type[stated.FrozenSettings] | type[stated.DriveSettings],
    help: Mapping[str, str] = {},
    without: Collection[str] = (),
) -> Callable[[Any], Any]:
    """Return a decorator that gives a command all options of an evaluation.

    So `harness eval` and its like need not repeat them. The command's first parameter then gets a
    `Settings`. A first argument on the command line names a file of settings, or a run's folder;
    options typed beside it win.

    Args:
        world: what is evaluated, frozen (recorded) scenes or a closed loop.
        help: other help texts for some options, by name.
        without: names of options to leave out.
    """

    def decorate(command: Any) -> Any:
        def typed(file: Path | None = None, **values: Any) -> Any:
            given = {name: values.pop(name) for name in names}
            given = {name: value for name, value in given.items() if value is not None}
            given |= {name: ",".join(given[name]) for name in listed & given.keys()}
            given |= {name: parsers[name](given[name]) for name in parsers.keys() & given.keys()}
            if "scenario" in given:
                typed_scenario(given["scenario"])
            if file:
                return command(stated.read(file, world, given), **values)
            return command(stated.changed(stated.Settings(world=world()), given), **values)

        settings = [
            _parameter(each._replace(help=help.get(each.name, each.help)))
            for each in stated.options(world)
            if each.name not in (*without, *inspect.signature(command).parameters)
        ]
        names = [each.name for each in settings]
        listed = {each.name for each in stated.options(world) if each.listed}
        parsers = {each.name: each.kind for each in stated.options(world) if each.is_parsed}
        file = inspect.Parameter(
            "file",
            inspect.Parameter.KEYWORD_ONLY,
            default=Argument(
                None,
                metavar="RUN.TOML",
                help="Settings of a run: its run.toml, or its folder. Options that are typed "
                "beside it win.",
            ),
            annotation=Path | None,
        )
        others = list(inspect.signature(command).parameters.values())[1:]
        others = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in others]
        parameters = [file, *settings, *others]
        return as_command(typed, command, parameters)

    return decorate


def as_command(typed: Any, command: Any, parameters: list[inspect.Parameter]) -> Any:
    """Return the function `typed` with these parameters, and with the name and help of `command`.

    Both are functions: typer reads the first as a command, which calls the second. Options of
    extensions come last in its help.
    """
    in_order = sorted(parameters, key=_is_of_extension)
    typed.__signature__ = inspect.Signature(in_order)
    typed.__annotations__ = {each.name: each.annotation for each in in_order}
    typed.__doc__, typed.__name__ = command.__doc__, command.__name__
    return typed


def _is_of_extension(parameter: inspect.Parameter) -> bool:
    """Return whether help has a parameter below the heading of an extension."""
    panel = getattr(parameter.default, "rich_help_panel", None)
    return isinstance(panel, str) and panel.startswith(stated.OF_EXTENSION)


def _parameter(option: stated.Option) -> inspect.Parameter:
    """Return a setting as a parameter;
    it is None where nothing is typed, so that a file's value stays.
    """
    flags = (option.flag, *([option.off] if option.kind is bool else ()))
    usual = (
        ""
        if option.default in (None, ()) or option.kind is bool
        else f" Default: {option.default}."
    )
    kind = list[str] if option.listed else str if option.is_parsed else option.kind
    default = Option(
        None,
        "/".join(flags),
        help=option.help + usual,
        metavar=NUMBER_OR_AUTO if option.is_parsed else None,
        rich_help_panel=option.panel or None,
    )
    return inspect.Parameter(
        option.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind | None
    )


def cards(models: "Sequence[str] | None") -> "list[Card]":
    """Return the model cards (files that describe a model) of the models that a user names.

    `models` are names, paths or hub ids; None stands for no models. Raises UserError if there is no
    such model.
    """
    from harness.backends.cards import resolve

    return [resolve(model) for model in models or ()]


def say_all(limit: int | None, datasets: "Iterable[Frozen]") -> None:
    """Print a line on stderr for each dataset that has fewer episodes than `--limit` asks for.

    `limit` is the number that was typed, None for no limit, which prints nothing; each of
    `datasets` is the recorded scenes of an evaluation.
    """
    for dataset in datasets:
        if limit is not None and limit > (n := dataset.manifest.episodes):
            echo(
                f"--limit {limit}: {printable(dataset.name)} has {n} episodes, all of which are "
                "used",
                err=True,
            )


def of_families(command: Any) -> Any:
    """Return a command with further options that name a scenario of a family.

    A family is scenarios that an extension makes by name, such as `env:merge-v0`. The command, a
    function, gets what is typed for them as `of_family`: texts by the option's name.
    """
    from harness.world.families import FAMILIES

    added = []
    for family in FAMILIES.usable().values():
        for option, text in family.options.items():
            default = Option(None, help=text, rich_help_panel=family.heading)
            added.append(_added(option, default, str))
    return _gathering(command, "of_family", added)


def of_extensions(followed: bool) -> Callable[[Any], Any]:
    """Return a decorator that gives a command the options of extensions that no run keeps.

    The command gets what is typed for them as `of_command`: values by the option's name. An option
    of what follows whole runs, such as a tracker, is given only if the command's runs are
    `followed`.
    """
    from harness.evaluate.command_options import OPTIONS

    added = []
    for name, option in OPTIONS.usable().items():
        heading = stated.OF_EXTENSION + str(owner_of_plugin("options", name))
        default = Option(None, metavar=option.metavar, help=option.help, rich_help_panel=heading)
        if followed or not option.follows:
            added.append(_added(name, default, option.kind))
    return lambda command: _gathering(command, "of_command", added)


def _added(name: str, default: Any, kind: Any) -> inspect.Parameter:
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind | None
    )


def _gathering(command: Any, name: str, added: Sequence[inspect.Parameter]) -> Any:
    """Return a command with these parameters in place of the one of this name.

    That gets a mapping of what is typed for them.
    """

    def typed(*settings: Any, **values: Any) -> Any:
        every_value = {each.name: values.pop(each.name) for each in added}
        given = {key: value for key, value in every_value.items() if value is not None}
        return command(*settings, **values, **{name: given})

    parameters = list(inspect.signature(command).parameters.values())
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    place = [each.name for each in parameters].index(name)
    return as_command(typed, command, [*parameters[:place], *added, *parameters[place + 1 :]])


def check_new_file(option: str, path: Path, kind: str) -> str:
    """Return what to say of a TOML file that is written to be named by runs; empty for nothing.

    It is where they would find it. `path` was given as `option`, and `kind` is the folder of such
    files, as `schedules`. Raises UserError if its name is none for it, or is taken.
    """
    if path.suffix != ".toml":
        raise UserError(f"{option} {printable(path)}: end it in .toml")
    if path.exists():
        raise UserError(
            f"{option} {printable(path)} is there already; give a new name, since runs name {kind}"
        )
    return "" if resources.finds(kind, path) else f"; runs find it in {kind}/ of a project"


def scenario_name(name: str | None, of_family: Mapping[str, str]) -> str:
    """Return the scenario's name that was typed, or that of a family by its options.

    A family is scenarios that an extension makes by name. `name` is None if no name was typed, and
    `of_family` has the options by name. Raises UserError unless exactly one of the two is given and
    can be used.
    """
    from harness.world.families import FAMILIES

    if name is not None and not of_family:
        return name
    families = FAMILIES.usable().values()
    first = [next(iter(family.options)) for family in families]
    typed = [family for family in families if family.options.keys() & of_family.keys()]
    if not typed or (name is not None and not of_family.keys().isdisjoint(first)):
        flags = [f" or --{option.replace('_', '-')}" for option in first]
        raise UserError(
            f"give either a scenario{''.join(flags)}; `harness dataset scenario list` lists "
            "scenarios"
        )
    if len(typed) > 1:
        given = [option for option in of_family if option in first]
        flags = [f"--{option.replace('_', '-')}" for option in given or of_family]
        raise UserError(f"{' and '.join(flags)} are of several scenarios; give those of one")
    return typed[0].named(of_family)


def typed_scenario(scenario: str) -> str:
    """Return a scenario's name as it is, and allow it to open what it needs, such as a module.

    Only a name that the user typed may do so, not one from a file.
    """
    from harness.world.families import family_of

    if family := family_of(scenario):
        family.allow(scenario)
    return scenario


def workers_of(text: str) -> "parallel.Workers":
    """Return the workers, a number of processes or a Ray cluster, that a text of --workers names.

    Raises UserError if it names none.
    """
    from harness.core.parallel import workers_of

    return workers_of(text)


def shard_of(text: str | None) -> "shards.Shard | None":
    """Return the shard that a text of --shard names, part I of N of a run or dataset.

    The text is such as `2/8`; None for None. Raises UserError if it is no such text.
    """
    from harness.core.shards import shard_of

    return None if text is None else shard_of(text)


def say_shard(shard: "shards.Shard", out: Path, what: str) -> None:
    """Print that one part of a run or dataset is done, and the command that merges all parts.

    Such a part is a shard, made apart from the others. `shard` says which of how many, `out` is its
    folder, and `what` says in words what it has.
    """
    echo(
        f"wrote {printable(out)}: {what}, shard {shard}; merge all {shard.of} shards with "
        "`harness run merge FOLDER... --out FOLDER`"
    )
