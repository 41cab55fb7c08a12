"""The strongest lies: no other message does more, brute force agrees, and bounds hold."""

from pathlib import Path

import numpy as np
import pytest
from evaluating import Watched, run, spec_of
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.coordination.consensus import Fused, Messages, inverse_distance_weights
from harness.coordination.coordinate import FusionInputs, TieDraws, fuse
from harness.coordination.exchange import exchange
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import RULES
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.draws import channel_draws, tie_draws
from harness.extensions.trust import lies, worst
from harness.extensions.trust.attackers import attackers_among
from harness.extensions.trust.bench import PEACE, Bench
from harness.extensions.trust.page import trust_study
from harness.extensions.trust.strongest_lies import (
    StrongestLies,
    _named,
    space_of,
    strongest_lies,
)
from harness.extensions.trust.study import CAPPED, run_bench, under
from harness.extensions.trust.worst_page import strongest
from harness.runs.headline import SUCCESS
from harness.studies.axes import Setting
from harness.studies.replayed_run import ReplayedRun
from harness.studies.sweep import point_of

EXACT = (*sorted(lies.ONE_HOT_SUFFICES), "linear:weight_cap=0.3", CAPPED)
IN_STEPS = ("geometric-median", "centred-clipping")
ATTACKS = (
    "liar", "brake", "random", "stuck", "stale", "replay", "silent", "overconfident",
    "spoof", "liar+spoof", "jump", "liar+jump", "sybil", "liar+sybil", "flood",
)  # fmt: skip
THIRD = 1 / 3


@pytest.fixture(scope="module")
def stored(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> ReplayedRun:
    return ReplayedRun(run(spec_of(small), tmp_path_factory.mktemp("worst") / "run").out)


@pytest.fixture(scope="module")
def bench(stored: ReplayedRun, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    rules, out = (*EXACT, *IN_STEPS, "trust"), tmp_path_factory.mktemp("worst") / "bench"
    return run_bench(stored, "6g", rules, ATTACKS, (THIRD,), stored.seeds, out, Watched())


def distributions(voices: int) -> st.SearchStrategy[np.ndarray]:
    weights = arrays(float, (voices, 3), elements=st.floats(0.01, 1))
    return weights.map(lambda each: each / each.sum(axis=-1, keepdims=True))


@pytest.mark.parametrize("name", sorted(lies.ONE_HOT_SUFFICES))
@given(
    p=distributions(5), metres=arrays(float, 5, elements=st.floats(1, 60)), said=distributions(1)
)
def test_whatever_a_liar_says_certainty_of_that_action_does_as_well(
    name: str, p: np.ndarray, metres: np.ndarray, said: np.ndarray
) -> None:
    heard = np.ones(4, dtype=bool)
    weights = inverse_distance_weights(metres, heard, 1.0)
    rule = RULES[name]

    def policy(message: np.ndarray) -> np.ndarray:
        intents = np.concatenate([p[:-1], message])
        messages = Messages(intents, weights, heard, np.zeros(4), metres, metres[1:])
        return rule.fuse(messages, rule.start((), 4, 3)).policy

    by_any = policy(said)
    action = int(np.argmax(by_any))
    if np.sort(by_any)[-2] < by_any[action] - 1e-6:
        assert np.argmax(policy(np.eye(3)[[action]])) == action


@pytest.mark.parametrize("name", [*EXACT, *IN_STEPS])
def test_brute_force_over_all_messages_of_a_lattice_finds_no_more_and_no_less(
    stored: ReplayedRun, bench: Bench, name: str
) -> None:
    point = under(point_of([stored], "6g"), name, PEACE, 0.0)
    finds_as_brute_force(stored, point, bench.strongest_lies[name].success[lies.WORDS][0])


@pytest.mark.parametrize("name", ["linear", "geometric-median"])
def test_an_ego_that_is_careful_where_it_is_unsure_is_made_unsure(
    stored: ReplayedRun, name: str
) -> None:
    pytest.importorskip("harness.extensions.promise")
    point = under(point_of([stored], "6g:careful_nats=0.6"), name, PEACE, 0.0)
    case = strongest_lies(stored, point, THIRD, stored.seeds)
    assert case is not None
    finds_as_brute_force(stored, point, case.success[lies.WORDS][0])
    assert case.at_least is None


def finds_as_brute_force(stored: ReplayedRun, point: OperatingPoint, success: np.ndarray) -> None:
    forest = stored.dataset.forest
    for tree, root in enumerate(forest.root.tolist()):
        lost = loses(stored, point, root)
        assert lost == (success[tree] == 0), forest.ids[root]


def loses(stored: ReplayedRun, point: OperatingPoint, node: int) -> bool:
    """Return whether some message at a decision point, or later, loses the episode."""
    forest = stored.dataset.forest
    tree = forest.tree[node]
    [scene] = stored.dataset.scenes([forest.ids[node]])
    messages = np.concatenate([lies.lattice(3), [[np.nan] * 3]])
    n = len(messages)
    truth = stored.whole([scene]).take(np.zeros(n, dtype=int))
    seed, layout = np.full(n, stored.seeds[0]), np.full(n, forest.seeds[tree])
    steps = stored.dataset.scenario.parameters.decisions
    step, helpers = np.full(n, forest.step[node]), truth.valid.shape[1]
    draws = channel_draws(seed, layout, step, steps, helpers, np.full(n, helpers))
    liars = attackers_among(THIRD, truth, draws)
    heard = exchange(point, truth, draws)
    ties = FusionInputs(None, None, tie_draws(draws, stored.spec.ties))
    spoken = fuse(point, heard, lies.with_message(truth, liars, messages), ties).action
    heard.on_time[liars] = False
    actions = {*spoken.tolist(), *fuse(point, heard, truth, ties).action.tolist()}
    for action in actions:
        child = forest.child[node, action]
        if not forest.safe[node, action] or (child >= 0 and loses(stored, point, child)):
            return True
    return False


@pytest.mark.parametrize("name", ["linear", "geometric-median", "trust"])
def test_decisions_that_are_alike_end_as_if_each_was_fused(
    stored: ReplayedRun, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = under(point_of([stored], "6g"), name, PEACE, 0.0)
    at_once = strongest_lies(stored, point, THIRD, range(4))
    kinds, shares = worst._Decisions.kinds, list[float]()

    def each_its_own(self: worst._Decisions, at: np.ndarray, ties: TieDraws) -> worst._Kinds:
        every = np.arange(len(at))
        shares.append(len(kinds(self, at, ties).first) / len(at))
        return worst._Kinds(every, every, ties)

    monkeypatch.setattr(worst._Decisions, "kinds", each_its_own)
    one_by_one = strongest_lies(stored, point, THIRD, range(4))
    assert at_once is not None
    assert one_by_one is not None
    assert min(shares) < 0.5
    for column, values in at_once.values().items():
        assert np.array_equal(values, one_by_one.values()[column]), column


def test_a_kind_is_played_on_as_long_as_one_of_its_decisions_is_open() -> None:
    kinds = worst._Kinds(np.array([0, 3]), np.array([0, 0, 0, 1]), None)
    of_the_second = np.array([False, True, False, False])
    assert kinds.of_some(of_the_second).tolist() == [0]
    fused = worst._Fused(np.array([1, 0]), np.eye(3)[[2, 0]], np.zeros((2, 1)), np.array([0.5, 1]))
    play = kinds.spread(fused)
    assert play.rows.tolist() == [3, 0, 1, 2]
    assert play.action.tolist() == [2, 0, 0, 0]
    assert play.trust.tolist() == [0.5, 1, 1, 1]


def test_without_a_liar_an_episode_ends_as_it_does_in_peace(bench: Bench) -> None:
    for rule, case in bench.strongest_lies.items():
        assert np.array_equal(case.liars > 0, bench.at(rule).success == 1), rule


def test_no_attack_that_ships_does_more(bench: Bench) -> None:
    for rule in (*EXACT, *IN_STEPS):
        case = bench.strongest_lies[rule]
        for attack in ATTACKS:
            if space_of(attack) == lies.WORDS:
                cell = bench.at(rule, attack, THIRD)
                assert np.all(case.success[lies.WORDS] <= cell.success), (rule, attack)
                assert np.all(case.unsafe >= cell.unsafe), (rule, attack)
    for rule in bench.strongest_lies:
        for attack in ATTACKS:
            case, cell = strongest(bench, rule), bench.at(rule, attack, THIRD)
            assert np.all(case.success[space_of(attack)] <= cell.success), (rule, attack)
            if space_of(attack) == lies.WORDS:
                assert np.all(case.unsafe >= cell.unsafe), (rule, attack)
                assert not np.any((case.liars > bench.liars) & (cell.success == 0)), (rule, attack)


def test_what_trust_keeps_in_any_case_no_lie_and_no_attack_takes(bench: Bench) -> None:
    case = bench.strongest_lies["trust"]
    assert np.all(case.at_least <= case.success[lies.WORDS])
    for attack in ATTACKS:
        if space_of(attack) == lies.WORDS:
            assert np.all(case.at_least <= bench.at("trust", attack, THIRD).success), attack


def test_rules_that_count_heads_withstand_one_liar_where_all_others_agree(bench: Bench) -> None:
    linear, median = (bench.strongest_lies[rule] for rule in ("linear", "geometric-median"))
    assert (median.liars > 1).sum() > (linear.liars > 1).sum()
    assert (linear.liars == 1).any()


def test_claims_only_add_to_words(bench: Bench) -> None:
    for case in bench.strongest_lies.values():
        assert np.all(case.success[lies.PLACES] <= case.success[lies.WORDS])
        assert np.all(case.success[lies.VOICES] <= case.success[lies.PLACES])


def test_the_study_begins_with_the_strongest_lies(bench: Bench) -> None:
    study = trust_study(bench)
    assert "say, from true places, what harms most" in study.headline[0]
    first, second = study.tables[:2]
    assert first.title.startswith("33 % of the helpers lie as well as they can")
    assert second.title.startswith("Certificates")
    assert len(first.rows) == len(bench.rules) + 1
    assert set(study.answer["worst"]) == set(bench.rules)


def test_without_a_model_nothing_is_looked_for(small: Dataset, tmp_path: Path) -> None:
    whole = run(spec_of(small, ask="all", seeds=(0,)), tmp_path / "run")
    silent = ReplayedRun(whole.out, asks=False)
    played = run_bench(
        silent, "6g", ("linear",), ("silent",), (THIRD,), (0,), tmp_path / "bench", Watched()
    )
    assert not played.strongest_lies
    assert "harms most" not in " ".join(trust_study(played).headline)


def test_a_worst_case_is_kept_as_it_was_found(stored: ReplayedRun) -> None:
    point = point_of([stored], "6g")
    case = strongest_lies(stored, point, THIRD, (0,))
    assert case is not None
    again = type(case).of(case.values())
    assert all(np.array_equal(value, again.values()[k]) for k, value in case.values().items())


def test_of_messages_from_other_scenes_no_strongest_lie_is_said(
    stored: ReplayedRun, tmp_path: Path
) -> None:
    pytest.importorskip("harness.extensions.controls")
    options = ("6g:messages=shuffled", ("linear",), ("silent",), (THIRD,), (0,), tmp_path)
    played = run_bench(stored, *options, Watched())
    assert not played.strongest_lies
    assert "looked for: messages come from other scenes." in played.caveats[-1]


def test_where_what_liars_say_decides_who_is_heard_no_strongest_lie_is_said(
    stored: ReplayedRun, tmp_path: Path
) -> None:
    options = ("6g:helper_rounds=true", ("linear",), ("brake",), (THIRD,), (0,), tmp_path)
    played = run_bench(stored, *options, Watched())
    assert not played.strongest_lies
    assert "looked for: what helpers say decides who is heard." in played.caveats[-1]


def test_an_attack_that_was_played_is_one_of_the_lies() -> None:
    every, none = np.ones((1, 4)), np.zeros((1, 4))
    case = StrongestLies(dict.fromkeys(lies.CLAIMS, every), none, every + 2, every)
    lost, ended = np.array([[1.0, 0, 1, np.nan]]), np.array([[0.0, 1, 0, np.nan]])
    of_words = case.with_lie(lies.WORDS, lost, ended, 1)
    assert of_words.success[lies.VOICES].tolist() == [[1, 0, 1, 1]]
    assert of_words.unsafe.tolist() == [[0, 1, 0, 0]]
    assert of_words.liars.tolist() == [[3, 1, 3, 3]]
    assert of_words.at_least is not None
    assert of_words.at_least.tolist() == [[1, 0, 1, 1]]
    of_places = case.with_lie(lies.PLACES, lost, ended, 1)
    assert of_places.success[lies.WORDS].tolist() == [[1, 1, 1, 1]]
    assert of_places.success[lies.PLACES].tolist() == [[1, 0, 1, 1]]
    assert of_places.liars.tolist() == [[3, 3, 3, 3]]


class Grudge:
    """A package's rule: it goes for the last action for ever once somebody was sure of the first."""

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> np.ndarray:
        return np.zeros((*batch, 1))

    def fuse(self, messages: Messages, state: np.ndarray) -> Fused:
        own, sure = messages.intents[..., 0, :], messages.intents[..., 1:, 0] > 0.99
        last = np.eye(own.shape[-1])[-1]
        seen = (sure & messages.heard).any(axis=-1, keepdims=True)
        policy = np.where(state > 0, last, own)
        return Fused(policy, messages.weights, np.maximum(state, seen))


def test_of_a_packages_rule_with_memory_nothing_is_said(
    stored: ReplayedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RULES._loaded, "grudge", Grudge())
    monkeypatch.setattr(RULES, "built_in", {**RULES.built_in, "grudge": Grudge()})
    options = ("6g", ("linear", "grudge"), ("brake",), (THIRD,), (0,), tmp_path)
    bench = run_bench(stored, *options, Watched())
    assert bench.rules == ("linear", "grudge")
    assert set(bench.strongest_lies) == {"linear"}
    study = trust_study(bench)
    assert study.tables[0].title.startswith("33 %")
    [said] = study.caveats
    assert said.startswith("The strongest lies against grudge were not looked for: of a package's")


def test_a_share_that_rounds_has_as_many_liars_as_the_attacks(
    stored: ReplayedRun, tmp_path: Path
) -> None:
    options = ("6g", ("linear",), ("brake", "liar"), (5 / 6,), (0,), tmp_path)
    bench = run_bench(stored, *options, Watched())
    case = bench.strongest_lies["linear"]
    for attack in bench.attacks:
        assert np.all(case.success[lies.WORDS] <= bench.at("linear", attack, 5 / 6).success)
    typed = point_of([stored], "6g:attack=brake:share=5/6")
    [[walked]] = stored.walked([Setting("typed", typed, stored.vehicles)], (0,))
    assert np.array_equal(walked.ends[SUCCESS], bench.at("linear", "brake", 5 / 6).success)


def test_who_is_in_no_scene_of_a_step_lies_to_nobody(stored: ReplayedRun) -> None:
    [scene] = stored.dataset.scenes([stored.dataset.forest.ids[stored.dataset.forest.root[0]]])
    truth = stored.whole([scene])
    helpers, zero = truth.valid.shape[1], np.array([0])
    draws = channel_draws(zero, np.array([1]), zero, 4, helpers, np.array([helpers]))
    assert _named((0, helpers), truth, draws).tolist() == _named((0,), truth, draws).tolist()


def test_a_share_of_nobody_is_one_line(stored: ReplayedRun, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="this is nobody of 3 helpers"):
        run_bench(stored, "6g", ("linear",), ("brake",), (0.1,), (0,), tmp_path, Watched())


def test_what_only_bounds_attacks_is_no_attack(stored: ReplayedRun, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--attacks absent: it is played beside any attack"):
        run_bench(stored, "6g", ("linear",), ("absent",), (THIRD,), (0,), tmp_path, Watched())
