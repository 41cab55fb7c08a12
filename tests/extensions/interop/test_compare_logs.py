"""`harness compare A B`: two logs of Inspect AI, or of lm-eval, paired by sample and epoch.

`logs/` has two that Inspect AI 0.3.285 wrote: six sums in two epochs, and a seventh in B. Their
events and tracebacks were taken out. `logs/right` and `logs/worse` each have what lm-eval 0.4.13
wrote of six sums under two filters.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
from run_on_disk import made_up

LOGS = Path(__file__).parent / "logs"
A, B = LOGS / "sums-a.eval", LOGS / "sums-b.eval"
RIGHT = LOGS / "right/samples_sums_2026-11-30T07-59-29.314080.jsonl"
WORSE = LOGS / "worse/samples_sums_2026-11-30T07-59-52.617443.jsonl"
Said = tuple[int, str, str]
Harness = Callable[..., Said]
Sample = dict[str, Any]
HOSTILE = "s\x1b[31m|`x`\u202e"


def sample(name: int | str, value: Any = "C", epoch: int = 1, **more: Any) -> Sample:
    scores = {"match": {"value": value}}
    return {"id": name, "epoch": epoch, "input": "?", "target": "!", "scores": scores, **more}


def log(file: str, samples: Sequence[Sample], head: str = "header.json", **more: Any) -> Path:
    """Write a log as Inspect did before it packed by Zstandard; NaN as it writes it."""
    spec = {"task": "t", "model": "m", "dataset": {"name": "d"}}
    with ZipFile(file, "w", ZIP_DEFLATED) as archive:
        archive.writestr(head, json.dumps({"status": "success", "eval": spec, **more}))
        for n, each in enumerate(samples):
            archive.writestr(f"samples/{n}.json", json.dumps(each))
    return Path(file)


def scorers_of(out: str) -> Mapping[str, Any]:
    return {each["scorer"]: each for each in json.loads(out)["scorers"]}


def test_real_logs_are_paired_by_sample_and_epoch(harness: Harness) -> None:
    """`includes`: in A all is right. In B s1 fails in epoch 2 and s2 in both, s3 has an error in
    epoch 1 and s5 in both: changes -.5, -1, 0, 0, 0 of s1, s2, s3, s4, s6, with a mean of -.3.

    Its standard error: the variance of the five is .8 / 4; squared weights 1 / 25 for each; two
    that differ by 1/10 and 1/5, so that two more are added, of (.025 + .015 exp(-2/6)) each.
    `length`: of s4 the answers are 1 and 6 letters long, and s6 is not scored; Student's t.
    """
    code, out, err = harness("compare", A, B, "--json")
    assert (code, err) == (0, "")
    whole, scorers = json.loads(out), scorers_of(out)
    assert [*scorers] == ["includes", "length", "halves/first", "halves/second"]
    includes, length = scorers["includes"], scorers["length"]
    error = math.sqrt(0.2 / 5 + 2 * (0.025 + 0.015 * math.exp(-2 / 6)))
    ends = [-0.3 - 1.959964 * error, -0.3 + 1.959964 * error]
    assert [includes[name] for name in ("a", "b", "difference", "low", "high")] == pytest.approx(
        [1.0, 0.7, -0.3, *ends], abs=1e-6
    )
    assert [includes[name] for name in ("n", "n_excluded", "answers", "answers_without_number")] == [
        5, 1, 9, 3,
    ]  # fmt: skip
    assert includes["p"] == pytest.approx(math.erfc(0.3 / error / math.sqrt(2)))
    assert includes["changed"] == {
        "count": 2,
        "listed": [{"sample": "s2", "a": 1.0, "b": 0.0}, {"sample": "s1", "a": 1.0, "b": 0.5}],
    }
    # four samples, one of which changes by 2.5: t is 1 with 3 degrees of freedom
    assert [length[name] for name in ("difference", "low", "high", "p", "n")] == pytest.approx(
        [0.625, 0.625 - 3.182446 * 0.625, 0.625 + 3.182446 * 0.625, 0.391002, 4], abs=1e-5
    )
    assert scorers["halves/second"]["b"] == pytest.approx((0.375 * 4 + 0.5) / 5)
    assert all(each["p_holm"] == 1.0 for each in scorers.values())
    assert (whole["answers"], whole["samples"], whole["only_in_a"]["count"]) == (12, 6, 0)
    assert whole["only_in_b"]["listed"] == [
        {"sample": "s7", "epoch": 1},
        {"sample": "s7", "epoch": 2},
    ]
    assert whole["b"]["errors"]["count"] == 3


def test_the_terminal_names_errors_and_what_is_left_out(harness: Harness) -> None:
    code, out, err = harness("compare", A, B, "--show", "1")
    lines = out.splitlines()
    assert (code, err, max(map(len, lines)) <= 80) == (0, "", True)
    for line in (
        "B: sums-b.eval: doubles · mockllm/model: 14 answers, 3 with an error",
        "  the first error: s3 epoch 1: RuntimeError('the tool\\x1b[31m broke')",
        "only in B, left out: 2: s7 epoch 1, 1 more",
        "includes                     1.000    0.700   -0.300   [-0.954, +0.354]    0.369",
        "  changed 2: s2 1 → 0, 1 more",
        "p is not corrected for 4 scorers",
    ):
        assert line in lines
    assert "left out: 3 answers" in out


def test_what_a_log_says_is_shown_as_text(harness: Harness) -> None:
    a = log("a.eval", [sample(HOSTILE), sample(7)])
    b = log("b.eval", [sample(HOSTILE, "I", error={"message": HOSTILE}), sample(7)])
    shown = harness("compare", a, b)[1]
    assert "\\x1b[31m|`x`\\u202e 1 → 0" in shown
    marked = harness("compare", a, b, "--markdown")[1]
    assert marked.startswith("### Comparison of two logs\n")
    assert "| `match` | 1.000 | 0.500 | -0.500 |" in marked
    assert "\x1b" not in shown + marked
    assert "\u202e" not in shown + marked


def test_scores_are_numbers_as_inspect_counts_them(harness: Harness) -> None:
    values = ["C", "P", "I", "N", True, "no", "0.25", 0.75, "c", [1], float("nan"), 10**400, 1e200]
    samples = [sample(n, value) for n, value in enumerate(values)]
    out = harness("compare", log("a.eval", samples), log("b.eval", samples), "--json")[1]
    match = scorers_of(out)["match"]
    assert (match["n"], match["n_excluded"], match["a"]) == (8, 5, 3.5 / 8)


def test_messages_are_compared_without_their_ids(harness: Harness) -> None:
    asked = [[{"role": "user", "content": "?", "id": name}] for name in ("x", "y")]
    a, b = (log(f"{n}.eval", [sample(1, input=each)]) for n, each in enumerate(asked))
    assert harness("compare", a, b)[0] == 0


def test_gates_are_on_scorers(harness: Harness) -> None:
    right = [sample(n) for n in range(40)]
    a = log("a.eval", right)
    b = log("b.eval", [sample(n, "I" if n < 20 else "C") for n in range(40)])
    for gate, code in (
        ("score < -0.6", 0),
        ("match:score < -0.01", 1),
        ("match:score.high < 0", 1),
        ("score.low < -0.9", 0),
    ):
        typed = ("compare", a, b, "--fail-if", gate, "--junit", "gates.xml")
        assert harness(*typed)[0] == code
        assert ("<failure" in Path("gates.xml").read_text()) == bool(code)
    shown = json.loads(harness("compare", a, b, "--json", "--fail-if", "score < 0")[1])
    [gate_of_all] = shown["gates"]
    assert (gate_of_all["scorers"], gate_of_all["passed"]) == (["match"], False)
    assert gate_of_all["failed_in"] == [{"scorer": "match", "value": -0.5}]


def test_a_gate_that_has_nothing_sure_to_judge_is_refused(harness: Harness) -> None:
    whole = log("whole.eval", [sample(n) for n in range(3)])
    begun = log("begun.eval", [sample(0)], head="_journal/start.json", status="started")
    failed = sample(1, scores={}, error={"message": "no sandbox"})
    erring = log("erring.eval", [sample(0), failed, sample(2)])
    unknown = log("unknown.eval", [sample(n, "maybe") for n in range(3)])
    part = log("part.eval", [sample(n) for n in range(2)])
    more = {"match": {"value": "C"}, "f1": {"value": 1}}
    scored = log("scored.eval", [sample(n, scores=more) for n in range(3)])
    for b, gate, reason in (
        (begun, "score < 0", "begun.eval has status started"),
        (erring, "score < 0", "1 answer of A or B failed with an error"),
        (unknown, "score < 0", "no number has 3 answers of A or B"),
        (scored, "score < 0", "is on all, and only B has f1; compare two"),
        (part, "score < 0", "one log alone has 1 answer"),
        (whole, "other:score < 0", "unknown condition of --fail-if"),
        (whole, "success_rate < 0", "unknown metric of --fail-if"),
    ):
        code, out, err = harness("compare", whole, b, "--fail-if", gate)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert reason in err
        if b != whole:
            assert harness("compare", whole, b)[0] == 0
    harness("compare", whole, erring, "--fail-if", "score < 0", "--junit", "gates.xml")
    assert "<error" in Path("gates.xml").read_text()


def test_what_cannot_be_compared_is_one_line(tmp_path: Path, harness: Harness) -> None:
    a = log("a.eval", [sample("x"), sample("y")])
    other_input = log("input.eval", [sample("x"), sample("y", input="??")])
    other_target = log("target.eval", [sample("x", target="?"), sample("y")])
    chosen_of = log("choices.eval", [sample("x", choices=["!", "?"]), sample("y")])
    other_scorer = log("scorer.eval", [sample("x", scores={"f1": {"value": 1}})])
    run = made_up(tmp_path / "run")
    for b, more, reason in (
        (log("none.eval", [sample("z")]), (), "have no sample in common (ids such as 'x' and 'z')"),
        (other_input, (), "1 of 2 answers, such as that to sample 'y', have another input"),
        (other_target, (), "1 of 2 answers, such as that to sample 'x', have another input"),
        (chosen_of, (), "such as that to sample 'x', have another input, choices or target"),
        (other_scorer, (), "have no scorer in common (match in A, f1 in B)"),
        (run, (), "one is a log of another program (.eval) and one is not"),
        (Path("gone.eval"), (), "gone.eval is no log of Inspect AI"),
        (a, ("--html", "page.html"), "--html shows runs"),
    ):
        code, out, err = harness("compare", a, b, *more)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert reason in err


def spoilt(file: str, name: str) -> Path:
    """Copy log B with one byte changed in what a sample was packed to."""
    data = bytearray(B.read_bytes())
    with ZipFile(B) as archive:
        member = archive.getinfo(name)
    data[member.header_offset + 30 + len(name) + member.compress_size // 2] ^= 0xFF
    Path(file).write_bytes(data)
    return Path(file)


def test_a_log_that_is_none_is_one_line(harness: Harness) -> None:
    Path("text.eval").write_text("no archive")
    Path("half.eval").write_bytes(B.read_bytes()[:-100])
    bomb = log("bomb.eval", [sample("x", input="a" * 30_000_000)])
    deep = log("deep.eval", [])
    with ZipFile(deep, "a", ZIP_DEFLATED) as archive:
        archive.writestr("samples/0.json", "[" * 100_000)
    many = {f"s{n}": {"value": 1} for n in range(101)}
    for b, reason in (
        (Path("text.eval"), "does not end as a zip file"),
        (Path("half.eval"), "does not end as a zip file"),
        (bomb, "would unpack to"),
        (deep, "recursion"),
        (spoilt("spoilt.eval", "samples/s1_epoch_1.json"), ""),
        (log("twice.eval", [sample("x"), sample("x")]), "sample x is there twice in epoch 1"),
        (log("many.eval", [sample("x", scores=many)]), "more than 100 scorers"),
        (log("empty.eval", []), "it has no samples"),
        (log("kind.eval", [sample("x", scores=7)]), "Expected `object | null`"),
        (log("lone.eval", [sample("\ud800")]), "surrogates not allowed"),
        (log("headless.eval", [sample("x")], head="else.json"), "_journal/start.json"),
        (log("other.eval", [sample("x")], eval={"task": 1}), "Expected `str`"),
    ):
        code, out, err = harness("compare", A, b)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert f"{b} is no log of Inspect AI (" in err
        assert reason in err


def test_the_package_reads_the_logs_alike(harness: Harness) -> None:
    inspect_log = pytest.importorskip("inspect_ai.log", reason="needs the inspect extra")
    out = harness("compare", A, B, "--json")[1]
    for side, file in (("a", A), ("b", B)):
        whole = inspect_log.read_eval_log(str(file))
        errors = [each for each in whole.samples if each.error]
        shown = json.loads(out)[side]
        assert (len(whole.samples), len(errors)) == (shown["answers"], shown["errors"]["count"])
        assert (whole.eval.task, whole.eval.model) == (shown["task"], shown["model"])


def test_answers_of_lm_eval_are_paired_by_document(harness: Harness) -> None:
    """`exact_match`: three of six are wrong in B, one of which the filter `digits` repairs.

    The standard error: the variance of the changes is .3; squared weights 1 / 36 for each; two that
    differ are added, of 1 / 36 each.
    """
    code, out, err = harness("compare", RIGHT, WORSE, "--json", "--fail-if", "score < -0.4")
    assert (code, err) == (1, "")
    whole, scorers = json.loads(out), scorers_of(out)
    plain, digits = scorers["exact_match"], scorers["exact_match,digits"]
    high = -0.5 + 1.959964 * math.sqrt(0.3 / 6 + 2 / 36)
    assert [plain[name] for name in ("a", "b", "difference", "low", "high")] == pytest.approx(
        [1.0, 0.5, -0.5, -1.0, high], abs=1e-6
    )
    assert [each["sample"] for each in plain["changed"]["listed"]] == [1, 2, 4]
    assert [each["sample"] for each in digits["changed"]["listed"]] == [1, 4]
    assert (whole["a"]["task"], whole["a"]["model"]) == ("sums", "right")
    assert whole["gates"][0]["failed_in"] == [{"scorer": "exact_match", "value": -0.5}]
    assert whole["answers_with_other_prompts"] == 0


def test_what_differs_beside_the_samples_is_a_line(harness: Harness) -> None:
    """The options of a scorer of one name, and the examples in a prompt."""
    spec = {"task": "t", "model": "m", "dataset": {"name": "d"}}
    logs = []
    for name in ("any", "end"):
        scorer = {"name": "match", "options": {"location": name}}
        logs.append(log(f"{name}.eval", [sample(1)], eval={**spec, "scorers": [scorer]}))
    said = "other options in A and B, of scorers: match"
    assert said in harness("compare", *logs)[1]
    assert said not in harness("compare", logs[0], logs[0])[1]
    files = []
    for shots in ("", "2 + 2 = 4\n"):
        line = {"doc_id": 0, "metrics": ["m"], "m": 1, "arguments": {"arg_0": f"{shots}1 + 1 ="}}
        files.append(Path(f"samples{len(shots)}.jsonl"))
        files[-1].write_text(json.dumps(line))
    said = "asked with another prompt in B than in A: 1 of these"
    assert said in harness("compare", *files)[1]
    assert said not in harness("compare", files[0], files[0])[1]


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ("", "it has no answers"),
        ("no JSON", "Expecting value"),
        ("[" * 100_000, "recursion"),
        ('{"doc_id": 0}', "missing required field `metrics`"),
        ('{"doc_id": 0, "metrics": ["m"], "m": 1}\n' * 2, "document 0 is there twice for m"),
        (
            '{"doc_id": 0, "metrics": []}\n{"doc_id": 0, "metrics": [], "doc": 1}',
            "document 0 is there with two inputs",
        ),
        (json.dumps({"doc_id": 0, "metrics": [f"m{n}" for n in range(101)]}), "more than 100"),
    ],
)
def test_a_file_that_is_not_of_lm_eval_is_one_line(
    lines: str, reason: str, harness: Harness
) -> None:
    Path("b.jsonl").write_text(lines)
    code, out, err = harness("compare", RIGHT, "b.jsonl")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "b.jsonl is no file of answers of lm-eval (" in err
    assert reason in err


def test_logs_of_two_programs_are_no_pair(harness: Harness) -> None:
    code, out, err = harness("compare", A, RIGHT)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "give two of a kind" in err
