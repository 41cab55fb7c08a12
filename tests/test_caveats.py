"""What is said before a run's numbers:
its answers could not be read, or its model reads no prompt.
"""

import json
from collections.abc import Callable
from html import unescape
from pathlib import Path

import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from msgspec.structs import replace

from harness.coordination.named_points import POINTS, named_point
from harness.dataset.load import Dataset
from harness.evaluate.lifecycle import Evaluated
from harness.report.caveats import no_prompt, of_one_name, unheard
from harness.report.findings import FIRST, LAST, Kind, findings
from harness.runs import folder
from harness.runs.folder import Run
from harness.runs.records import Manifest, Score

Said = tuple[int, str, str]
NO_PROMPT = "proxy reads no prompt: it decides by the scene graph, whatever v2 says."
UNREAD = "None of the ego's 24 answers could be read: it drives by the fallback"
CARD = """engine = "proxy"
description = "nothing it says can be read"
[latency]
source = "card"
basis = "declared"
inference_s = 0.1
[failures]
nan = 1.0
"""


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    points = (POINTS["single-local"], POINTS["6g"])
    return evaluate(
        spec_of(small, points=points, seeds=(0,)), tmp_path_factory.mktemp("sound") / "run"
    )


def said_of(run: Run, *kinds: Kind) -> list[str]:
    return [finding.sentence for finding in findings(run, *kinds)]


def without_prompt(done: Evaluated, *manifests: Manifest) -> list[str]:
    return no_prompt({str(n): Run(done.out, manifest) for n, manifest in enumerate(manifests)})


def with_engine(done: Evaluated, engine: str) -> Manifest:
    return replace(done.manifest, model={**done.manifest.model, "engine": engine})


def test_a_radio_of_one_name_that_is_another_in_some_runs_is_said(done: Evaluated) -> None:
    radios = done.manifest.channels
    other = replace(radios["6g"], parameters={**radios["6g"].parameters, "loss": 0.5})
    moved = replace(done.manifest, channels={**radios, "6g": other})
    runs = {name: Run(done.out, stated) for name, stated in (("a", done.manifest), ("b", moved))}
    assert of_one_name(runs) == [
        "radio 6g is another in a and b: conditions that name it are not the same."
    ]
    assert of_one_name({"a": runs["a"], "c": runs["a"]}) == []


def share(metric: str, value: float) -> Score:
    return Score("all", metric, value, None, None, 1440, 0, "answers")


def test_half_of_the_answers_unread_are_said_by_role(done: Evaluated) -> None:
    language_model = with_engine(done, "llama-cpp")

    def told(*scores: Score) -> list[str]:
        run = Run(done.out, language_model)
        run.__dict__["scores"] = scores  # as if it had read them from its file
        return said_of(run, Kind.VOID, Kind.CAVEAT)

    assert told() == []
    assert told(share("failed_rate_ego", 0.49)) == []
    assert told(share("failed_rate_ego", 0.5)) == [
        "Only 50.0 % of the ego's 1440 answers could be read: it drives by the fallback, and "
        "success says little about the model."
    ]
    assert [line.split(":")[0] for line in told(
        share("failed_rate_ego", 1.0), share("failed_rate_helper", 1.0), share("failed_rate_merge", 0.984)
    )] == [
        "None of the ego's 1440 answers could be read", 
            "None of the helpers' 1440 "
            "answers could be read",
        "Only 1.6 % of the fusion calls' 1440 answers could be read",
    ]  # fmt: skip


@pytest.mark.parametrize("engine", ["proxy", "driver"])
def test_a_rule_reads_no_prompt_and_says_so(done: Evaluated, engine: str) -> None:
    assert said_of(Run(done.out, with_engine(done, engine)), Kind.LIMIT)[-1] == NO_PROMPT


def test_several_rules_are_named_in_one_sentence(done: Evaluated) -> None:
    def under(prompt: str, model: str = "proxy") -> Manifest:
        manifest = done.manifest
        names = {
            "model": {**manifest.model, "name": model},
            "prompt": {**manifest.prompt, "version": prompt},
        }
        return replace(manifest, **names)

    assert without_prompt(done, under("v1"), under("v2")) == [NO_PROMPT.replace("v2", "v1 or v2")]
    assert without_prompt(done, under("v2", "mine"), under("v2", "yours"), done.manifest) == [
        "mine, yours and proxy read no prompt: they decide by the scene graph, whatever v2 says."
    ]
    assert without_prompt(done, with_engine(done, "llama-cpp"), done.manifest) == [NO_PROMPT]


def test_a_driver_that_looks_at_nothing_does_not_decide_by_the_scene_graph(done: Evaluated) -> None:
    def driven(name: str) -> Manifest:
        return replace(
            done.manifest, model={**done.manifest.model, "engine": "driver", "name": name}
        )

    told = without_prompt(
        done, *map(driven, ("local-view", "cruise", "brake", "uniform", "constant"))
    )
    assert told == [
        NO_PROMPT.replace("proxy", "local-view"),
        "cruise, brake, uniform and constant read no prompt: they decide without looking, "
        "whatever v2 says.",
    ]
    assert without_prompt(done, driven("uniform")) == [
        "uniform reads no prompt: it decides without looking, whatever v2 says."
    ]


def test_an_engine_that_is_not_here_is_not_judged(done: Evaluated) -> None:
    assert said_of(Run(done.out, with_engine(done, "elsewhere")), Kind.CAVEAT) == []


@pytest.mark.slow
def test_whatever_shows_a_run_says_the_same_of_it_in_the_same_order(
    small_path: Path, harness: Callable[..., Said]
) -> None:
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models/mute.toml").write_text(CARD)
    options = ("--dataset", small_path, "--seeds", "0", "--condition", "6g", "--ties", "first")
    typed = ("eval", "--model", "mute", *options, "--verbose", "--out", "run")
    code, terminal, err = harness(*typed)
    assert (code, err) == (0, "")
    every = said_of(folder.read(Path("run")), *FIRST)
    assert len(every) > 4
    page = unescape(Path("run/report.html").read_text())
    assert f"<strong>{every[0]}</strong>" in page
    assert f"<strong>{every[-1]}" not in page
    below = said_of(folder.read(Path("run")), *LAST)
    assert len(below) > 1
    for shown in (" ".join(terminal.split()), page):
        places = [shown.index(sentence) for sentence in (*every, *below)]
        assert places == sorted(places)
    again = json.loads(harness("eval", "--model", "mute", *options, "--out", "again", "--json")[1])
    assert (again["caveats"], again["notes"]) == (every, below)
    assert json.loads(harness("compare", "run", "again", "--json")[1])["caveats"] == every


@pytest.mark.exhaustive
def test_a_run_that_said_nothing_says_so_wherever_it_is_shown(
    small_path: Path, harness: Callable[..., Said]
) -> None:
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models/mute.toml").write_text(CARD)
    options = (
        "--dataset",
        small_path,
        "--seeds",
        "0",
        "--condition",
        "6g",
        "--ties",
        "first",
        "--ask",
        "all",
    )
    code, out, err = harness(
        "eval", "--model", "mute", *options, "--out", "reports/mute", "--verbose"
    )
    assert (code, err) == (0, "")
    said = " ".join(out.split())
    assert said.index(UNREAD) < said.index("condition")
    assert "mute reads no prompt: it decides by the scene graph, whatever v2 says." in said
    assert "None of the helpers' 72 answers could be read: they send no message." in said
    cause = (
        "24 of the ego's 24 answers could not be read. The commonest cause, 24 of 24: a probability"
    )
    assert said.index(cause) < said.index("condition")
    page = unescape(Path("reports/mute/report.html").read_text())
    assert cause in page
    assert page.index(UNREAD) < page.index("Under 6g, mute")
    assert (
        "none of the ego's answers could be read: it drives by the fallback"
        in harness("run", "ls")[1]
    )
    sound = ("--prompt", "v1", "--json", "--out", "reports/sound")
    code, out, err = harness("eval", "--model", "proxy", *options, *sound)
    few = "Only 4 episodes: the interval of a rate may reach 49 points to either side."
    assert json.loads(out)["caveats"] == [few, NO_PROMPT.replace("v2", "v1")]
    sound_page = unescape(Path("reports/sound/report.html").read_text())
    assert "all answers could be read" in sound_page
    assert "None of the ego's" not in sound_page
    both = ("reports/mute", "reports/sound")
    assert f"A: {UNREAD}" in " ".join(harness("compare", *both)[1].split())
    assert f"A: {UNREAD}" in harness("compare", *both, "--markdown")[1]
    assert json.loads(harness("compare", *both, "--json")[1])["caveats"][0].startswith(
        f"A: {UNREAD}"
    )
    assert harness("compare", *both, "--html", "both.html")[0] == 0
    assert f"A: {UNREAD}" in unescape(Path("both.html").read_text())
    assert harness("report", *both, "--out", "matrix.html")[0] == 0
    assert f": {UNREAD}" in unescape(Path("matrix.html").read_text())


def test_a_page_says_what_else_bounds_its_numbers(small: Dataset, tmp_path: Path) -> None:
    """Four episodes; decisions over v2x take longer than the dataset's lag;
    two conditions are controls.
    """
    points = (POINTS["v2x"], *map(named_point, ("6g:messages=shuffled", "6g:messages=blind")))
    done = evaluate(spec_of(small, points=points, seeds=(0,)), tmp_path / "run")
    assert said_of(folder.read(done.out), Kind.LIMIT) == [
        "Only 4 episodes: the interval of a rate may reach 49 points to either side.",
        "Without a danger, success is 100.0 % under every condition in 1 layout: none changes "
        "that half of the balance here. In other layouts one may, by as much as the interval of "
        "its gain says.",
        "6g:messages=shuffled is a control: the ego hears what helpers say in another layout, "
        "while a decision's page shows what its own helpers say.",
        "6g:messages=blind is a control: the ego hears helpers that are shown nothing.",
        "Under v2x, most decisions take longer than these frozen scenes assume: closed-loop "
        "success may differ. harness study fidelity compares the two.",
        NO_PROMPT,
    ]


def test_a_window_that_no_reply_keeps_is_said(small: Dataset, tmp_path: Path) -> None:
    """A lost reply is no late one, and one that is heard is enough."""
    points = [named_point(name) for name in ("6g", "6g:loss=1", "6g:window_s=0.01,loss=0")]
    run = folder.read(evaluate(spec_of(small, points=points, seeds=(0,)), tmp_path / "run").out)
    scheduled = run.score(points[-1].name, "message_count")
    assert scheduled
    assert scheduled.value
    [said] = unheard(run)
    assert said == (
        f"Under {points[-1].name}, nobody is heard: of {scheduled.value:.0f} messages that "
        "arrived, none came within the decision window, so that the ego decided alone."
    )
    assert said in said_of(run, Kind.LIMIT)
