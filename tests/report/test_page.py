"""The report page of a real, small run."""

import base64
import json
import shutil
from dataclasses import replace
from xml.etree import ElementTree

import pytest
import typer
from reading import Page
from sample_run import write_run
from typer.testing import CliRunner

from harness import prompts
from harness.cli.report import command
from harness.errors import UserError
from harness.report.page import visible, write_report
from harness.report.words import headline, latency_source
from harness.run.folder import Score, read

V2 = prompts.load("v2")


@pytest.fixture(scope="session")
def page(run, tmp_path_factory):
    def prompts(scene, viewer, heard):
        return [{"role": "system", "content": "Be careful."}, {"role": "user", "content": f"I am {viewer}."}]

    return Page(write_report(run, tmp_path_factory.mktemp("page") / "page.html", prompts).read_text())


def test_at_least_fifty_decisions_open_one_by_one_each_with_its_picture_on_a_light_page(run, tmp_path):
    many = changed(run, tmp_path, "rows.jsonl", lambda text: text * 6)
    written = write_report(many)
    assert written == many / "report.html"
    assert written.stat().st_size < 6_000_000
    page = Page(written.read_text())
    assert page.values("class").count("decision") >= 50
    assert len(page.values("src")) == page.values("class").count("decision") + 2


def test_a_decision_shows_answers_messages_and_outcomes(run, page):
    row = json.loads((run / "rows.jsonl").read_text().splitlines()[2])
    assert row["answers"]["v3"]["raw"] in "".join(page.pieces)
    arrived = [m for d in row["decisions"] if d["seed"] == 0 for m in d["messages"] if m["delivered"]]
    assert arrived
    for message in arrived:
        assert f"{message['from']}: {message['arrival_ms']:.1f} ms" in page.text
        assert f"weight {message['weight']:.3f}" in page.text
    assert "code_fence" in page.text
    assert "none: no_json" in page.text
    assert "✗ unsafe" in page.text


def test_prompts_are_those_given_and_said_to_be_missing_where_none_are(run, page, tmp_path):
    assert "I am v3." in page.text
    assert "prompt: not rendered" not in page.text
    assert "prompt: not rendered" in Page(write_report(run, tmp_path / "bare.html").read_text()).text


def test_a_page_names_the_answer_mode_and_shows_the_prompt_of_a_read_out(dataset, tmp_path):
    change = {"label_mass": 0.25, "retries": 2, "cached": True}
    run = write_run(tmp_path / "run", dataset, change=lambda scene, viewer, answer: {**answer, **change})
    before = Page(write_report(run).read_text()).text
    assert "prompt v2, answers json" in before  # as runs of older versions, which name none
    asks = f"Answer with one letter: A {dataset.actions[0]}"
    assert asks not in before
    config = json.loads((run / "run.json").read_text())
    config |= {"answer": "readout", "cached_answers": 48, "prompt": {"version": "v2", "sha256": V2.sha256}}
    (run / "run.json").write_text(json.dumps(config))
    page = Page(write_report(run).read_text())
    assert "prompt v2, answers readout" in page.text
    assert "48 answers came from the cache" in page.text
    assert "25.00 % of the probability on the letters; 2 failed attempts before; from the cache" in page.text
    prompts = [piece for piece in page.pieces if piece.startswith("EGO")]
    assert prompts
    assert all(asks in prompt for prompt in prompts)


def test_the_summary_has_every_condition_and_metric_with_interval_and_n(run, page):
    for name in ("single-local", "v2x", "6g"):
        score = read(run).score(name, "success_rate")
        assert score.interval == "episodes"
        assert f"{100 * score.value:.1f} % {100 * score.low:.1f} to {100 * score.high:.1f} %" in page.text
    assert "n = 2 episodes" in page.text
    for metric in ("latency proxy", "trigger rate", "entropy"):
        assert metric in page.text


def test_the_page_names_model_prompt_dataset_versions_and_where_latency_comes_from(run, page, dataset):
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


def test_the_page_needs_no_network_and_no_script(page):
    metas = [value for tag, name, value in page.attributes if tag == "meta" and name == "content"]
    assert metas[0].startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:;")
    assert not page.tags.keys() & {"script", "link", "iframe", "object", "embed", "base", "form"}
    assert all(src.startswith("data:image/svg+xml;base64,") for src in page.values("src"))
    assert set(page.values("href")) == {"#run"}
    assert not any(name.startswith("on") for _, name, _ in page.attributes)


def test_pictures_in_the_page_are_sound_xml(page):
    for src in page.values("src"):
        root = ElementTree.fromstring(base64.b64decode(src.partition(",")[2]))
        assert root.tag == "{http://www.w3.org/2000/svg}svg"


def test_the_same_run_gives_the_same_page(run, tmp_path):
    first, second = (write_report(run, tmp_path / name).read_bytes() for name in ("a.html", "b.html"))
    assert first == second


PAYLOADS = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{ 7 * 7 }}", "</pre></details>")


def test_nothing_that_a_model_a_prompt_or_a_file_says_becomes_markup(dataset, tmp_path, page):
    """Payloads in completions, messages, the model's name and the prompts stay text."""
    payload = "".join(PAYLOADS)

    def change(scene, viewer, answer):
        if answer["role"] == "helper" and answer["message"]:
            answer["message"]["evidence"] = payload
        return answer | {"raw": payload, "detail": payload, "error": payload}

    run = write_run(tmp_path / "run", dataset, model=payload, change=change)
    out = write_report(run, prompts=lambda scene, viewer, heard: [{"role": payload, "content": payload}] * 2)
    found = Page(out.read_text())
    assert "script" not in found.tags
    assert not any(name.startswith("on") for _, name, _ in found.attributes)
    same = {"html", "head", "body", "main", "style", "title", "img", "section", "details", "pre"}
    assert {tag: found.tags[tag] for tag in same} == {tag: page.tags[tag] for tag in same}
    text = "".join(found.pieces)
    for part in PAYLOADS:
        assert text.count(part) >= 5 * found.tags["section"]


def test_characters_that_show_nothing_or_turn_the_line_around_are_spelt_out():
    assert visible("a\u202eb\x00\ud800\tc\n") == "a⟨U+202E⟩b⟨U+0000⟩⟨U+D800⟩\tc\n"
    assert (visible(None), visible(True), visible(0.5)) == ("–", "yes", 0.5)


def test_a_lone_surrogate_in_an_answer_does_not_break_the_page(dataset, tmp_path):
    run = write_run(tmp_path / "run", dataset, change=lambda s, v, answer: answer | {"raw": "\ud800"})
    assert "⟨U+D800⟩" in write_report(run).read_text()


def scored(run, *scores):
    return replace(run, scores=tuple(Score(*s, n=2, n_excluded=0, interval="episodes") for s in scores))


def test_the_headline_is_one_sentence_with_the_best_condition_and_the_one_without_v2v(run):
    found = scored(
        read(run),
        ("single-local", "success_rate", 0.68, 0.58, 0.76),
        ("6g", "success_rate", 0.94, 0.88, 0.97),
        ("6g", "latency_proxy_ms", 151.4, 151.0, 151.8),
        ("6g", "success_gain_over_single-local", 0.26, 0.17, 0.35),
    )
    assert headline(found) == (
        "With rule-of-thumb, 6g clears 94.0 % (95 % interval 88.0 to 97.0 %) of the episodes of two "
        "at 151.4 ms a decision; single-local clears 68.0 % (95 % interval 58.0 to 76.0 %) of the episodes, "
        "a gap of 26.0 points (17.0 to 35.0 points), a clear difference."
    )


def test_a_gap_whose_interval_holds_zero_is_said_to_be_chance_perhaps(run):
    found = scored(
        read(run),
        ("single-local", "success_rate", 0.68, 0.58, 0.76),
        ("v2x", "success_rate", 0.70, 0.60, 0.78),
        ("v2x", "success_gain_over_single-local", 0.02, -0.03, 0.07),
    )
    assert headline(found).endswith("a gap of 2.0 points (-3.0 to 7.0 points), which may be chance.")


def test_where_nothing_beats_driving_alone_the_headline_says_so(run):
    found = scored(
        read(run),
        ("single-local", "success_rate", 0.7, None, None),
        ("6g", "success_rate", 0.7, None, None),
    )
    alone = "With rule-of-thumb, single-local clears 70.0 % of the episodes of two"
    assert headline(found) == f"{alone}, and no other condition does better."


@pytest.mark.parametrize(
    ("latency", "words"),
    [
        (
            {"source": "card", "inference_s": {"ego": 0.145, "helper": 0.2}, "basis": "cited"},
            "ego 145 ms, helper 200 ms; stated by the model card, not measured here (cited)",
        ),
        (
            {"source": "measured", "inference_s": None, "basis": "batch 1"},
            "each answer has its own time; measured where it ran, one answer at a time (batch 1)",
        ),
    ],
)
def test_the_source_of_latency_in_words(latency, words):
    assert latency_source(latency) == words


def changed(run, tmp_path, name, edit):
    """A copy of a run with one file edited."""
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / name).write_text(edit((copy / name).read_text()))
    return copy


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        (
            "run.json",
            lambda t: t.replace("swarmdrive-run/1", "swarmdrive-run/9"),
            "has format 'swarmdrive-run/9'",
        ),
        ("run.json", lambda t: "[]", "has format 'None'"),
        ("run.json", lambda t: t[:50], "run.json is broken"),
        ("run.json", lambda t: t.replace('"seeds"', '"seed"'), "run.json lacks seeds"),
        ("rows.jsonl", lambda t: t[:-40], "rows.jsonl line 12 is broken"),
        ("rows.jsonl", lambda t: "", "holds no decisions"),
        ("rows.jsonl", lambda t: t.replace('"scene": "00000-0"', '"scene": "x"'), "has scene 'x'"),
        ("summary.csv", lambda t: t.replace("ci_low", "low"), "summary.csv is broken"),
    ],
)
def test_a_broken_run_is_one_line_that_names_the_file(run, tmp_path, name, edit, message):
    with pytest.raises(UserError, match=message) as error:
        write_report(changed(run, tmp_path, name, edit))
    assert "\n" not in str(error.value)


def test_a_run_on_another_dataset_than_lies_there_is_refused(run, tmp_path):
    other = changed(run, tmp_path, "run.json", lambda t: t.replace('"sha256": "', '"sha256": "0'))
    with pytest.raises(UserError, match=r"is not the one that .* was made on"):
        write_report(other)


def test_the_command_says_where_it_wrote_and_refuses_what_is_no_run(run, tmp_path):
    app = typer.Typer()
    app.command()(command)
    out = tmp_path / "page.html"
    done = CliRunner().invoke(app, [str(run), "--out", str(out)])
    assert done.output == f"wrote {out}\n"
    assert out.is_file()
    with pytest.raises(UserError, match=r"is no run: it has no run.json"):
        CliRunner().invoke(app, [str(tmp_path)], catch_exceptions=False)
    with pytest.raises(UserError, match="is a folder; name a file in it"):
        CliRunner().invoke(app, [str(run), "--out", str(tmp_path)], catch_exceptions=False)
