"""Options that several commands have, each declared once."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option, echo

from harness.core.errors import UserError, printable, unknown
from harness.core.files import text_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from harness.backends.base import AnswerMode
    from harness.backends.base import Letters as LettersMode
    from harness.backends.base import Sums as SumsMode
    from harness.backends.cards import Card
    from harness.coordination.operating_point import OperatingPoint
    from harness.core import parallel, shards
    from harness.dataset.load import Dataset as Frozen  # Dataset is an option here
    from harness.evaluate.agent import ImageMode
else:  # typer takes any text; what is evaluated says which are allowed
    AnswerMode = ImageMode = LettersMode = SumsMode = str

MOST_SEEDS = 1000
_RAY = "or a Ray cluster: ray, ray://HOST:PORT or ray:HOST:PORT."

Runs = Annotated[list[Path], Argument(help="One or more folders of finished runs.", metavar="RUN...")]
Reports = Annotated[Path, Argument(metavar="DIR", help="Folder that holds the runs.")]
Model = Annotated[
    str,
    Option(
        help="Model: a card name (`harness model list` shows them), a checkpoint directory, a .gguf file or "
        "a hub id."
    ),
]
RunModel = Annotated[
    list[str] | None,
    Option(
        "--model",
        help="The run's model, where it is none of your cards: a checkpoint directory, a .gguf file or a hub "
        "id. Nothing that only a run names is opened or asked. Repeatable, for several models.",
    ),
]
Scenario = Annotated[str, Argument(help="Scenario name; `harness dataset scenario list` shows them.")]
Env = Annotated[
    str | None,
    Option(
        help="A highway-env environment to use instead of a scenario: merge-v0, or my_package:MyEnv-v0 for "
        "one of your own."
    ),
]
EnvConfig = Annotated[Path | None, Option(help="With --env: JSON file with changes to its configuration.")]
Engine = Annotated[
    str | None,
    Option(
        help="Engine to run the model on, such as llama-cpp, if its card names several. Default: its main "
        "one."
    ),
]
Prompt = Annotated[str, Option(help="Prompt version; `harness prompt list` shows them.")]
ScenarioPrompt = Annotated[
    str | None,
    Option(help="Prompt version; `harness prompt list` shows them. Default: the scenario's usual one."),
]
RunsDataset = Annotated[
    Path | None,
    Option(
        "--dataset",
        help="Folder of the run's dataset, if it has moved. Default: where the run states, or by its name.",
    ),
]
Dataset = Annotated[str, Option(help="Name of a shipped dataset, or a dataset's folder.")]
Conditions = Annotated[
    list[str] | None,
    Option(
        help="Condition to score: an operating point such as single-local, v2x or 6g, or one with changed "
        "settings: 6g:consensus=ego-prompt. Repeatable. Default: all operating points."
    ),
]
Controls = Annotated[
    list[str] | None,
    Option(
        "--control",
        help="Beside each condition with a channel, also score a control. shuffled-messages: the ego hears "
        "the helpers of another layout. no-messages: every message is lost. blind: the helpers see nothing. "
        "Repeatable.",
    ),
]
Attacks = Annotated[
    list[str] | None,
    Option(
        "--attack",
        help="Beside each condition with a channel, also score it under attack: liar:share=1/3 makes a "
        "third of the helpers lie; liar+spoof combines two attacks. `harness study trust --help` lists them. "
        "Repeatable.",
    ),
]
Seeds = Annotated[
    str,
    Option(help="Channel seeds: 0:5 means 0 to 4; 3,7,9 is a list. Every episode is scored with each seed."),
]
FirstSeed = Annotated[int, Option(help="Layout seed of the first episode; the others follow.")]
Thinking = Annotated[bool, Option("--thinking", help="Ask the model to think before it answers.")]
Answer = Annotated[
    AnswerMode,
    Option(
        help="How the model answers. json: free text with a JSON object. constrained: decoding allows only "
        "what fits the schema. readout: the intent is read from the probabilities of one letter per action."
    ),
]
Letters = Annotated[
    LettersMode | None,
    Option(
        help="How a readout's letters are read. raw: once. cyclic: averaged over as many orders of the list "
        "as there are actions, so that no letter is preferred. Default: the card's, or cyclic."
    ),
]
Flip = Annotated[
    bool,
    Option(
        "--flip",
        help="Ask each readout once more with the list of actions reversed, and count how often the "
        "likeliest action changes. It changes no decision.",
    ),
]
Sums = Annotated[
    SumsMode,
    Option(
        help="What becomes of an answer in json whose only fault is that its numbers do not sum to 1. "
        "refuse: it failed. divide: they are divided by their sum, and the summary counts it as divided."
    ),
]
Image = Annotated[
    ImageMode,
    Option(
        help="Which picture an image prompt shows: own (the viewer's), blank, another (another scene's), or "
        "none (text only)."
    ),
]
HelperModel = Annotated[
    str | None,
    Option(
        help="Model of the helpers. Several, such as a,b,c, are assigned to the helpers in turn. "
        "Default: the ego's model."
    ),
]
HelperPrompt = Annotated[str | None, Option(help="Prompt version of the helpers. Default: the ego's prompt.")]
HelperAnswer = Annotated[
    AnswerMode | None,
    Option(help="How the helpers answer: json, constrained or readout. Default: like the ego."),
]
HelperThinking = Annotated[
    bool | None,
    Option(
        "--helper-thinking/--no-helper-thinking",
        help="Ask the helpers to think before they answer. Default: like the ego.",
    ),
]
BatchSize = Annotated[
    int,
    Option(help="Number of prompts in one batch; with a served model, of requests to each server at once."),
]
Servers = Annotated[
    list[str] | None,
    Option(
        "--server",
        help="Base URL of a server of the model, such as http://gpu-1:8000/v1; replaces the card's. Repeat "
        "it to spread the requests over several servers.",
    ),
]
Workers = Annotated[
    str,
    Option(metavar="WHO", help=f"Number of worker processes, {_RAY}"),
]
ModelWorkers = Annotated[
    str,
    Option(
        metavar="WHO",
        help=f"Number of worker processes, each of which loads the model, {_RAY}",
    ),
]
RuleWorkers = Annotated[
    str | None,
    Option(
        metavar="WHO",
        help=f"Number of worker processes, {_RAY} For rules such as proxy only; used on more than 256 "
        "layouts, and for the report of more than 1536 scenes. Default: 2.",
    ),
]
PageWorkers = Annotated[
    str,
    Option(metavar="WHO", help=f"Number of worker processes, {_RAY} Used on more than 1536 scenes."),
]
Shard = Annotated[
    str | None,
    Option(
        metavar="I/N",
        help="Do only part I of N, such as 3/16; `harness run merge` joins the parts. auto/N takes I from "
        "the task number of a Slurm or Kubernetes job.",
    ),
]
Device = Annotated[
    str | None,
    Option(
        help="Where the model runs: cpu, cuda or cuda:N; with llama-cpp cpu or gpu. Default: a GPU if there "
        "is one."
    ),
]
Dtype = Annotated[
    str | None, Option(help="Number format of the weights: float32, bfloat16 or auto. Default: the card's.")
]
Latency = Annotated[
    str | None,
    Option(
        help="Inference time of one answer: paper (145 ms), card (what the card states), measured (batch 1 "
        "on this machine, which must be idle), or seconds: ego=0.2,helper=0.1,fusion=0.3. Default: card, or "
        "paper if the card states none."
    ),
]
DeviceProfile = Annotated[
    str | None,
    Option(
        help="Computer in every vehicle, such as agx-orin (`harness model device list`). It times each "
        "answer by its tokens; use it instead of --latency."
    ),
]
DeviceModel = Annotated[
    str | None,
    Option(
        help="With --device-profile: model whose row of the profile times all answers. Default: the model "
        "that gave the answer."
    ),
]
Temperature = Annotated[float, Option(help="Sampling temperature, 0 to 2; 0 is greedy decoding.")]
SamplingSeed = Annotated[int, Option(help="Seed of the sampling; needs a --temperature above 0.")]
Ask = Annotated[
    str,
    Option(
        help="Which helpers answer. used: those whose answer some condition uses. all: every helper in every "
        "scene, which gives the same decisions and lets other conditions be scored later without the model."
    ),
]
Ties = Annotated[
    str | None,
    Option(
        help="Which of equally likely actions the ego takes. drawn: one by chance, with the same draws for "
        "every condition, prompt and model. first: the most careful. Default: drawn, or as in the run that "
        "is replayed."
    ),
]
NoCache = Annotated[
    bool, Option("--no-cache", help="Ask the model again, even for answers that an earlier run stored.")
]
Tags = Annotated[list[str] | None, Option(help="Label to find the run by later. Repeatable.")]
Json = Annotated[bool, Option("--json", help="Print the result as JSON.")]
Quiet = Annotated[bool, Option("--quiet", help="Print only errors, and the JSON of --json.")]


CONTROLS = {"shuffled-messages": "messages=shuffled", "no-messages": "loss=1", "blind": "messages=blind"}


def points(
    conditions: "Sequence[str]",
    controls: "Sequence[str] | None" = None,
    attacks: "Sequence[str] | None" = None,
) -> "tuple[OperatingPoint, ...]":
    """Operating points by name, each once, and with a channel their controls, and attacks on them."""
    from harness.coordination.operating_point import named_point

    given = [named_point(name) for name in dict.fromkeys(conditions)]
    found, beside = list(given), []
    for control in dict.fromkeys(controls or ()):
        if control not in CONTROLS:
            raise unknown("--control", control, CONTROLS)
        beside.append(CONTROLS[control])
    for setting in (*beside, *(f"attack={attack}" for attack in dict.fromkeys(attacks or ()))):
        for point in given:
            if point.profile and setting.partition("=")[0] not in point.name:
                found.append(named_point(point.name + ("," if ":" in point.name else ":") + setting))
    return tuple(dict.fromkeys(found))


def cards(models: "Sequence[str] | None") -> "list[Card]":
    """Cards of the models that a user names. Raises UserError if there is no such model."""
    from harness.backends.cards import resolve

    return [resolve(model) for model in models or ()]


def say_all(limit: int | None, datasets: "Iterable[Frozen]") -> None:
    """Say on stderr which of these have fewer episodes than --limit."""
    for dataset in datasets:
        if limit is not None and limit > (n := dataset.manifest.episodes):
            echo(
                f"--limit {limit}: {printable(dataset.name)} has {n} episodes, all of which are used",
                err=True,
            )


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from `0:5` (0 to 4) or `3,7,9`."""
    start, colon, stop = text.partition(":")
    try:
        # A range is counted before it is made: 0:99999999999 would not fit into memory.
        most = int(start) + MOST_SEEDS + 1 if colon else 0
        seeds = tuple(range(int(start), min(int(stop), most)) if colon else map(int, text.split(",")))
    except ValueError:
        seeds = ()
    if not colon and len(seeds) == 1 and seeds != (0,):
        n, end = (printable(at, 20) for at in (seeds[0], seeds[0] + 1))
        raise UserError(f"--seeds {n}: give 0:{n} for seeds from 0 on, or {n}:{end} for seed {n} alone")
    if not 0 < len(seeds) <= MOST_SEEDS:
        raise UserError(
            f"--seeds {printable(text)}: give a range such as 0:5, or a list such as 3,7,9, "
            f"of {MOST_SEEDS} seeds at most"
        )
    return seeds


def scenario_name(name: str | None, env: str | None, env_config: Path | None) -> str:
    """The scenario that is meant by a name, or by an environment and what its configuration changes."""
    import json

    from harness.world.environments import environment

    if (name is None) == (env is None):
        raise UserError("give either a scenario or --env; `harness dataset scenario list` lists scenarios")
    if name is not None:
        if env_config is not None:
            raise UserError("--env-config changes an environment; give --env as well")
        return typed(name)
    assert env is not None
    typed(f"{environment.PREFIX}{env}")
    if env_config is None:
        return f"{environment.PREFIX}{env}"
    try:
        named = environment.named(env, json.loads(text_of(env_config, "settings")))
        named.encode()  # JSON can write half a character, which no file can hold
        return named
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"--env-config {printable(env_config)} cannot be read ({printable(error)}); give a JSON file"
        ) from None


def typed(scenario: str) -> str:
    """Return a scenario's name that the user typed, which may thus import an environment's module."""
    from harness.world.environments import environment

    if scenario.startswith(environment.PREFIX):
        environment.allow(scenario)
    return scenario


def workers_of(text: str) -> "parallel.Workers":
    """Who `--workers` names. Raises UserError where it names nobody."""
    from harness.core.parallel import workers_of

    return workers_of(text)


def shard_of(text: str | None) -> "shards.Shard | None":
    """The shard that `--shard` names; None where it is not given."""
    from harness.core.shards import shard_of

    return None if text is None else shard_of(text)


def say_shard(shard: "shards.Shard", out: Path, what: str) -> None:
    """Say that a shard is done, and what is done with it."""
    echo(
        f"wrote {printable(out)}: {what}, shard {shard}; merge all {shard.of} shards with "
        "`harness run merge FOLDER... --out FOLDER`"
    )


def in_range(option: str, value: int, least: int, most: int) -> None:
    """Raise UserError unless `least` <= `value` <= `most`."""
    if not least <= value <= most:
        raise UserError(f"{option} {value} is out of range; give {least} to {most}")
