"""What is guessed of an answer: only what came after the same tokens every time, numbers apart."""

from typing import Any

from harness.backends.drafts import MOST, Drafts


class Letters:
    """A chat whose tokens are characters."""

    def pieces(self, ids: list[int]) -> list[str]:
        return [chr(i) for i in ids]


def of(*texts: str, kind: str = "ego") -> Drafts:
    chat: Any = Letters()
    drafts = Drafts(chat)
    for text in texts:
        for end in range(1, len(text) + 1):
            drafts.learn(kind, list(map(ord, text[:end])))
    return drafts


def guess(drafts: Drafts, text: str, most: int = 99, kind: str = "ego") -> str:
    return "".join(map(chr, drafts.after(kind, list(map(ord, text)), most)))


def test_a_text_goes_on_as_one_before_it_up_to_a_bound() -> None:
    drafts = of("slower: yes")
    assert guess(drafts, "slow") == "er: yes"
    assert guess(drafts, "slow", most=3) == "er:"
    assert guess(drafts, "slow", most=0) == ""
    assert guess(drafts, "fast") == ""
    assert len(guess(of("a" * 4 + "b" * 40), "aaaab")) == MOST


def test_nothing_is_guessed_where_texts_differ() -> None:
    assert guess(of("risk low;", "risk high;"), "ri") == "sk "
    assert guess(of("risk low;", "risk high;"), "risk l") == "ow;"


def test_numbers_are_alike_before_a_token_and_differ_as_one() -> None:
    drafts = of("p 0.12, q 0.34}", "p 0.56, q 0.78}")
    assert guess(drafts, "p 0.99") == ", q 0."
    assert guess(drafts, "p 0.99, q 0.00") == "}"


def test_each_kind_has_its_own() -> None:
    assert guess(of("abc", kind="helper"), "a") == ""
