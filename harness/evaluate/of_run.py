"""The evaluation that a finished run is; prompts, channels and networks must be as they were."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any, cast

import msgspec
from msgspec import structs

from harness.backends import cards
from harness.backends.base import AnswerMode, Letters, Sums
from harness.backends.card import Card
from harness.backends.registry import registration
from harness.coordination.operating_point import OperatingPoint, kept_of
from harness.coordination.parts import Kept
from harness.coordination.schedules import SCHEDULES
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.formats import SOURCES
from harness.evaluate.agent import Agent, ImageMode
from harness.evaluate.spec import Source, Spec
from harness.prompts import versions
from harness.radio.networks import network
from harness.radio.profiles import CHANNELS
from harness.runs.contradictions import current
from harness.runs.folder import Run
from harness.runs.settings import deciding
from harness.runs.sources import PROMPTS, copies, prompt_of, refuse_other_files

DRIVER = "driver"  # the engine of what has no model and no prompt


def spec_of(run: Run, source: Source) -> Spec:
    """Return the evaluation by which a finished run's scenes were answered.

    It has the run's models, prompts and settings, and no conditions; `source` has the scenes.
    Raises UserError if a prompt of it is not installed here.
    """
    manifest = run.manifest
    ego, *helpers = (_agent(run, record) for record in (manifest.agent(0), *manifest.helpers))
    settings = deciding(manifest.settings)
    settings = structs.replace(settings, ask="used", latency=None)
    return Spec(ego, source, (), manifest.seeds, tuple(helpers), settings=settings)


def card_here(card: Card) -> Card:
    """Return the description (card) of a run's model: the run's own, but of a rule the one here.

    A card is what a file says of a model, such as its engine and weights. A rule is a driver
    without a model.
    """
    return cards.load(card.name) if card.engine == DRIVER else card


def sees_all(model: Mapping[str, Any]) -> bool:
    """Return whether a run's model sees what no vehicle can see, whatever its record says of that.

    `model` is the record of its card. A rule does so if the one here does, and another model only
    if its engine can.
    """
    engine, is_privileged = model["engine"], bool(model.get("privileged"))
    if engine == DRIVER:
        is_privileged = cards.load(model["name"]).privileged
    return is_privileged and "privileged" in registration(engine).card_keys


def points_of(run: Run) -> dict[str, OperatingPoint]:
    """Return the settings of a run's conditions, each an operating point, by condition name.

    They are of the radio, of asking helpers and of fusing their messages. Raises UserError if a
    channel, network, schedule or other file that they name has changed since.
    """
    manifest = run.manifest
    refuse_other_files(run)
    points = {}
    for condition in manifest.conditions:
        try:
            points[str(condition["name"])] = OperatingPoint.from_dict(condition)
        except UserError as error:
            raise UserError(f"{printable(run.path)}: {error}") from None
    kept = kept_of(points.values())
    records_by_kind: dict[str, tuple[Mapping[str, Any], Callable[[str, Any], bool]]] = {
        "channel profile": (manifest.channels, CHANNELS.unchanged),
        "network": (manifest.networks, lambda name, then: _same(asdict(network(name)), then)),
        "schedule": (
            manifest.schedules,
            lambda name, then: _same(SCHEDULES.file_sha256(name), then),
        ),
    }
    copies_here = copies(run) if manifest.kept else {}
    for folder, recorded_there in manifest.kept.items():
        alike = {name for where, name in copies_here if where == folder}
        is_kept = partial(_is_kept, kept.get(folder, {}), alike)
        records_by_kind[printable(folder.removesuffix("s"))] = recorded_there, is_kept
    if current(run):
        _check_recorded(run, points, kept)
    for what, (by_name, unchanged) in records_by_kind.items():
        for name, recorded in by_name.items():
            if not unchanged(name, recorded):
                raise UserError(
                    f"{printable(run.path)}: {what} {printable(name)} has changed since; restore "
                    "it or run again"
                )
    return points


def _check_recorded(
    run: Run, points: Mapping[str, OperatingPoint], kept: Mapping[str, Mapping[str, Kept]]
) -> None:
    """Raise UserError if a run does not state what its conditions' schedules and parts open."""
    schedules = {point.ask.schedule for point in points.values()}
    places = [("schedules", name) for name in schedules if SCHEDULES.file(name)]
    for folder, by_name in kept.items():
        places += [(folder, name) for name in by_name]
    for folder, name in places:
        recorded = run.manifest.kept.get(folder, {})
        if name not in (run.manifest.schedules if folder == "schedules" else recorded):
            raise UserError(
                f"{printable(run.path)}: run.json has no record of {printable(name)} of its "
                f"{printable(folder)}, which a condition names; make the run again"
            )


def records_otherwise(run: Run) -> Iterator[str]:
    """Yield a sentence for each fact on a radio that `run.json` has otherwise than its file here.

    The facts are words: the description, the source, how well it is supported, and the limits for
    which its model is validated. What the radio does is compared elsewhere (`points_of`).
    """
    for name, recorded in run.manifest.channels.items():
        if name not in CHANNELS:
            continue
        here, there = CHANNELS.record(name), msgspec.to_builtins(recorded)
        for key in ("description", "source", "status", "limits"):
            if here[key] != _plain(there[key]):
                what = f"{key} of channel profile {printable(name)}"
                yield f"run.json has the {what} otherwise than here"


def check_prompts(run: Run, spec: Spec) -> None:
    """Raise UserError if a prompt's files here differ from those that the run was made with.

    `spec` is the run's evaluation, with the prompts that are installed here (`spec_of`).
    """
    agent_records = (run.manifest.agent(0), *run.manifest.helpers)
    for agent, each in zip(spec.agents, agent_records, strict=True):
        if agent.prompt.sha256 != each["prompt"]["sha256"]:
            version = printable(agent.prompt.version)
            raise UserError(
                f"{printable(run.path)}: prompt {version} has changed since; {_restore(run, each)}"
            )


def _is_kept(kept: Mapping[str, Kept], alike: Collection[str], name: str, recorded: Any) -> bool:
    """Whether a file is as a run states; `refuse_other_files` held those `alike` to its copies."""
    return name in kept and (name in alike or _same(kept[name].record, recorded))


def _same(now: Any, recorded: Any) -> bool:
    return bool(now == _plain(recorded))


def _plain(recorded: Any) -> Any:
    return msgspec.json.decode(msgspec.json.encode(recorded))


def model_of(run: Run, agent_record: Mapping[str, Any]) -> Card:
    """Return the description (card) of a model that answered in a run, from the run's record.

    `agent_record` is the record of the model with its prompt; a card is what a file says of a
    model, such as its engine. Raises UserError if the record is none, or the engine is not
    installed.
    """
    where = f"{printable(run.path)}: its model"
    card = convert(agent_record["model"], Card, where)
    registration(card.engine, where)
    return card


def _agent(run: Run, agent_record: Mapping[str, Any]) -> Agent:
    card = model_of(run, agent_record)
    if (version := agent_record["prompt"]["version"]) not in versions.names():
        raise UserError(
            f"{printable(run.path)}: prompt {printable(version)} is not here; "
            f"{_restore(run, agent_record)}"
        )
    return Agent(
        card,
        versions.load(version),
        cast("AnswerMode", agent_record["answer"]),
        agent_record["thinking"],
        cast("ImageMode", agent_record["image"]),
        cast("Letters", agent_record["letters"]),
        cast("Sums", agent_record["sums"]),
    )


def _restore(run: Run, agent_record: Mapping[str, Any]) -> str:
    """What to do if a prompt is not here as it was: nothing is asked with a run's prompts."""
    if prompt_of(run, agent_record["prompt"]) is None:
        return "restore it or run again"
    kept = run.path / SOURCES / PROMPTS / agent_record["prompt"]["version"]
    return f"copy {printable(kept)} to prompts/, or run again"
