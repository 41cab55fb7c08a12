"""`--tag`: words to find a run by, which change nothing in it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from evaluating import FILES, run, spec_of

from harness.core.process import Stop
from harness.dataset.load import Dataset
from harness.evaluate.run import evaluate
from harness.report.compare.difference import compare
from harness.report.compare.pair import pair
from harness.runs.listing import runs

Said = tuple[int, str, str]


class Killed(Stop):
    pass


def die(done: int) -> None:
    raise Killed


@pytest.mark.slow
def test_tags_are_recorded_listed_and_repeated_by_the_command(
    harness: Callable[..., Said], small_path: Path
) -> None:
    tags = ("--tag", "nightly", "--tag", "for the paper", "--tag", "nightly")
    once = ("--seeds", "0", "--condition", "6g", *tags, "--quiet")
    frozen = ("eval", "--dataset", small_path, "--limit", "1", *once, "--out", "reports/frozen")
    live = ("drive", "--episodes", "1", "--workers", "1", *once, "--out", "reports/live")
    for typed in (frozen, live):
        assert harness(*typed) == (0, "", "")
        manifest = json.loads((Path(str(typed[-1])) / "run.json").read_text())
        assert manifest["tags"] == ["nightly", "for the paper"]
        assert "--tag nightly --tag 'for the paper' --out" in manifest["command"]
    told = harness("run", "ls")[1]
    assert told.count("\n        tags: nightly, for the paper\n") == 2
    assert [one["tags"] for one in json.loads(harness("run", "ls", "--json")[1])] == [
        ["nightly", "for the paper"]
    ] * 2


@pytest.mark.parametrize("tag", ["", " ", "a ", "\x1b[31mred", "two\nlines", "x" * 41])
def test_a_tag_is_short_printable_text(tag: str, harness: Callable[..., Said]) -> None:
    for command in ("eval", "drive") if tag == "" else ("eval",):
        code, out, err = harness(command, "--tag", tag)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("harness: --tag '")
        assert err.endswith("': give 1 to 40 printable characters, with no space at either end\n")


@pytest.mark.exhaustive
def test_a_run_goes_on_under_other_tags_and_keeps_those_it_was_begun_with(
    small: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(Killed):
        evaluate(spec_of(small, tag=("first",)), tmp_path / "tagged", die)
    [begun] = runs(tmp_path)
    assert (begun.state, begun.tags) == ("unfinished", ("first",))
    done = run(spec_of(small, tag=("second", "first")), tmp_path / "tagged")
    assert done.manifest.tags == ("first", "second")
    plain = run(spec_of(small), tmp_path / "plain")
    assert plain.manifest.tags == ()
    for file in FILES:
        assert (done.out / file).read_bytes() == (plain.out / file).read_bytes()
    assert compare(pair(done.out, plain.out)).settings == ()


def test_a_run_whose_manifest_has_no_tags_is_listed_as_broken(
    small: Dataset, tmp_path: Path
) -> None:
    out = run(spec_of(small), tmp_path / "old").out
    manifest = json.loads((out / "run.json").read_text())
    del manifest["tags"]
    (out / "run.json").write_text(json.dumps(manifest))
    assert [(one.state, one.why, one.tags) for one in runs(tmp_path)] == [
        ("broken", "run.json", ())
    ]
