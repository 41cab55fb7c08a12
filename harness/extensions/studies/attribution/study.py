"""`harness study attribute`: what moved a run's answers and decisions,
by leaving out one thing at a time.

An object is left out as if no sensor of the viewer had reported it: its line, its conflict, what it
hides. The viewer's model is asked again. A message is left out as if it had been lost: the
consensus rule fuses the others, which is exact and asks nobody; a fusion call is made again.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from harness.backends.base import Request
from harness.coordination.coordinate import FusionInputs, fuse
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Ints
from harness.core.errors import UserError, printable, unknown
from harness.core.figures import PERCENT, Unit, as_mapping, some_of
from harness.core.figures import interval_of as figure
from harness.core.files import write_whole
from harness.core.statistics import Estimate, rate_interval, units_of
from harness.dataset.load import Scene
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.fusion import codes_of
from harness.evaluate.requests import requests
from harness.evaluate.walk import Decided, Memory, places_of, shown_attackers, walk
from harness.extensions.studies.attribution.record import FILE, Attribution, LeftOut
from harness.extensions.studies.twins.scoring import distance
from harness.prompts.versions import listed as listing
from harness.report.document import Table
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study
from harness.world.perception.graph import scene_graph

HIDDEN, SEEN, OTHER = "hidden conflict vehicle", "seen conflict vehicle", "other object"
SHIFT = Unit(decimals=2)
SIGHT, NO_SIGHT = "helper with sight", "helper without sight"
KINDS = (
    *(("ego", kind) for kind in (SEEN, OTHER)),
    *(("helper", kind) for kind in (HIDDEN, SEEN, OTHER)),
    *(("fusion", kind) for kind in (SIGHT, NO_SIGHT)),
)


@dataclass(frozen=True)
class Row:
    """Hold how much one kind of object or message moves answers, over all that were left out.

    Answers are probabilities of actions; each was compared with that to a prompt, or of a fusion,
    without the item. `role` says whose prompt it was left out of, `ego` or `helper`, or `fusion`
    for messages. `shift` is the mean total variation distance of both, `flips` the share whose
    likeliest action changed, and `failed` the share that failed without the item, which the others
    leave out.
    """

    role: str  # whose prompt it was left out of, `ego` or `helper`; or `fusion`, for messages
    kind: str  # kind of object or message, such as `hidden conflict vehicle`
    shift: Estimate  # mean total variation distance, 0 to 1, of the answers with and without it
    flips: Estimate  # share of answers whose likeliest action changed
    failed: Estimate  # share of answers that failed without it; the other two leave these out


def attribute(stored: ReplayedRun, condition: str, sample: int, seed: int) -> Attribution:
    """Measure what answers depend on, by leaving out each listed object and each message heard.

    `stored` is the run, and `condition` the name of one of its operating points (settings of radio,
    asking and fusion). At most `sample` of its decision points, situations in which the ego
    decided, are drawn, by `seed`. Items are left out one at a time; questions that the run has no
    answer for are put to its model. Returns what each item changed in the probabilities of actions.

    Raises:
        UserError: the run has no such condition, or its model is not available or cannot be asked
            otherwise.
        Unanswered: too many questions got no answer; the run keeps all others.
    """
    for agent in stored.spec.agents:
        name = f"{printable(stored.run.path)}: {printable(agent.card.name)}"
        if not agent.can.closed_loop:
            raise UserError(
                f"{name} has no answers to other questions; give the run that it replays"
            )
        if agent.card.privileged:
            raise UserError(
                f"{name} reads the truth and no prompt; give a run of local-view or of a model"
            )
        if agent.sees:
            raise UserError(
                f"{name} was shown pictures by prompt {agent.prompt.version}, and no object can be "
                "left out of one; give a run with --image none, or of another prompt"
            )
    if condition not in stored.points:
        raise unknown("condition", condition, stored.points)
    drawn, of = draw(stored, condition, sample, seed)
    scenes = stored.dataset.scenes(list(drawn))
    left_out = [*objects(stored, scenes), *messages(stored, stored.points[condition], drawn)]
    stored.settle()
    place = {scene: n for n, scene in enumerate(drawn)}
    left_out.sort(key=lambda each: (each.episode, place[each.scene]))
    return Attribution(
        condition=condition,
        decision_points=len(drawn),
        of=of,
        sample_seed=seed,
        left_out=tuple(left_out),
    )


def draw(stored: ReplayedRun, condition: str, sample: int, seed: int) -> tuple[dict[str, int], int]:
    """Draw at most `sample` decision points of a condition, and for each a channel seed.

    A decision point is a situation in which the ego decided. `stored` is the run, and `condition`
    names settings of radio, asking and fusion in it. Returns the seed of each decision point by its
    id, and how many decision points there are. All are equally likely, and so are the seeds of
    each; `seed` is that of the draw. A larger sample contains a smaller one.
    """
    run = stored.run
    here = run.decisions.codes("condition", run.conditions) == run.conditions.index(condition)
    seeds, by_scene = run.decisions.whole("seed"), dict[str, list[int]]()
    for scene, rows in run.decisions.scenes.items():
        if here_seeds := seeds[rows.start : rows.stop][here[rows.start : rows.stop]].tolist():
            by_scene[scene] = here_seeds

    def chance(*key: object) -> float:
        return float(noise.uniforms((1,), "attribution", seed, *key)[0])

    chosen = sorted(by_scene, key=chance)[:sample]
    return {scene: min(by_scene[scene], key=lambda s: chance(scene, s)) for scene in chosen}, len(
        by_scene
    )


def objects(stored: ReplayedRun, scenes: Sequence[Scene]) -> Iterator[LeftOut]:
    """Yield what each listed object changes when it is left out of one viewer's prompt.

    Objects are vehicles and the like that a prompt lists; a viewer is the vehicle that is asked.
    This is done for every viewer of these scenes whose prompt lists the object. `stored` is the
    run, whose model is asked what it has no answer for. An item says how the probabilities of
    actions change.
    """
    questions = [each for scene in scenes for each in _questions(stored, scene)]
    whole = requests(stored.spec, scenes)
    answers = stored.answered([*whole, *(request for *_, request in questions)])
    for scene, viewer, item, request in questions:
        p = answers[f"{scene.id}/{viewer}"].intent
        if p and answers[request.id].error is None:
            yield _left_out(
                scene,
                stored.dataset.actions,
                p,
                answers[request.id].intent,
                viewer=viewer,
                role=request.role,
                item=item,
                kind=_kind(scene, viewer, item),
            )


def _questions(stored: ReplayedRun, scene: Scene) -> Iterator[tuple[Scene, str, str, Request]]:
    """Yield the decision point, who is asked, what is left out, and the question."""
    spec, graphs = stored.spec, scene.graphs
    listed: dict[str, list[str]] = {}
    for place, viewer in enumerate(spec.viewers(scene)):
        agent, graph = spec.agents[spec.agent(place)], graphs[viewer]
        reads = (
            listing(graph, agent.prompt.max_objects)
            if agent.can.language_model
            else range(len(graph.nodes))
        )
        listed[viewer] = [graph.nodes[n].id for n in reads]
    for item in dict.fromkeys(chain.from_iterable(listed.values())):
        less = {
            v: scene_graph(spec.scenario_of(scene), scene.state, v, [item])
            for v in listed
            if item in listed[v]
        }
        name = f"{scene.id}~without-{item}"
        for request in requests(spec, [scene.changed(graphs={**graphs, **less}, scene=name)]):
            viewer = request.id.rpartition("/")[2]
            if viewer in less:
                yield scene, viewer, item, request


def _kind(scene: Scene, viewer: str, item: str) -> str:
    """Return an item's kind: without a conflict that its viewer sees, seen by the ego,
    or hidden from it.
    """
    if item not in {conflict.vehicle for conflict in scene.graphs[viewer].conflicts}:
        return OTHER
    return SEEN if item in scene.graphs[scene.viewers[0]].seen else HIDDEN


def messages(
    stored: ReplayedRun, point: OperatingPoint, drawn: Mapping[str, int]
) -> Iterator[LeftOut]:
    """Yield what each message that came in time changes when it is left out of the fusion.

    The fusion makes the ego's policy (probabilities of actions) of its own answer and of messages.
    `stored` is the run, and `point` the settings of radio, asking and fusion. `drawn` has the
    situations to take: by id of the decision point, the channel seed of its decision.
    """
    memory, world = Memory(), FrozenWorld(stored.dataset, [point], stored.seeds)
    for [part] in walk(world, [point], stored, stored.spec.ties):
        yield from _messages(stored, part, memory, drawn)
        memory.keep(part.due, part.result.state)


def _messages(
    stored: ReplayedRun, part: Decided[Scene], memory: Memory, drawn: Mapping[str, int]
) -> Iterator[LeftOut]:
    point, due, points = part.point, part.due, part.decision_points
    state, _ = memory.recall(due)
    chosen = [
        drawn.get(points[at].id) == seed for at, seed in zip(due.at.tolist(), due.seed, strict=True)
    ]
    decisions, helpers = np.nonzero(part.result.on_time & np.array(chosen)[:, None])
    if not len(decisions):
        return
    broadcast = part.said.take(decisions)
    taken = {
        field.name: getattr(part.result, field.name)[decisions] for field in fields(part.result)
    }
    whole, at = replace(part.result, **taken), due.at[decisions]
    places = places_of(point, due, len(points))[decisions]
    rest = whole.on_time & (np.arange(whole.on_time.shape[1]) != helpers[:, None])
    call = None
    if point.has_fusion_call:
        attackers = shown_attackers(point, broadcast)
        codes = np.unique(codes_of(rest, places, attackers)[rest.any(axis=1)])
        call = stored.fusion_call(points, codes, point.rewrites)(places, attackers)
    fusion = FusionInputs(call, None if state is None else state[decisions])
    less = fuse(point, replace(whole, on_time=rest), broadcast.intents, fusion)
    for n, voice in enumerate(helpers.tolist()):
        helper = (
            voice
            if broadcast.intents.voice_of is None
            else int(broadcast.intents.voice_of[n, voice])
        )
        scene = points[at[n]]
        sender = scene.viewers[1 + helper]
        items = scene.graphs[sender].seen
        sight = any(_kind(scene, sender, item) == HIDDEN for item in items)
        q = None if less.fusion_failed[n] else less.fused[n].tolist()
        if not whole.fusion_failed[n]:
            yield _left_out(
                scene,
                stored.dataset.actions,
                whole.fused[n].tolist(),
                q,
                seed=int(due.seed[decisions[n]]),
                viewer=scene.viewers[0],
                role="fusion",
                item=sender,
                kind=SIGHT if sight else NO_SIGHT,
            )


def _left_out(
    scene: Scene, actions: Sequence[str], p: Sequence[float], q: Sequence[float] | None, **what: Any
) -> LeftOut:
    best = int(np.argmax(p))
    return LeftOut(
        scene=scene.id,
        episode=scene.record.episode,
        **{"seed": None, **what},
        action=actions[best],
        instead=actions[int(np.argmax(q))] if q else None,
        change=q[best] - p[best] if q else None,
        shift=distance(p, q),
    )


def rows(
    result: Attribution, episodes: Sequence[int] = (), clusters: Ints | None = None
) -> list[Row]:
    """Return a row for each kind of object or message that was left out, with 95 % intervals.

    `result` is the attribution, what answers become without each. The intervals are over episodes,
    or over the `clusters`, (E,), of the run's E `episodes`, if they have some.
    """
    by_kind: dict[tuple[str, str], list[LeftOut]] = {}
    for each in result.left_out:
        by_kind.setdefault((each.role, each.kind), []).append(each)
    table = []
    for kind in KINDS:
        if kind in by_kind:
            numbers = np.array([each.episode for each in by_kind[kind]])
            units = units_of(numbers, episodes, clusters)
            table.append(_row(*kind, by_kind[kind], units))
    return table


def _row(role: str, kind: str, left_out: Sequence[LeftOut], units: Ints) -> Row:
    shift = np.array([np.nan if each.shift is None else each.shift for each in left_out])
    flips = np.array([float(each.instead != each.action) for each in left_out])
    failed = np.isnan(shift)
    return Row(
        role,
        kind,
        rate_interval(shift, units),  # a distance is from 0 to 1, too
        rate_interval(np.where(failed, np.nan, flips), units),
        rate_interval(failed.astype(float), units),
    )


def _what(row: Row) -> str:
    return {
        "ego": f"{row.kind} in the ego's prompt",
        "helper": f"{row.kind} in a helper's prompt",
        "fusion": f"message of a {row.kind} of a {HIDDEN}",
    }[row.role]


def headline(table: Sequence[Row]) -> str:
    """Return a sentence on which kind of object or message moved answers most, if that is clear.

    `table` has a row for each kind, with how much answers change without it.
    """
    rows = [row for row in table if row.shift.n]
    if not rows:
        return (
            "Nothing was left out: no prompt of the sample lists an object, and no message was in "
            "time."
        )
    most = max(rows, key=lambda row: row.shift.value)
    close = [row for row in rows if row is not most and not row.shift.high < most.shift.low]
    if close:
        return (
            f"What moves answers most is not clear: {figure(most.shift, SHIFT)} of the probability "
            f"moves to other actions at the most (n = {most.shift.n}), and the intervals of these "
            f"overlap: {some_of([_what(row) for row in (most, *close)])}."
        )
    return (
        f"The {_what(most)} moves answers most: without it, {figure(most.shift, SHIFT)} of the "
        f"probability moves to other actions, and {figure(most.flips)} % of the most probable "
        f"actions change (n = {most.shift.n})."
    )


def attribution_study(result: Attribution, run: ReplayedRun) -> Study:
    """Return the study of an attribution, tables and sentences for the terminal and `--json`.

    `result` has what the answers become without one object or message, and `run` is the run whose
    answers they are.
    """
    table = rows(result, run.dataset.episodes, run.clusters)
    cells, plain_rows = list[Sequence[str]](), list[dict[str, Any]]()
    for row in table:
        shift, flips = figure(row.shift, SHIFT), figure(row.flips)
        failed, n = PERCENT.number(row.failed.value), str(row.shift.n)
        cells.append((row.kind, row.role, shift, flips, failed, n))
        estimates = {"shift": row.shift, "flips": row.flips, "failed": row.failed}
        values = {name: as_mapping(estimate) for name, estimate in estimates.items()}
        plain_rows.append({"role": row.role, "kind": row.kind, **values})
    answer = {
        "run": str(run.run.path),
        "condition": result.condition,
        "decision_points": result.decision_points,
        "of": result.of,
        "sample_seed": result.sample_seed,
        "rows": plain_rows,
    }
    return Study(
        "attribution",
        f"{run.name} · {run.run.source}",
        [headline(table)],
        [
            f"{result.decision_points} of the {result.of} decision points of {result.condition}, "
            f"drawn with sample seed {result.sample_seed}, each as likely as any other; 95 % "
            "intervals are over episodes. Of: the prompt that it is left out of; fusion: a "
            "message that came in time. Shift: total variation distance of the answers or "
            "policies; flips: another action is most probable; failed: the answer without it "
            "could not be read."
        ],
        [
            Table(
                "What was left out",
                ("left out", "of", "shift [95 %]", "flips % [95 %]", "failed", "n"),
                cells,
                terminal=range(6),
            )
        ],
        {},
        {},
        answer,
        caveats=run.caveats,
    )


def write(result: Attribution, run: Path) -> Path:
    """Write an attribution to its file in a run's folder, and return the file's path.

    An attribution, here `result`, says what answers become without one object or message. `run` is
    the folder.
    """
    write_whole(run / FILE, msgspec.json.format(msgspec.json.encode(result), indent=1) + b"\n")
    return run / FILE
