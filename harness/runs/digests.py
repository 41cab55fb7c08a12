"""Hold what a run's `run.json` states to digests of what it stated when it was written.

There is one of each agent, over all that decides its answers; one of all else; and one of the
answers. They show that a file was changed in part. They are no signature: who changes a file can
state its digests anew.
"""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import msgspec

from harness.core.errors import printable
from harness.core.files import digest
from harness.runs.folder import Run
from harness.runs.records import AGENT

EGO, REST, ANSWERS = "ego", "run", "answers.jsonl"
# Of run.json, beside what is of the ego's agent: what decides the answers of every agent.
OF_ALL = ("actions", "dtype", "temperature", "sampling_seed", "batch_size")
LABELS = ("name", "created", "command", "tags")  # which describe no answer, and may be changed


def digests_of(record: Mapping[str, Any], answers_sha256: str) -> dict[str, str]:
    """Return the digests of a run's files, by name: `ego`, `helper 1` and so on, `run` and answers.

    Those of agents (models with their prompts) are over all that decides an answer: the model's
    card, the prompt, how it is asked, what it is, and how tokens are drawn. `run` is over all else.
    `record` is the content of `run.json` as it is in the file, and `answers_sha256` the digest of
    `answers.jsonl`.
    """
    plain = msgspec.json.decode(msgspec.json.encode(record))
    identity = plain.get("identity", {})
    helpers, identities = plain.get("helpers", []), identity.get("helpers")
    of_helpers = identities if isinstance(identities, list) else []
    of_ego = {name: value for name, value in identity.items() if name != "helpers"}
    shared = _part(plain, OF_ALL)
    digests = {EGO: digest([_part(plain, AGENT), of_ego, shared])}
    for place, helper in enumerate(helpers):
        its_identity = of_helpers[place] if place < len(of_helpers) else None
        digests[f"helper {place + 1}"] = digest([helper, its_identity, shared])
    besides = (*LABELS, *AGENT, *OF_ALL, "helpers", "digests")
    rest = {name: value for name, value in plain.items() if name not in besides}
    if isinstance(world := rest.get("world"), dict):  # its dataset has a digest, wherever it lies
        rest["world"] = {name: value for name, value in world.items() if name != "path"}
    digests[REST] = digest(rest)
    return {**digests, ANSWERS: answers_sha256}


def otherwise(run: Run) -> Iterator[str]:
    """Yield a sentence for each digest of a run that is not of what its files state.

    A run by an earlier version may have none; `unheld` says so.
    """
    recorded = run.record.get("digests", {})
    here = digests_of(run.record, run.answers.sha256) if recorded else {}
    for name in {**here, **recorded}:
        if here.get(name) != recorded.get(name):
            makes = "that file makes" if name == ANSWERS else "what it states makes"
            yield f"run.json has another digest of {printable(name, 40)} than {makes}"


def unheld(run: Run) -> Iterator[str]:
    """Yield a sentence if a run has no digests of its files, which later versions write."""
    if not run.record.get("digests"):
        yield (
            "It has no digests of what it states, as runs of earlier versions: how its models were "
            "asked is as run.json states it."
        )


def _part(record: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    return {name: record[name] for name in names if name in record}
