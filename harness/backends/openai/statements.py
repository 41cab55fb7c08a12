"""What a server states of its model: weights, template, context and version,
as far as its kind tells.

All of it is part of the model's identity, so that other weights under the same name are asked
again. What only says when or where a server was started, or what it is doing, is left out.
"""

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from harness.backends.openai.kinds import SERVER_KINDS, Ask, as_text, entry_of
from harness.backends.servers import Kind
from harness.core.errors import printable
from harness.core.files import sha256_bytes

Fact = str | int | float | bool
_LISTED = ("id", "owned_by", "root", "max_model_len")
# Keys that say nothing of a model, at any depth: dates, permissions, prices, and what the server is
# doing.
_PASSING = frozenset(
    {
        "active",
        "created",
        "created_at",
        "expires_at",
        "last_used",
        "loaded",
        "loaded_context_length",
        "modified_at",
        "object",
        "per_request_limits",
        "permission",
        "permissions",
        "pricing",
        "state",
        "status",
        "updated_at",
        "uptime",
    }
)
_MOST_FACTS, _MOST_DEPTH = 64, 4
# longest text that is kept as it is; of longer ones, such as templates, the digest is kept
_SHOWN = 100
_EXACT = 2**53  # integers beyond are no JSON numbers that every program reads alike
# last names of facts that change if the weights do, as a rule
_WEIGHTS = ("digest", "n_params", "size")


class Model(NamedTuple):
    """Hold what a server states of its model, by which models are told apart.

    `listed` is its entry in the server's list of models, `version` the server's, and `states` all
    else by dotted names; None where the server does not tell.
    """

    listed: dict[str, Any] | None = None  # name, owner, root and length in the server's list
    version: str | None = None  # version of the server; None if it does not tell
    states: Mapping[str, Fact] = {}  # everything else, by dotted names; long texts as digests

    @property
    def tells_weights(self) -> bool:
        """Return whether the server states a digest or size, which differ for other weights."""
        return any(name.rpartition(".")[2] in _WEIGHTS for name in self.states)

    def covers(self, earlier: "Model") -> bool:
        """Return whether it states all that an earlier statement on the same model, `earlier`, did.

        It tells a model that was replaced from a server that is still loading, which states less.
        """
        lists = earlier.listed is None or self.listed is not None
        tells_version = earlier.version is None or self.version is not None
        return lists and tells_version and earlier.states.keys() <= self.states.keys()


async def read_statement(kind: Kind, weights: str, models: Any, ask: Ask) -> Model:
    """Return what a server states of its model, by which models are told apart.

    Args:
        kind: the server program, such as `vllm`.
        weights: the model's name at the server. One with a single model accepts any name.
        models: the decoded JSON of its reply at `/v1/models`.
        ask: requests another path of the server, given the path and JSON to post, or None.

    It is empty if the model is not in the list.
    """
    entry = entry_of(models, "data", weights)
    if entry is None:
        return Model()
    listed: dict[str, Fact] = {}
    for name in _LISTED:
        value = entry.get(name)
        if type(value) is int and 0 < abs(value) <= _EXACT:
            listed[name] = value
        elif value:
            listed[name] = printable(value)
    facts = {name: value for name, value in entry.items() if name not in _LISTED}
    version, more = await SERVER_KINDS[kind].states(weights, ask)
    facts |= more
    return Model(listed, printable(version) if isinstance(version, str) else None, _flat(facts))


def _flat(facts: Mapping[str, Any]) -> dict[str, Fact]:
    """Return facts by dotted names, sorted. Of too many, the last are one digest."""
    flat = dict(sorted(_leaves(facts, "")))
    if len(flat) > _MOST_FACTS:
        names = list(flat)
        rest = {name: flat.pop(name) for name in names[_MOST_FACTS - 1 :]}
        flat["more"] = _digest(json.dumps(rest))
    return flat


def _leaves(facts: Mapping[str, Any], above: str, depth: int = 1) -> Iterator[tuple[str, Fact]]:
    for name, value in facts.items():
        if name in _PASSING or value is None or value == "":
            continue
        at = f"{above}{printable(name, _SHOWN)}"
        if isinstance(value, dict) and depth < _MOST_DEPTH:
            yield from _leaves(value, f"{at}.", depth + 1)
        else:
            yield at, _fact(value)


def _fact(value: Any) -> Fact:
    if isinstance(value, bool) or (isinstance(value, int) and abs(value) <= _EXACT):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    text = value if isinstance(value, str) else as_text(value)
    return printable(text) if len(text) <= _SHOWN else _digest(text)


def _digest(text: str) -> str:
    return f"sha256:{sha256_bytes(text.encode('utf-8', 'replace'))}"
