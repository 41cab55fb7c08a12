"""`harness drive` as it is typed."""

import json

import pytest

pytestmark = pytest.mark.usefixtures("svg_alone")


@pytest.mark.slow
def test_a_run_is_driven_told_and_told_to_machines(harness, tmp_path):
    options = (
        "--condition",
        "all",
        "--episodes",
        2,
        "--first-seed",
        5,
        "--seeds",
        "0:2",
        "--workers",
        1,
    )
    code, out, err = harness("drive", "--model", "local-view", *options, "--out", tmp_path / "run")
    assert (code, err) == (0, "")
    lines, (_, last, *_) = out.splitlines(), out.partition("\nnext: ")
    page = f"wrote {tmp_path / 'run' / 'report.html'}"
    assert max(map(len, lines[: lines.index(page)])) <= 80
    assert last
    assert (tmp_path / "run" / "report.html").is_file()
    assert "…" not in out
    assert " · closed loop · occluded-intersection, scenes of v2v-safety-2" in " ".join(out.split())
    assert "n = 2 episodes × 2 channel seeds; layout seeds 5 to 6 (tune)\n" in out
    code, out, _ = harness(
        "drive", "--model", "local-view", *options, "--out", tmp_path / "run2", "--json"
    )
    found = json.loads(out)
    assert (code, found["manifest"]["world"]["first_seed"]) == (0, 5)
    [success] = [
        row["value"] for row in found["summary"]
        if (row["condition"], row["metric"], row["interval"]) == ("6g", "success_rate", "episodes")
    ]  # fmt: skip
    assert success in (0.0, 0.5, 1.0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--episodes 0", "--episodes 0 is out of range; give 1 to 100000"),
        ("--first-seed -1", "--first-seed -1 is out of range"),
        ("--workers 0", "--workers 0: give 1 to 256 processes, or ray"),
        ("--condition 5g", "unknown operating point '5g'"),
        ("--condition all --condition 6g", "--condition all stands for every operating point"),
        ("--seeds 3:3", "--seeds 3:3: give a range"),
        ("--model nobody", "unknown model 'nobody'"),
        ("--model replay:EMPTY", "a replay has answers to frozen scenes alone"),
        ("--prompt v999", "unknown prompt"),
        ("--batch-size 0", "--batch-size 0: give 1 or more"),
        ("--answer readout", "proxy is no language model; use json"),
        ("--device cpu", "proxy has no weights here"),
        ("--out EMPTY/file --episodes 1", "is no folder; choose an empty or a new one"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2_and_nothing_is_written(
    harness, tmp_path, words, says
):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "file").write_text("mine")
    words = words.replace("EMPTY", str(tmp_path / "empty"))
    where = () if "--out" in words else ("--out", tmp_path / "out")
    code, out, err = harness("drive", *words.split(), *where)
    assert (code, out) == (2, "")
    assert err.startswith("harness: ")
    assert err.count("\n") == 1
    assert says in err
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["empty", "file"]
