"""Hold the times of answers that a run states against the sources that it names for them."""

from collections.abc import Iterator, Sequence
from itertools import zip_longest

from msgspec import structs

from harness.backends import cards
from harness.backends.card import Card
from harness.backends.registry import registration
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.evaluate import latency as latencies
from harness.evaluate.of_run import model_of
from harness.runs.answerers import REPLAY
from harness.runs.folder import Run
from harness.runs.records import MEASURED, Latency

DECLARED = "declared"  # the source of times that were typed


def times_otherwise(run: Run, card: Card) -> Iterator[str]:
    """Yield a sentence for each of a run's times that is not what its source says.

    The source is the card (a file that describes a model), the paper, a sample of answers that were
    timed, or what was typed. `card` is that of the ego's model.
    """
    yield from _of_card(run, card)
    yield from _of_latency(run)


def refuse_otherwise(run: Run) -> None:
    """Raise UserError if a run states other times of answers than the source that it names has."""
    for sentence in times_otherwise(run, model_of(run, run.manifest.agent(0))):
        raise UserError(f"{printable(run.path)}: {sentence}; make the run again")


def unchecked_times(run: Run) -> Iterator[str]:
    """Yield a sentence for each of a run's times that the run alone states.

    One is said to be from a card, the file that describes a model: the card of that name that is
    here may state another time, or none is here. Others are of a run that is replayed.
    """
    latency, manifest = run.manifest.latency, run.manifest
    if manifest.settings.latency in (None, "card"):
        models = [asked_card(run), *(model_of(run, helper) for helper in manifest.helpers)]
        for card in dict.fromkeys(models):
            yield from _of_card_here(card)
    replays = [manifest.model, *(helper["model"] for helper in manifest.helpers)]
    is_replay = manifest.model["engine"] == REPLAY
    if is_replay and manifest.settings.latency is None and latency.source in (DECLARED, MEASURED):
        yield (
            f"Its latency of {latency.ego_s:g} s, {latency.source} in the run that it replays, is "
            "stated by run.json alone."
        )
    several = is_replay and bool(manifest.answerers.identity.get("helpers"))
    by_run = any(model["engine"] == REPLAY for model in replays[1:])
    if latency.source in ("card", "paper") and (several or by_run):
        times = dict.fromkeys(f"{seconds:g} s" for seconds in latency.helper_times_s())
        yield f"Its helpers' latency of {' and '.join(times)} is stated by run.json alone."


def asked_card(run: Run) -> Card:
    """Return the card (description) of the model that was asked, as the run states it.

    Of answers that are replayed it is that of the first run. Raises UserError if the run states
    none.
    """
    model, where = run.manifest.answerers.model, printable(run.path)
    if not model:
        raise UserError(f"{where}: run.json states no model of what it replays; make it again")
    return convert(model, Card, f"{where}: its model")


def _of_card(run: Run, card: Card) -> Iterator[str]:
    """Yield whether a run's latency is otherwise than this card says, if it names that."""
    latency, card_s = run.manifest.latency, card.latency.inference_s
    if card.engine == REPLAY:  # its answers took as long as in the run that it replays
        card_s = asked_card(run).latency.inference_s
    if latency.source == "card" and card_s != latency.ego_s:
        yield "run.json has another latency than its model's card, which it names as the source"


def _of_card_here(card: Card) -> Iterator[str]:
    """Yield a sentence if the card of this name that is here states another time, or none is."""
    if card.engine == REPLAY:
        return
    in_run = _time(card)
    if card.name in cards.names():
        here = _time(cards.load(card.name))
        if here != in_run:
            yield (
                f"The card {printable(card.name)} in run.json states {in_run} for an answer; the "
                f"one that is here states {here}."
            )
    elif card.latency.inference_s is not None:
        yield (
            f"The card {printable(card.name)} in run.json states {in_run} for an answer, and none "
            "of that name is here."
        )


def _time(card: Card) -> str:
    """Return in words the time of an answer that a card states."""
    seconds = card.latency.inference_s
    return "no time" if seconds is None else f"{seconds:g} s ({card.latency.source})"


def _of_latency(run: Run) -> Iterator[str]:
    """Yield what a run's latencies are otherwise than the source that it names for them."""
    latency = run.manifest.latency
    if latency.source == "paper" and latency.ego_s != latencies.PAPER.ego_s:
        yield "run.json has another latency than the paper, which it names as the source"
    if latency.source == MEASURED and not _is_measured(latency):
        yield "run.json has another measured latency than the median of its sample"
    if latency.source in (DECLARED, MEASURED) and not _is_typed(run):
        yield f"run.json has times that are {latency.source}, and its settings do not have them"
    if latency.source in ("card", "paper"):
        others = {"a fusion call": latency.fusion_s}
        is_replay = run.manifest.model["engine"] == REPLAY
        # Those of the run that it replays may have models of their own, whose cards are not here.
        if is_replay and run.manifest.answerers.identity.get("helpers"):
            pass
        elif not run.manifest.helpers:
            others["the helpers"] = latency.helper_s
        elif latency.helper_times_s() != _helpers_s(run, latency.helper_times_s()):
            yield "run.json has another latency of the helpers than their cards, or the paper, have"
        for whose in (whose for whose, seconds in others.items() if seconds != latency.ego_s):
            yield f"run.json has another latency of {whose} than of the ego, whose source it names"


def _is_measured(latency: Latency) -> bool:
    """Return whether measured times are the medians of the sample; one of several models' may be.

    A role that was not timed has the time of the ego. A latency without a sample is an older run's.
    """
    sample = latency.sample
    if "ego" not in sample:
        return True
    helper_s, fusion_s = (sample.get(role, sample["ego"]).median_s for role in ("helper", "merge"))
    by_role = (latency.ego_s, latency.fusion_s) == (sample["ego"].median_s, fusion_s)
    return by_role and (bool(latency.helpers_s) or latency.helper_s == helper_s)


def _is_typed(run: Run) -> bool:
    """Return whether a run's settings have its times, as a finished run's do, or its model has."""
    typed = run.manifest.settings.latency
    if typed is None:
        return registration(run.manifest.model["engine"]).capabilities.own_latency
    if typed in latencies.NAMES:
        return False
    latency = run.manifest.latency
    of_typed = structs.replace(latencies.declared(typed), source=latency.source)
    return latencies.same_times(of_typed, latency)


def _helpers_s(run: Run, in_manifest: Sequence[float]) -> tuple[float | None, ...]:
    """Return the times of the models that answer for helpers alone, by what was typed or cards.

    Answers that are replayed have their own, which `in_manifest` states.
    """
    typed = run.manifest.settings.latency
    choice = typed if typed in latencies.NAMES else None
    times = []
    for helper, helper_s in zip_longest(run.manifest.helpers, in_manifest):
        card = model_of(run, helper or run.manifest.helpers[0])
        has_own = choice is None and registration(card.engine).capabilities.own_latency
        times.append(helper_s if has_own else latencies.of_card(choice, card).helper_s)
    return tuple(times)
