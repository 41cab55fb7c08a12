"""Options that several commands have, each declared once."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option, echo

from harness.core.errors import UserError, printable, unknown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.backends.base import AnswerMode
    from harness.coordination.operating_point import OperatingPoint
    from harness.core import parallel, shards
    from harness.evaluate.agent import ImageMode
else:  # typer takes any text; what is evaluated says which are allowed
    AnswerMode = ImageMode = str

MOST_SEEDS = 1000

Runs = Annotated[list[Path], Argument(help="Folders of finished runs.", metavar="RUN...")]
Reports = Annotated[Path, Argument(metavar="DIR", help="Folder that holds them.")]
Model = Annotated[str, Option(help="Card, checkpoint directory, .gguf file or hub id. `harness model list`.")]
Scenario = Annotated[str, Argument(help="Scenario.")]
Env = Annotated[
    str | None,
    Option(help="An environment of highway-env in place of a scenario: merge-v0, or my_package:MyEnv-v0."),
]
EnvConfig = Annotated[Path | None, Option(help="JSON file of what its configuration changes.")]
Engine = Annotated[str | None, Option(help="Another engine that the card names, such as llama-cpp.")]
Prompt = Annotated[str, Option(help="Prompt version. `harness prompt list`.")]
ScenarioPrompt = Annotated[
    str | None, Option(help="Prompt version. Default: the scenario's. `harness prompt list`.")
]
Dataset = Annotated[str, Option(help="Shipped dataset, or a dataset's folder.")]
Conditions = Annotated[
    list[str] | None,
    Option(help="Operating point, or a change of one: 6g:consensus=ego-prompt. Repeatable. Default: all."),
]
Controls = Annotated[
    list[str] | None,
    Option(
        "--control",
        help="shuffled-messages: beside each condition with a channel, one whose ego hears the helpers of "
        "another layout; no-messages: one that loses all; blind: one whose helpers see nothing. Repeatable.",
    ),
]
Attacks = Annotated[
    list[str] | None,
    Option(
        "--attack",
        help="Beside each condition with a channel, one whose helpers attack: liar:share=1/3, or several at "
        "once: liar+spoof. Repeatable. `harness trust --help`.",
    ),
]
Seeds = Annotated[str, Option(help="Seeds of the channel: 0:5 is 0 to 4; or 3,7,9.")]
FirstSeed = Annotated[int, Option(help="Seed of the first episode.")]
Thinking = Annotated[bool, Option("--thinking", help="Ask the model to think first.")]
Answer = Annotated[AnswerMode, Option(help="json: free text; constrained: to the schema; readout: letters.")]
Image = Annotated[
    ImageMode,
    Option(help="Picture of an image prompt: own, blank, another (scene's), or none, which leaves its text."),
]
HelperModel = Annotated[
    str | None,
    Option(help="Model of the helpers; several, such as a,b,c, take them in turn. Default: the ego's."),
]
HelperPrompt = Annotated[str | None, Option(help="Prompt version of the helpers. Default: the ego's.")]
HelperAnswer = Annotated[AnswerMode | None, Option(help="How helpers answer. Default: as the ego.")]
HelperThinking = Annotated[
    bool | None,
    Option("--helper-thinking/--no-helper-thinking", help="Ask helpers to think first. Default: as the ego."),
]
BatchSize = Annotated[int, Option(help="Most prompts that go through the engine together.")]
Servers = Annotated[
    list[str] | None,
    Option(
        "--server", help="Base URL of a served model, in place of its card's. Repeatable: any may answer."
    ),
]
Workers = Annotated[
    str, Option(metavar="WHO", help="Processes; or a Ray cluster: ray, ray://HOST:PORT, ray:HOST:PORT.")
]
ModelWorkers = Annotated[
    str,
    Option(
        metavar="WHO",
        help="Processes, each with the model loaded; or a Ray cluster: ray, ray://HOST:PORT, ray:HOST:PORT.",
    ),
]
RuleWorkers = Annotated[
    str | None,
    Option(
        metavar="WHO",
        help="Of rules in more than 256 layouts: processes, or a Ray cluster as of drive. Default: 2.",
    ),
]
Shard = Annotated[
    str | None,
    Option(
        metavar="I/N",
        help="Do part I of N, for `harness merge`; auto/N: that of this task of a Slurm or Kubernetes job.",
    ),
]
Device = Annotated[str | None, Option(help="cpu or cuda.")]
Dtype = Annotated[str | None, Option(help="float32, bfloat16 or auto, in place of the card's.")]
Latency = Annotated[
    str | None,
    Option(
        help="Inference times: paper (145 ms), card, ego=SECONDS,helper=SECONDS,fusion=SECONDS, or measured "
        "(batch 1, on this machine if it is idle). Default: the card's, else the paper's."
    ),
]
DeviceProfile = Annotated[
    str | None,
    Option(help="Computer of every vehicle, in place of --latency: agx-orin. `harness device list`."),
]
DeviceModel = Annotated[
    str | None, Option(help="Model whose row of it times all answers. Default: each answer's own model.")
]
Temperature = Annotated[
    float, Option(help="Draw answers at this temperature, 0 to 2; 0 takes the likeliest token each time.")
]
SamplingSeed = Annotated[int, Option(help="Seed of those draws.")]
NoCache = Annotated[bool, Option("--no-cache", help="Ask again for answers that an earlier run has.")]
Tags = Annotated[list[str] | None, Option(help="Word to find the run by. Repeatable.")]
Json = Annotated[bool, Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, Option("--quiet", help="Print nothing but errors, and what --json asks for.")]


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
        raise UserError("give a scenario or --env, one of the two; `harness scenario list` lists scenarios")
    if name is not None:
        if env_config is not None:
            raise UserError("--env-config is of an environment; give --env as well")
        return name
    assert env is not None
    if env_config is None:
        return f"{environment.PREFIX}{env}"
    try:
        changes = json.loads(env_config.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"--env-config {printable(env_config)} cannot be read ({printable(error)}); give a JSON file"
        ) from None
    return environment.named(env, changes)


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
        f"wrote {printable(out)}: {what}, shard {shard}; put together all {shard.of} with "
        "`harness merge FOLDER... --out FOLDER`"
    )


def in_range(option: str, value: int, least: int, most: int) -> None:
    """Raise UserError unless `least` <= `value` <= `most`."""
    if not least <= value <= most:
        raise UserError(f"{option} {value} is out of range; give {least} to {most}")
