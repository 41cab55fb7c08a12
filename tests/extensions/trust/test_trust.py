"""The bench of rules under attack: its cells are runs, its figures paired,
and it goes on when stopped.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import served
from evaluating import Watched, figure, live_spec_of, run, spec_of
from misbehaving import Asked, serving

from harness.coordination.named_points import named_point
from harness.core import resources, versions
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.evaluate.claims import claims
from harness.evaluate.lifecycle import Evaluated
from harness.extensions.trust import study as trust
from harness.extensions.trust.bench import EXCLUDED, PEACE, Bench
from harness.extensions.trust.page import headline, trust_study
from harness.extensions.trust.study import names_of, run_bench, shares_of
from harness.runs.folder import read
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import write_study

pytestmark = pytest.mark.usefixtures("svg_alone")
ATTACKED = named_point("6g:attack=liar:share=1/3+spoof:share=1/3")
RULES, ATTACKS, THIRD = ("linear", "trust", "linear:weight_cap=0.3"), ("liar+spoof", "stale"), 1 / 3


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    spec = spec_of(small, points=(*spec_of(small).points, ATTACKED))
    return run(spec, tmp_path_factory.mktemp("trust") / "run")


def played(done: Evaluated, out: Path) -> Bench:
    stored = ReplayedRun(done.out)
    return run_bench(stored, "6g", RULES, ATTACKS, (THIRD,), stored.seeds, out, Watched())


@pytest.fixture(scope="module")
def bench(done: Evaluated, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return played(done, tmp_path_factory.mktemp("trust") / "bench")


def test_its_cells_are_what_a_run_says_under_the_same_condition(
    done: Evaluated, bench: Bench
) -> None:
    assert bench.success("linear").value == pytest.approx(
        figure(done, "6g", "balanced_success_rate").value
    )
    attacked = bench.success("linear", "liar+spoof", THIRD)
    assert attacked.value == pytest.approx(
        figure(done, ATTACKED.name, "balanced_success_rate").value
    )
    alone = bench.success_rule.mean(bench.alone)
    assert alone == pytest.approx(figure(done, "single-local", "balanced_success_rate").value)


def test_every_rule_meets_every_attack_and_peace_and_the_reference_is_there(bench: Bench) -> None:
    assert bench.rules == RULES
    assert bench.attacks == ATTACKS
    assert {of[1] for of in bench.cells} == {PEACE, EXCLUDED, *ATTACKS}
    assert len(bench.cells) == 3 + 1 + 3 * 2


def test_a_liar_at_a_false_place_is_found_and_nobody_is_while_nobody_lies(bench: Bench) -> None:
    found = bench.at("trust", "liar+spoof", THIRD).detection()
    assert found["recall"].value > 0.5
    assert found["precision"].value > 0.5
    peace = bench.at("trust").flagged
    assert peace is not None
    assert peace[:2].sum() == 0
    assert bench.at("linear", "liar+spoof", THIRD).detection() == {}


def test_a_loss_is_paired_with_the_same_rule_in_peace(bench: Bench) -> None:
    loss = bench.loss("linear", "liar+spoof", THIRD)
    parts = bench.success("linear", "liar+spoof", THIRD).value - bench.success("linear").value
    assert loss.value == pytest.approx(parts)
    assert bench.price("linear").value == 0


@pytest.mark.slow
def test_finished_cells_are_kept_and_a_torn_one_is_played_again(
    done: Evaluated, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = played(done, tmp_path)
    kept = tmp_path / "cells.jsonl"
    lines = kept.read_bytes().splitlines(keepends=True)
    assert len(lines) == len(first.cells) + len(first.strongest_lies)
    kept.write_bytes(b"".join(lines[:4]) + lines[4][:50])
    again: list[tuple[str, str, float]] = []
    real = trust.cell_of

    def counting(of: Any, result: Any) -> Any:
        again.append(of)
        return real(of, result)

    monkeypatch.setattr(trust, "cell_of", counting)
    second = played(done, tmp_path)
    assert len(again) == len(first.cells) - 4
    for of, cell in first.cells.items():
        assert np.array_equal(second.cells[of].success, cell.success)
        assert second.cells[of].first == cell.first
        assert second.cells[of].nats == pytest.approx(cell.nats, abs=1e-6, nan_ok=True)
    monkeypatch.setattr(versions, "DECISIONS", versions.DECISIONS + 1)
    again.clear()
    played(done, tmp_path)
    assert len(again) == len(first.cells)


@pytest.mark.slow
def test_cells_are_of_what_the_conditions_files_say(
    done: Evaluated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(resources.MARKER).touch()
    Path("networks").mkdir()
    stored, success = ReplayedRun(done.out), {}
    for round_trip_ms in (10, 3000, 10):
        Path("networks/mine.toml").write_text(
            'description = "x"\nsource = "x"\nstatus = "assumed"\n'
            f"[quantiles_ms]\n0 = {round_trip_ms}\n100 = {round_trip_ms}\n"
        )
        on = (stored, "6g:round_trip=mine", ("linear",), ("liar",), (THIRD,), stored.seeds)
        played_again = run_bench(*on, tmp_path / "bench", Watched())
        ends = success.setdefault(round_trip_ms, played_again.cells["linear", PEACE, 0.0].success)
        assert np.array_equal(ends, played_again.cells["linear", PEACE, 0.0].success)
    assert not np.array_equal(success[10], success[3000])


def test_its_folder_has_a_page_figures_and_a_picture(bench: Bench, tmp_path: Path) -> None:
    page = write_study(trust_study(bench), tmp_path).read_text()
    assert "liar+spoof" in page
    assert headline(bench)[1].startswith("While nobody attacks")
    rows = [json.loads(line) for line in (tmp_path / "figures.jsonl").read_text().splitlines()]
    assert {row["metric"] for row in rows} >= {
        "success_rate",
        "balanced_success_rate",
        "unsafe_rate",
        "nats",
        "detection_f1",
        "price_in_peace",
    }


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: shares_of("0,2"), "--share 0,2"),
        (lambda: shares_of("1/0"), "--share 1/0"),
        (lambda: shares_of("0"), "nobody attacks"),
        (lambda: names_of("--attacks", "liar,lair", ("liar",)), "unknown --attacks 'lair'"),
        (lambda: names_of("--attacks", "liar:share=1", ("liar",)), "--share"),
        (lambda: trust.under(named_point("6g"), "linear:tau=1", "", 0.0), "weight_cap"),
    ],
)
def test_what_it_cannot_play_is_one_line(act: Any, said: str) -> None:
    with pytest.raises(UserError, match=said) as problem:
        act()
    assert "\n" not in str(problem.value)


@pytest.mark.exhaustive
def test_frozen_and_driven_trust_alike(small: Dataset, tmp_path: Path) -> None:
    attacks = ("", ",attack=spoof", ",attack=jump", ",attack=liar+sybil")
    points = tuple(named_point(f"6g:consensus=trust{attack}") for attack in attacks)
    same: Any = {"points": points, "latency": "paper"}
    frozen = read(run(spec_of(load(small.path, 2), **same), tmp_path / "frozen").out)
    driven = read(run(live_spec_of(episodes=2, first_seed=100, **same), tmp_path / "driven").out)
    assert [e.success for e in frozen.episodes] == [e.success for e in driven.episodes]
    trust, other = (done.decisions.of_messages("trust") for done in (frozen, driven))
    assert np.array_equal(trust, other, equal_nan=True)
    attackers = frozen.decisions.of_messages("attacker") == 1
    assert np.nanmean(trust[attackers]) < 0.5 < np.nanmean(trust[~attackers])


@pytest.mark.exhaustive
def test_nobody_looks_at_claims_unless_a_rule_or_an_attack_does(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    monkeypatch.setattr("harness.evaluate.walk.claims", lambda *of: looked.append(1) or claims(*of))
    for n, (text, looks) in enumerate([
        ("6g", False), ("6g:attack=liar+sybil", False), ("6g:consensus=median", False),
        ("6g:consensus=trust", True), ("6g:attack=jump", True),
    ]):  # fmt: skip
        looked.clear()
        run(spec_of(small, points=(named_point(text),), limit=1), tmp_path / str(n))
        assert bool(looked) == looks, text


@pytest.mark.slow
def test_of_a_model_a_run_is_made_first_and_not_twice(
    harness: Callable[..., Any], small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources, "DATASET", str(small_path))
    typed = (
        *(
            "study",
            "trust",
            "--model",
            "proxy",
            "--prompt",
            "v4",
            "--attacks",
            "liar",
            "--rules",
            "trust",
        ),
        *("--share", "0,1/3", "--out", "bench"),
    )
    code, out, _ = harness(*typed, "--verbose")
    assert code == 0
    assert "Under liar, no rule clearly has the most" in " ".join(out.split())
    cells = Path("bench/cells.jsonl").read_bytes()
    assert read(Path("bench/run")).manifest.prompt["version"] == "v4"
    assert harness(*typed)[0] == 0
    assert Path("bench/cells.jsonl").read_bytes() == cells
    code, _, err = harness(*typed, "--seeds", "0:1")
    assert code == 2
    assert "was begun with --seeds" in err
    code, _, err = harness("study", "trust")
    assert code == 2
    assert "give either RUN, the folder of a finished run, or --model, with its --prompt" in err


@pytest.mark.exhaustive
def test_objects_are_attacked_by_the_usual_attacks_on_objects(
    done: Evaluated, tmp_path: Path
) -> None:
    stored = ReplayedRun(done.out)
    bench = run_bench(stored, "6g:content=objects", (), (), (1.0,), (0,), tmp_path, Watched())
    assert (bench.rules, bench.attacks) == (("linear",), ("ghost", "hide", "shift"))
    peace = bench.success("linear").value
    assert min(bench.success("linear", attack, 1.0).value for attack in bench.attacks) < peace
    said = " ".join(headline(bench))
    assert "linear pool" not in said
    assert "content objects holds no intents" in said
    assert write_study(trust_study(bench), tmp_path).is_file()


@pytest.mark.parametrize(
    ("condition", "rules", "attacks", "said"),
    [
        ("6g:content=oracle", (), (), "none of the usual attacks"),
        (
            "6g:content=objects",
            ("trust",),
            (),
            "no rule changes anything: content objects holds no intents",
        ),
        (
            "6g:content=objects",
            (),
            ("ghost", "liar"),
            "it must be absent, ghost, hide, shift or left out",
        ),
    ],
)
def test_what_no_message_holds_cannot_be_attacked(
    done: Evaluated, tmp_path: Path, condition: str, rules: Any, attacks: Any, said: str
) -> None:
    with pytest.raises(UserError, match=said) as problem:
        run_bench(
            ReplayedRun(done.out), condition, rules, attacks, (THIRD,), (0,), tmp_path, Watched()
        )
    assert "\n" not in str(problem.value)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("condition", "rules", "said"),
    [
        ("6g", ("ego-prompt",), "proxy is no language model and cannot fuse messages"),
        ("6g:attack=liar", ("linear",), "it has an attack; leave it out"),
        (
            "6g",
            ("ego-prompt:weight_cap=0.3",),
            "weight_cap changes nothing: consensus ego-prompt weighs no distances; give ego-prompt",
        ),
    ],
)
def test_a_bench_that_cannot_be_played_is_one_line(
    done: Evaluated, tmp_path: Path, condition: str, rules: Any, said: str
) -> None:
    with pytest.raises(UserError, match=said):
        run_bench(ReplayedRun(done.out), condition, rules, (), (THIRD,), (0,), tmp_path, Watched())


def test_what_is_spelt_in_two_ways_is_played_once(done: Evaluated, tmp_path: Path) -> None:
    rules = names_of(
        "--rules", "linear:weight_cap=1,median,median:weight_cap=0.250", ("linear", "median")
    )
    attacks = names_of("--attacks", "liar,liar:says=one-hot", ("liar",))
    shares = shares_of("1/3,0.33333333333")
    assert shares == (THIRD,)
    again = (*rules, "median:weight_cap=0.25")
    stored = ReplayedRun(done.out)
    bench = run_bench(stored, "6g", again, attacks, shares, (0,), tmp_path, Watched())
    assert (bench.rules, bench.attacks) == (("linear", *rules[1:]), ("liar",))
    assert set(bench.strongest_lies) == {"linear", *rules[1:]}


@pytest.mark.parametrize("attack", ["absent+absent", "silent+absent"])
def test_an_attack_of_who_is_absent_is_one_line(
    attack: str, done: Evaluated, tmp_path: Path
) -> None:
    options = ("6g", (), (attack,), (THIRD,), (0,))
    with pytest.raises(UserError, match="absent leaves the attackers out, whatever else they"):
        run_bench(ReplayedRun(done.out), *options, tmp_path, Watched())


def test_of_objects_a_model_is_asked_about_lists_of_liars(done: Evaluated, tmp_path: Path) -> None:
    options = ("6g:content=objects", (), ("ghost", "hide"), (1.0,), (0,))
    bench = run_bench(ReplayedRun(done.out), *options, tmp_path, Watched())
    case = bench.strongest_lies["linear"]
    assert set(case.success) == {"worst"}
    assert np.array_equal(case.liars > 0, bench.at("linear").success == 1)
    for attack in bench.attacks:
        assert np.all(case.success["worst"] <= bench.at("linear", attack, 1.0).success)
    assert "harms most" in headline(bench)[0]
    assert write_study(trust_study(bench), tmp_path).is_file()


def test_cells_without_the_model_are_not_taken_for_cells_with_it(
    small: Dataset, tmp_path: Path
) -> None:
    whole = run(spec_of(small, ask="all", seeds=(0,)), tmp_path / "run")
    options = ("6g", ("linear",), ("liar",), (THIRD,), (0,))
    without = ReplayedRun(whole.out, asks=False)
    first = run_bench(without, *options, tmp_path / "bench", Watched())
    asking = ReplayedRun(whole.out)
    second = run_bench(asking, *options, tmp_path / "bench", Watched())
    fresh = run_bench(ReplayedRun(whole.out), *options, tmp_path / "fresh", Watched())
    assert np.isnan(first.at("linear", "liar", THIRD).success).any()
    for key, cell in fresh.cells.items():
        assert np.array_equal(second.cells[key].success, cell.success)


@pytest.mark.slow
def test_a_study_of_kept_cells_says_again_what_was_left_out(small: Dataset, tmp_path: Path) -> None:
    whole = run(spec_of(small, ask="all", seeds=(0,)), tmp_path / "run")

    def caveats() -> tuple[str, ...]:
        without = ReplayedRun(whole.out, asks=False)
        options = ("6g", ("linear", "trust"), ("liar",), (THIRD,), (0,))
        return run_bench(without, *options, tmp_path / "bench", Watched()).caveats

    first = caveats()
    assert "No strongest lie is looked for: the model is not asked." in first[-1]
    assert any("left out episodes that reach one of" in caveat for caveat in first)
    assert caveats() == first
    kept = tmp_path / "bench" / "cells.jsonl"
    lines = kept.read_bytes().splitlines(keepends=True)
    kept.write_bytes(b"".join(lines[:2]))  # as of a study that was stopped
    assert caveats() == first


@pytest.mark.slow
def test_a_study_of_kept_cells_says_again_which_answers_were_lost(
    harness: Callable[..., tuple[int, str, str]], small_path: Path
) -> None:
    run_of_server = "--seeds 0:1 --condition single-local --condition 6g --out run --no-cache"
    study = "study trust run --rules linear --attacks liar --seeds 0:1 --out bench --json"
    number = [-1]  # of the next question: the tenth of the study's is refused

    def play(asked: Asked) -> None:
        number[0] += number[0] >= 0
        if number[0] == 10:
            asked.reply({"error": {"message": "content filter"}}, 400)
        else:
            served.answer(asked)

    with serving(play) as server:
        model = ("--model", f"{server.url}#m")
        made = harness("eval", *run_of_server.split(), *model, "--dataset", small_path)
        assert made[0] == 0, made
        number[0] = 0
        said = [harness(*study.split(), *model) for _ in range(2)]
    caveats = [json.loads(out)["caveats"] for _, out, _ in said]
    assert re.search(r"no answer to 1 of \d{2,} questions to helpers", caveats[0][-1])
    assert caveats[1] == caveats[0]
    assert json.loads(Path("bench/trust.json").read_text())["caveats"] == caveats[0]
