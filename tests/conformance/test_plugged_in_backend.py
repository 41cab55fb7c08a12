"""A backend of another package, registered by an entry point: it runs as one that is built in."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from msgspec import structs
from packaged import register

from harness.backends import cards, registry
from harness.backends.base import MOST_CHARS, Completion, Request, Served
from harness.backends.engine_of_package import SILENT, EngineOfPackage
from harness.core.errors import UserError
from harness.core.extensions import extensions
from harness.runs.records import Latency

MODULE = """
from dataclasses import replace
from harness.backends.registry import Capabilities, Registration
from swarm_extras import CAUTIOUS, answer

ECHO = replace(
    CAUTIOUS,
    capabilities=replace(CAUTIOUS.capabilities, language_model=True),
    packages={"json": "json"},
)
BARE = Registration(
    "echoing:opened", Capabilities(), packages={"no_such_module": "a-package"}, install="pip install it"
)
WIDE = replace(CAUTIOUS, answers="many")
"""
ENTRIES = """[swarmdrive.backends]
echo = echoing:ECHO
bare = echoing:BARE
gone = no_such_module:ECHO
odd = echoing:answer
wide = echoing:WIDE
"""
CARD = """engine = "echo"
description = "Slows down where it sees a conflict"
revision = "2"
[latency]
source = "card"
inference_s = 0.01
basis = "declared: none"
"""


# engines of extensions
SHIPPED = [name for each in extensions().values() for name in each.adds.get("backends", ())]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a card, and on the path a package that registers its engine."""
    site = tmp_path / "site"
    register(site, ENTRIES, echoing=MODULE)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "echo-1.toml").write_text(CARD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(registry.ENGINES, "_loaded", dict(registry.BUILT_IN))
    return tmp_path


@pytest.mark.slow
def test_a_card_names_it_and_it_is_listed_and_run(
    project: Path, small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    of_packages = [name for name in registry.ENGINES if name not in (*registry.BUILT_IN, *SHIPPED)]
    assert of_packages == ["bare", "echo", "gone", "odd", "wide"]
    _, out, _ = harness("model", "list", "--json")
    [listed] = [card for card in json.loads(out) if card["name"] == "echo-1"]
    assert (listed["engine"], listed["missing"]) == ("echo", None)
    code, _, err = harness(
        "eval", "--model", "echo-1", "--dataset", small_path, "--limit", "1", "--out", "run"
    )
    assert (code, err.count("harness: ")) == (0, 0), err
    manifest = json.loads((project / "run" / "run.json").read_text())
    assert manifest["identity"] == {"engine": "cautious", "answers": 1, "version": 1}


def test_what_it_cannot_do_is_refused_by_its_capabilities(
    project: Path, small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    asked = ("eval", "--model", "echo-1", "--dataset", small_path, "--out", "run")
    assert (
        "--answer readout: echo-1 cannot answer so; use json"
        in harness(*asked, "--answer", "readout")[2]
    )
    assert "--thinking: echo-1 cannot think" in harness(*asked, "--thinking")[2]
    assert "--device cpu: echo-1 has no weights here" in harness(*asked, "--device", "cpu")[2]


PROXY = cards.load("proxy")
CAN = registry.Capabilities(language_model=True)
REQUEST = Request("00001-0/v1", "ego", ({"role": "user", "content": "?"},), ("STAY", "GO"), 9)
DONE = Completion(REQUEST.id, "{}", 3, 1, "stop", None, 1)


class Engine:
    """Answers as a function says."""

    def __init__(self, answers: Callable[[Request], Any]) -> None:
        self.answers = answers

    def complete(self, requests: Sequence[Request]) -> Any:
        return self.answers(requests[0])

    def identity(self) -> Any:
        return ["no dict"]


def other(**fields: Any) -> Callable[[Request], Any]:
    return lambda request: [replace(DONE, **fields)]


def stopped(request: Request) -> Any:
    raise StopIteration


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        (stopped, r"engine proxy fails \(StopIteration at .*"),
        (lambda request: None, "engine proxy fails .*'NoneType' object is not iterable"),
        (lambda request: [], "it gives 0 answers to 1 requests"),
        (lambda request: ["{}"], "it gives a str and no Completion"),
        (other(request_id="00002-0/v1"), "request_id is '00002-0/v1'; give answers in the order"),
        (other(text=5), "engine proxy fails .*'int' object has no attribute 'isascii'"),
        (other(text="a" * (MOST_CHARS + 1)), "text = .*; allowed: a text of at most 4194304 char"),
        (other(slow_s=-100.0), "slow_s = -100.0; allowed: seconds, 0 or more, at most 3600"),
        (other(slow_s=3000.0), "slow_s is 3000, which its card does not declare"),
        (other(seconds=math.nan), "seconds = nan; allowed: seconds"),
        (other(prompt_tokens=-5), "prompt_tokens = -5; allowed: a whole number, 0 or more"),
        (other(completion_tokens=10**30), "completion_tokens = 1000"),
        (other(label_mass="x"), "label_mass = 'x'; allowed: a number"),
        (other(label_mass=0.5), "label_mass is stated, which only a read-out has"),
        (
            other(text="a" * 99),
            "1 tokens of a text with 99 characters, too few; count them all, or",
        ),
        (other(letter_share=99.0), "letter_share = 99.0; allowed: a number from 0 to 1"),
        (other(finish_reason="done"), "unknown finish_reason in engine proxy, answer 00001-0/v1"),
        (other(error="busy"), "an error has finish_reason error, and nothing else has"),
    ],
)
def test_answers_that_cannot_be_are_one_line(answers: Callable[[Request], Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        EngineOfPackage(Engine(answers), PROXY, CAN).complete([REQUEST])


LONE = "\udc80"
LATENCY = Latency("declared", "mine", 0.1, 0.1, 0.1)
ODD_FACTS = [
    (fact, odd)
    for fact, odds in {
        "window": (-1, 1.5, True, math.nan, "4", 10**30, None),
        "batch_size": (-1, "8", 10**30),
        "doubt": (5, "", b"x"),
        "several": ("http://a", 5, [5]),
        "served": (5, lambda: 5, lambda: [5], lambda: [Served("a", cast(Any, 5))]),
        "latency": (
            None,
            lambda: 5,
            lambda: structs.replace(LATENCY, ego_s=math.nan),
            lambda: structs.replace(LATENCY, ego_s=-1.0),
            lambda: structs.replace(LATENCY, ego_s=1e300),
            lambda: structs.replace(LATENCY, ego_s=None),
        ),
        "rendered": (
            None,
            lambda given: 5,
            lambda given: [],
            lambda given: [5],
            lambda given: [LONE],
        ),
        "forget": (lambda: 1 / 0,),
        "chat": (property(lambda engine: 1 / 0),),
    }.items()
    for odd in (*odds, property(lambda engine: 1 / 0))
]


@pytest.mark.parametrize(("fact", "odd"), ODD_FACTS)
def test_what_an_engine_says_of_itself_is_asked_behind_the_door(fact: str, odd: Any) -> None:
    given = staticmethod(odd) if callable(odd) else odd
    engine: Any = EngineOfPackage(type("Odd", (Engine,), {fact: given})(stopped), PROXY, CAN)
    asked = ([REQUEST],) if fact == "rendered" else ()
    with pytest.raises(UserError, match=r"^engine proxy(, [a-z]+)?(: | fails \()") as error:
        getattr(engine, fact)(*asked)
    assert "\n" not in str(error.value)


def test_an_engine_that_says_nothing_of_itself_has_what_is_usual() -> None:
    engine = EngineOfPackage(Engine(stopped), PROXY, CAN)
    assert (engine.window, engine.batch_size, engine.doubt) == (0, None, None)
    assert (engine.several, engine.served(), getattr(engine, "chat", 5)) == ([], [], 5)
    engine.forget()
    said = {"served": lambda engine: [Served("a", "b")], "latency": lambda engine: LATENCY}
    engine = EngineOfPackage(type("Said", (Engine,), {**said, "window": 3})(stopped), PROXY, CAN)
    assert (engine.window, engine.latency(), engine.served()) == (3, LATENCY, [Served("a", "b")])


def test_what_it_does_to_requests_and_answers_stays_its_own() -> None:
    def greedy(request: Request) -> list[Completion]:
        request.messages[0]["content"] = "other"  # type: ignore[index]
        object.__setattr__(request, "id", "other")
        return [DONE]

    [done] = EngineOfPackage(Engine(greedy), PROXY, CAN).complete([REQUEST])
    assert done == DONE
    assert done is not DONE
    assert (REQUEST.id, REQUEST.messages[0]["content"]) == (DONE.request_id, "?")


def test_texts_and_numbers_of_other_kinds_become_pythons_own() -> None:
    engine = Engine(
        other(text=np.str_("{}"), seconds=np.float64(0.5), first_token_s=np.float64(0.1))
    )
    [done] = EngineOfPackage(engine, PROXY, CAN).complete([REQUEST])
    assert msgspec.json.encode(done)
    assert (type(done.text), type(done.seconds), done.seconds) == (str, float, 0.5)


def test_an_error_without_a_reason_has_one() -> None:
    engine = Engine(other(error="", finish_reason="error"))
    [done] = EngineOfPackage(engine, PROXY, CAN).complete([REQUEST])
    assert done.error == SILENT


def test_an_identity_that_is_none_is_one_line() -> None:
    with pytest.raises(UserError, match=r"engine proxy fails .*its identity is a list and no dict"):
        EngineOfPackage(Engine(stopped), PROXY, CAN).identity()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('"echo"', '"ecko"'), "unknown engine in model card .* 'ecko'; did you mean 'echo'?"),
        (
            ('revision = "2"', "gated = true"),
            "gated goes with engine = transformers or llama-cpp",
        ),
        (
            ('"echo"', '"gone"'),
            r"plug-in 'gone' \(swarmdrive.backends\): no_such_module:ECHO does not load",
        ),
        (
            ('"echo"', '"odd"'),
            "plug-in 'odd' .*: echoing:answer is of type function and no Registration",
        ),
        (
            ('"echo"', '"wide"'),
            "plug-in 'wide' .* of package by-hand: answers = 'many'; allowed: a whole number",
        ),
    ],
)
def test_a_mistake_is_one_line(project: Path, change: tuple[str, str], said: str) -> None:
    (project / "models" / "echo-1.toml").write_text(CARD.replace(*change))
    with pytest.raises(UserError, match=said):
        cards.load("echo-1")


def test_a_package_that_it_needs_is_named_with_the_command_that_installs_it(project: Path) -> None:
    text = CARD.replace('"echo"', '"bare"').replace('revision = "2"\n', "")
    (project / "models" / "echo-1.toml").write_text(text)
    card = cards.load("echo-1")
    assert registry.missing(card) == "a-package"
    with pytest.raises(
        UserError, match="needs a-package, which is not installed; run `pip install it`"
    ):
        registry.open_backend(card)
