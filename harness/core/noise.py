"""Random draws keyed by content.

A draw depends on its purpose (run seed, scene, link), never on when it is made, so order, batch size,
workers and a resume cannot change it, and two operating points share their draws.
"""

import hashlib
from collections.abc import Sequence
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Constants of NumPy's SeedSequence and PCG64, whose streams NumPy keeps.
WRAP, MULTIPLIER = 1 << 128, 0x2360ED051FC65DA44385DF649FCCF645
MIX_LEFT, MIX_RIGHT, SHIFT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715), np.uint32(16)
INTO_POOL, OUT_OF_POOL = (
    np.array([first * pow(factor, k, 1 << 32) % (1 << 32) for k in range(n)], dtype=np.uint32)
    for first, factor, n in ((0x43B0D7E5, 0x931E8875, 17), (0x8B51F9DD, 0x58F38DED, 9))
)


def generator(*key: object) -> np.random.Generator:
    """Return the generator of one key. Parts are joined by their `repr`, so `1` and `"1"` differ."""
    return np.random.Generator(np.random.PCG64(int.from_bytes(_seed(key), "big")))


def _seed(key: tuple[object, ...]) -> bytes:
    return hashlib.sha256("\x1f".join(map(repr, key)).encode()).digest()[:16]


def normals(n: int, keys: Sequence[tuple[object, ...]]) -> NDArray[np.float64]:
    """Return the first n standard normal draws of the `generator` of each key, (keys, n).

    One generator is set to each key's state in turn, which takes a third of the time of new ones.
    """
    drawn, bits = np.empty((len(keys), n)), np.random.PCG64(0)
    draws = np.random.Generator(bits)
    seeds = np.frombuffer(b"".join(map(_seed, keys)), ">u4").reshape(-1, 4)
    for row, words in zip(drawn, _words(seeds.astype(np.uint32)).tolist(), strict=True):
        # How PCG64 begins (pcg_setseq_128_srandom_r, O'Neill 2014).
        start, step = (words[0] << 64) + words[1], ((words[2] << 65) + (words[3] << 1)) % WRAP | 1
        state: Any = {"state": ((step + start) * MULTIPLIER + step) % WRAP, "inc": step}
        bits.state = {"bit_generator": "PCG64", "state": state, "has_uint32": 0, "uinteger": 0}
        draws.standard_normal(out=row)
    return drawn


def _words(seeds: NDArray[np.uint32]) -> NDArray[np.uint64]:
    """Return the four words of 64 bits that SeedSequence makes of each seed, whose highest word is first."""
    factors = pairwise(INTO_POOL)

    def hashed(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
        before, factor = next(factors)
        words = (words ^ before) * factor
        return words ^ (words >> SHIFT)

    pool = [hashed(words) for words in seeds.T[::-1]]
    for source, to in permutations(range(4), 2):
        mixed = MIX_LEFT * pool[to] - MIX_RIGHT * hashed(pool[source])
        pool[to] = mixed ^ (mixed >> SHIFT)
    out = (np.stack(pool * 2, axis=-1) ^ OUT_OF_POOL[:-1]) * OUT_OF_POOL[1:]
    out ^= out >> SHIFT
    return out[:, ::2] + (out[:, 1::2].astype(np.uint64) << np.uint64(32))


def uniforms(shape: tuple[int, ...], *key: object) -> NDArray[np.float64]:
    """Return the uniform draws in [0, 1) of one key."""
    return generator(*key).random(shape)
