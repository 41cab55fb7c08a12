"""Live episodes: a hand-played one, what latency does, and what episodes share."""

from dataclasses import replace

import numpy as np
import pytest
from driving import ALONE, FROM_LEFT, NO_DANGER, ONCOMING, Script, decisions, driven, spec
from harness.evaluate.live import P, _draws, frames
from harness.evaluate.scoring import draw

from harness.coordination.operating_point import POINTS, named_point
from harness.core.noise import uniforms
from harness.evaluate.branches import Decision, Episode, Trajectory
from harness.evaluate.success import table
from harness.world import reference as live
from harness.world.drivers import DRIVERS
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.world import World

IDLE, SLOWER, FASTER, UNSURE = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.4, 0.3)


def test_an_episode_played_by_hand():
    """Nobody is dangerous. At 1 s the ego is unsure: alone it goes on, over 6G its helpers make it brake.

    A decision takes 0.1 s of thought, 5 frames. Over 6G it takes 5 ms of latency and at most 1.9 ms of
    jitter and 0.02 ms on air more: 6 frames. What braking costs shows in the time to clear.
    """

    def line(viewer, step):
        if step != 1:
            return FASTER if step > 1 else IDLE
        return UNSURE if viewer == "v1" else SLOWER

    script = Script(line)
    run = spec(points=(ALONE, POINTS["6g"]), seeds=(0,), first_seed=NO_DANGER)
    moments, (alone, told) = driven(run, backend=script, infer_s=0.1)

    mine, its = decisions(moments, "single-local"), decisions(moments, "6g")
    assert [mine[k]["acts_at_s"] for k in range(3)] == [0.1, 1.1, 2.1]
    assert (mine[1]["action"], mine[1]["triggered"], mine[1]["messages"]) == ("IDLE", False, [])
    assert (its[1]["action"], its[1]["triggered"], its[1]["acts_at_s"]) == ("SLOWER", True, 1.12)
    assert [m["from"] for m in its[1]["messages"]] == ["v2", "v3", "v4"]
    assert all(m["on_time"] and 105 <= m["arrival_ms"] < 107 for m in its[1]["messages"])
    assert mine[1]["scene"] == its[1]["scene"]  # nothing has parted them before
    assert mine[2]["scene"] != its[2]["scene"]
    assert len(script.asked) == len(set(script.asked)) == 4 * len(moments)

    world = World.start(SCENARIO, NO_DANGER)
    for frame, action in ((56, "SLOWER"), (105, "FASTER"), (155, "FASTER")):
        world.advance(frame)
        world.take(action)
    world.advance(500)
    assert (told["result"], told["clear_s"]) == ("cleared", world.outcome.time_s)
    assert (told["hard_brakings"], alone["hard_brakings"]) == (1, 0)
    assert alone["clear_s"] == live.drive(SCENARIO, "cruise", NO_DANGER).time_s < told["clear_s"]


def test_braking_three_frames_later_is_42_centimetres_further():
    """145 ms are 8 frames and 219 ms are 11. From 14 to 7 m/s, 0.06 s later: 0.06 s x 7 m/s."""
    assert (frames(0.145), frames(0.219), frames(0.14), frames(0.0)) == (8, 11, 7, 0)
    south_m = []
    for latency_s in (0.145, 0.219):
        episode = Episode(ALONE, 0, Decision("SLOWER", 50 + frames(latency_s), {}))
        [one] = Trajectory(0, World.start(SCENARIO, NO_DANGER), [episode]).advance(250)
        assert one.world.state().ego.speed_mps == pytest.approx(7.0, abs=0.02)
        south_m.append(one.world.state().ego.y_m)
    assert south_m[0] - south_m[1] == pytest.approx(0.42, abs=1e-3)


def test_a_decision_acts_in_its_frame_and_not_before():
    still, braking = World.start(SCENARIO, NO_DANGER), Trajectory(
        0, World.start(SCENARIO, NO_DANGER), [Episode(ALONE, 0, Decision("SLOWER", 8, {}))]
    )  # fmt: skip
    still.advance(8)
    braking.advance(8)
    assert braking.world.state().vehicles == still.state().vehicles
    assert (still.speed_index, braking.world.speed_index) == (2, 1)
    braking.advance(9)
    still.advance(9)
    assert still.state().ego.speed_mps - braking.world.state().ego.speed_mps == pytest.approx(8.0 * 0.02)


def test_a_decision_still_open_when_the_next_is_due_goes_on_and_the_next_is_skipped():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=NO_DANGER)
    moments, [episode] = driven(run, backend=Script(lambda viewer, step: SLOWER), infer_s=1.3)
    made = decisions(moments, "single-local")
    assert {k: d["acts_at_s"] for k, d in made.items()} == {0: 1.3, 2: 3.3, 4: 5.3}
    assert (episode["decisions"], episode["skipped"], episode["never_acted"]) == (3, 3, 0)
    assert episode["deadline_misses"] == 3  # 1.3 s outlast a window of 0.2 s
    world = World.start(SCENARIO, NO_DANGER)
    for frame in (65, 165, 265):
        world.advance(frame)
        world.take("SLOWER")
    world.advance(500)
    assert (episode["result"], episode["least_gap_m"]) == ("time_out", round(world.outcome.least_gap_m, 3))


def test_a_decision_that_is_ready_when_the_next_is_due_acts_first():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=NO_DANGER)
    moments, [episode] = driven(run, backend=Script(lambda viewer, step: IDLE), infer_s=1.0)
    made = decisions(moments, "single-local")
    assert (list(made), episode["skipped"]) == ([0, 1, 2, 3, 4, 5], 0)


def test_an_episode_that_ends_while_a_decision_is_open_records_it_and_never_acts_on_it():
    run = spec(points=(ALONE,), seeds=(0,), first_seed=FROM_LEFT)  # cruising ends in a collision
    moments, [episode] = driven(run, backend=Script(lambda viewer, step: IDLE), infer_s=0.9)
    made = decisions(moments, "single-local")
    last = made[max(made)]
    assert (episode["result"], episode["never_acted"], last["acted"]) == ("collision", 1, False)
    assert last["acts_at_s"] > episode["time_s"]
    assert (episode["partner"] is not None, episode["fault"], episode["least_gap_m"]) == (True, "ego", 0.0)


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("seed", [NO_DANGER, FROM_LEFT, ONCOMING])
def test_a_driver_that_needs_no_time_drives_as_the_reference_does(driver, seed):
    _, episodes = driven(spec(driver, first_seed=seed))
    outcome = live.drive_all(SCENARIO, seed)[driver]
    assert len(episodes) == 6
    for episode in episodes:
        assert (episode["result"], episode["time_s"]) == (outcome.result, outcome.time_s)
        assert (episode["partner"], episode["fault"]) == (outcome.partner, outcome.fault)
        assert episode["messages"] == episode["skipped"] == episode["deadline_misses"] == 0


def test_episodes_are_in_one_world_until_one_acts_otherwise():
    moments, _ = driven(spec(first_seed=FROM_LEFT))
    lives = [(c, s) for c in POINTS for s in (0, 1)]
    made = {one: decisions(moments, *one) for one in lives}
    assert len({d[0]["scene"] for d in made.values()}) == 1
    for step in range(1, 6):
        there = [one for one in lives if step in made[one]]
        for a in there:
            for b in there:
                past = [
                    [(d["action"], d["acts_at_s"]) for d in list(made[x].values())[:step]] for x in (a, b)
                ]
                if past[0] == past[1]:
                    assert made[a][step]["scene"] == made[b][step]["scene"]
                elif made[a][step]["scene"] == made[b][step]["scene"]:
                    # Keeping the speed is the same at any time.
                    assert [x for x in past[0] if x[0] == "SLOWER"] == [
                        x for x in past[1] if x[0] == "SLOWER"
                    ]


def test_sharing_a_world_changes_nothing():
    together = driven(spec(), (0, 1, 6))
    alone = [driven(spec(points=(point,), seeds=(seed,)), (e,)) for e in (0, 1, 6)
             for point in POINTS.values() for seed in (0, 1)]  # fmt: skip
    assert together[1] == [episode for _, episodes in alone for episode in episodes]
    answers = {row["scene"]: row["answers"] for row in together[0]}
    for moments, _ in alone:
        assert all(answers[row["scene"]] == row["answers"] for row in moments)


def test_who_is_driven_beside_changes_nothing():
    together = driven(spec("proxy-faulty"), range(5))
    apart = [driven(spec("proxy-faulty"), (e,)) for e in range(5)]
    assert together[0] == [row for moments, _ in apart for row in moments]
    assert together[1] == [row for _, episodes in apart for row in episodes]


def test_the_luck_is_the_frozen_runs(small):
    drawn = draw(table(small), 3, (len(small.scenes), 3))
    first = small.scenes[0].record["episode_seed"]
    assert np.array_equal(_draws(3, first, 3)[:2].T, drawn.link[0])
    assert np.array_equal(_draws(3, first, 3)[2 + 4], drawn.jitter[4])
    assert P.decisions == 6
    assert uniforms((8, 3), "channel", 3, first).tolist() == _draws(3, first, 3).tolist()


def test_helpers_that_cannot_be_heard_make_no_difference_but_time():
    deaf = replace(POINTS["v2x"], name="deaf", loss=1.0)
    _, episodes = driven(spec(points=(ALONE, deaf), seeds=(0,), first_seed=FROM_LEFT))
    assert episodes[0]["messages"] == 0 < episodes[1]["messages"]
    assert episodes[1]["means"]["latency_ms"] > episodes[0]["means"]["latency_ms"]


def test_messages_that_the_egos_model_merges_take_a_second_inference():
    """Unsure at 1 s, the ego hears three helpers, is asked again with their messages, and is for braking."""
    merging = named_point("6g:consensus=ego-prompt")
    run = spec("swarm-tiny", points=(POINTS["6g"], merging), seeds=(0,), first_seed=NO_DANGER)
    script = Script(
        lambda viewer, step: (UNSURE if viewer == "v1" else FASTER) if step == 1 else IDLE, SLOWER
    )
    moments, _ = driven(run, backend=script, infer_s=0.1)
    plain, merged = decisions(moments, "6g"), decisions(moments, merging.name)
    assert (plain[1]["action"], plain[1]["acts_at_s"]) == ("FASTER", 1.12)
    assert (merged[1]["action"], merged[1]["acts_at_s"], merged[1]["fusion_ms"]) == ("SLOWER", 1.22, 100.0)
    assert (merged[0]["fusion_ms"], merged[0]["acts_at_s"]) == (0.0, 0.1)
    [again] = [row["merged"] for row in moments if "merged" in row]
    assert list(again) == ["v1+v2+v3+v4"]
    assert sum("+" in asked for asked in script.asked) == 1


@pytest.mark.slow
def test_a_language_model_in_float32_drives_alike_in_any_company():
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    points = [ALONE, named_point("6g:consensus=ego-prompt")]
    tiny = spec("swarm-tiny:transformers", points, (0,), first_seed=FROM_LEFT, latency="paper")
    together = driven(tiny, (0, 1), infer_s=0.145)
    alone = [driven(replace(tiny, batch_size=1), (e,), infer_s=0.145) for e in (0, 1)]
    assert together[1] == [episode for _, episodes in alone for episode in episodes]
    moments = [row for some, _ in alone for row in some]
    assert any("merged" in row for row in moments)
    for row in (*moments, *together[0]):
        for answer in (*row["answers"].values(), *row.get("merged", {}).values()):
            del answer["batch_size"], answer["seconds"]
    assert moments == together[0]
