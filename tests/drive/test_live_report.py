"""The report page of a real, small live run."""

import json
import shutil

import pytest
from driving import FROM_LEFT, spec
from reading import Page

from harness import prompts
from harness.drive.folder import read
from harness.drive.replay import scene_of
from harness.drive.run import run
from harness.errors import UserError
from harness.operating_point import named_point
from harness.report.choose import FAILURE, failures, pick
from harness.report.page import write_report
from harness.run import folder

V2 = prompts.load("v2")


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Layouts with dangers; among others the ego alone runs into somebody, and does not under 6g."""
    out = tmp_path_factory.mktemp("live") / "run"
    run(spec(episodes=3, first_seed=FROM_LEFT), out, False, 1, lambda done: None)
    return out


@pytest.fixture(scope="module")
def page(driven):
    return Page(write_report(driven).read_text())


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


def test_a_moment_shows_what_was_decided_when_it_acted_and_who_was_hit_by_whose_fault(driven, page):
    found = read(driven)
    shown = pick(found.rows, failures(found), 60)
    for row, seed, _ in shown:
        for made in row["decisions"]:
            if made["seed"] == seed and made["acted"]:
                assert f"acts at {made['acts_at_s']:.2f} s" in page.text
    crashes = {
        (end["partner"], end["fault"], end["time_s"])
        for row, seed, _ in shown
        for name in found.conditions
        if (end := found.ends[name, seed, row["episode"]])["result"] == "collision"
    }
    assert crashes
    for partner, fault, time_s in crashes:
        assert f"collision with {partner}, fault: {fault}" in page.text
        assert f"{time_s:.2f} s" in page.text


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


def test_prompts_are_the_very_ones_that_were_sent(driven, page):
    assert "prompt: not rendered" not in page.text
    [row] = [r for r in read(driven).rows if (r["episode"], r["step"]) == (0, 0)]
    sent = V2.render(scene_of(read(driven), row).record["graphs"]["v1"], read(driven).config["actions"], [])
    assert sent[-1]["content"] in "".join(page.pieces)


@pytest.mark.slow
def test_the_prompt_of_a_second_answer_has_the_messages_that_were_heard(tmp_path):
    point = named_point("6g:consensus=ego-prompt")
    of = spec("swarm-tiny", points=[point], seeds=(0,), first_seed=FROM_LEFT, latency="paper")
    run(of, tmp_path / "run", False, 1, lambda done: None)
    heard = [key for row in read(tmp_path / "run").rows for key in row.get("merged", {})]
    found = Page(write_report(tmp_path / "run").read_text())
    assert "prompt: not rendered" not in found.text
    assert found.text.count(", merge") == len(heard) > 0


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

    found = Page(write_report(changed(driven, tmp_path, "rows.jsonl", edit)).read_text())
    moments = found.values("class").count("decision")
    assert found.text.count("prompt: not rendered") == moments
    assert found.tags["img"] == moments + 2


def test_a_moment_that_cannot_be_played_again_has_neither_picture_nor_prompt(driven, tmp_path):
    other = changed(
        driven, tmp_path, "run.json", lambda text: text.replace('"first_seed": 6', '"first_seed": 600')
    )
    found = Page(write_report(other).read_text())
    assert found.tags["img"] == 2
    assert found.text.count("No picture: played again here") == found.values("class").count("decision")
    assert "prompt, 2 messages" not in found.text


PAYLOADS = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{ 7 * 7 }}", "</pre></details>")


def test_nothing_that_a_model_or_a_file_says_becomes_markup(driven, tmp_path, page):
    payload = "".join(PAYLOADS)

    def edit(text):
        rows = [json.loads(line) for line in text.splitlines()]
        for row in rows:
            for answer in row["answers"].values():
                answer |= {"raw": payload, "detail": payload, "error": payload}
        return "".join(json.dumps(row) + "\n" for row in rows)

    hostile = changed(driven, tmp_path, "rows.jsonl", edit)
    quoted = payload.replace('"', '""')
    episodes = (hostile / "episodes.csv").read_text().replace(",ego,", f',"{quoted}",')
    (hostile / "episodes.csv").write_text(episodes.replace(",other,", f',"{quoted}",'))
    found = Page(write_report(hostile).read_text())
    assert "script" not in found.tags
    assert not any(name.startswith("on") for _, name, _ in found.attributes)
    same = {"html", "head", "body", "main", "style", "title", "img", "section", "details", "pre"}
    assert {tag: found.tags[tag] for tag in same} == {tag: page.tags[tag] for tag in same}
    assert f"fault: {' '.join(payload.split())}" in found.text


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
        write_report(changed(driven, tmp_path, name, edit))
    assert "\n" not in str(error.value)


def test_what_needs_frozen_scenes_refuses_a_live_run(driven):
    with pytest.raises(UserError, match=r"has format 'swarmdrive-drive/1'.* made by `harness eval`"):
        folder.read(driven)
