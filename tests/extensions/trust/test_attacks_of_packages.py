"""What a package's attack may do: it changes what is an attacker's, and fails in one line."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from harness.coordination.intents import Intents
from harness.coordination.part_settings import change_of
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.extensions.trust.attackers import _acted
from harness.extensions.trust.attacks import ATTACKS, Attack, Turn, with_voices

Typed = Callable[..., tuple[int, str, str]]
P = np.full((2, 2), 0.5)
SAID = Intents(P, np.full((2, 2, 2), 0.5), np.ones((2, 2), dtype=bool), np.ones((2, 3)), 2 * P, 2 * P,
               np.ones((2, 3)))  # fmt: skip
TURN = Turn(
    SAID, np.array([[True, False]] * 2), SAID.helpers, np.empty((2, 0, 2, 2)), np.zeros((2, 2))
)


@dataclass(frozen=True)
class Lie(Attack):
    lie: Callable[[Intents], Intents] = lambda sent: sent

    def act(self, sent: Intents, turn: Turn) -> Intents:
        return self.lie(sent)


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        (
            lambda s: replace(s, distance_m=0 * s.distance_m),
            "it changes distance_m of the ego, or of a hel",
        ),
        (
            lambda s: replace(s, inference_s=0 * s.inference_s),
            "it changes inference_s of the ego, or of a ",
        ),
        (
            lambda s: replace(s, silent=np.ones((2, 2), dtype=bool)),
            "it changes silent of the ego, or of a ",
        ),
        (
            lambda s: replace(s, valid=~s.valid),
            "it changes valid of the ego, or of a helper that is no att",
        ),
        (lambda s: replace(s, silent=s.valid.tolist()), "silent of type list"),
        (
            lambda s: replace(s, helpers=np.ma.masked_array(7 * s.helpers)),
            "intents of type MaskedArray",
        ),
        (lambda s: replace(s, text_bytes=s.range_m), "it adds or leaves out text_bytes"),
        (lambda s: replace(s, voice_of=np.full((2, 2), 9)), "a voice of nobody who is there"),
    ],
)
def test_an_attack_changes_what_is_its_own(lie: Callable[[Intents], Intents], says: str) -> None:
    with pytest.raises(UserError, match=rf"^attack Lie of \S+ fails .ValueError: {says}"):
        _acted(Lie(lie=lie), SAID, TURN)


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        (lambda s: replace(s, helpers=s.helpers[:, :, ::-1] * [0.2, 1.8]), "it changes helpers of"),
        (
            lambda s: replace(s, inference_s=s.inference_s + 1),
            "it changes inference_s of the ego, or",
        ),
        (
            lambda s: replace(s, range_m=np.where([True, False, True], s.range_m, np.nan)),
            "has no v",
        ),
        (
            lambda s: replace(s, voice_of=np.array([[0, 1, 1]] * 2)),
            "it changes distance_m of the ego, or",
        ),
    ],
)
def test_voices_that_an_attack_adds_leave_honest_ones_alone(
    lie: Callable[[Intents], Intents], says: str
) -> None:
    """With its own further voice, the attacker's, it may do as it likes."""
    added = with_voices(SAID, TURN.attackers, 2)
    assert _acted(Lie(lie=lambda said: added), SAID, TURN).voice_of is not None
    with pytest.raises(UserError, match=f"fails .ValueError: .*{says}"):
        _acted(Lie(lie=lambda said: lie(added)), SAID, TURN)


def test_an_attacker_may_be_silent_far_away_and_late() -> None:
    far = _acted(Lie(lie=lambda s: replace(
        s, silent=np.array([[True, False]] * 2), range_m=np.add(s.range_m, [9.0, 0.0]),
        inference_s=np.add(s.inference_s, [0.0, 9.0, 0.0]),
    )), SAID, TURN)  # fmt: skip
    assert far.range_m[0].tolist() == [10.0, 1.0]


def test_of_a_helper_that_was_not_asked_nothing_is_known() -> None:
    """As where lists of objects are sent, which need no answer; what was answered stays one."""
    unknown = np.where([[[True], [False]]] * 2, np.nan, SAID.helpers)
    unasked = replace(SAID, helpers=unknown)
    assert np.isnan(_acted(Lie(), unasked, TURN).helpers[:, 0]).all()
    with pytest.raises(UserError, match="intents that are no distributions"):
        _acted(Lie(lie=lambda s: replace(s, helpers=unknown)), SAID, TURN)


@dataclass(frozen=True)
class Listing(Attack):
    """Lists what the text says."""

    lists: str = "graph"

    def listed(self, graph: Any, ghost: Any) -> Any:
        if self.lists == "nothing":
            return None
        if self.lists == "boom":
            raise TypeError("boom")
        return structs.replace(graph, viewer="v77") if self.lists == "viewer" else graph


def test_what_a_packages_attack_lists_is_a_graph_of_its_sender(
    small: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ATTACKS._loaded, "lists", Listing())
    monkeypatch.setattr(type(ATTACKS), "__iter__", lambda self: iter(self._loaded))
    scene = small.scenes(small.courses())[0]
    graph = scene.graphs[scene.viewers[1]]
    assert change_of("lists").graph(graph, small.scenario, scene) == graph
    for lists, says in (("nothing", "no graph"), ("boom", "boom"), ("viewer", "viewer is another")):
        with pytest.raises(UserError, match=rf"^attack Listing of \S+ fails .*{says}"):
            change_of(f"lists:lists={lists}").graph(graph, small.scenario, scene)


class Failing(Attack):
    """Returns what has no value for each action."""

    def act(self, sent: Intents, turn: Turn) -> Intents:
        return replace(sent, helpers=sent.helpers[..., 0])


@pytest.mark.slow
def test_an_attack_that_fails_is_one_line(
    two_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ATTACKS._loaded, "mine", Failing())
    typed = ("eval", "--dataset", two_path, "--attack", "mine", "--limit", "1", "--quiet")
    code, out, said = harness(*typed, "--out", "run")
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert said.startswith("harness: attack Failing of ")
