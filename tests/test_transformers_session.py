"""Sequences that go forward together say what each says alone, read whole and uncached."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.backends.engine import common_beginning
from harness.backends.transformers import memory
from harness.backends.transformers import session as reading
from harness.backends.transformers.memory import LEAST_TOKENS, Prefix, Prefixes
from harness.backends.transformers.session import Reader

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

SHAPE: dict[str, Any] = {
    "vocab_size": 64, "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
    "num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 8, "max_position_embeddings": 256,
    "initializer_range": 0.6,
}  # fmt: skip
EVERY = list(range(64))
tokens = st.integers(0, 63)
few = settings(max_examples=8)


def full_attention() -> Any:
    # two seconds, which collecting need not take
    from transformers import Qwen3Config, Qwen3ForCausalLM

    torch.manual_seed(0)
    return Qwen3ForCausalLM(Qwen3Config(**SHAPE)).eval()


def sliding_window() -> Any:
    from transformers import Gemma3ForCausalLM, Gemma3TextConfig

    torch.manual_seed(0)
    layers = ["sliding_attention", "full_attention"]
    return Gemma3ForCausalLM(Gemma3TextConfig(**SHAPE, sliding_window=6, layer_types=layers)).eval()


@pytest.fixture(scope="module", params=[full_attention, sliding_window], ids=lambda f: f.__name__)
def model(request: pytest.FixtureRequest) -> Any:
    return request.param()


@pytest.fixture(scope="module")
def qwen() -> Any:
    return full_attention()


def naive(model: Any, sequences: Sequence[Sequence[int]]) -> Any:
    """Log-probabilities of every token as the next one, each sequence by one forward."""
    with torch.inference_mode():
        rows = [model(torch.tensor([list(ids)])).logits[0, -1] for ids in sequences]
    return torch.stack(rows).double().log_softmax(-1).numpy()


@contextmanager
def widths(model: Any) -> Iterator[list[tuple[int, int]]]:
    """Rows and columns of every forward in the block."""
    seen: list[tuple[int, int]] = []

    def look(_: Any, args: Any, options: Any) -> None:
        seen.append(tuple(options["input_ids"].shape))

    hook = model.register_forward_pre_hook(look, with_kwargs=True)
    try:
        yield seen
    finally:
        hook.remove()


# -- a session -------------------------------------------------------------------------------------


shared_beginnings = st.lists(tokens, max_size=20)
own_ends = st.lists(st.lists(tokens, min_size=1, max_size=12), min_size=1, max_size=4)


def any_way_ends_where_one_forward_does(
    model: Any, shared: list[int], ends: list[list[int]], data: st.DataObject
) -> None:
    sequences = [[*shared, *end] for end in ends]
    with closing(Reader(model).begin(sequences)) as session:
        for _ in range(data.draw(st.integers(0, 3))):
            if data.draw(st.booleans()):
                places = data.draw(
                    st.lists(st.sampled_from(range(len(sequences))), min_size=1, unique=True)
                )
                session.keep(places)
                sequences = [sequences[place] for place in places]
            chunks = [data.draw(st.lists(tokens, max_size=4)) for _ in sequences]
            session.advance(chunks)
            sequences = [[*ids, *chunk] for ids, chunk in zip(sequences, chunks, strict=True)]
        expected = naive(model, sequences)
        np.testing.assert_allclose(session.log_probs(EVERY), expected, atol=1e-4)
        assert session.argmax([None] * len(sequences)) == expected.argmax(-1).tolist()


@few
@given(shared_beginnings, own_ends, st.data())
def test_any_way_of_going_forward_ends_where_one_forward_does(
    model: Any, shared: list[int], ends: list[list[int]], data: st.DataObject
) -> None:
    any_way_ends_where_one_forward_does(model, shared, ends, data)


@pytest.mark.exhaustive
@given(shared_beginnings, own_ends, st.data())
def test_of_many_ways_to_go_forward_each_ends_where_one_forward_does(
    model: Any, shared: list[int], ends: list[list[int]], data: st.DataObject
) -> None:
    any_way_ends_where_one_forward_does(model, shared, ends, data)


def test_an_empty_chunk_leaves_a_sequence_to_the_last_bit(model: Any) -> None:
    with closing(Reader(model).begin([[1, 2, 3], [4, 5]])) as session:
        before = session.log_probs(EVERY)
        session.advance([[], [6, 7, 8]])
        after = session.log_probs(EVERY)
        session.advance([[], []])
        assert (after[0] == before[0]).all()
        assert (after[1] != before[1]).any()
        assert (session.log_probs(EVERY) == after).all()


def test_the_likeliest_is_looked_for_among_what_is_listed_and_the_lowest_wins_a_tie(
    model: Any,
) -> None:
    with closing(Reader(model).begin([[1, 2], [1, 2], [1, 2]])) as session:
        order = session.log_probs(EVERY)[0].argsort()[::-1].tolist()
        assert session.argmax([None, order[3:6], [order[9]]]) == [order[0], order[3], order[9]]
    even = full_attention()
    with torch.no_grad():
        even.lm_head.weight.zero_()
    with closing(Reader(even).begin([[1], [1]])) as session:
        assert session.argmax([None, [7, 5, 9]]) == [0, 5]


def test_log_probabilities_are_of_the_whole_vocabulary(model: Any) -> None:
    with closing(Reader(model).begin([[1, 2, 3]])) as session:
        whole = session.log_probs(EVERY)
        assert np.exp(whole).sum() == pytest.approx(1)
        assert session.log_probs([9, 2, 9]).tolist() == whole[:, [9, 2, 9]].tolist()
        assert whole.dtype == np.float64


def what_is_right_of_a_guess_stays(model: Any, data: st.DataObject) -> None:
    """Sequences go forward by right, wrong and empty guesses,
    and end where one forward of each does.
    """
    sequences = data.draw(
        st.lists(st.lists(tokens, min_size=1, max_size=9), min_size=1, max_size=4)
    )
    reader = Reader(model)
    with closing(reader.begin(sequences)) as session:
        for _ in range(data.draw(st.integers(1, 3))):
            chunks = [[data.draw(tokens)] for _ in sequences]
            sequences = [[*ids, *chunk] for ids, chunk in zip(sequences, chunks, strict=True)]
            guesses, right = [], []
            for ids in sequences:
                guess: list[int] = []
                for _ in range(data.draw(st.integers(0, 3))):
                    guess.append(int(naive(model, [[*ids, *guess]]).argmax()))
                right.append(len(guess))
                if data.draw(st.booleans()):  # a token that is not the likeliest, and more after it
                    wrong = int(naive(model, [[*ids, *guess]]).argmin())
                    guess += [wrong, *data.draw(st.lists(tokens, max_size=2))]
                guesses.append(guess)
            counts = session.follow(chunks, guesses)
            assert counts == (right if reader.together else [0] * len(guesses))
            sequences = [
                [*ids, *guess[:count]]
                for ids, guess, count in zip(sequences, guesses, counts, strict=True)
            ]
            if len(sequences) > 1 and data.draw(st.booleans()):
                session.keep(range(1, len(sequences)))
                sequences = sequences[1:]
            np.testing.assert_allclose(session.log_probs(EVERY), naive(model, sequences), atol=1e-4)


@few
@given(st.data())
def test_of_a_guess_stays_what_the_model_would_have_written(
    model: Any, data: st.DataObject
) -> None:
    what_is_right_of_a_guess_stays(model, data)


@pytest.mark.exhaustive
@given(st.data())
def test_of_many_guesses_stays_what_the_model_would_have_written(
    model: Any, data: st.DataObject
) -> None:
    what_is_right_of_a_guess_stays(model, data)


@few
@given(st.lists(st.lists(tokens, min_size=1, max_size=12), min_size=1, max_size=3), st.data())
def test_each_way_to_go_on_ends_where_one_forward_does(
    model: Any, sequences: list[list[int]], data: st.DataObject
) -> None:
    """Longer sequences than the window, and ways of different lengths."""
    ways = data.draw(st.integers(1, 3))
    chunks = [
        [data.draw(st.lists(tokens, min_size=1, max_size=8)) for _ in range(ways)]
        for _ in sequences
    ]
    with closing(Reader(model).begin(sequences)) as session:
        found = session.ends(chunks, EVERY)
    whole = [[*ids, *way] for ids, of in zip(sequences, chunks, strict=True) for way in of]
    assert found.shape == (len(sequences), ways, len(EVERY))
    np.testing.assert_allclose(found.reshape(len(whole), -1), naive(model, whole), atol=1e-4)


@pytest.mark.parametrize("make", [full_attention, sliding_window])
def test_exact_logits_of_16_bit_weights_are_float32s_until_the_next_call(make: Any) -> None:
    half, exact, read = make().to(torch.bfloat16), [7, 9, 30], []
    half.lm_head.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0][0, -1]))
    reader = Reader(half)
    for asked, way in (((), []), (exact, []), ((), [5, 6]), (exact, [5, 6])):
        with closing(reader.begin([[1, 2, 3, 4, 5, 6, 7, 8]], asked)) as session:
            found = session.ends([[way]], exact)[0, 0] if way else session.log_probs(exact)[0]
        with torch.inference_mode():
            logits = (read[-1].float() @ half.lm_head.weight[exact].float().T).double().numpy()
        off = float(np.abs(np.diff(found) - np.diff(logits)).max())
        assert off < 1e-5 if asked else off > 1e-3


def test_only_full_attention_is_padded() -> None:
    """A window that counts tokens would count the pads:
    such a model reads its prompts one by one.
    """
    for make, together in ((full_attention, True), (sliding_window, False)):
        reader = Reader(make())
        assert reader.together == together


def test_bfloat16_goes_forward_too(qwen: Any) -> None:
    half = full_attention().to(torch.bfloat16)
    with closing(Reader(half).begin([[1, 2, 3], [4]])) as session:
        session.advance([[5], [6, 7]])
        # Eight bits of a mantissa, through two layers of large random weights.
        np.testing.assert_allclose(
            np.exp(session.log_probs(EVERY)),
            np.exp(naive(qwen, [[1, 2, 3, 5], [4, 6, 7]])),
            atol=0.1,
        )


# -- what prompts begin with in common -------------------------------------------------------------

SYSTEM = [(7 * i) % 64 for i in range(40)]


def test_what_a_batch_begins_with_in_common_is_read_once(qwen: Any) -> None:
    reader = Reader(qwen)
    with widths(qwen) as seen:
        reader.begin([[*SYSTEM, 1, 2, 3], [*SYSTEM, 4], [*SYSTEM, 5, 6]])
        reader.begin([[*SYSTEM, 9, 8], [*SYSTEM, 7]])
    assert seen == [
        (1, 40),  # what all begin with
        (3, 3),
        (2, 2),  # it is still there
    ]


OTHER = [(11 * i + 3) % 64 for i in range(50)]


def test_a_batch_with_two_beginnings_reads_each_once(qwen: Any) -> None:
    """An ego's prompts and its helpers' have other system texts."""
    reader = Reader(qwen)
    prompts = [*([*SYSTEM, i, i] for i in range(4)), *([*OTHER, i] for i in range(3))]
    mixed = [prompts[place] for place in (0, 4, 1, 5, 2, 6, 3)]
    expected = naive(qwen, mixed)
    for first in ([(1, 50), (3, 1), (1, 40), (4, 2)], [(3, 1), (4, 2)]):
        with widths(qwen) as seen, closing(reader.begin(mixed)) as session:
            np.testing.assert_allclose(session.log_probs(EVERY), expected, atol=1e-4)
        assert sorted(seen) == sorted(first)


def test_short_prompts_are_not_padded_to_the_longest_of_all(
    qwen: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is read together is bounded on a CPU;
    what goes forward afterwards is one batch again.
    """
    monkeypatch.setattr(reading, "CPU_TOKENS", 24)
    prompts = [[i] * n for i, n in enumerate((3, 30, 8, 5, 12, 7), start=1)]
    ends = ([9], [], [8, 7], [1], [2], [3, 4, 5])
    longer = [[*prompt, *end] for prompt, end in zip(prompts, ends, strict=True)]
    before, after = naive(qwen, prompts), naive(qwen, longer)
    with widths(qwen) as seen, closing(Reader(qwen).begin(prompts)) as session:
        np.testing.assert_allclose(session.log_probs(EVERY), before, atol=1e-4)
        session.advance(ends)
        np.testing.assert_allclose(session.log_probs(EVERY), after, atol=1e-4)
    assert seen == [(1, 30), (2, 12), (3, 7), (6, 3)]


def test_a_long_answer_is_what_one_forward_says(qwen: Any) -> None:
    sequences = [[1, 2, 3], [4, 5]]
    with closing(Reader(qwen).begin(sequences)) as session:
        for token in range(128):
            session.advance([[token % 64], [(token + 7) % 64]])
            if token == 64:
                session.keep([1, 0])
                session.keep([1, 0])
        ends = ([t % 64 for t in range(128)], [(t + 7) % 64 for t in range(128)])
        longer = [[*ids, *end] for ids, end in zip(sequences, ends, strict=True)]
        np.testing.assert_allclose(session.log_probs(EVERY), naive(qwen, longer), atol=1e-4)


def test_a_prompt_alone_reads_on_where_the_last_ones_part_from_it(qwen: Any) -> None:
    reader = Reader(qwen)
    with widths(qwen) as seen:
        reader.begin([[*SYSTEM, 1, 2, 3]])
        reader.begin([[*SYSTEM, 1, 5]])
        reader.begin([[*SYSTEM, 4]])
    assert seen == [(1, 43), (1, 1), (1, 1)]


def test_a_prompt_that_is_asked_again_is_read_again_since_its_seconds_are_an_answers(
    qwen: Any,
) -> None:
    reader = Reader(qwen)
    with widths(qwen) as seen:
        for end in (1, 1, 2, 1):
            reader.begin([[*SYSTEM, end]])
    assert seen == [(1, 41), (1, 41), (1, 1), (1, 1)]


def test_a_short_beginning_is_read_again(qwen: Any) -> None:
    reader = Reader(qwen)
    short = SYSTEM[: LEAST_TOKENS - 1]
    with widths(qwen) as seen:
        reader.begin([[*short, 1], [*short, 2]])
        reader.begin([[*short, 1], [*short, 2]])
    assert seen == [(2, LEAST_TOKENS)] * 2


def test_a_prompt_that_is_another_ones_beginning_still_has_a_token_of_its_own(qwen: Any) -> None:
    sequences = [SYSTEM, [*SYSTEM, 3, 4], SYSTEM]
    for reader in (Reader(qwen), Reader(qwen)):
        for _ in range(2):
            with closing(reader.begin(sequences)) as session:
                np.testing.assert_allclose(
                    session.log_probs(EVERY), naive(qwen, sequences), atol=1e-4
                )


calls = st.lists(
    st.lists(st.sampled_from([SYSTEM, SYSTEM[::-1], SYSTEM[:20]]), min_size=1, max_size=3),
    min_size=1, max_size=5,
)  # fmt: skip


@few
@given(calls, st.data())
def test_what_was_read_before_changes_no_answer(
    qwen: Any, heads: list[list[list[int]]], data: st.DataObject
) -> None:
    """Calls of one reader after another, each against a reader that has read nothing."""
    reader = Reader(qwen)
    for batch in heads:
        prompts = [[*head, *data.draw(st.lists(tokens, min_size=1, max_size=5))] for head in batch]
        with closing(reader.begin(prompts)) as one, closing(Reader(qwen).begin(prompts)) as other:
            one.advance([[1]] * len(prompts))  # altering what was kept would show in a later call
            other.advance([[1]] * len(prompts))
            np.testing.assert_allclose(one.log_probs(EVERY), other.log_probs(EVERY), atol=1e-4)


def test_after_a_failure_nothing_is_kept(qwen: Any) -> None:
    reader = Reader(qwen)
    reader.begin([[*SYSTEM, 1]])
    with pytest.raises(IndexError):
        reader.begin([[*SYSTEM, 64]])  # a token that the model does not have
    with widths(qwen) as seen:
        reader.begin([[*SYSTEM, 2]])
    assert seen == [(1, 41)]


def read(ids: Sequence[int]) -> Prefix:
    """A beginning whose one layer holds its own tokens as keys and values."""
    held = torch.tensor(list(ids)).reshape(1, 1, -1, 1)
    return Prefix(list(ids), [(held, held)])


def test_the_oldest_beginnings_leave_and_one_in_use_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MOST_TOKENS", 100)
    kept = Prefixes()
    first, second, third = ([n] * 40 for n in (1, 2, 3))
    kept.keep(read(first))
    kept.keep(read(second))
    assert kept.longest([*first, 9]).ids == first  # used: now the second is the oldest
    kept.keep(read(third))
    assert [kept.longest(ids).ids for ids in (first, second, third)] == [first, [], third]
    kept.keep(read([4] * 101))
    assert [kept.longest(ids).ids for ids in (first, third, [4] * 101)] == [[], [], []]


def test_only_the_part_in_common_is_given_back() -> None:
    kept = Prefixes()
    kept.keep(read(SYSTEM))
    found = kept.longest([*SYSTEM[:20], 63, 63])
    assert found.ids == SYSTEM[:20]
    assert [t.flatten().tolist() for t in found.layers[0]] == [SYSTEM[:20]] * 2


@given(st.lists(st.lists(st.integers(0, 1), max_size=6), min_size=1, max_size=5))
def test_common_is_the_longest_beginning_of_all(sequences: list[list[int]]) -> None:
    found = common_beginning(sequences)
    assert all(ids[: len(found)] == found for ids in sequences)
    longer = {tuple(ids[: len(found) + 1]) for ids in sequences}
    assert len(longer) > 1 or len(min(longer)) == len(found)
