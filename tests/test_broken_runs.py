"""A run that is broken, or of another version, is one line that names the file and what to do."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import reduce
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from run_on_disk import configure, damage, digested, made_up, rows_of
from tiers import some

import harness
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.report.compare import text
from harness.report.compare.difference import compare
from harness.report.compare.pair import pair
from harness.runs import folder, formats

READERS: dict[str, Callable[[Path], object]] = {
    "decisions.parquet": lambda run: folder.read(run).decisions,
    "answers.jsonl": lambda run: folder.read(run).answers,
    "episodes.csv": lambda run: folder.read(run).episodes,
    "summary.csv": lambda run: folder.read(run).scores,
    "run.json": folder.read,
}


@pytest.fixture
def run(once: Callable[[str, Callable[[Path], object]], Path], tmp_path: Path) -> Path:
    made = once("to-break", lambda folder: made_up(folder / "run"))
    return Path(shutil.copytree(made / "run", tmp_path / "run"))


def refused(run: Path, file: str) -> str:
    with pytest.raises(UserError) as raised:
        READERS[file](run)
    line = str(raised.value)
    assert line.isprintable()
    assert str(run / file) in line
    assert "; make the run again" in line
    return line


@pytest.mark.parametrize("file", READERS)
@pytest.mark.parametrize(
    "data", [b"", b"\xff\xfe\x00", b"{", b"[" * 100_000, b'a\n1,2,3\n"', b"PAR1PAR1"]
)
def test_no_bytes_are_taken_for_a_file(file: str, data: bytes, run: Path) -> None:
    if file != "answers.jsonl" or data:  # a replay may have none
        (run / file).write_bytes(data)
        refused(run, file)


@pytest.mark.parametrize("file", [name for name in READERS if name != "run.json"])
def test_a_file_that_is_missing_or_a_folder_is_named(file: str, run: Path) -> None:
    (run / file).unlink()
    assert "No such file" in refused(run, file)
    (run / file).mkdir()
    refused(run, file)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_table_of_decisions(share: float, run: Path) -> None:
    data = (run / "decisions.parquet").read_bytes()
    (run / "decisions.parquet").write_bytes(data[: int(len(data) * share)])
    refused(run, "decisions.parquet")


def rewritten(run: Path, rewrite: Callable[[pa.Table], pa.Table]) -> None:
    file = run / "decisions.parquet"
    pq.write_table(rewrite(pq.ParquetFile(file).read()), file)


def put(name: str, values: Any) -> Callable[[pa.Table], pa.Table]:
    """Another column of this name."""
    return lambda t: t.set_column(t.schema.get_field_index(name), name, pa.array(values))


def scene_of_another_row(table: pa.Table) -> pa.Table:
    """A table whose first row has the scene of its last."""
    scenes = table["scene"].to_pylist()
    return put("scene", [scenes[-1], *scenes[1:]])(table)


N = 32  # decisions of the made-up run


@pytest.mark.parametrize(
    ("rewrite", "said"),
    [
        (lambda t: t.drop_columns(["latency_ms"]), "it lacks latency_ms"),
        (lambda t: t.drop_columns(["fused_IDLE", "weight_2"]), "it lacks fused_IDLE, weight_2"),
        (put("condition", ["7g"] * N), "unknown condition '7g'"),
        (put("action", ["HONK\x1b"] * N), "unknown action 'HONK"),
        (put("action", pa.array([None] * N, pa.string())), "action is unknown"),
        (put("condition", pa.array([None] * N, pa.string())), "condition is unknown"),
        (put("seed", [9] * N), "a decision of another seed or episode"),
        (put("seed", [0, None] * (N // 2)), "seed is unknown"),
        (put("episode", [-1] * N), "a decision of another seed or episode"),
        (put("step", [None] * N), "step is unknown"),
        (put("latency_ms", ["soon"] * N), "is broken"),
        (put("latency_ms", [[1.0]] * N), "is broken"),
        (put("latency_ms", [float("inf")] * N), "latency_ms is too large"),
        (put("messages", [2**53 + 1] * N), "messages is too large"),
        (put("requests", [-(2**63)] * N), "requests is too large"),
        (scene_of_another_row, "the decisions of one decision point do not stand together"),
        (lambda t: t.slice(1), "not every decision of episodes.csv is there"),
        (lambda t: pa.concat_tables([t, t.slice(0, 1)]), "a decision is there twice"),
        (lambda t: pa.concat_tables([t.slice(1), t.slice(5, 1)]), "a decision is there twice"),
        (lambda t: t.slice(0, 0), "not every decision of episodes.csv is there"),
    ],
)
def test_a_wrong_table_of_decisions_says_what_is_wrong(
    rewrite: Callable[[pa.Table], pa.Table], said: str, run: Path
) -> None:
    assert len(rows_of(run)) == N
    rewritten(run, rewrite)
    assert said in refused(run, "decisions.parquet")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"strict", b"\xff", "utf-8"),
        (b'"ego"', b'"driver"', "role"),
        (b"[0.0,1.0,0.0]", b"[1.0]", "answer 00000-0/v1 has 1 probabilities"),
        (b'"status"', b'"state"', "status"),
        (b'"v2"', b'"v1"', "an answer is there twice"),
    ],
)
def test_a_wrong_answer_says_what_is_wrong(old: bytes, new: bytes, said: str, run: Path) -> None:
    file = run / "answers.jsonl"
    file.write_bytes(file.read_bytes().replace(old, new, 1))
    assert said in refused(run, "answers.jsonl")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda text: "\n".join(text.splitlines()[:-1]), "not every episode is there once"),
        (lambda text: text + text.splitlines()[-1] + "\n", "not every episode is there once"),
        (lambda text: text.replace("True", "perhaps"), "'perhaps'"),
        (lambda text: text.replace(",True,", ",,"), "success is unknown in some rows"),
        (lambda text: text.replace("6g", "7g"), "not every episode is there once"),
        (lambda text: text.replace("failure", "fail"), "it lacks failure"),
        (lambda text: re.sub(r"\d\.\d", "1e308", text, count=1), "is too large"),
        (lambda text: re.sub(r"\d\.\d", "-inf", text, count=1), "is too large"),
    ],
)
def test_wrong_episodes_say_what_is_wrong(
    wrong: Callable[[str], str], said: str, run: Path
) -> None:
    file = run / "episodes.csv"
    file.write_text(wrong(file.read_text()))
    assert said in refused(run, "episodes.csv")


@pytest.mark.parametrize(
    "values",
    [
        {"world": "small"}, {"world": {}}, {"seeds": ["x"]}, {"seeds": [0, 0]}, {"actions": None},
        {"actions": []}, {"conditions": []}, {"conditions": [{}]}, {"model": {}},
        {"prompt": {"version": "v2"}}, {"conditions": [{"name": "a", "profile": 3}]},
        {"model": {"name": 3, "engine": "x"}}, {"model": {"name": " ", "engine": "x"}},
        {"model": {"name": "m" * 301, "engine": "x"}}, {"model": {"name": 
            "m · v2 · json", "engine": "x"}},
        {"prompt": {"version": "", "sha256": "x"}}, {"prompt": {"version": 
            "v2 · json", "sha256": "x"}},
    ],
)  # fmt: skip
def test_a_wrong_manifest_says_what_is_wrong(values: dict[str, Any], run: Path) -> None:
    configure(run, **values)
    assert next(iter(values)) in refused(run, "run.json")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"temperature": 0.5}, "its settings have temperature 0.5, and beside them it is 0.0"),
        ({"latency": "paper"}, "its settings have latency paper, and beside them it is None"),
        ({"prompt": "v9\x1b"}, "its settings have prompt v9\\x1b, and beside them it is v2"),
        ({"seeds": "3,7"}, "its settings have seeds 3,7, and beside them it is"),
        ({"condition": []}, "its settings have condition [], and beside them it is"),
        (
            {"world": {"kind": "closed-loop"}},
            "its settings have world.kind closed-loop, and beside them it",
        ),
        ({"batch_size": "many"}, "its settings have batch_size many, and beside them it is 8"),
        ({"server": 3}, "settings.server"),
        ({"model": "qwen3-4b"}, "its settings have model qwen3-4b, and beside them it is made-up"),
        (
            {"model": "models/prox.gguf"},
            "its settings have model models/prox.gguf, and beside them",
        ),
        ({"model": 3}, "its settings have model 3, and beside them it is made-up"),
        (
            {"world": {"dataset": "unsignalised"}},
            "its settings have world.dataset unsignalised, and beside",
        ),
    ],
)
def test_settings_that_say_otherwise_than_what_stands_beside_them(
    settings: dict[str, Any], said: str, run: Path
) -> None:
    stated = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(
        json.dumps({**stated, "settings": {**stated["settings"], **settings}})
    )
    assert said in refused(run, "run.json")


@pytest.mark.parametrize(
    ("typed", "name", "may_be"),
    [
        ("crossing:ambient=fog", "crossing", True),
        ("crossing:ambient=fog", "merge", False),
        ("proxy,a/b", "proxy,b", True),
        ("proxy", "proxy,b", False),
    ],
)
def test_what_was_typed_may_open_what_is_called_so(typed: str, name: str, may_be: bool) -> None:
    assert formats._may_be(typed, name) == may_be


@pytest.mark.parametrize("table", [None, [], "all", 3])
def test_settings_that_are_no_table(table: Any, run: Path) -> None:
    configure(run, settings=table)
    assert "settings" in refused(run, "run.json")


def test_settings_of_a_later_harness_are_read_without_what_they_have_more(run: Path) -> None:
    stated = json.loads((run / "run.json").read_text())
    configure(run, settings={**stated["settings"], "later": 3})
    assert folder.read(run).manifest.settings.temperature == 0.0


WRONG = (None, -1, "x\x1b", [], {"a": 1})


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where each value of a JSON text stands."""
    pairs = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in pairs:
        yield (*at, key)
        yield from places(inner, (*at, key))


def wrong_values(stated: Any, at: tuple[Any, ...]) -> Iterator[Any]:
    """A JSON value with what stands at a place gone, and with each wrong value there."""
    for wrong in ("gone", *WRONG):
        changed = deepcopy(stated)
        table = reduce(lambda table, key: table[key], at[:-1], changed)
        if wrong == "gone":
            del table[at[-1]]
        else:
            table[at[-1]] = wrong
        yield changed


def said_of(run: Path, stated: Any, compares: bool = True) -> tuple[bool, str]:
    """Whether a run that states this is read, and the comparison with itself or the error."""
    (run / "run.json").write_text(json.dumps(stated))
    try:
        folder.read(run)
        digested(run)
        return True, text.terminal(compare(pair(run, run)), [], 5) if compares else ""
    except UserError as error:
        return False, str(error)


@pytest.mark.exhaustive
@pytest.mark.parametrize("closed_loop", [False, True])
def test_whatever_the_manifest_says_the_run_is_read_or_refused_in_a_line(
    closed_loop: bool, tmp_path: Path
) -> None:
    """Each value of run.json gone or another: what is read can be compared."""
    run = made_up(tmp_path / "run", closed_loop=closed_loop, episodes=1, steps=1)
    stated = json.loads((run / "run.json").read_text())
    compared = 0
    for at in places(stated):
        for changed in wrong_values(stated, at):
            is_read, said = said_of(run, changed)
            assert said.replace("\n", "").isprintable()
            compared += is_read
    assert compared > 50


@pytest.mark.parametrize("closed_loop", some([True], exhaustive=[False]))
def test_whatever_the_manifest_says_the_run_is_refused_in_a_line_or_the_first_that_is_read_compared(
    closed_loop: bool, tmp_path: Path
) -> None:
    """Every other value of a run with one condition;
    where it was driven, what is said of its world.
    """
    run = made_up(
        tmp_path / "run", closed_loop=closed_loop, points=(POINTS["6g"],), episodes=1, steps=1
    )
    stated = json.loads((run / "run.json").read_text())
    compared = 0
    for at in [*places(stated)][:: 1 if closed_loop else 2]:
        # the table has tests of its own
        if at[0] == "settings" or (closed_loop and at[0] != "world"):
            continue
        fresh = True
        for changed in wrong_values(stated, at):
            is_read, said = said_of(run, changed, compares=fresh)
            assert said.replace("\n", "").isprintable()
            compared += is_read and fresh
            fresh = fresh and not is_read
    assert compared > (1 if closed_loop else 20)


@pytest.mark.parametrize("episodes", [0, 1, 3, 5, 10**9])
@pytest.mark.parametrize("closed_loop", [False, True])
def test_another_number_of_episodes_is_refused(
    closed_loop: bool, episodes: int, tmp_path: Path
) -> None:
    run = made_up(tmp_path / "run", closed_loop=closed_loop)
    world = json.loads((run / "run.json").read_text())["world"]
    configure(run, world={**world, "episodes": episodes})
    assert f"it has 4 episodes, and run.json says {episodes}" in refused(run, "episodes.csv")


def test_a_first_seed_that_is_not_the_episodes_is_refused(tmp_path: Path) -> None:
    run = made_up(tmp_path / "run", closed_loop=True)
    world = json.loads((run / "run.json").read_text())["world"]
    configure(run, world={**world, "first_seed": 7})
    assert "a layout that is none of run.json's, whose first seed is 7" in refused(
        run, "episodes.csv"
    )


def test_a_summary_with_a_figure_twice_is_refused(run: Path) -> None:
    with (run / "summary.csv").open("r+") as file:
        file.write(file.readlines()[-1])
    assert "a figure is there twice" in refused(run, "summary.csv")


@pytest.mark.parametrize("old", ["swarmdrive-run/1", "swarmdrive-drive/1"])
def test_a_run_of_an_older_format_names_the_version_that_reads_it(old: str, run: Path) -> None:
    configure(run, format=old)
    with pytest.raises(
        UserError, match=r"harness 0\.1 reads it: run again, or install that version$"
    ):
        folder.read(run)


@pytest.mark.parametrize("value", [None, 2, [], "swarmdrive-run/9", "\x1b"])
def test_a_run_of_no_known_format_is_refused(value: object, run: Path) -> None:
    configure(run, format=value)
    with pytest.raises(UserError, match=r"has format .*, not 'swarmdrive-run/2'") as raised:
        folder.read(run)
    assert str(raised.value).isprintable()


@pytest.mark.parametrize("place", ["identity", "made-up"])
def test_a_manifest_that_nests_deep_is_broken(place: str, run: Path) -> None:
    stated = json.loads((run / "run.json").read_text())
    text = json.dumps({**stated, place: {"helpers": "HERE"}})
    (run / "run.json").write_text(text.replace('"HERE"', '[{"helpers":' * 200 + "1" + "}]" * 200))
    assert "nests more than 32 deep" in refused(run, "run.json")


@pytest.mark.parametrize("text", ["[]", "3", "null"])
def test_a_manifest_that_is_no_object_is_refused(text: str, run: Path) -> None:
    (run / "run.json").write_text(text)
    with pytest.raises(UserError, match="has format 'None'"):
        folder.read(run)


@pytest.mark.parametrize("file", [name for name in READERS if name != "run.json"])
def test_tables_raise_the_same(file: str, run: Path) -> None:
    (run / file).write_bytes(b"\xff")
    table = {"decisions.parquet": "decisions", "answers.jsonl": "answers"}.get(
        file, Path(file).stem
    )
    with pytest.raises(harness.UserError, match=file):
        getattr(harness.load(run), table)


def test_names_of_folders_are_no_columns(tmp_path: Path) -> None:
    run = made_up(tmp_path / "seed=7" / "condition=x")
    assert set(folder.read(run).decisions.whole("seed")) == {0, 1}


def test_text_of_any_kind_is_read_as_it_was_written(run: Path) -> None:
    said = 'a "b",\n\r\n=1 null NaN \u202e'
    damage(run, episode=lambda row: row.update(failure=said, partner=said))
    assert {(e.failure, e.partner, e.fault) for e in folder.read(run).episodes} == {
        (said, said, None)
    }


def test_a_change_by_hand_is_read_again(run: Path) -> None:
    damage(
        run,
        decision=lambda row: row.update(latency_ms=3.0),
        episode=lambda row: row.update(failure="late"),
    )
    read = folder.read(run)
    assert (read.decisions["latency_ms"] == 3.0).all()
    assert {episode.failure for episode in read.episodes} == {"late"}
    assert json.loads((run / "run.json").read_text())["name"] == "run"


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"window_s": "soon"}, "conditions: window_s = 'soon'; allowed: a number"),
        ({"tau_nats": None}, "conditions: tau_nats = None; allowed: a number"),
        ({"loss": [0.1]}, "conditions: loss = [0.1]; allowed: a number"),
        ({"profile": 6}, "conditions: profile = 6; allowed: a text"),
        ({"on_demand": 1}, "conditions: on_demand = 1; allowed: true or false"),
    ],
)
def test_a_condition_of_another_type_is_named(
    setting: dict[str, Any], said: str, run: Path
) -> None:
    stated = json.loads((run / "run.json").read_text())
    stated["conditions"][0] |= setting
    (run / "run.json").write_text(json.dumps(stated))
    assert said in refused(run, "run.json")


def test_a_condition_of_another_version_may_have_other_settings(run: Path) -> None:
    stated = json.loads((run / "run.json").read_text())
    stated["conditions"][0]["of_a_later_version"] = 1
    del stated["conditions"][0]["encoding"]
    (run / "run.json").write_text(json.dumps(stated))
    assert folder.read(run).conditions[0] == stated["conditions"][0]["name"]


def test_an_answer_to_messages_that_is_no_fusion_calls_is_named(run: Path) -> None:
    damage(run, answer=lambda row: row.update(heard=["v2"]))
    assert "heard messages, and is no fusion call's" in refused(run, "answers.jsonl")


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        ({"viewer": "v1~blind!liar"}, "is of a viewer that no vehicle is"),
        ({"role": "zork"}, "has role zork; known: ego, helper, merge"),
    ],
)
def test_an_answer_of_nobody_or_of_no_role_is_named(
    stated: dict[str, str], says: str, run: Path
) -> None:
    damage(run, answer=lambda row: row.update(stated))
    assert says in refused(run, "answers.jsonl")


def test_a_run_saved_with_a_byte_order_mark_is_the_same_run(run: Path) -> None:
    before = folder.read(run).manifest
    (run / "run.json").write_bytes(b"\xef\xbb\xbf" + (run / "run.json").read_bytes())
    assert folder.read(run).manifest == before
