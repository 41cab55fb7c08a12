"""Prompts and models side by side."""

from dataclasses import replace

import numpy as np
import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from markupsafe import escape
from reading import by_workers, details
from run_on_disk import answers_of, rows_of
from sample_run import write_run

from harness.coordination.named_points import POINTS
from harness.dataset.load import load
from harness.report import matrix, panels
from harness.report.charts import statuses
from harness.report.page import render
from harness.report.runs import gather
from harness.report.words import score_texts
from harness.runs.folder import read
from harness.runs.headline import SUCCESS


def marked(*ended):
    [marks] = matrix.marked([[{(e, 0): x for e, x in enumerate(of)} for of in ended]])
    return marks


def marks(*ended):
    return [mark for mark, _ in marked(*ended)]


def test_the_best_is_marked_and_who_cannot_be_told_from_it():
    best, close, worse = [1.0] * 19 + [0.0], [1.0] * 18 + [0.0] * 2, [1.0] * 8 + [0.0] * 12
    assert marks(close, best, worse) == [matrix.CLOSE, matrix.BEST, matrix.WORSE]
    assert marks(best) == [""]  # nobody to be better than


def test_where_seeds_differ_the_interval_over_episodes_decides():
    luck = np.random.default_rng(0)
    one = {(e, s): float(luck.random() < 0.9) for e in range(60) for s in range(3)}
    other = {(e, s): float(luck.random() < 0.5) for e in range(60) for s in range(3)}
    [[(first, _), (second, behind)]] = matrix.marked([[one, other]])
    assert (first, second) == (matrix.BEST, matrix.WORSE)
    assert behind.change.value < behind.change.high < 0
    assert (behind.change.n, behind.p_value < 0.001) == (60, True)


def test_a_run_of_easier_episodes_alone_is_not_the_best():
    """Its 19 of 20 are 95 %, against 120 of 200; on these 20 the other succeeds in every one."""
    long, short = [1.0] * 120 + [0.0] * 80, [1.0] * 19 + [0.0]
    (first, _), (second, behind) = marked(long, short)
    assert (first, second) == (matrix.BEST, matrix.CLOSE)
    assert (behind.change.value, behind.change.n) == (pytest.approx(-0.05), 20)
    assert marks(short, long) == [matrix.CLOSE, matrix.BEST], "whatever the order"


def test_where_each_run_is_behind_another_none_is_the_best():
    """The first beats the second on 40 episodes;
    the third, of 4, beats the first and loses to the second.
    """
    first = [0.0, 0.0, 1.0, 0.0] + [1.0] * 36
    second = [1.0, 1.0, 1.0, 1.0] + [0.0] * 36
    third = [1.0, 1.0, 1.0, 0.0]
    assert marked(first, second, third) == [("", None)] * 3


def test_runs_without_episodes_in_common_are_not_marked():
    one, other = {(e, 0): 1.0 for e in range(5)}, {(e, 0): 0.0 for e in range(5, 10)}
    assert matrix.marked([[one, other]]) == [[("", None), ("", None)]]
    assert matrix.marked([[one, {}]]) == [[("", None), ("", None)]], "made under another condition"


def test_holm_counts_every_pair_under_every_condition():
    """Seven of 18 successes lost in 20 episodes, none gained:
    real alone and among 6 pairs, not among 12.

    Of 4 runs under 2 conditions there are 12 pairs:
    the first counts 12 times, and so do the next, equal ones at least.
    """
    best, worse = ({(e, 0): float(first <= e < 18) for e in range(20)} for first in (0, 7))
    [[_, (mark, alone)]] = matrix.marked([[best, worse]])
    assert mark == matrix.WORSE
    assert alone.change.high < 0
    [[_, *others]] = matrix.marked([[best, worse, worse, worse]])
    assert [mark for mark, _ in others] == [matrix.WORSE] * 3
    assert [behind.p_value for _, behind in others] == pytest.approx([6 * alone.p_value] * 3)
    for _, *others in matrix.marked([[best, worse, worse, worse]] * 2):
        assert [mark for mark, _ in others] == [matrix.CLOSE] * 3
        assert [behind.p_value for _, behind in others] == pytest.approx([12 * alone.p_value] * 3)


@pytest.fixture(scope="session")
def both(run, dataset, tmp_path_factory):
    prompt = {"version": "v1", "sha256": "00" * 32}
    other = write_run(
        tmp_path_factory.mktemp("matrix") / "other", dataset, model="other", prompt=prompt
    )
    return gather([run, other])


def test_a_run_has_a_line_under_each_condition_and_a_place_in_each_grid(both):
    lines = matrix.lines(both)
    assert [(x.name, x.condition) for x in lines] == [
        (name, c) for c in both.conditions for name in ("rule-of-thumb · v2", "other · v1")
    ]
    for grid in matrix.grids(lines):
        assert grid.prompts == ("v2", "v1")
        assert [(model, [len(cell) for cell in cells]) for model, cells in grid.rows] == [
            ("rule-of-thumb", [1, 0]), ("other", [0, 1]),
        ]  # fmt: skip


def test_the_headline_names_the_best_or_says_that_there_is_none(both):
    lines = matrix.lines(both)
    assert matrix.headline(lines).startswith(
        "Best under single-local: none clearly (0.0 % at the most; "
    )
    best = [line for line in lines if line.mark == matrix.BEST]
    apart = "the most of 2 runs that cannot be told apart"
    assert [(f["what"], f["value"]) for f in matrix.figures(lines)] == [
        (f"success with {line.condition}, {apart}", score_texts(line.scores[SUCCESS])["value"])
        for line in best
    ]
    clear = [
        replace(line, mark=matrix.WORSE if line.mark == matrix.CLOSE else line.mark)
        for line in lines
    ]
    assert f"single-local: {best[0].name} " in matrix.headline(clear)
    assert [f["what"] for f in matrix.figures(clear)] == [
        f"success with {line.condition}, best: {line.name}" for line in best
    ]
    assert len(best) == len(both.conditions)
    bare = [replace(line, mark="", behind=None) for line in lines]
    assert matrix.figures(bare) == []
    assert "6g: no run, since each is behind another" in matrix.headline(bare)


@pytest.mark.exhaustive
def test_a_page_of_runs_of_other_lengths_says_so(run, tmp_path, small_path, monkeypatch):
    points, seeds = tuple(POINTS.values()), (0, 1, 2)
    paths = [
        evaluate(
            spec_of(load(small_path, limit), points=points, seeds=seeds), tmp_path / f"{limit}"
        ).out
        for limit in (4, 2)
    ]
    runs = gather(paths)
    assert matrix.uneven(gather([run])) is None
    assert matrix.uneven(runs).startswith("The runs have different episodes × seeds (")
    assert "4 × 3" in matrix.uneven(runs)
    assert "2 × 3" in matrix.uneven(runs)
    page = render(runs)
    assert "on 2 shared" in page
    assert escape(matrix.uneven(runs)) in page
    # In parts of a few scenes, of which the shorter run has none.
    [parted] = by_workers(runs, tmp_path, monkeypatch, (1,))
    told = details(page)
    assert details(parted) == told
    assert [d["runs"][1] is None for d in told.values()].count(True) > 4


@pytest.mark.exhaustive
@pytest.mark.parametrize("limits", [(4, 2), (2, 4)])
def test_workers_write_a_page_of_runs_of_other_lengths(limits, tmp_path, small_path, monkeypatch):
    paths = [
        evaluate(spec_of(load(small_path, limit), seeds=(0, 1, 2)), tmp_path / f"{limit}").out
        for limit in limits
    ]
    runs = gather(paths)
    one, two = by_workers(runs, tmp_path, monkeypatch)
    assert one == two
    assert details(two) == details(render(runs))


def test_runs_of_one_name_are_told_apart(run, dataset, tmp_path):
    again = write_run(tmp_path / "again", dataset)
    assert gather([run, again]).names == (
        "rule-of-thumb · v2 · json · sample",
        "rule-of-thumb · v2 · json · again",
    )
    (tmp_path / "other").mkdir()
    (again.rename(tmp_path / "other" / "sample"))
    names = gather([run, tmp_path / "other" / "sample"]).names
    assert len(set(names)) == 2
    assert gather([run, run]).names == ("rule-of-thumb · v2",)


def test_every_decision_and_reply_is_counted_once(run, dataset):
    found = read(run)
    rows, forest = rows_of(run), dataset.forest
    assert len(rows) == sum(episode.decisions for episode in found.episodes)
    judged = sum(bool(forest.value[forest.place[row["scene"]]]) for row in rows)
    assert judged > 0
    assert sum(row["n"] for row in panels.errors(found)) == judged
    replies = panels.replies(found)
    assert sum(row["count"] for row in replies) == sum(row["messages"] for row in rows)
    arrived = sum(row[f"delivered_{place}"] is True for row in rows for place in (1, 2, 3))
    assert sum(row["count"] for row in panels.arrivals(found)) == arrived > 0
    answers = answers_of(run)
    assert len(answers) == sum(
        len(scene.viewers) for scene in dataset.scenes(list(found.decisions.scenes))
    )
    assert sum(row["count"] for row in panels.statuses(found)) == len(answers)
    read_out = [a for a in answers if a.role == "ego" and a.intent]
    assert sum(row["count"] for row in panels.entropies(found)) == len(read_out)


def test_a_value_on_an_edge_belongs_to_the_bar_above_it():
    bars = panels._histogram([0.3, 0.3, 0.1, 0.6], 0.1, "x")
    assert [(bar["x"], bar["count"]) for bar in bars] == [
        (0.1, 1), (0.2, 0), (0.3, 2), (0.4, 0), (0.5, 0), (0.6, 1),
    ]  # fmt: skip


def test_what_is_no_verdict_is_drawn_as_no_answer():
    row = {
        "run": "r",
        "role": "ego",
        "status": "<b>",
        "verdict": "<i>",
        "count": 1,
        "share": 1.0,
        "n": 1,
    }
    spec = statuses([row])
    assert spec["encoding"]["color"]["scale"]["domain"] == ["<b>"]
