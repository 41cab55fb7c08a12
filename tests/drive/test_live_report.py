"""The report page of a real, small live run."""

import json
import shutil
from dataclasses import replace

import pandas as pd
import pytest
from driving import FROM_LEFT
from evaluating import live_spec_of, run
from former import NAME, SCENARIO
from reading import Page, by_workers, details
from run_on_disk import change, damage, digested, rows_of

from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.evaluate.replay import played, scenes_of
from harness.prompts import versions as prompts
from harness.report.compare.pair import pair
from harness.report.decisions import failures, pick
from harness.report.details import cameras
from harness.report.page import render
from harness.report.runs import gather
from harness.runs.folder import read
from harness.runs.records import ClosedLoop
from harness.studies.replayed_run import ReplayedRun
from harness.world import scenarios

V2 = prompts.load("v2")


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Layouts with dangers; among others the ego alone runs into somebody,
    and does not under 6g.
    """
    out = tmp_path_factory.mktemp("live") / "run"
    run(live_spec_of(episodes=2, first_seed=FROM_LEFT), out)
    return out


def written(run):
    return render(gather([run]), full=True)


@pytest.fixture(scope="module")
def text(driven):
    return written(driven)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


@pytest.mark.slow
def test_every_moment_played_again_is_the_moment_that_was_asked(driven):
    found = read(driven)
    assert found.decisions.scenes
    names = list(found.decisions.scenes)
    assert [scene.id for scene in scenes_of(found, names)] == names


@pytest.mark.exhaustive
def test_workers_change_no_byte_of_a_page(driven, tmp_path, monkeypatch):
    one, two = by_workers(gather([driven]), tmp_path, monkeypatch)
    assert len(details(one)) > 8
    assert two == one


@pytest.mark.exhaustive
def test_a_run_with_other_beacons_is_replayed_with_them(tmp_path):
    spec = live_spec_of(
        episodes=1, first_seed=FROM_LEFT, points=(named_point("single-local"),), seeds=(0,)
    )
    name = f"{NAME},perfect_knowledge=true"
    run(replace(spec, source=replace(spec.source, scenario_name=name)), tmp_path / "run")
    found = read(tmp_path / "run")
    assert isinstance(found.manifest.world, ClosedLoop)
    assert found.manifest.world.scenario["parameters"]["perfect_knowledge"] is True
    scenes = scenes_of(found, list(found.decisions.scenes))
    assert [scene.id for scene in scenes] == list(found.decisions.scenes)
    assert all(scene.record.state.beacons == () for scene in scenes)
    run(spec, tmp_path / "beacons")
    paired = pair(tmp_path / "run", tmp_path / "beacons")
    ours, theirs = (side.settings["scenario.perfect_knowledge"] for side in (paired.a, paired.b))
    assert (ours, theirs) == ("True", "False")


@pytest.mark.slow
def test_a_run_is_replayed_with_the_parameters_that_it_states(driven, tmp_path):
    found = read(driven)
    scene = next(iter(found.decisions.scenes))
    earlier = edited(
        driven,
        tmp_path,
        "run.json",
        lambda text: text.replace('"time_limit_s": 10.0', '"time_limit_s": 0.5'),
    )
    assert played(read(earlier), 0, "6g", 0).scenario.parameters.time_limit_s == 0.5
    assert [replayed.id for replayed in scenes_of(read(earlier), [scene])] == [scene]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "says"),
    [
        ('"patience_s": 10.0', "scenario occluded-intersection has other parameters here"),
        ('"time_limit_s": 0.0', r"scenario: time_limit_s is 0\.0; it must be above 0"),
    ],
)
def test_parameters_that_no_scenario_has_are_said_to_be_the_runs(driven, tmp_path, stated, says):
    scene = next(iter(read(driven).decisions.scenes))
    forged = edited(
        driven, tmp_path, "run.json", lambda text: text.replace('"time_limit_s": 10.0', stated)
    )
    with pytest.raises(UserError, match=f"^run.json of [a-z]+: {says}"):
        scenes_of(read(forged), [scene])


@pytest.mark.exhaustive
def test_the_cameras_of_a_run_see_by_the_light_that_it_was_driven_in(tmp_path):
    spec = live_spec_of(
        episodes=1, first_seed=FROM_LEFT, points=(named_point("single-local"),), seeds=(0,)
    )
    name = f"{NAME},ambient=night"
    run(replace(spec, source=replace(spec.source, scenario_name=name)), tmp_path / "run")
    found = read(tmp_path / "run")
    every = details(written(tmp_path / "run"))
    assert list(every) == list(found.decisions.scenes)
    for scene, detail in every.items():
        [replayed] = scenes_of(found, [scene])
        assert detail["cameras"] == plain(cameras(scenarios.get(name), replayed))
        assert detail["cameras"] != plain(cameras(SCENARIO, replayed))


def plain(value):
    """As it comes back from JSON."""
    return json.loads(json.dumps(value))


@pytest.mark.slow
def test_each_condition_is_shown_with_what_only_driving_shows(driven, page):
    found = read(driven)
    for name in ("single-local", "v2x", "6g"):
        score = found.score(name, "collision_rate")
        assert (
            f"{100 * score.value:.1f} % {100 * score.low:.1f} to {100 * score.high:.1f} %"
            in page.text
        )
        gap = found.score(name, "least_gap_m")
        assert f"{gap.value:.1f} m" in page.text
    assert (
        "2 episodes of occluded-intersection, scenes of v2v-safety, driven in closed loop ("
        in page.text
    )
    assert "(layout seeds 6 to 7)" in page.text
    for metric in ("collision rate", "time to clear", "least gap", "hard brakings per episode"):
        assert metric in page.text
    assert "decision that leads to a collision" not in page.text  # a frozen run's unsafe rate


def by_scene(run):
    """Decisions of each moment."""
    found = {}
    for row in rows_of(run):
        found.setdefault(row["scene"], []).append(row)
    return found


@pytest.mark.slow
def test_a_moment_has_what_was_decided_when_it_acted_and_what_became_of_each_episode(driven, text):
    every, moments = details(text), by_scene(driven)
    ends = {(e.condition, e.seed, e.episode): e for e in read(driven).episodes}
    assert list(every) == list(moments)
    for scene, rows in moments.items():
        [told] = every[scene]["runs"]
        again = {
            (d["condition"], seed): d.get("acts_at_s")
            for d in told["decisions"]
            for seed in d["seeds"]
        }
        assert again == {(row["condition"], row["seed"]): row["acts_at_s"] for row in rows}
        number = rows[0]["episode"]
        assert len(told["ends"]) == len([e for e in ends.values() if e.episode == number])
        for end in told["ends"]:
            known = ends[end["condition"], end["seed"], number]
            assert end["result"] == (known.failure or "cleared")
            assert all(
                end[name] == getattr(known, name)
                for name in ("time_s", "delay_s", "partner", "striker", "fault", "least_gap_m",
                             "hard_brakings", "other_crashes")
            )  # fmt: skip
    assert any(end["result"] == "collision" for d in every.values() for end in d["runs"][0]["ends"])


@pytest.mark.slow
def test_a_failure_is_shown_where_it_parts_from_a_success_with_its_seed(driven):
    found, moments = read(driven), by_scene(driven)
    failed = {(e.condition, e.seed, e.episode) for e in found.episodes if not e.success}

    def fails(row):
        return (row["condition"], row["seed"], row["episode"]) in failed

    telling = failures(found)
    assert telling
    for scene, seed in telling.items():
        rows = moments[scene]
        of_layout = [e.success for e in found.episodes if e.episode == rows[0]["episode"]]
        assert not all(map(fails, rows)) or not any(of_layout)
        assert any(fails(row) and row["seed"] == seed for row in rows)
        later = list(moments.values())[list(moments).index(scene) + 1 :]
        for others in (
            rows for rows in later if rows[0]["episode"] == moments[scene][0]["episode"]
        ):
            assert len(set(map(fails, others))) == 1
    assert set(telling) <= set(pick(found, telling, 60))


def shown(every):
    """What each answer of each moment was asked, as far as the page knows."""
    return {
        (scene, a["viewer"]): a["prompt"] is not None and d["prompts"][a["prompt"]]
        for scene, d in every.items() for a in d["runs"][0]["answers"]
    }  # fmt: skip


@pytest.mark.slow
def test_prompts_are_the_very_ones_that_were_sent(driven, text):
    found = shown(details(text))
    assert all(found.values())
    run = read(driven)
    [scene] = {row["scene"] for row in rows_of(driven) if (row["episode"], row["step"]) == (0, 0)}
    sent = V2.render(scenes_of(run, [scene])[0].graphs["v1"], run.actions, [])
    assert found[scene, "v1"] == [dict(message) for message in sent]


@pytest.mark.exhaustive
def test_the_prompt_of_a_second_answer_has_the_messages_that_were_heard(tmp_path):
    pytest.importorskip("torch", reason="needs the transformers extra")
    point = named_point("6g:consensus=ego-prompt")
    of = live_spec_of(
        "swarm-tiny:transformers", episodes=1, points=(point,), seeds=(0,), first_seed=FROM_LEFT,
        latency="paper",
    )  # fmt: skip
    run(of, tmp_path / "run")
    heard = {(a.scene, a.key) for a in read(tmp_path / "run").answers if a.heard}
    found = shown(details(written(tmp_path / "run")))
    assert all(found.values())
    assert heard
    assert {key for key in found if "+" in key[1]} == heard
    assert all("MESSAGES" in found[key][-1]["content"] for key in heard)


@pytest.mark.exhaustive
def test_a_driver_beside_a_model_takes_no_helper_out_of_the_picture(driven, tmp_path):
    run(live_spec_of("cruise", episodes=2, first_seed=FROM_LEFT), tmp_path / "cruise")
    every = details(render(gather([tmp_path / "cruise", driven])))
    both = [d for d in every.values() if all(d["runs"])]
    assert both
    assert all(len(d["world"]["viewers"]) == 4 for d in both)


def copied(driven, tmp_path):
    return shutil.copytree(driven, tmp_path / "copy")


def edited(driven, tmp_path, name, edit):
    """A copy of the run with one text file edited."""
    copy = copied(driven, tmp_path)
    (copy / name).write_text(edit((copy / name).read_text()))
    return copy


@pytest.mark.exhaustive
def test_a_prompt_with_another_digest_than_was_asked_is_not_shown(driven, tmp_path):
    def answer(a):
        if a["viewer"] == "v2":
            a["prompt_sha256"] = "0" * 64

    copy = copied(driven, tmp_path)
    change(copy, answer=answer)
    found = shown(details(written(copy)))
    assert {viewer for (_, viewer), sent in found.items() if not sent} == {"v2"}
    assert all(sent for (_, viewer), sent in found.items() if viewer != "v2")


@pytest.mark.slow
def test_a_moment_that_cannot_be_played_again_has_neither_picture_nor_prompt(driven, tmp_path):
    other = edited(
        driven,
        tmp_path,
        "run.json",
        lambda text: text.replace('"first_seed": 6', '"first_seed": 600'),
    )
    digested(other)
    episodes = pd.read_csv(other / "episodes.csv")
    episodes["layout_seed"] += 594
    episodes.to_csv(other / "episodes.csv", index=False)
    every = details(written(other))
    assert every
    assert all(detail["world"] is None and detail["cameras"] is None for detail in every.values())
    assert not any(shown(every).values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        (
            "run.json",
            lambda t: t.replace('"first_seed"', '"first"'),
            "run.json is broken .*`first_seed`",
        ),
        ("episodes.csv", lambda t: t.replace("partner", "p"), "episodes.csv is broken .*partner"),
        (
            "episodes.csv",
            lambda t: t[: t.rindex("\n", 0, -1) + 1],
            "episodes.csv is broken .not every episode is there once in every condition and seed",
        ),
    ],
)
def test_a_broken_live_run_is_one_line_that_names_the_file(driven, tmp_path, name, edit, message):
    with pytest.raises(UserError, match=message) as error:
        written(edited(driven, tmp_path, name, edit))
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_decisions_without_a_step_are_one_line_that_names_the_file(driven, tmp_path):
    copy = copied(driven, tmp_path)
    damage(copy, decision=lambda row: row.update(step=None))
    with pytest.raises(UserError, match=r"decisions.parquet is broken .step is unknown") as error:
        written(copy)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_what_needs_frozen_scenes_refuses_a_live_run(driven):
    with pytest.raises(UserError, match=r"was driven, .* give a folder made by `harness eval`"):
        ReplayedRun(driven)
