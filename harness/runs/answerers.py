"""Find out who was asked in a run: of answers that are replayed, in the first of the runs."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

REPLAY = "replay"  # the engine of stored answers


class Answerers(NamedTuple):
    """Hold who gave a run's answers, as `run.json` states it, values by name.

    `model` is the card of the ego's model, the content of the file that describes it, and
    `identity` tells the models apart; both are empty if nothing states them. `helpers` are the
    agents (model, prompt and way of answering) of helpers, none if the ego's model answered for
    them, and `temperature` that of drawing tokens; both are None of a replay that does not state
    them, as earlier versions did not.
    """

    model: Mapping[str, Any]
    identity: Mapping[str, Any]
    helpers: Sequence[Mapping[str, Any]] | None
    temperature: float | None


NOBODY = Answerers({}, {}, None, None)


def answerers_of(
    model: Mapping[str, Any],
    identity: Mapping[str, Any],
    helpers: Sequence[Mapping[str, Any]],
    temperature: float,
) -> Answerers:
    """Return who was asked in a run that states these; of a replay, what the first run stated.

    Args:
        model: the card of the ego's model.
        identity: what tells the run's models apart, in which a replay has its earlier run (`of`).
        helpers: the agents of helpers; those of a replay answer before those of its earlier run.
        temperature: that of drawing tokens.
    """
    answerers = Answerers(model, identity, helpers, temperature)
    while answerers.model.get("engine") == REPLAY:
        earlier = answerers.identity.get("of")
        if not isinstance(earlier, dict):
            return answerers._replace(helpers=None, temperature=None)
        its_model, its_identity = earlier.get("model"), earlier.get("identity")
        if not (isinstance(its_model, dict) and isinstance(its_identity, dict)):
            return NOBODY
        its_helpers = answerers.helpers or _agents(earlier.get("helpers"))
        its_temperature = _temperature(earlier.get("temperature"))
        answerers = Answerers(its_model, its_identity, its_helpers, its_temperature)
    return answerers


def _agents(value: Any) -> Sequence[Mapping[str, Any]] | None:
    """Return what a file states of helpers' agents; None if it is no list of such."""
    if not isinstance(value, list | tuple):
        return None
    has_models = all(
        isinstance(each, dict) and isinstance(each.get("model"), dict) for each in value
    )
    return tuple(value) if has_models else None


def _temperature(value: Any) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
