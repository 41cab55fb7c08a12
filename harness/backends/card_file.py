"""What a card's file may say: its keys, their kinds, and which engines they go with."""

import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from harness.backends import failures, servers
from harness.backends.failures import Failures
from harness.backends.registry import engines, registration
from harness.backends.servers import Server
from harness.core.errors import UserError, printable, unknown

Dtype = Literal["float32", "bfloat16", "auto"]
Thinking = Literal["none", "switch", "always"]
LatencySource = Literal["card", "measured"]
Table = Mapping[str, Any]

# What one model may have anew for each engine that it runs on.
_BY_ENGINE: Mapping[str, type] = {
    "latency": dict, "weights": str, "file": str, "revision": str, "sha256": str, "gated": bool, "dtype": str,
    "quantisation": str, "server": dict,
}  # fmt: skip
_KEYS: Mapping[str, type] = {
    **_BY_ENGINE, "engine": str, "engines": dict, "description": str, "context_tokens": int, "thinking": str,
    "privileged": bool, "licence": str, "max_new_tokens": int, "thinking_tokens": int, "failures": dict,
}  # fmt: skip
_LATENCY_KEYS: Mapping[str, type] = {"source": str, "inference_s": float, "basis": str}
_CHOICES = {
    "dtype": get_args(Dtype),
    "thinking": get_args(Thinking),
    "source": get_args(LatencySource),
    "kind": servers.KINDS,
}
_SHA256 = re.compile(r"[0-9a-f]{64}")


def read(path: Path) -> dict[str, dict[str, Any]]:
    """What a card's file says of its model on each engine, checked; the engine it runs on unasked is first.

    `latency` stays a table; `server` and `failures` are made what they are.

    Raises:
        UserError: for every mistake in the file, in one line.
    """
    where = f"model card {path}"
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{where} is no TOML: {printable(error)}; mend the file") from None
    _check(table, where, _KEYS, required=("engine", "description", "latency"))
    others = table.pop("engines", {})
    found = {table["engine"]: _checked(table, where)}
    shared = {key: value for key, value in table.items() if key not in _BY_ENGINE}
    if table["latency"]["source"] == "measured":  # one that was declared says nothing of another engine
        shared["latency"] = table["latency"]
    for engine, own in others.items():
        at = f"{where} [engines.{printable(engine)}]"
        known = set(_takers("weights")) - {table["engine"]}
        if engine not in known:
            raise unknown(f"engine in {where}", engine, known)
        if not isinstance(own, dict):
            raise UserError(f"{at} = {printable(own)!r}; allowed: a table")
        _check(own, at, _BY_ENGINE, required=())
        whole = {**shared, **own, "engine": engine}
        _check(whole, at, _KEYS, required=("latency",))
        found[engine] = _checked(whole, at)
    return found


def _checked(table: Table, where: str) -> dict[str, Any]:
    engine, latency = table["engine"], table["latency"]
    _check(latency, f"{where} [latency]", _LATENCY_KEYS, required=("source", "basis"))
    seconds = latency.get("inference_s")
    if (latency["source"] == "card") != (seconds is not None):
        raise UserError(f'{where} [latency]: inference_s goes with source = "card", and only with it')
    if seconds is not None and not 0 <= seconds < float("inf"):
        raise UserError(f"{where} [latency]: inference_s = {seconds}; allowed: seconds, 0 or more")
    for key in ("context_tokens", "max_new_tokens", "thinking_tokens"):
        if table.get(key, 1) < 1:
            raise UserError(f"{where}: {key} = {table[key]}; allowed: 1 or more")
    if not _SHA256.fullmatch(table.get("sha256", "0" * 64)):
        raise UserError(f"{where}: sha256 = {printable(table['sha256'])!r}; allowed: 64 digits 0-9 a-f")
    known = registration(engine)
    for key in (key for key in _KEYS if _takers(key)):
        lacking = key not in table and key in known.required_keys
        if lacking or (key in table and key not in known.keys):
            shown = f"[{key}]" if _KEYS[key] is dict else key
            takers = " or ".join(_takers(key))
            raise UserError(f"{where}: {shown} goes with engine = {takers}, and only with it")
    return {**table, "server": _server(table, where), "failures": _failures(table, where)}


def _takers(key: str) -> list[str]:
    """Engines whose cards may have a key that not all may have."""
    return [engine for engine in engines() if key in registration(engine).keys]


def _server(card: Table, where: str) -> Server | None:
    if "server" not in card:
        return None
    where = f"{where} [server]"
    _check(card["server"], where, servers.KEYS, required=("base_url",))
    server = servers.read(card["server"], where)
    if card.get("thinking") == "switch" and not server.tells_thinking:
        raise UserError(
            f'{where}: thinking = "switch" needs the kind vllm or llama-server, which a request can tell; '
            "else set it at the server, and here none or always"
        )
    return server


def _failures(card: Table, where: str) -> Failures | None:
    if "failures" not in card:
        return None
    where = f"{where} [failures]"
    _check(card["failures"], where, failures.KEYS, required=())
    read = failures.read(card["failures"], where)
    if read.slow_tail and card["latency"]["source"] != "card":
        raise UserError(f'{where}: a slow tail goes with a latency whose source = "card"')
    return read


def _check(table: Table, where: str, keys: Mapping[str, type], required: Collection[str]) -> None:
    """Refuse unknown keys, missing keys, wrong types and values that are none of the choices."""
    for key, value in table.items():
        if key not in keys:
            raise unknown(f"key in {where}", key, keys)
        kind = keys[key]
        # By exact type: a bool is an int to isinstance. TOML writes 0 seconds as an integer.
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise UserError(f"{where}: {key} = {printable(value)!r}; allowed: a {kind.__name__}")
        if value not in _CHOICES.get(key, (value,)):
            raise unknown(f"{key} in {where}", str(value), _CHOICES[key])
    if "engine" in table and table["engine"] not in engines():
        raise unknown(f"engine in {where}", table["engine"], engines())
    for key in required:
        if key not in table:
            raise UserError(f"{where} has no {key}; add it")
