"""The report page of a real, small run."""

import base64
import email.errors
import email.message
import hashlib
import json
import math
import re
import shutil
import subprocess
import sys

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import typer
from evaluating import scenes_of, spec_of
from msgspec import structs
from reading import Page, by_workers, details, packed
from run_on_disk import answers_of, change, configure, damage, digested, rows_of
from sample_run import write_run
from typer.testing import CliRunner

from harness.backends.base import Completion
from harness.cli.report import command
from harness.core.errors import UserError
from harness.core.files import digest
from harness.evaluate.answers import answer_of
from harness.evaluate.requests import requests
from harness.prompts import readout
from harness.prompts import versions as prompts
from harness.report import contents, library
from harness.report.details import prompts_of
from harness.report.notes import answer_times, latency_source, pace, readings
from harness.report.page import render
from harness.report.runs import gather
from harness.report.templating import visible
from harness.report.words import figures, headline, score_texts
from harness.runs.folder import Run, read
from harness.runs.records import Episode, Latency, Score, Times
from harness.runs.writer import csv_text

V2 = prompts.load("v2")
ENDED = {"single-local": 34, "v2x": 35, "6g": 47}  # successes of 50


def told(viewer_says):
    """Prompts of a run, as `render` takes them."""
    return lambda run: lambda scene, viewer, heard: viewer_says(viewer)


def written(*folders, prompts=prompts_of):
    return render(gather(list(folders)), prompts)


def greeting(viewer):
    return [
        {"role": "system", "content": "Be careful."},
        {"role": "user", "content": f"I am {viewer}."},
    ]


@pytest.fixture(scope="session")
def text(run, tmp_path_factory):
    """The page of a run that was asked with a greeting."""
    greeted = shutil.copytree(run, tmp_path_factory.mktemp("greeted") / "sample")
    change(greeted, answer=lambda a: a.update(prompt_sha256=digest(greeting(a["viewer"]))))
    return written(greeted, prompts=told(greeting))


@pytest.fixture(scope="session")
def page(text):
    return Page(text)


@pytest.fixture(scope="session")
def opened(text):
    return details(text)


def by_scene(run):
    """Decisions and answers of each decision point."""
    found = {row["scene"]: ([], {}) for row in rows_of(run)}
    for row in rows_of(run):
        found[row["scene"]][0].append(row)
    for answer in answers_of(run):
        found[answer.scene][1][answer.viewer] = answer
    return found


def messages_in(row):
    """A decision's messages, as a page has them."""
    names = ("delivered", "on_time", "arrival_ms", "weight", "trust", "attacker")
    return [
        {"from": row[f"helper_{n}"], **{name: row[f"{name}_{n}"] for name in names}}
        for n in (1, 2, 3)
        if row[f"helper_{n}"]
    ]


def test_every_decision_can_be_opened_with_all_that_is_known_of_it(run, opened, dataset):
    every = by_scene(run)
    assert list(opened) == list(every)
    assert set(every) <= set(dataset.forest.ids)
    for scene, (rows, answers) in every.items():
        detail = opened[scene]
        [found] = detail["runs"]
        assert {a["viewer"]: a["raw"] for a in found["answers"]} == {
            v: a.raw for v, a in answers.items()
        }
        again = {
            (d["condition"], seed): (d["action"], d["fused"], d["messages"])
            for d in found["decisions"] for seed in d["seeds"]
        }  # fmt: skip
        assert again == {
            (row["condition"], row["seed"]): (
                row["action"],
                [row[f"fused_{action}"] for action in dataset.actions],
                messages_in(row),
            )
            for row in rows
        }
        assert [(o["safe"], o["delay_s"]) for o in detail["outcomes"]] == [
            (
                rows[0][f"safe_{action}"],
                (delay_s := rows[0][f"delay_s_{action}"]) and round(delay_s, 3),
            )
            for action in dataset.actions
        ]
        assert set(detail["world"]["viewers"]) == set(answers)
        asked = {" ".join(m["from"] for m in d["messages"]) for d in found["decisions"]}
        for sees in detail["world"]["viewers"].values():
            assert {"", *asked} <= set(sees["views"]), "a picture for each condition"
            assert all(60 <= width <= 160 for _, _, width in sees["views"].values())


def test_the_list_says_of_each_decision_what_was_done_and_what_came_of_it(run, text, dataset):
    index = json.loads(packed(text, "index"))
    [of] = index["runs"]
    keys = [(c, s) for c in of["conditions"] for s in of["seeds"]]
    for n, (rows, answers) in enumerate(by_scene(run).values()):
        made = {(row["condition"], row["seed"]): row for row in rows}
        for k, key in enumerate(keys):
            at = n * len(keys) + k
            if key not in made:
                assert of["acted"][at] == of["ended"][at] == "-"
                continue
            assert index["actions"][int(of["acted"][at])] == made[key]["action"]
            assert of["asked"][at] == str(int(made[key]["triggered"]))
            assert (of["ended"][at] == "n") == (not made[key]["value"])
            assert (of["ended"][at] == "u") == bool(made[key]["regret"])
        statuses = {s for k, s in enumerate(index["statuses"]) if of["statuses"][n] & 1 << k}
        assert statuses == {a.status for a in answers.values()}


def test_what_was_read_in_a_recovered_answer_is_marked(opened):
    fenced = [
        a
        for d in opened.values()
        for a in d["runs"][0]["answers"]
        if a.get("repairs") == ["code_fence"]
    ]
    assert fenced
    for answer in fenced:
        [(start, end)] = answer["spans"]
        assert answer["raw"][start:end] == answer["raw"].removeprefix("```json\n").removesuffix(
            "\n```"
        )


def prompts_in(opened):
    return [m["content"] for d in opened.values() for sent in d["prompts"] for m in sent]


@pytest.mark.slow
def test_prompts_are_those_given_and_none_where_none_are(run, opened):
    assert "I am v3." in prompts_in(opened)
    # The sample's prompt is nobody's, and it was asked with another than this greeting.
    for bare in (details(written(run)), details(written(run, prompts=told(greeting)))):
        assert prompts_in(bare) == []
        assert all(a["prompt"] is None for d in bare.values() for a in d["runs"][0]["answers"])


@pytest.mark.slow
def test_a_page_names_the_answer_mode_and_has_the_prompt_of_a_read_out(dataset, tmp_path):
    said = {"label_mass": 0.25, "retries": 2, "cached": True}

    def as_read_out(answer):
        [scene] = dataset.scenes([answer.scene])
        shown = V2.render(scene.graphs[answer.viewer], dataset.actions)
        return structs.replace(
            answer, prompt_sha256=digest(readout.letter_chat(shown, dataset.actions)), **said
        )

    run = write_run(tmp_path / "run", dataset, change=as_read_out)
    assert "prompt v2, answers json" in Page(written(run)).text
    prompt = {"version": "v2", "sha256": V2.sha256, "released": True}
    configure(run, answer="readout", prompt=prompt)
    after = written(run)
    assert "prompt v2, answers readout" in Page(after).text
    assert "80 answers came from the cache" in Page(after).text
    found = details(after)
    assert all(a.items() >= said.items() for d in found.values() for a in d["runs"][0]["answers"])
    asked = [text for text in prompts_in(found) if text.startswith("EGO")]
    assert asked
    assert all(f"Answer with one letter: A {dataset.actions[0]}" in text for text in asked)


def test_the_summary_has_every_condition_and_metric_with_interval_and_n(run, page):
    for name in ("single-local", "v2x", "6g"):
        score = read(run).score(name, "success_rate")
        assert score.interval == "episodes"
        assert (
            f"{100 * score.value:.1f} % {100 * score.low:.1f} to {100 * score.high:.1f} %"
            in page.text
        )
    assert "2 episodes × 3 channel seeds of two; 95 % intervals over episodes" in page.text
    for metric in ("latency proxy", "trigger rate", "entropy"):
        assert metric in page.text


def test_the_page_says_how_honest_the_probabilities_are(run, page):
    """A line a condition, above the picture;
    figures that others have replaced stay off the page.
    """
    loaded = read(run)
    rows = loaded.decisions
    optimal = (rows.of_actions("safe") == 1.0).sum(axis=1)
    open_rows, one_optimal = optimal > 0, optimal == 1
    table = page.text.split("How honest the probabilities are")[1].split("Layouts are resampled")[0]
    for condition in ("single-local", "v2x", "6g"):
        line = table.split(condition)[1]
        here = rows.codes("condition", loaded.conditions) == loaded.conditions.index(condition)
        assert line.split()[0] == str((open_rows & here).sum())
        for metric in contents.HONEST:
            cell = score_texts(loaded.score(condition, metric))
            assert f"{cell['value']} {cell['interval']}" in line
        # no flip was asked for, and they are too few
        assert f" – {(one_optimal & here).sum()} – – " in line
    assert "fewer than 100 such decisions" in page.text
    assert "negative log likelihood" not in page.text


def test_the_page_names_model_prompt_dataset_versions_and_where_latency_comes_from(
    run, page, dataset
):
    config = json.loads((run / "run.json").read_text())
    for fact in (
        config["model"]["name"],
        config["prompt"]["sha256"],
        dataset.sha256,
        config["versions"]["numpy"],
        config["command"],
        "the paper's, not measured here",
    ):
        assert fact in page.text


def test_the_page_asks_for_nothing_and_runs_two_scripts_that_it_names(text, page):
    metas = [value for tag, name, value in page.attributes if tag == "meta" and name == "content"]
    assert metas[0].startswith("default-src 'none'; script-src 'sha256-")
    assert metas[0].count("'sha256-") == 2
    assert "unsafe-eval" not in metas[0]
    assert not page.tags.keys() & {"link", "iframe", "object", "embed", "base"}
    assert all(href.startswith("#") for href in page.values("href"))
    assert not page.values("src")
    assert not any(name.startswith("on") for _, name, _ in page.attributes)
    own = text[text.rindex("<script>") + len("<script>") : text.rindex("</script>")]
    for script in (own, packed(text, "vega")):
        assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in metas[0]


def test_a_page_is_written_where_python_writes_no_package_metadata_as_text(monkeypatch):
    def refuse(self, *args, **options):
        # Python 3.12.5 and later
        raise email.errors.HeaderWriteError("folded header contains newline")

    monkeypatch.setattr(email.message.Message, "as_string", refuse)
    assert re.search(
        r"Vega 5[\d.]+, Vega Lite 5[\d.]+, Vega Embed 6[\d.]+, which lie", library.licence()
    )


@pytest.mark.slow
def test_the_same_runs_give_the_same_page(run):
    assert written(run) == written(run)


@pytest.mark.exhaustive
def test_workers_change_no_byte_of_a_page(run, dataset, tmp_path, monkeypatch):
    other = write_run(tmp_path / "other", dataset, model="other")
    change(other, decision=lambda row: row.update(triggered=False))
    one, two = by_workers(gather([run, other]), tmp_path, monkeypatch)
    assert len(details(one)) > 8
    assert two == one


@pytest.mark.slow
def test_several_runs_stand_side_by_side_and_each_is_named(run, dataset, tmp_path):
    brave = write_run(
        tmp_path / "brave", dataset, model="brave",
        change=lambda answer: structs.replace(answer, intent=answer.intent and (0.02, 0.08, 0.9)),
    )  # fmt: skip
    text = written(run, brave)
    found = Page(text).text
    assert "rule-of-thumb · v2" in found
    assert "brave · v2" in found
    assert found.count("★ best") + found.count("≈ best") >= 3
    every = details(text)
    came = [by_scene(of) for of in (run, brave)]
    assert len(every) < sum(map(len, came)), "some scenes are of both"
    for scene, detail in every.items():
        assert [told is not None for told in detail["runs"]] == [scene in of for of in came]


@pytest.mark.slow
def test_sweeps_in_a_runs_folder_are_in_its_page_unless_a_link_leads_out(run, tmp_path):
    swept = copied(run, tmp_path)
    (tmp_path / "secret.svg").write_text("<svg>secret</svg>")
    for name in ("sweep-tau", "sweep-out"):
        (swept / name).mkdir()
        (swept / name / "sweep.json").write_text("{}")
    (swept / "sweep-tau" / "sweep.svg").write_text("<svg>along tau</svg>")
    (swept / "sweep-out" / "sweep.svg").symlink_to(tmp_path / "secret.svg")
    [source] = Page(written(swept)).values("src")
    assert base64.b64decode(source.partition(",")[2]) == b"<svg>along tau</svg>"


def test_runs_on_other_scenes_are_not_reported_together(run, dataset, tmp_path):
    other = edited(run, tmp_path, "run.json", lambda t: t.replace(dataset.sha256, "f" * 64))
    digested(other)
    with pytest.raises(UserError, match="are not of the same scenes") as error:
        gather([run, other])
    assert "report them apart" in str(error.value)


def test_characters_that_show_nothing_or_turn_the_line_around_are_spelt_out():
    assert visible("a\u202eb\x00\ud800\tc\n") == "a⟨U+202E⟩b⟨U+0000⟩⟨U+D800⟩\tc\n"
    assert (visible(None), visible(True), visible(0.5)) == ("–", "yes", 0.5)


def test_a_lone_surrogate_in_an_answer_is_replaced_before_it_is_written(dataset):
    [request] = list(requests(spec_of(dataset), scenes_of(dataset)[:1]))[:1]
    answer = answer_of(request, Completion(request.id, "I\ud800", None, None, "stop", None, 1))
    assert answer.raw == "I?"


def scored(run, tmp_path, *scores, ended=None):
    """The run with another summary, and in each condition so many successes of 50 episodes."""
    found = [
        Score(condition, metric, value, low, high, 2, 0, "episodes")
        for condition, metric, value, low, high in scores
    ]
    copy = copied(run, tmp_path)
    variant = read(run).manifest.variant
    (copy / "summary.csv").write_text(csv_text(Score, found, variant))
    if ended:
        [*some] = {(e.condition, e.seed): e for e in read(run).episodes}.values()
        episodes = [
            structs.replace(e, episode=n, success=n < ended[e.condition])
            for e in some
            for n in range(50)
        ]
        (copy / "episodes.csv").write_text(csv_text(Episode, episodes, variant))
        manifest = json.loads((copy / "run.json").read_text())
        manifest["world"]["episodes"] = 50
        (copy / "run.json").write_text(json.dumps(manifest))
        digested(copy)
    return read(copy)


def test_the_headline_is_one_sentence_with_the_best_condition_and_the_one_without_v2v(
    run, tmp_path
):
    found = scored(
        run,
        tmp_path,
        ("single-local", "success_rate", 0.68, 0.58, 0.76),
        ("6g", "success_rate", 0.94, 0.88, 0.97),
        ("6g", "latency_proxy_ms", 151.4, 151.0, 151.8),
        ("6g", "success_gain_over_single-local", 0.26, 0.17, 0.35),
        ended=ENDED,
    )
    assert headline(found) == (
        "Under 6g, rule-of-thumb clears 94.0 % of the episodes; under single-local, 68.0 %: +26.0 "
        "[+12.5, +39.5] points, a clear difference."
    )
    told = [(figure["value"], figure["interval"]) for figure in figures(found)]
    assert told == [
        ("94.0 %", "88.0 to 97.0 %"),
        ("26.0 points", "17.0 to 35.0 points"),
        ("151.4 ms", "151.0 to 151.8 ms"),
    ]


def test_the_headline_and_the_figures_are_of_the_best_condition_that_no_warning_is_about(
    run, tmp_path
):
    rates = (("single-local", 0.6), ("v2x", 0.9), ("6g", 0.7))
    found = scored(
        run,
        tmp_path,
        *((condition, "success_rate", rate, None, None) for condition, rate in rates),
        ("v2x", "off_lag_rate", 0.9, None, None),
    )
    assert headline(found).startswith(
        "Under 6g, rule-of-thumb clears 70.0 % of the episodes; under single-local"
    )
    assert [figure["value"] for figure in figures(found)] == ["70.0 %"]


def test_where_only_a_doubted_condition_beats_driving_alone_the_headline_does_not_deny_it(
    run, tmp_path
):
    rates = (("single-local", 0.7), ("v2x", 0.9), ("6g", 0.6))
    found = scored(
        run,
        tmp_path,
        *((condition, "success_rate", rate, None, None) for condition, rate in rates),
        ("v2x", "off_lag_rate", 0.9, None, None),
    )
    assert headline(found).endswith(
        "70.0 % of the episodes, and no other condition without a warning does better."
    )


def test_a_gap_whose_interval_holds_zero_says_what_is_excluded(run, tmp_path):
    found = scored(
        run,
        tmp_path,
        ("single-local", "success_rate", 0.68, 0.58, 0.76),
        ("v2x", "success_rate", 0.70, 0.60, 0.78),
        ("v2x", "success_gain_over_single-local", 0.02, -0.03, 0.07),
        ended=ENDED,
    )
    assert headline(found).endswith(
        "under single-local, 68.0 %: +2.0 [-4.8, +8.8] points, not clear, but within ±8.8 points."
    )


def test_where_nothing_beats_driving_alone_the_headline_says_so(run, tmp_path):
    found = scored(
        run,
        tmp_path,
        ("single-local", "success_rate", 0.7, None, None),
        ("6g", "success_rate", 0.7, None, None),
    )
    alone = "Under single-local, rule-of-thumb clears 70.0 % of the episodes"
    assert headline(found) == f"{alone}, and no other condition does better."


@pytest.mark.parametrize(
    ("latency", "words"),
    [
        (
            Latency("card", "cited", 0.145, 0.2, 0.3),
            "ego 145 ms, helper 200 ms, ego with messages 300 ms; "
            "stated by the model card, not measured here (cited)",
        ),
        (
            Latency("measured", "batch 1", 0.1, 0.1, 0.1),
            "ego 100 ms, helper 100 ms, ego with messages 100 ms; "
            "measured on the machine of the run, before it (batch 1)",
        ),
    ],
)
def test_the_source_of_latency_in_words(latency, words):
    assert latency_source(latency) == words


def whose_answers_took(run, **times):
    """The run, with other times of its own answers."""
    return Run(run, msgspec.structs.replace(read(run).manifest, answer_times=times))


def test_prefill_and_decode_in_words(run):
    """Half a millisecond a token has two decimals.
    Where some TTFTs are unknown there is no share.
    """
    first = Times(240, 0.021, 0.02, 0.03, (0.0205, 0.0215), (0.029, 0.031))
    ego = Times(240, 0.042, 0.03, 0.05, first_token=first, token=Times(240, 0.0005, 0.0004, 0.0006))
    helper = msgspec.structs.replace(ego, n=241)
    timed = whose_answers_took(run, ego=ego, helper=helper, merge=Times(1, 0.2, 0.2, 0.2))
    of_both = [
        "TTFT 21.0 [20.5, 21.5] ms, p95 30.0 [29.0, 31.0], n = 240",
        "TPOT 0.50 ms, p95 0.60, n = 240",
    ]
    assert list(pace(timed)) == [
        "ego: 50 % of the median answer is prefill (batch 1, measured where it ran)",
        *(f"  ego {line}" for line in of_both),
        *(f"  helper {line}" for line in of_both),
    ]
    assert all(len(line) <= 80 for line in pace(timed))
    assert list(pace(whose_answers_took(run))) == []
    one = Times(1, 0.021, 0.021, 0.021)
    alone = whose_answers_took(run, ego=Times(1, 0.04, 0.04, 0.04, first_token=one))
    assert list(pace(alone))[1:] == ["  ego TTFT 21.0 ms, n = 1"], "one answer has no percentile"
    assert next(pace(whose_answers_took(run, merge=ego))).startswith("fusion: 50 % of the median")


def test_people_read_fusion_where_files_say_merge(run):
    """In what is said of times and of how answers were read."""
    shares = {f"{kind}_rate_merge": kind == "strict" for kind in ("strict", "recovered", "failed")}
    fused = whose_answers_took(run, merge=Times(1, 0.2, 0.2, 0.2))
    fused.__dict__["scores"] = [
        Score("all", name, float(value), None, None, 8, 0, "answers")
        for name, value in shares.items()
    ]
    assert [*answer_times(fused), *readings(fused)] == [
        "fusion answers took 200.0 ms (5-95 %: 200.0 to 200.0, n = 1); not used as latency",
        "fusion answers strict / recovered / failed: 100.0 / 0.0 / 0.0 % of 8",
    ]


def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "copy")


def edited(run, tmp_path, name, edit):
    """A copy of a run with one text file edited."""
    copy = copied(run, tmp_path)
    (copy / name).write_text(edit((copy / name).read_text()))
    return copy


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        (
            "run.json",
            lambda t: t.replace("swarmdrive-run/2", "swarmdrive-run/9"),
            "has format 'swarmdrive-run/9'",
        ),
        (
            "run.json",
            lambda t: t.replace("swarmdrive-run/2", "swarmdrive-run/1"),
            "has format 'swarmdrive-run/1', .*harness 0.1 reads it: run again, or install that "
            "version",
        ),
        ("run.json", lambda t: "[]", "has format 'None'"),
        ("run.json", lambda t: t[:50], "run.json is broken"),
        ("run.json", lambda t: t.replace('"seeds"', '"seed"'), "run.json is broken .*`seeds`"),
        ("run.json", lambda t: t.replace("brakes", r"\ud800"), "run.json is broken"),
        ("answers.jsonl", lambda t: t[:-40], "answers.jsonl is broken"),
        (
            "answers.jsonl",
            lambda t: t.replace('"verdict"', '"said"'),
            "answers.jsonl is broken .*`verdict`",
        ),
        (
            "answers.jsonl",
            lambda t: t.replace('"strict"', '"stern"'),
            "answers.jsonl is broken .*'stern'",
        ),
        ("answers.jsonl", lambda t: t.replace("would", r"\ud800"), "answers.jsonl is broken"),
        (
            "answers.jsonl",
            lambda t: t.replace('"intent":[', '"intent":[0.0,'),
            "has 4 probabilities",
        ),
        ("decisions.parquet", lambda t: t[:-40], "decisions.parquet is broken"),
        ("decisions.parquet", lambda t: "", "decisions.parquet is broken"),
        ("summary.csv", lambda t: t.replace("ci_low", "low"), "summary.csv is broken .*ci_low"),
        (
            "episodes.csv",
            lambda t: t.replace("layout_seed", "layout"),
            "episodes.csv is broken .*layout_seed",
        ),
    ],
)
def test_a_broken_run_is_one_line_that_names_the_file(run, tmp_path, name, edit, message):
    copy = copied(run, tmp_path)
    data = (copy / name).read_bytes().decode("latin-1")
    (copy / name).write_bytes(edit(data).encode("latin-1"))
    with pytest.raises(UserError, match=message) as error:
        written(copy)
    assert "\n" not in str(error.value)


def set_in_first(name, value):
    """Changes a column of the first decision."""

    def decision(row):
        if (row["episode"], row["step"], row["condition"], row["seed"]) == (0, 0, "v2x", 0):
            row[name] = value

    return decision


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d.take(np.arange(0)),
            "decisions.parquet is broken .not every decision of episodes.csv is there",
        ),
        (lambda d: d.take(range(1, len(d))), "broken .not every decision of episodes.csv is there"),
        (lambda d: d.take([0, *range(len(d))]), "broken .a decision is there twice"),
    ],
)
def test_a_table_that_is_not_whole_is_refused(run, tmp_path, change, message):
    copy = copied(run, tmp_path)
    change(read(run).decisions).write(copy / "decisions.parquet")
    with pytest.raises(UserError, match=message) as error:
        written(copy)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("decision", "message"),
    [
        (
            lambda row: row.update(scene="x") if (row["episode"], row["step"]) == (0, 0) else None,
            "answers.jsonl has scene '00000-0-[0-9a-f]+', which decisions.parquet has not",
        ),
        (set_in_first("condition", "v3x"), "decisions.parquet is broken .unknown condition 'v3x'"),
        (
            set_in_first("seed", 9),
            "decisions.parquet is broken .a decision of another seed or episode",
        ),
        (set_in_first("action", "XIDLE"), "decisions.parquet is broken .unknown action 'XIDLE'"),
        (
            set_in_first("action", None),
            "decisions.parquet is broken .action is unknown in some rows",
        ),
        (
            set_in_first("latency_ms", math.inf),
            "decisions.parquet is broken .latency_ms is too large",
        ),
    ],
)
def test_a_broken_decision_is_one_line_that_names_the_file(run, tmp_path, decision, message):
    copy = copied(run, tmp_path)
    damage(copy, decision)
    with pytest.raises(UserError, match=message) as error:
        written(copy)
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["on_time_1", "fused_IDLE", "triggered"])
def test_a_missing_column_is_named(run, tmp_path, column):
    copy = copied(run, tmp_path)
    pq.write_table(read(run).decisions.table.drop_columns([column]), copy / "decisions.parquet")
    with pytest.raises(
        UserError, match=rf"decisions.parquet is broken .it lacks {column}"
    ) as error:
        written(copy)
    assert "\n" not in str(error.value)


def test_a_run_on_another_dataset_than_lies_there_is_refused(run, tmp_path):
    other = edited(run, tmp_path, "run.json", lambda t: t.replace('"sha256": "', '"sha256": "0'))
    digested(other)
    with pytest.raises(UserError, match=r"is not the one that .* was made on"):
        gather([other])


@pytest.mark.slow
def test_the_command_says_where_it_wrote_and_refuses_what_is_no_run(run, tmp_path):
    app = typer.Typer()
    app.command()(command)
    out = tmp_path / "page.html"
    done = CliRunner().invoke(app, [str(run), "--out", str(out)])
    assert done.output == f"wrote {out}\n"
    assert out.is_file()
    notes = tmp_path / "notes.md"
    notes.write_text("mine")
    for arguments, message in (
        ([run, "--out", notes], "is a file that no command here wrote, and would be lost; name"),
        ([tmp_path], r"is no finished run: it has no run.json"),
        ([run, "--out", tmp_path], "is a folder; name a file in it"),
        ([run, "--out", out / "page.html"], "cannot be written"),
        ([run, "--out", run / "summary.csv"], "is a file of a run, suite or dataset, which would"),
        ([run, run.parent], "2 runs and no --out; name the file to write"),
    ):
        with pytest.raises(UserError, match=message):
            CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False)
    assert notes.read_text() == "mine"
    assert CliRunner().invoke(app, [str(run), "--out", str(out)]).output == f"wrote {out}\n"


@pytest.mark.exhaustive
def test_a_page_of_a_frozen_run_waits_for_no_painter_no_simulator_and_no_pandas(run, tmp_path):
    program = (
        "import sys; from pathlib import Path; from harness.cli.report import write;"
        f"write([Path({str(run)!r})], Path({str(tmp_path / 'page.html')!r}), quiet=True);"
        "print(sorted({'matplotlib', 'highway_env', 'gymnasium', 'pandas', 'torch'} & "
        "set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert said.stdout == "[]\n"


@pytest.mark.slow
def test_an_answer_of_somebody_who_is_not_in_the_scene_is_one_line(dataset, tmp_path):
    run = write_run(tmp_path / "run", dataset)
    answers = (run / "answers.jsonl").read_text().splitlines()
    first = json.loads(answers[-1])
    (run / "answers.jsonl").write_text(
        "\n".join([*answers[:-1], json.dumps(first | {"viewer": "v99"})]) + "\n"
    )
    digested(run)
    with pytest.raises(
        UserError, match=r"answers\.jsonl has an answer of 'v99' in scene .*; make the run again"
    ):
        render(gather([run]))
