"""Random draws keyed by content.

A draw depends on its purpose (run seed, scene, link), never on when it is made, so order, batch
size, workers and a resume cannot change it, and two operating points share their draws.
"""

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

# How `SeedSequence` mixes the words of a seed, and how PCG64 steps; NumPy promises to keep both.
MANY = 8  # keys from which their seeds are mixed together
Words = NDArray[np.uint32]
WORDS, SHIFT = 4, np.uint32(16)
LEFT, RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
STEP, BITS_128 = 0x2360ED051FC65DA44385DF649FCCF645, (1 << 128) - 1


def generator(*key: object) -> np.random.Generator:
    """Return a random generator that is the same for equal keys, on every machine.

    So draws do not depend on their order. `key` has any values with a stable `repr`, such as a
    purpose and seeds. They are joined by their `repr`, so `1` and `"1"` differ.
    """
    # The words of the digest as a whole number, which NumPy would take apart at thrice the cost.
    words = np.frombuffer(_seed(key), "<u4")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


def _seed(key: Sequence[object]) -> bytes:
    return hashlib.sha256("\x1f".join(map(repr, key)).encode()).digest()[15::-1]


def generators(keys: Sequence[Sequence[object]]) -> Iterator[np.random.Generator]:
    """Yield what `generator` returns for each of some keys; many are several times as fast.

    They may be one object, which begins anew for the next key: draw before that.
    """
    if len(keys) < MANY:
        for key in keys:
            yield generator(*key)
        return
    seeds = np.frombuffer(b"".join([_seed(key) for key in keys]), "<u4").reshape(-1, WORDS)
    bits = np.random.PCG64(0)
    drawn, state = np.random.Generator(bits), bits.state
    for high, low, high_step, low_step in _mixed(seeds).tolist():
        step = (high_step << 65 | low_step << 1 | 1) & BITS_128
        start = (high << 64 | low) + step
        state["state"] = {"state": start * STEP + step & BITS_128, "inc": step}
        bits.state = state
        yield drawn


def _mixed(seeds: Words) -> NDArray[np.uint64]:
    """Return the first four numbers that `SeedSequence` makes of each of n seeds, (n, 4)."""
    constants = _constants(0x43B0D7E5, 0x931E8875)
    pool = [_hashed(seeds[:, n], constants) for n in range(WORDS)]
    for source in range(WORDS):
        for n in range(WORDS):
            if n != source:
                mixed = LEFT * pool[n] - RIGHT * _hashed(pool[source], constants)
                pool[n] = mixed ^ mixed >> SHIFT
    constants = _constants(0x8B51F9DD, 0x58F38DED)
    words = [_hashed(pool[n % WORDS], constants) for n in range(2 * WORDS)]
    return np.stack(words, axis=-1).view("<u8")


def _constants(first: int, factor: int) -> Iterator[tuple[np.uint32, np.uint32]]:
    """Yield what each hash takes: a constant and the next one."""
    while True:
        following = first * factor & 0xFFFFFFFF
        yield np.uint32(first), np.uint32(following)
        first = following


def _hashed(words: Words, constants: Iterator[tuple[np.uint32, np.uint32]]) -> Words:
    before, after = next(constants)
    mixed: Words = (words ^ before) * after
    return mixed ^ mixed >> SHIFT


def uniforms(shape: tuple[int, ...], *key: object) -> NDArray[np.float64]:
    """Return uniform draws in [0, 1) of this shape, the same for equal keys on every machine.

    `key` has any values with a stable `repr`, such as a purpose and seeds.
    """
    return generator(*key).random(shape)
