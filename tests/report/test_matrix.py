"""Prompts and models side by side."""

import numpy as np
import pytest
from run_on_disk import answers_of, rows_of
from sample_run import write_run

from harness.report import matrix, statistics
from harness.report.charts import statuses
from harness.report.runs import gather
from harness.runs.folder import read


def marks(*ended):
    return [mark for mark, _ in matrix._marks([{(e, 0): x for e, x in enumerate(of)} for of in ended])]


def test_the_best_is_marked_and_who_cannot_be_told_from_it():
    best, close, worse = [1.0] * 19 + [0.0], [1.0] * 18 + [0.0] * 2, [1.0] * 8 + [0.0] * 12
    assert marks(close, best, worse) == [matrix.CLOSE, matrix.BEST, matrix.WORSE]
    assert marks(best) == [""]  # nobody to be better than


def test_where_seeds_differ_the_interval_over_episodes_decides():
    luck = np.random.default_rng(0)
    one = {(e, s): float(luck.random() < 0.9) for e in range(60) for s in range(3)}
    other = {(e, s): float(luck.random() < 0.5) for e in range(60) for s in range(3)}
    (first, _), (second, behind) = matrix._marks([one, other])
    assert (first, second) == (matrix.BEST, matrix.WORSE)
    assert behind.test.method == "interval"
    assert behind.difference < behind.test.high < 0
    assert behind.episodes == 60


def test_runs_without_episodes_in_common_are_not_marked():
    one, other = {(e, 0): 1.0 for e in range(5)}, {(e, 0): 0.0 for e in range(5, 10)}
    assert matrix._marks([one, other]) == [(matrix.BEST, None), ("", None)]


@pytest.fixture(scope="session")
def both(run, dataset, tmp_path_factory):
    prompt = {"version": "v1", "sha256": "00" * 32}
    other = write_run(tmp_path_factory.mktemp("matrix") / "other", dataset, model="other", prompt=prompt)
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
    assert 0 < judged
    assert sum(row["n"] for row in statistics.reliability(found)) == judged
    assert sum(row["n"] for row in statistics.errors(found)) == judged
    replies = statistics.replies(found)
    assert sum(row["count"] for row in replies) == sum(row["messages"] for row in rows)
    arrived = sum(row[f"delivered_{place}"] is True for row in rows for place in (1, 2, 3))
    assert sum(row["count"] for row in statistics.arrivals(found)) == arrived > 0
    answers = answers_of(run)
    assert len(answers) == sum(len(scene.viewers) for scene in dataset.scenes(list(found.decisions.scenes)))
    assert sum(row["count"] for row in statistics.statuses(found)) == len(answers)
    read_out = [a for a in answers if a.role == "ego" and a.intent]
    assert sum(row["count"] for row in statistics.entropies(found)) == len(read_out)


def test_a_value_on_an_edge_belongs_to_the_bar_above_it():
    bars = statistics._histogram([0.3, 0.3, 0.1, 0.6], 0.1, "x")
    assert [(bar["x"], bar["count"]) for bar in bars] == [
        (0.1, 1), (0.2, 0), (0.3, 2), (0.4, 0), (0.5, 0), (0.6, 1),
    ]  # fmt: skip


def test_what_is_no_verdict_is_drawn_as_no_answer():
    row = {"run": "r", "role": "ego", "status": "<b>", "verdict": "<i>", "count": 1, "share": 1.0, "n": 1}
    spec = statuses([row])
    assert spec["encoding"]["color"]["scale"]["domain"] == ["<b>"]
