"""Live episodes: a hand-played one, what latency does, and what episodes share."""

from functools import cache
from itertools import product

import msgspec
import numpy as np
import pytest
from driving import ALONE, FROM_LEFT, NO_DANGER, ONCOMING, Script, column, decisions, driven, spec
from evaluating import spec_of
from former import SCENARIO
from run_on_disk import UNTIMED
from tiers import some

from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS, named_point
from harness.core.noise import uniforms
from harness.evaluate.asking import Asker
from harness.evaluate.branches import Course, Decision, Trajectory, advance
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.latency import PAPER
from harness.evaluate.live_world import LiveWorld
from harness.evaluate.walk import walk
from harness.runs.decisions import Decisions
from harness.world import reference as live
from harness.world.drivers import DRIVERS
from harness.world.parameters import frames
from harness.world.world import World

IDLE, SLOWER, FASTER, UNSURE = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.4, 0.3)


@pytest.mark.slow
def test_an_episode_played_by_hand():
    """Nobody is dangerous. At 1 s the ego is unsure:
    alone it goes on, over 6G its helpers make it brake.

    A decision takes 0.1 s of thought, 5 frames. Over 6G it takes 5 ms of latency and at most 1.9 ms
    of jitter and 0.02 ms on air more: 6 frames. What braking costs shows in the time to clear.
    """

    def line(viewer, step):
        if step != 1:
            return FASTER if step > 1 else IDLE
        return UNSURE if viewer == "v1" else SLOWER

    script = Script(line)
    run = spec(points=(ALONE, POINTS["6g"]), seeds=(0,), first_seed=NO_DANGER)
    made = driven(run, backend=script, infers=0.1)
    alone, helped = made.episodes

    mine, its = decisions(made, "single-local"), decisions(made, "6g")
    assert [mine[k].acts_at_s for k in range(3)] == [0.1, 1.1, 2.1]
    assert (mine[1].action, mine[1].triggered, mine[1].messages) == ("IDLE", False, ())
    assert (its[1].action, its[1].triggered, its[1].acts_at_s) == ("SLOWER", True, 1.12)
    assert [m.sender for m in its[1].messages] == ["v2", "v3", "v4"]
    assert all(m.on_time and 105 <= m.arrival_ms < 107 for m in its[1].messages)
    assert mine[1].scene == its[1].scene  # nothing has parted them before
    assert mine[2].scene != its[2].scene
    helpers = {f"{its[1].scene}/{viewer}" for viewer in ("v2", "v3", "v4")}
    egos = [asked for asked in script.asked if asked.endswith("/v1")]
    assert len(egos) == len(set(egos)) == made.decision_points
    # of whom the ego was unsure, once
    assert sorted(set(script.asked) - set(egos)) == sorted(helpers)
    assert len(script.asked) == len(egos) + len(helpers)

    world = World.start(SCENARIO, NO_DANGER)
    for frame, action in ((56, "SLOWER"), (105, "FASTER"), (155, "FASTER")):
        world.advance(frame)
        world.take(action)
    world.advance(500)
    assert (helped.success, helped.failure, helped.time_s) == (True, "", world.outcome.time_s)
    assert (helped.hard_brakings, alone.hard_brakings) == (1, 0)
    assert alone.success
    assert alone.time_s == live.drive(SCENARIO, "cruise", NO_DANGER).time_s < helped.time_s


def test_braking_three_frames_later_is_42_centimetres_further():
    """145 ms are 8 frames and 219 ms are 11. From 14 to 7 m/s, 0.06 s later: 0.06 s x 7 m/s."""
    assert (frames(0.145, 50), frames(0.219, 50), frames(0.14, 50), frames(0.0, 50)) == (
        8,
        11,
        7,
        0,
    )
    south_m = []
    for latency_s in (0.145, 0.219):
        course = Course(ALONE, 0, {0: Decision("SLOWER", 50 + frames(latency_s, 50))})
        [one] = advance([Trajectory(0, World.start(SCENARIO, NO_DANGER), [course])], 250)
        assert one.world.state().ego.speed_mps == pytest.approx(7.0, abs=0.02)
        south_m.append(one.world.state().ego.y_m)
    assert south_m[0] - south_m[1] == pytest.approx(0.42, abs=1e-3)


def test_a_decision_acts_in_its_frame_and_not_before():
    still, braking = World.start(SCENARIO, NO_DANGER), Trajectory(
        0, World.start(SCENARIO, NO_DANGER), [Course(ALONE, 0, {0: Decision("SLOWER", 8)})]
    )  # fmt: skip
    still.advance(8)
    advance([braking], 8)
    assert braking.world.state().vehicles == still.state().vehicles
    assert (still.target()[1], braking.world.target()[1]) == (2, 1)
    advance([braking], 9)
    still.advance(9)
    assert still.state().ego.speed_mps - braking.world.state().ego.speed_mps == pytest.approx(
        8.0 * 0.02
    )


def test_a_decision_still_open_when_the_next_is_due_goes_on_and_the_next_is_skipped():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=NO_DANGER)
    made = driven(run, backend=Script(lambda viewer, step: SLOWER), infers=1.3)
    [episode] = made.episodes
    acts_at_s = {step: d.acts_at_s for step, d in decisions(made, "single-local").items()}
    assert acts_at_s == {0: 1.3, 2: 3.3, 4: 5.3}
    assert (episode.decisions, episode.skipped, episode.never_acted) == (3, 3, 0)
    assert episode.deadline_misses == 3  # 1.3 s outlast a window of 0.2 s
    world = World.start(SCENARIO, NO_DANGER)
    for frame in (65, 165, 265):
        world.advance(frame)
        world.take("SLOWER")
    world.advance(500)
    assert (episode.failure, episode.least_gap_m) == (
        "time_out",
        round(world.outcome.least_gap_m, 3),
    )


def test_a_decision_that_is_ready_when_the_next_is_due_acts_first():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=NO_DANGER)
    made = driven(run, backend=Script(lambda viewer, step: IDLE), infers=1.0)
    [episode] = made.episodes
    assert (list(decisions(made, "single-local")), episode.skipped) == ([0, 1, 2, 3, 4, 5], 0)


def test_an_episode_that_ends_while_a_decision_is_open_records_it_and_never_acts_on_it():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=FROM_LEFT)  # cruising ends in a collision
    made = driven(run, backend=Script(lambda viewer, step: IDLE), infers=0.9)
    [episode] = made.episodes
    _, last = max(decisions(made, "single-local").items())
    assert (episode.failure, episode.never_acted, last.acted) == ("collision", 1, False)
    assert last.acts_at_s > episode.time_s
    assert (episode.partner is not None, episode.fault, episode.least_gap_m) == (True, "ego", 0.0)


@cache
def by_reference(seed):
    """How each reference driver ends a layout."""
    return live.drive_all(SCENARIO, [seed])[0]


@pytest.mark.parametrize(
    ("driver", "seed"),
    some(
        [("full-view", FROM_LEFT), ("local-view", FROM_LEFT)],
        exhaustive=[
            *product(("brake", "cruise"), [FROM_LEFT]),
            *product(DRIVERS, (NO_DANGER, ONCOMING)),
        ],
    ),
)
def test_a_driver_that_takes_the_lag_drives_as_the_reference_does(driver, seed):
    episodes = driven(spec(driver, first_seed=seed)).episodes
    outcome = by_reference(seed)[driver]
    assert len(episodes) == 6
    for episode in episodes:
        assert episode.success == outcome.success
        assert episode.failure == ("" if outcome.success else outcome.result)
        assert episode.time_s == outcome.time_s
        assert (episode.partner, episode.fault) == (outcome.partner, outcome.fault)
        assert episode.messages == episode.skipped == episode.deadline_misses == 0


@pytest.mark.slow
def test_episodes_are_in_one_world_until_one_acts_otherwise():
    driven_together = driven(spec(first_seed=FROM_LEFT))
    lives = [(c, s) for c in POINTS for s in (0, 1)]
    made = {one: decisions(driven_together, *one) for one in lives}
    assert len({d[0].scene for d in made.values()}) == 1
    for step in range(1, 6):
        there = [one for one in lives if step in made[one]]
        for a in there:
            for b in there:
                past = [
                    [(d.action, d.acts_at_s) for d in list(made[x].values())[:step]] for x in (a, b)
                ]
                if past[0] == past[1]:
                    assert made[a][step].scene == made[b][step].scene
                elif made[a][step].scene == made[b][step].scene:
                    # Keeping the speed is the same at any time.
                    assert [x for x in past[0] if x[0] == "SLOWER"] == [
                        x for x in past[1] if x[0] == "SLOWER"
                    ]


@pytest.mark.parametrize(
    ("points", "seeds", "episodes"),
    [
        pytest.param((ALONE, POINTS["6g"]), (0,), (1,), marks=pytest.mark.slow),
        pytest.param(tuple(POINTS.values()), (0, 1), (0, 1, 6), marks=pytest.mark.exhaustive),
    ],
)
def test_sharing_a_world_changes_nothing(points, seeds, episodes):
    together = driven(spec(points=points, seeds=seeds), episodes)
    places = product(points, seeds, episodes)
    alone = [driven(spec(points=(point,), seeds=(seed,)), (e,)) for point, seed, e in places]
    assert together.episodes == [episode for made in alone for episode in made.episodes]
    answers = {answer.id: answer for answer in together.answers}
    for made in alone:
        assert made.answers == [answers[answer.id] for answer in made.answers]
    assert set(answers) == {answer.id for made in alone for answer in made.answers}
    apart = [row for made in alone for row in made.decisions.table.to_pylist()]
    assert sorted(map(repr, together.decisions.table.to_pylist())) == sorted(map(repr, apart))


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "count",
    [pytest.param(2, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.exhaustive)],
)
def test_who_is_driven_beside_changes_nothing(count):
    together = driven(spec("proxy-faulty"), range(count))
    apart = [driven(spec("proxy-faulty"), (e,)) for e in range(count)]
    rows = Decisions.concat([made.decisions for made in apart]).table.to_pylist()
    assert together.decisions.table.to_pylist() == rows
    assert together.answers == [answer for made in apart for answer in made.answers]
    episodes = [episode for made in apart for episode in made.episodes]
    assert sorted(map(repr, together.episodes)) == sorted(map(repr, episodes))


def test_the_luck_is_the_frozen_runs(small):
    """The draws of every decision, frozen and in the closed loop, for the layouts of `small`."""

    def draws(of, world):
        asker = Asker(of, lambda: open_backend(of.ego.card), PAPER)
        for step, [decided] in enumerate(walk(world, of.points, asker, of.ties)):
            due = decided.due
            for n, (episode, seed) in enumerate(
                zip(due.episode.tolist(), due.seed.tolist(), strict=True)
            ):
                yield (
                    (episode, seed, step),
                    (due.draws.link[n].tolist(), due.draws.jitter[n].tolist()),
                )

    first = small.manifest.seed
    run = spec("cruise", points=(ALONE,), seeds=(3, 4), first_seed=first, episodes=4)
    frozen = dict(
        draws(spec_of(small, "cruise", points=(ALONE,)), FrozenWorld(small, (ALONE,), (3, 4)))
    )
    # A driver asks no helper, so the ego alone is looked at; `ego_alone` is given here to see all
    # four.
    closed = dict(
        draws(run, LiveWorld(SCENARIO, first, range(4), run.points, run.seeds, ego_alone=False))
    )
    assert closed.keys() <= frozen.keys()
    assert {step for *_, step in closed} == set(range(6))
    assert closed == {place: frozen[place] for place in closed}
    drawn = uniforms((8, 3), "channel", 3, first)
    link, jitter = frozen[0, 3, 4]
    assert np.array_equal(link, drawn[:2].T)
    assert np.array_equal(jitter, drawn[2 + 4])


def test_helpers_that_cannot_be_heard_make_no_difference_but_time():
    deaf = POINTS["v2x"].changed(name="deaf", loss=1.0)
    alone, unheard = driven(spec(points=(ALONE, deaf), seeds=(0,), first_seed=FROM_LEFT)).episodes
    assert alone.messages == 0 < unheard.messages
    assert unheard.latency_ms > alone.latency_ms


@pytest.mark.slow
def test_messages_that_the_egos_model_fuses_take_a_second_inference():
    """Unsure at 1 s, the ego hears three helpers, is asked again with their messages,
    and is for braking.
    """
    calling = named_point("6g:consensus=ego-prompt")
    run = spec("swarm-tiny", points=(POINTS["6g"], calling), seeds=(0,), first_seed=NO_DANGER)
    script = Script(
        lambda viewer, step: (UNSURE if viewer == "v1" else FASTER) if step == 1 else IDLE, SLOWER
    )
    made = driven(run, backend=script, infers=0.1)
    plain, fused = decisions(made, "6g"), decisions(made, calling.name)
    fusion_ms = column(made, "fusion_ms", calling.name)
    assert (plain[1].action, plain[1].acts_at_s) == ("FASTER", 1.12)
    assert (fused[1].action, fused[1].acts_at_s, fusion_ms[1]) == ("SLOWER", 1.22, 100.0)
    assert (fusion_ms[0], fused[0].acts_at_s) == (0.0, 0.1)
    assert [answer.key for answer in made.answers if answer.role == "merge"] == ["v1+v2+v3+v4"]
    assert sum("+" in asked for asked in script.asked) == 1


@pytest.mark.exhaustive
def test_a_language_model_in_float32_drives_alike_in_any_company():
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    points = [ALONE, named_point("6g:consensus=ego-prompt")]
    tiny = spec("swarm-tiny:transformers", points, (0,), first_seed=FROM_LEFT, latency="paper")
    together = driven(tiny, (0, 1), infers=0.145)
    alone = [driven(tiny.changed(batch_size=1), (e,), infers=0.145) for e in (0, 1)]
    episodes = [episode for made in alone for episode in made.episodes]
    assert sorted(map(repr, together.episodes)) == sorted(map(repr, episodes))
    answers = [answer for made in alone for answer in made.answers]
    assert any(answer.role == "merge" for answer in answers)

    def said(answers):
        return [msgspec.structs.replace(answer, batch_size=0, **UNTIMED) for answer in answers]

    assert said(together.answers) == said(answers)
    rows = [row for made in alone for row in made.decisions.table.to_pylist()]
    assert together.decisions.table.to_pylist() == rows
