"""What differs between two prompts: texts word by word, settings, and what a model is sent."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core import resources
from harness.prompts import difference
from harness.prompts import versions as prompts

Said = tuple[int, str, str]
Harness = Callable[..., Said]
TEXTS = st.lists(
    st.sampled_from(["drive", "slow", "down", " ", "  ", "\n", "%}", "\x1b["]), max_size=30
).map("".join)


def test_a_change_by_hand() -> None:
    changed = difference.words("You drive\ncar v1 now.", "You may drive\ncar v1 later.")
    [hunk] = changed.hunks
    assert (changed.removed, changed.added) == (1, 2)
    replaced = (("removed", " now."), ("added", " later."))
    pieces = (("same", "You"), ("added", " may"), ("same", " drive\ncar v1"), *replaced)
    assert (hunk.line_a, hunk.line_b, hunk.pieces) == (1, 1, pieces)
    shown = "".join(text for _, text in difference.marked(hunk))
    assert shown == "You {+may+} drive\ncar v1 [-now.-] {+later.+}"


def test_far_changes_are_hunks_of_their_own_with_their_lines() -> None:
    lines = [f"line {n} says so" for n in range(12)]
    changed = difference.words(
        "\n".join(lines), "\n".join([*lines[:3], "new", *lines[3:11], "last"])
    )
    assert [(hunk.line_a, hunk.line_b) for hunk in changed.hunks] == [(2, 2), (10, 11)]
    assert ("added", "\nnew") in changed.hunks[0].pieces


@given(TEXTS, TEXTS)
def test_with_all_words_around_it_a_change_is_both_texts(a: str, b: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(difference, "CONTEXT", 1000)
        hunks = difference.words(a, b).hunks
    assert bool(hunks) == (a != b)
    for kind, text in (("removed", a), ("added", b)):
        said = "".join(piece for hunk in hunks for of, piece in hunk.pieces if of in ("same", kind))
        assert said == (text if hunks else "")


def test_the_end_of_a_line_is_shown_where_it_changes_and_nothing_reaches_the_terminal() -> None:
    [hunk] = difference.words("go\nnow \x1b[31m", "go now \x1b[32m").hunks
    assert (
        "".join(text for _, text in difference.marked(hunk))
        == "go[-↵now \\x1b[31m-] {+now \\x1b[32m+}"
    )


def test_settings_that_decide_what_is_asked_are_compared_and_notes_are_not() -> None:
    change = difference.change(prompts.load("v3"), prompts.load("v4"))
    assert change.settings == (
        ("max_answer_tokens.ego", 64, 96), ("max_answer_tokens.helper", 128, 160), ("max_conflicts", None, 3),
    )  # fmt: skip
    assert change
    assert not difference.change(prompts.load("v3"), prompts.load("v3"))


def test_v2_and_v3_differ_only_for_an_ego_with_messages(small_path: Path, harness: Harness) -> None:
    tokenizer = resources.find("models", "swarm-tiny")
    args = ("prompt", "compare", "v2", "v3", "--dataset", small_path)
    code, out, err = harness(*args, "--tokenizer", tokenizer, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert (told["a"]["version"], told["b"]["sha256"]) == ("v2", prompts.load("v3").sha256)
    assert (told["settings"], told["texts"]["helper.j2"]["hunks"]) == ([], [])
    by_role = {sent["role"]: sent for sent in told["sent"]}
    assert list(by_role) == ["ego", "helper", "fusion"]
    for role, sent in by_role.items():
        assert bool(sent["parts"]["user"]["hunks"]) == (role == "fusion")
        assert not sent["parts"]["system"]["hunks"]
        assert (sent["tokens"][0] == sent["tokens"][1]) == (role != "fusion")
        assert min(sent["tokens"]) > min(sent["words"]) > 50


def test_every_hunk_is_of_what_prompt_show_prints(small_path: Path, harness: Harness) -> None:
    of = ("--scene", "00001-0", "--dataset", small_path)
    shown = [
        json.loads(harness("prompt", "show", version, *of, "--json")[1]) for version in ("v3", "v4")
    ]
    told = json.loads(harness("prompt", "compare", "v3", "v4", *of, "--json")[1])
    assert told["scene"].startswith("00001-0-")
    alone = [sent for sent in told["sent"] if sent["role"] != "fusion"]
    for sent in alone:
        for version, kind in enumerate(("removed", "added")):
            messages = {
                message["role"]: message["content"] for message in shown[version][sent["viewer"]]
            }
            assert sent["words"][version] == sum(len(text.split()) for text in messages.values())
            for part, changed in sent["parts"].items():
                assert changed["hunks"]
                for hunk in changed["hunks"]:
                    text = "".join(piece for of, piece in hunk["pieces"] if of in ("same", kind))
                    line = hunk["line_a" if kind == "removed" else "line_b"]
                    assert text in "\n".join(["", *messages[part].split("\n")[line - 1 :]])


def test_it_fits_a_terminal(small_path: Path, harness: Harness) -> None:
    code, out, err = harness("prompt", "compare", "v3", "v4", "--dataset", small_path)
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert "  max_conflicts             none → 3\n" in out
    assert "tokens not counted: give --tokenizer" in out


def test_a_terminal_has_colours_and_a_pipe_has_none(
    small_path: Path, harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = ("prompt", "compare", "v3", "v4", "--dataset", small_path)
    assert "\x1b" not in harness(*args)[1]
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    coloured = harness(*args)[1]
    assert "\x1b[31m[-SECTORS-]" in coloured
    assert "\x1b[32m{+REGIONS+}" in coloured


def test_a_version_against_itself(small_path: Path, harness: Harness) -> None:
    code, out, _ = harness("prompt", "compare", "v4", "v4", "--dataset", small_path)
    assert (code, out.splitlines()[0]) == (0, "v4 → v4: the same settings and texts")
    assert "@@" not in out


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("v3", "v33"), "unknown prompt 'v33'; did you mean 'v3'?"),
        (("v3", "v4", "--scene", "99999-9"), "unknown scene '99999-9'"),
        (("v3", "v4", "--tokenizer", "absent.gguf"), "no tokenizer at absent.gguf"),
    ],
)
def test_what_is_not_there_is_one_line(
    args: tuple[str, ...], said: str, small_path: Path, harness: Harness
) -> None:
    code, out, err = harness("prompt", "compare", *args, "--dataset", small_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
