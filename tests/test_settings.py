"""The settings of an evaluation: one record for the command line,
a run's file and a run's command.
"""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from evaluating import same_decisions, spec_of
from hypothesis import given
from hypothesis import strategies as st

from harness.coordination.named_points import POINTS
from harness.core.at_once import at_once_of
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate import resolve
from harness.evaluate.frozen_world import FrozenSource
from harness.runs.folder import read as read_run
from harness.runs.formats import gathered
from harness.runs.settings import (
    WORLDS,
    DriveSettings,
    FrozenSettings,
    Settings,
    changed,
    of_words,
    options,
    read,
    text_of,
    words,
)  # fmt: skip

Said = tuple[int, str, str]
# no command line holds NUL
TEXTS = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=8
)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    str(str): TEXTS, str(int): st.integers(0, 99), str(float): st.floats(0, 2), str(bool): st.booleans(),
    str(list[str]): st.lists(TEXTS, min_size=1, max_size=3).map(tuple),
    str(at_once_of): st.integers(1, 99) | st.just("auto"),
}  # fmt: skip


@st.composite
def every_setting(draw: Callable[..., Any]) -> Settings:
    """Settings with any value that their types allow."""
    world = draw(st.sampled_from(list(WORLDS.values())))
    given: dict[str, Any] = {}
    for each in options(world):
        value = draw(VALUES[str(each.kind)])
        if not (each.is_added and value == each.default) and draw(st.booleans()):
            given[each.name] = value
    return changed(Settings(world=world()), given)


@given(every_setting())
def test_settings_are_the_same_as_words_and_as_a_file(settings: Settings) -> None:
    assert of_words(words(settings)) == settings
    assert msgspec.convert(gathered(tomllib.loads(text_of(settings))), Settings) == settings


def test_what_is_no_command_of_a_run_is_refused() -> None:
    for typed in (
        (),
        ("harness", "report"),
        ("harness", "eval", "--nothing"),
        ("harness", "eval", "--limit", "x"),
    ):
        with pytest.raises(UserError, match="is no command of a run"):
            of_words(typed)


def test_an_evaluation_states_the_settings_that_make_it(small: Dataset) -> None:
    settings = (
        replace(spec_of(small), seeds=(3, 7)).changed(tag=("nightly",), latency="paper").settings
    )
    assert (settings.tag, settings.latency, settings.seeds) == (("nightly",), "paper", "3,7")
    spec = resolve.spec(settings, FrozenSource(small))
    assert (spec.settings, spec.seeds, spec.points) == (settings, (3, 7), tuple(POINTS.values()))
    assert replace(spec, seeds=(1,)).settings == changed(settings, {"seeds": "1:2"})
    with pytest.raises(ValueError, match="seeds is what is opened here"):
        spec.changed(seeds="1:2")


@pytest.mark.exhaustive
def test_a_run_is_repeated_by_its_file(harness: Callable[..., Said], small_path: Path) -> None:
    asked = (
        "eval",
        "--dataset",
        small_path,
        "--limit",
        "2",
        "--seeds",
        "3,7",
        "--condition",
        "6g:tau=0.5",
        "--quiet",
    )
    assert harness(*asked, "--tag", "first", "--out", "a")[0] == 0
    stated = tomllib.loads(Path("a/run.toml").read_text())
    assert (stated["model"], stated["prompt"], stated["seeds"]) == ("proxy", "v2", "3,7")
    assert stated["ties"] == "drawn", "its default is another than that of older versions"
    world = {"kind": "frozen", "dataset": str(small_path), "limit": 2, "sample_seed": 0}
    assert stated["world"] == world
    for file in ("a/run.toml", "a"):
        assert harness("eval", file, "--quiet", "--out", f"of-{Path(file).name}") == (0, "", "")
        assert same_decisions(Path("a"), Path(f"of-{Path(file).name}"))
    Path("a/run.toml").write_text(Path("a/run.toml").read_text().replace("3,7", "3,8"))
    assert harness("eval", "a", "--seeds", "3:4", "--quiet", "--out", "typed") == (0, "", "")
    said = "it has --seeds 3,8, and run.json beside it has --seeds 3,7; run.toml is taken"
    line = f"harness: settings a/run.toml: {said}\n"
    assert harness("eval", "a", "--quiet", "--out", "edited") == (0, "", line)
    assert harness("eval", "a", "--limit", "1", "--prompt", "v4", "--quiet", "--out", "b")[0] == 0
    changed: Any = read_run(Path("b")).manifest
    assert (changed.world.limit, changed.prompt["version"], changed.tags) == (1, "v4", ("first",))
    assert [point["name"] for point in changed.conditions] == ["6g:tau=0.5"]
    assert (
        harness("eval", "a", "--model", "replay:a", "--ties", "first", "--quiet", "--out", "c")[0]
        == 0
    )
    assert harness("eval", "c", "--quiet", "--out", "of-c") == (0, "", ""), (
        "it replays what that replayed"
    )
    assert same_decisions(Path("c"), Path("of-c"))
    assert read_run(Path("of-c")).manifest.settings.ties == "first"


HOSTILE = {
    'model = "./theirs"': "./theirs is none of your cards, and a file "
    "opens no other model by itself; if "
    "you want it, type `harness eval stated.toml --model ./theirs`",
    'model = "http://theirs:1/v1"': "`harness eval stated.toml --model http://theirs:1/v1`",
    'model = "./a b; rm"\nserver = '
    '["http://theirs:1/v1"]': "`harness eval stated.toml --model './a b; rm' "
    "--server http://theirs:1/v1`",
    'model = "replay:theirs"': "theirs is no finished run: it has no run.json",
    'model = "theirs/on-the-hub"': "theirs/on-the-hub is none of your cards",
    '[helpers]\nmodel = "proxy, ./theirs"': "`harness eval stated.toml "
    "--helper-model 'proxy, ./theirs'`",
    'server = ["http://theirs:1/v1"]': "http://theirs:1/v1 is a server, and a "
    "file asks none by itself; if "
    "you want it, type `harness eval stated.toml --server http://theirs:1/v1`",
    "model = 3": "model = 3; allowed: a text",
    'prompd = "v2"': "unknown key in settings stated.toml 'prompd'; did you mean 'prompt'?",
    '[world]\nkind = "frozen"\nlimti = 1': "unknown key in settings "
    "stated.toml [world] 'limti'; did "
    "you "
    "mean 'limit'?",
    '[world]\nkind = "closed-loop"': "are of `harness drive`; type that",
    '[world]\nkind = "dream"': "stated.toml",
    "model =": "stated.toml is no TOML",
    "model = proxy": "stated.toml is no TOML: Invalid value (at line "
    "1, column 9); put a text in quotes",
    "limit = 2": "settings stated.toml: limit stands in a table; "
    "write limit below a line [world] instead",
    'condition = "6g"': "condition = '6g'; allowed: a list",
    "world = 2": "world = 2; allowed: a table",
}


@pytest.mark.parametrize(("text", "said"), HOSTILE.items())
def test_a_file_of_settings_opens_nothing_that_the_user_did_not_name(
    harness: Callable[..., Said], text: str, said: str
) -> None:
    Path("theirs").mkdir()
    Path("theirs/config.json").write_text("{}")
    Path("stated.toml").write_text(text)
    code, out, err = harness("eval", "stated.toml", "--limit", "1")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert said in err
    assert not Path("reports").exists()


def test_episodes_of_a_file_are_those_of_its_command(tmp_path: Path) -> None:
    file = tmp_path / "stated.toml"
    file.write_text("[world]\nlimit = 2\n")
    assert read(file, FrozenSettings, {}).world == FrozenSettings(limit=2)
    file.write_text("[world]\nepisodes = 2\n")
    assert read(file, DriveSettings, {}).world == DriveSettings(episodes=2)
    file.write_text("")
    assert read(file, DriveSettings, {}) == Settings(world=DriveSettings())


def test_what_is_typed_beside_a_file_wins(tmp_path: Path) -> None:
    file = tmp_path / "stated.toml"
    file.write_text(
        'model = "./theirs"\nthinking = true\nserver = ["http://theirs:1/v1"]\n'
        '[world]\nkind = "closed-loop"\n'
    )
    typed = {"model": "proxy", "thinking": False, "server": ["http://mine:1/v1"], "episodes": 3}
    settings = read(file, DriveSettings, typed)
    assert (settings.model, settings.thinking, settings.server) == (
        "proxy",
        False,
        ("http://mine:1/v1",),
    )
    assert settings.world == DriveSettings(episodes=3)
    with pytest.raises(UserError, match="are of `harness drive`"):
        read(file, FrozenSettings, typed)


@pytest.mark.parametrize("command", ["eval", "drive"])
def test_help_shows_ten_options_first(harness: Callable[..., Said], command: str) -> None:
    blocks = harness(command, "--help")[1].split("\n\n")
    [first] = [block for block in blocks if block.startswith("Options:")]
    assert sum(line.startswith("  --") for line in first.splitlines()) == 11  # with --help
    assert (
        len(
            [block for block in blocks if block.startswith(("Helpers:", "Conditions:", "Latency:"))]
        )
        == 3
    )
