"""The report page of a real, small live run."""

import json
import shutil

import pytest
from driving import FROM_LEFT, spec
from harness.evaluate.drive import run
from harness.runs.driven_folder import read
from reading import Page, details

from harness.coordination.operating_point import named_point
from harness.core.errors import UserError
from harness.evaluate.replay import scene_of
from harness.prompts import versions as prompts
from harness.report.choose import FAILURE, failures, pick
from harness.report.page import render
from harness.report.runs import gather
from harness.runs import folder

V2 = prompts.load("v2")


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Layouts with dangers; among others the ego alone runs into somebody, and does not under 6g."""
    out = tmp_path_factory.mktemp("live") / "run"
    run(spec(episodes=3, first_seed=FROM_LEFT), out, False, 1, lambda done: None)
    return out


def written(run):
    return render(gather([run]))


@pytest.fixture(scope="module")
def text(driven):
    return written(driven)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_every_moment_played_again_is_the_moment_that_was_asked(driven):
    found = read(driven)
    assert [scene_of(found, row).id for row in found.rows] == [row["scene"] for row in found.rows]


def test_each_condition_is_shown_with_what_only_driving_shows(driven, page):
    found = read(driven)
    for name in ("single-local", "v2x", "6g"):
        score = found.score(name, "collision_rate")
        assert f"{100 * score.value:.1f} % {100 * score.low:.1f} to {100 * score.high:.1f} %" in page.text
        gap = found.score(name, "least_gap_m")
        assert f"{gap.value:.1f} m" in page.text
    assert "3 episodes of occluded-intersection driven live (layout seeds 6 to 8)" in page.text
    for metric in ("collision rate", "time to clear", "least gap", "hard brakings per episode"):
        assert metric in page.text
    assert "decision that leads to a collision" not in page.text  # a frozen run's unsafe rate


def test_a_moment_has_what_was_decided_when_it_acted_and_what_became_of_each_episode(driven, text):
    found, every = read(driven), details(text)
    assert list(every) == [row["scene"] for row in found.rows]
    for row in found.rows:
        [told] = every[row["scene"]]["runs"]
        again = {(d["condition"], seed): d.get("acts_at_s") for d in told["decisions"] for seed in d["seeds"]}
        assert again == {(d["condition"], d["seed"]): d.get("acts_at_s") for d in row["decisions"]}
        for end in told["ends"]:
            known = found.ends[end["condition"], end["seed"], row["episode"]]
            assert end.items() >= known.items()
    assert any(end["result"] == "collision" for d in every.values() for end in d["runs"][0]["ends"])


def test_a_failure_is_shown_where_it_parts_from_a_success_with_its_seed(driven):
    found = read(driven)
    for i, seed in failures(found).items():
        row = found.rows[i]
        ends = {
            (d["condition"], d["seed"]): found.ends[d["condition"], d["seed"], row["episode"]]["result"]
            for d in row["decisions"]
        }
        assert "cleared" in ends.values()
        assert any(result != "cleared" and s == seed for (_, s), result in ends.items())
        later = [r for r in found.rows[i + 1 :] if r["episode"] == row["episode"]]
        for other in later:
            results = {
                found.ends[d["condition"], d["seed"], other["episode"]]["result"] for d in other["decisions"]
            }
            assert results == {"cleared"} or "cleared" not in results
    assert FAILURE in {chosen.why for chosen in pick(found.rows, failures(found), 60)}


def shown(every):
    """What each answer of each moment was asked, as far as the page knows."""
    return {
        (scene, a["viewer"]): a["prompt"] is not None and d["prompts"][a["prompt"]]
        for scene, d in every.items() for a in d["runs"][0]["answers"]
    }  # fmt: skip


def test_prompts_are_the_very_ones_that_were_sent(driven, text):
    found = shown(details(text))
    assert all(found.values())
    run = read(driven)
    [row] = [r for r in run.rows if (r["episode"], r["step"]) == (0, 0)]
    sent = V2.render(scene_of(run, row).record["graphs"]["v1"], run.config["actions"], [])
    assert found[row["scene"], "v1"] == [dict(message) for message in sent]


@pytest.mark.slow
def test_the_prompt_of_a_second_answer_has_the_messages_that_were_heard(tmp_path):
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    point = named_point("6g:consensus=ego-prompt")
    of = spec("swarm-tiny", points=[point], seeds=(0,), first_seed=FROM_LEFT, latency="paper")
    run(of, tmp_path / "run", False, 1, lambda done: None)
    heard = {(row["scene"], key) for row in read(tmp_path / "run").rows for key in row.get("merged", {})}
    found = shown(details(written(tmp_path / "run")))
    assert all(found.values())
    assert heard
    assert {key for key in found if "+" in key[1]} == heard
    assert all("MESSAGES" in found[key][-1]["content"] for key in heard)


def test_a_driver_beside_a_model_takes_no_helper_out_of_the_picture(driven, tmp_path):
    run(spec("cruise", episodes=3, first_seed=FROM_LEFT), tmp_path / "cruise", False, 1, lambda done: None)
    every = details(render(gather([tmp_path / "cruise", driven])))
    both = [d for d in every.values() if all(d["runs"])]
    assert both
    assert all(len(d["world"]["viewers"]) == 4 for d in both)


def changed(driven, tmp_path, name, edit):
    copy = tmp_path / "copy"
    shutil.copytree(driven, copy)
    (copy / name).write_text(edit((copy / name).read_text()))
    return copy


def test_a_prompt_with_another_digest_than_was_asked_is_not_shown(driven, tmp_path):
    def edit(text):
        rows = [json.loads(line) for line in text.splitlines()[:5]]
        for row in rows:
            row["answers"]["v2"]["prompt_sha256"] = "0" * 64
        return "".join(json.dumps(row) + "\n" for row in rows)

    found = shown(details(written(changed(driven, tmp_path, "rows.jsonl", edit))))
    assert {viewer for (_, viewer), sent in found.items() if not sent} == {"v2"}
    assert all(sent for (_, viewer), sent in found.items() if viewer != "v2")


def test_a_moment_that_cannot_be_played_again_has_neither_picture_nor_prompt(driven, tmp_path):
    other = changed(
        driven, tmp_path, "run.json", lambda text: text.replace('"first_seed": 6', '"first_seed": 600')
    )
    every = details(written(other))
    assert all(detail["world"] is None for detail in every.values())
    assert not any(shown(every).values())


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("run.json", lambda t: t.replace('"first_seed"', '"first"'), "run.json lacks first_seed"),
        ("rows.jsonl", lambda t: t.replace('"step"', '"stop"'), "rows.jsonl line 1 lacks step"),
        ("episodes.csv", lambda t: t.replace("partner", "p"), "episodes.csv is broken"),
        ("episodes.csv", lambda t: t[: t.rindex("\n", 0, -1) + 1], "lacks episode 2 of 6g with seed 1"),
    ],
)
def test_a_broken_live_run_is_one_line_that_names_the_file(driven, tmp_path, name, edit, message):
    with pytest.raises(UserError, match=message) as error:
        gather([changed(driven, tmp_path, name, edit)])
    assert "\n" not in str(error.value)


def test_what_needs_frozen_scenes_refuses_a_live_run(driven):
    with pytest.raises(UserError, match=r"has format 'swarmdrive-drive/1'.* made by `harness eval`"):
        folder.read(driven)
