"""`harness compare` as typed: what it prints, its gates and its exit codes."""

import json
import re
import shutil
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import parse_qsl
from xml.etree import ElementTree

import pytest
from changing import ends
from run_on_disk import Row, answers_of, change, configure, made_up

from harness.coordination.named_points import POINTS
from harness.core.statistics import Estimate
from harness.report.compare.difference import Comparison, Difference, compare
from harness.report.compare.gate import gate, judge
from harness.report.compare.pair import pair
from harness.report.compare.text import code
from harness.report.compare.words import line

Said = tuple[int, str, str]
Harness = Callable[..., Said]


@pytest.fixture
def worse(worse_once: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """The two of which one is worse, each to be changed by a test."""
    one, other = (Path(shutil.copytree(run, tmp_path / run.name)) for run in worse_once)
    return one, other


@pytest.fixture(scope="module")
def compared(worse_once: tuple[Path, Path]) -> Comparison:
    return compare(pair(*worse_once))


@pytest.mark.parametrize(
    ("text", "failed"),
    [
        ("success_rate < -0.25", []),  # it is -0.25, and its interval ends at -1 and at +0.60
        ("success_rate <= -0.25", ["6g"]),
        ("success_rate < -0.01", ["6g"]),
        ("success_rate<-0.01", ["6g"]),
        ("6g:success_rate < -0.01", ["6g"]),
        ("single-local:success_rate < -0.01", []),
        ("success_rate <= 0", ["single-local", "6g"]),
        ("late_rate > 0.2", ["6g"]),
        ("late_rate >= 0.3", []),
        ("success_rate.high < 0", []),
        ("success_rate.high < 0.6", ["6g"]),
        ("6g:success_rate.low < -0.9", ["6g"]),
        ("success_rate.low <= -1", ["6g"]),
        # Alike in all episodes: 0 stands for its ends.
        ("latency_proxy_ms.high >= 0", ["single-local", "6g"]),
        ("latency_proxy_ms > 5", []),
        ("late_rate > 0", ["6g"]),
        ("unsafe_rate > 0", []),
    ],
)
def test_a_gate_fails_where_it_says(text: str, failed: list[str], compared: Comparison) -> None:
    assert [condition for condition, _ in judge(gate(text), compared).failed] == failed


@pytest.mark.parametrize(
    ("gates", "failed"),
    [
        (["success_rate < -0.25"], []),
        (["success_rate <= 0"], ["single-local", "6g"]),
        (["latency_proxy_ms > 5", "late_rate > 0", "unsafe_rate > 0"], ["6g"]),
    ],
)
def test_gates_decide_the_exit_code(
    gates: list[str], failed: list[str], worse_once: tuple[Path, Path], harness: Harness
) -> None:
    options = [part for gate in gates for part in ("--fail-if", gate)]
    code, out, err = harness("compare", *worse_once, *options, "--json")
    told = json.loads(out, parse_constant=pytest.fail)
    assert (code, err) == (1 if failed else 0, "")
    assert told["passed"] is not bool(failed)
    assert [where["condition"] for gate in told["gates"] for where in gate["failed_in"]] == failed
    assert [gate["gate"] for gate in told["gates"]] == gates
    assert {*map(tuple, [gate["conditions"] for gate in told["gates"]])} == {("single-local", "6g")}


@pytest.mark.parametrize(
    ("gate", "code"), [("success_rate < -0.25", 0), ("success_rate <= -0.25", 1)]
)
@pytest.mark.parametrize("form", [(), ("--markdown",)])
def test_every_form_ends_with_the_exit_code_of_its_gates(
    form: tuple[str, ...], gate: str, code: int, worse_once: tuple[Path, Path], harness: Harness
) -> None:
    assert harness("compare", *worse_once, *form, "--fail-if", gate)[0] == code


def test_rounding_decides_no_gate(runs: tuple[Path, Path], harness: Harness) -> None:
    """A loss of 0.1 + 0.2 - 0.3 is none."""

    def undecided(run: Path, nats: float) -> None:
        change(run, decision=lambda row: row.update(entropy_nats=nats))

    undecided(runs[0], 0.3)
    undecided(runs[1], 0.1 + 0.2)
    assert harness("compare", *runs, "--fail-if", "entropy_nats > 0")[0] == 0
    undecided(runs[1], 0.3 + 1e-6)
    assert harness("compare", *runs, "--fail-if", "entropy_nats > 0")[0] == 1


def test_a_condition_with_colons_in_its_name_has_gates_too(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    config = json.loads((runs[0] / "run.json").read_text())
    name = "6g:consensus=median,window_s=0.4"
    config["conditions"][1] |= {"name": name, "consensus": "median", "window_s": 0.4}

    def renamed(row: Row) -> None:
        if row["condition"] == "6g":
            row["condition"] = name

    for run in runs:
        change(run, decision=renamed, episode=renamed, conditions=config["conditions"])
    code, out, _ = harness("compare", *runs, "--fail-if", f"{name}:success_rate >= 0")
    assert code == 1
    assert f"FAILED: {name}:success_rate >= 0 in {name} (+0)" in " ".join(out.split())


@pytest.mark.parametrize(
    ("gate", "said"),
    [
        ("success_rate", "cannot be read; give [CONDITION:]METRIC[.low|.high] OP NUMBER"),
        ("success_rate < low", "cannot be read"),
        ("success_rate < nan", "cannot be read"),
        ("success_rate == 0", "[.low|.high] OP NUMBER with OP one of < <= > >=, such as "),
        ("success_rate < 0 or so", "cannot be read"),
        ("\x1b[31m", "cannot be read"),
        ("", "cannot be read"),
        ("sucess_rate < 0", "'sucess_rate'; did you mean 'success_rate'? known: success_rate, "),
        ("success_rate.middle < 0", "interval in --fail-if 'middle'; known: high, low"),
        ("5g:success_rate < 0", "unknown condition of --fail-if '5g:success_rate < 0' '5g'"),
        ("6g:success_rate < -5", "'6g:success_rate < -5' passes whatever was run: a difference of "
            "success_rate is from -1 to 1, where 0.01 is one point; give a number on that scale"),
        ("success_rate < -1", "passes whatever was run"),
        ("success_rate.high > 1", "passes whatever was run"),
        ("success_rate >= -1", "fails whatever was run"),
        ("late_rate < 10", "fails whatever was run"),
        ("optimal_brier > 2", "is from -2 to 2; give"),
    ],
)  # fmt: skip
def test_a_gate_that_cannot_be_read_is_one_line(
    gate: str, said: str, runs: tuple[Path, Path], harness: Harness
) -> None:
    options = ("--fail-if", "success_rate < -0.9", "--fail-if", gate, "--html", "page.html")
    code, out, err = harness("compare", *runs, *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert err[:-1].isprintable()
    assert not Path("page.html").exists()


def test_a_run_beside_itself_is_said_to_be(runs: tuple[Path, Path], harness: Harness) -> None:
    code, out, err = harness("compare", runs[0], runs[0])
    assert (code, err) == (0, "")
    assert "A and B are one folder" in " ".join(out.split())
    assert "(0 more" not in out


def test_a_gate_on_what_is_not_known_is_refused_and_does_not_pass(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    change(runs[1], decision=lambda row: row.update(latency_ms=None))
    code, out, err = harness("compare", *runs, "--fail-if", "latency_proxy_ms > 5")
    assert (code, out) == (2, "")
    assert "single-local has no such number in these runs" in err
    assert harness("compare", *runs)[0] == 0


def test_options_that_cannot_be_are_one_line(runs: tuple[Path, Path], harness: Harness) -> None:
    Path("mine").write_text("mine")
    for options, said in (
        (("--json", "--markdown"), "--markdown and --json: give one of them"),
        (("--show", "-1"), "--show -1 is out of range"),
        (("--html", "."), "--html . is a folder; name a file in it"),
        (("--html", "a/run.json"), "--html a/run.json is a file of a run, suite or dataset, whi"),
        (("--html", "mine"), "--html mine is a file that no command here wrote"),
        (("--junit", "mine", "--fail-if", "late_rate > 0"), "--junit mine is a file that no comm"),
        (("--html", "x", "--junit", "./x", "--fail-if", "success_rate drops > 1"), "two"),
        (("--html", "a/run.json/page.html"), "--html a/run.json/page.html cannot be written"),
    ):
        code, out, err = harness("compare", *runs, *options)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert said in err


def test_the_table_fits_and_says_it_all(worse: tuple[Path, Path], harness: Harness) -> None:
    configure(worse[1], answer="constrained")
    change(worse[1], answer=lambda row: row["viewer"] == "v1" and row.update(verdict="failed"))
    code, out, err = harness(
        "compare", "--verbose", *worse, "--show", "2", "--fail-if", "6g:late_rate > 0.1"
    )
    assert (code, err) == (1, "")
    assert max(map(len, out.splitlines())) <= 80
    said = " ".join(out.split())
    scenes = list(dict.fromkeys(answer.scene for answer in answers_of(worse[0])))
    n = len(scenes)
    for part in (
        "B: ", "proxy · prompt v2 · constrained", 
            "4 episodes × 2 channel seeds of small", "differ in answer",
        "answer: json → constrained", "success_rate % 100.0 75.0 -25.0 [-100.0, +59.9] 1.000",
        "success: 0 gained, 2 lost of 8 episodes × seeds",
        "lost: 1 late", f"answers: ego strict → failed: {n} of {n}",
        f"{scenes[0]}/v1, {scenes[1]}/v1, {n - 2} more",
        "FAILED: 6g:late_rate > 0.1 in 6g (+0.25)",
    ):  # fmt: skip
        assert part in said, part


@pytest.mark.slow
def test_six_metrics_come_first_and_all_print_the_rest(
    worse: tuple[Path, Path], harness: Harness
) -> None:
    """The primary metrics, then what changed most clearly:
    entropy, and bits, alike in every episode.
    """

    def differ(row: Row) -> None:
        row["entropy_nats"] += 0.5 + row["episode"] % 2 / 100
        row["request_bits"] += 8

    change(worse[1], decision=differ)
    metrics = json.loads(harness("compare", *worse, "--json")[1])["conditions"][1]["metrics"]
    for form in ((), ("--markdown",)):
        few, every = (
            harness("compare", "--verbose", *worse, *form, *more)[1] for more in ((), ("--all",))
        )
        rows = [
            [name for name in metrics if re.search(rf"[ ?] {name} ", text)] for text in (few, every)
        ]
        primary = ["success_rate", "balanced_success_rate", "unsafe_rate", "latency_proxy_ms"]
        assert set(rows[0]) == {*primary, "bits_per_episode", "entropy_nats"}
        assert set(rows[1]) == set(metrics)
        assert f"{len(metrics) - 6} more metrics: --all" in few
        assert re.search(r"\? entropy_nats ", few)
        assert "more metrics" not in every
    assert [name for name, d in metrics.items() if d["primary"]] == primary


def test_radios_networks_and_what_extensions_opened_are_told_where_both_runs_have_them(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    """A name, such as that of a file of one's own, may have come to mean another."""
    stated = json.loads((runs[1] / "run.json").read_text())
    radio = stated["channels"]["6g"]
    faster = {**radio, "parameters": {**radio["parameters"], "latency_s": 0.001}}
    configure(runs[1], channels={**stated["channels"], "6g": faster}, schedules={"mine": "0" * 64})
    out = " ".join(harness("compare", "--verbose", *runs)[1].split())
    assert "differ in channels" in out
    assert "channels.6g.latency_s: 0.005 → 0.001" in out
    assert "mine" not in out


def test_prefill_and_decode_of_each_run_are_said(
    runs: tuple[Path, Path], harness: Harness, tmp_path: Path
) -> None:
    def timed(row: Row) -> None:
        if row["viewer"] == "v1":
            row |= {"seconds": 0.12, "first_token_s": 0.03}

    change(runs[1], answer=timed)
    out = harness("compare", "--verbose", *runs, "--html", tmp_path / "page.html")[1]
    said = "B: ego: 25 % of the median answer is prefill (batch 1, measured where it ran)"
    for text in (out, (tmp_path / "page.html").read_text()):
        assert said in text
        assert "B: ego TTFT 30.0 ms, p95 30.0, n = 30" in text
    told = json.loads(harness("compare", *runs, "--json")[1])
    assert told["a"]["answer_times"] == {}
    assert told["b"]["answer_times"]["ego"]["first_token"]["median_s"] == 0.03


def test_json_lists_what_is_shown_and_counts_all(
    worse: tuple[Path, Path], harness: Harness
) -> None:
    change(worse[1], answer=lambda row: row["viewer"] == "v2" and row.update(verdict="recovered"))
    told = json.loads(
        harness("compare", *worse, "--show", "1", "--json")[1], parse_constant=pytest.fail
    )
    condition = told["conditions"][1]
    assert condition["metrics"]["success_rate"] | {"low": 0, "high": 0} == {
        "a": 1.0, "b": 0.75, "difference": -0.25, "low": 0, "high": 0, "n": 4, "n_excluded": 0,
        "p": pytest.approx(0.564, abs=1e-3), "p_holm": 1.0, "primary": True,
    }  # fmt: skip
    assert condition["lost"] == {
        "count": 2, "episodes": 1,
        "listed": [{"episode": 1, "seeds": [0, 1], "a": "success", "b": "late"}],
    }  # fmt: skip
    row = condition["metrics"]["success_rate"]
    assert condition["test"] == {
        "method": "interval", "p_value": row["p"], "low": row["low"], "high": row["high"],
    }  # fmt: skip
    scenes = list(dict.fromkeys(answer.scene for answer in answers_of(worse[0])))
    [turned] = told["answers"]
    assert turned == {
        "role": "helper", "a": "strict", "b": "recovered", "count": len(scenes),
        "requests": [f"{scenes[0]}/v2"],
    }  # fmt: skip
    assert (told["seeds"], told["episodes"], told["passed"]) == ([0, 1], 4, True)


@pytest.mark.exhaustive
def test_no_p_is_printed_as_zero_and_json_keeps_the_number(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    """B takes 50 ms more in even episodes and 50.01 in odd ones:
    certain, also among some thirty.
    """

    def slower(row: Row) -> None:
        row["latency_ms"] = 150.0 + row["episode"] % 2 * 0.01

    change(runs[0], decision=lambda row: row.update(latency_ms=100.0))
    change(runs[1], decision=slower)
    told = json.loads(harness("compare", *runs, "--json")[1], parse_constant=pytest.fail)
    of = [
        metric
        for c in told["conditions"]
        for metric in c["metrics"].values()
        if metric["p"] is not None
    ]
    latency = told["conditions"][1]["metrics"]["latency_proxy_ms"]
    assert 0 < latency["p"] < latency["p_holm"] <= latency["p"] * 6 < 1e-9
    printed = [
        harness("compare", *runs, "--verbose", *form)[1]
        for form in ((), ("--markdown",), ("--html", "page.html"))
    ]
    for text in (*printed[:2], unescape(Path("page.html").read_text())):
        said = " ".join(text.split())
        assert "< 0.001" in said
        tested, primary = len(of), sum(metric["primary"] for metric in of)
        assert f"corrects that of the primary metrics, {primary} differences" in said
        assert f"The other {tested - primary} are exploratory" in said
    assert not [line for line in printed[0].splitlines() if line.endswith((" 0.000", "= 0.000"))]


def test_better_and_worse_are_marked_in_words_and_signs_where_they_are_beyond_chance(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    change(runs[0], decision=lambda row: row.update(latency_ms=100.0, deadline_missed=False))
    change(runs[1], decision=lambda row: row.update(latency_ms=150.0 + row["episode"] % 2 * 0.01))
    out = harness("compare", "--verbose", *runs, "--html", "page.html")[1]
    [*marked] = (line for line in out.splitlines() if line.startswith(("✓", "✗")))
    assert any(line.startswith("✗ latency_proxy_ms") for line in marked)
    assert not any("success_rate" in line for line in marked), "it is the same in both"
    page = unescape(Path("page.html").read_text())
    assert "<strong>+50.0</strong> ✗ worse" in page
    assert page.count('class="forest worse"') == len(marked)
    back = harness("compare", "--verbose", *reversed(runs))[1]
    turned = [line.split()[1] for line in back.splitlines() if line.startswith("✓")]
    assert turned == [line.split()[1] for line in marked]


def test_a_flip_leads_to_the_decisions_of_both_runs_that_lost_it(
    worse: tuple[Path, Path], harness: Harness
) -> None:
    (worse[0] / "report.html").touch()
    (worse[1] / "report.html").touch()
    assert harness("compare", *worse, "--html", "page.html")[0] == 0
    links = re.findall(r'<a href="([^"]+)">([AB])', unescape(Path("page.html").read_text()))
    assert [name for _, name in links] == ["A", "B"]
    for (href, _), run in zip(links, worse, strict=True):
        file, _, where = href.partition("#")
        assert Path(file).resolve() == run / "report.html"
        scene = dict(parse_qsl(where))["scene"]
        assert scene in {answer.scene for answer in answers_of(run)}
        assert scene.startswith("00001-"), "the episode that flipped"
        assert "condition=6g&seed=0" in where


def test_gates_are_test_cases_of_junit(worse_once: tuple[Path, Path], harness: Harness) -> None:
    gates = ("--fail-if", "6g:success_rate < -0.01", "--fail-if", "unsafe_rate > 0.5")
    assert harness("compare", *worse_once, *gates, "--junit", "gates.xml")[0] == 1
    suite = ElementTree.parse("gates.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    failed, passed = suite.findall("testcase")
    assert (failed.get("name"), passed.get("name")) == (
        "6g:success_rate < -0.01",
        "unsafe_rate > 0.5",
    )
    assert "in 6g (-0.25)" in failed.find("failure").get("message", "")
    assert passed.find("failure") is None
    judged = [case.findtext("system-out") for case in suite]
    assert judged == ["judged: 6g", "judged: single-local, 6g"]
    code, _, err = harness("compare", *worse_once, "--junit", "gates.xml")
    assert (code, err) == (2, "harness: --junit writes gates; give one or more with --fail-if\n")


@pytest.mark.parametrize("which", ["A", "B"])
def test_a_gate_on_all_conditions_does_not_pass_where_a_run_lacks_one(
    which: str, tmp_path: Path, harness: Harness
) -> None:
    whole, part = (
        made_up(tmp_path / "whole"),
        made_up(tmp_path / "part", points=[POINTS["single-local"]]),
    )
    both = (whole, part) if which == "A" else (part, whole)
    typed = ("compare", *both, "--junit", "gates.xml", "--fail-if")
    code, out, err = harness(*typed, "success_rate < -0.9")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"is on all, and only {which} has 6g; compare two that have the same, or name" in err
    [case] = ElementTree.parse("gates.xml").getroot()
    assert f"only {which} has 6g" in case.find("error").get("message", "")
    [named] = re.findall(r"both have: '(.*)'", err)
    assert harness(*typed, named)[0] == 0
    assert ElementTree.parse("gates.xml").findtext("testcase/system-out") == "judged: single-local"


def test_no_number_has_more_than_four_figures() -> None:
    def told(value: float) -> str:
        return line(
            Difference("bits_per_episode", value, 0.0, Estimate(value, value, value, 2, 0))
        ).a

    assert [told(value) for value in (0.0, 7.0, 1234.4, 25850.3, 25856.0)] == [
        "0", "7", "1234", "25850", "25860",
    ]  # fmt: skip
    gap = Difference("least_gap_m", 123.456, 0.0, Estimate(-0.04, -0.04, -0.04, 2, 0))
    assert (line(gap).a, line(gap).change) == ("123.5", "+0.0")


HOSTILE = "`<script>alert(1)</script> @everyone ![x](http://x) {{ 7 * 7 }} | ``\n\u202e"


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[str] = []
        self.pieces: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [name for name, _ in attrs]

    def handle_data(self, data: str) -> None:
        self.pieces.append(data)


@pytest.fixture
def hostile(worse: tuple[Path, Path]) -> tuple[Path, Path]:
    """Whatever a run can say is hostile: names, ends, verdicts, ids of requests."""
    ends(worse[1], "6g", [["", HOSTILE, "", ""]] * 2)
    config = json.loads((worse[0] / "run.json").read_text())
    for run in worse:
        scenes = config["world"] | {"name": HOSTILE}
        configure(run, model=config["model"] | {"name": HOSTILE}, world=scenes)
    configure(worse[1], prompt=config["prompt"] | {"version": HOSTILE}, identity={HOSTILE: HOSTILE})

    def spoil(row: Row) -> None:
        row["scene"] += HOSTILE

    for run in worse:
        change(run, decision=spoil, answer=spoil)
    change(worse[1], answer=lambda row: row["viewer"] == "v1" and row.update(verdict="failed"))
    return worse


def test_nothing_a_run_says_becomes_markup(hostile: tuple[Path, Path], harness: Harness) -> None:
    gate = ("--fail-if", "6g:success_rate < 0")
    code, out, _ = harness("compare", "--verbose", *hostile, *gate, "--html", "page.html")
    assert code == 1
    assert max(map(len, out.splitlines())) <= 80
    assert out.replace("\n", "").isprintable()
    text = Path("page.html").read_text()
    page = Page(text)
    assert not {"script", "img", "link", "iframe", "form"} & set(page.tags)
    assert not [name for name in page.attributes if name.startswith("on")]
    assert "default-src 'none'; style-src 'unsafe-inline'" in text
    assert "⟨U+202E⟩" in text
    assert "\u202e" not in text
    for part in (
        "{{ 7 * 7 }}",
        "<script>alert(1)</script>",
        "FAILED: 6g:success_rate < 0 in 6g (-0.25)",
    ):
        assert part in "".join(page.pieces)
    marked = harness("compare", *hostile, *gate, "--markdown")[1]
    bare = re.sub(r"(?<!`)(`+)(?!`).*?(?<!`)\1(?!`)", "", marked)
    assert HOSTILE[1:20] in marked
    for part in ("script", "@everyone", "![x]", "\u202e"):
        assert part not in bare


@pytest.mark.parametrize(
    ("text", "marked"),
    [("a", "`a`"), ("a`b", "`` a`b ``"), ("``", "``` `` ```"), ("a\nb", r"`a\nb`"), ("|", "`|`")],
)
def test_code_holds_any_text(text: str, marked: str) -> None:
    assert code(text) == marked
