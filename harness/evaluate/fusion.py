"""Make fusion calls: the ego's model answers with the messages that arrived in its prompt.

Who is heard depends on the channel and not on the fusion. So the sets of messages that any
condition and seed hears are known before the first call, and each set needs one call. What a plan
says depends on the rounds before, so it stands in its sender's key, and equal plans are one
question.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from harness.coordination.contents import WHOLE, Call
from harness.coordination.contents_of_packages import words
from harness.coordination.coordinate import FusionCall
from harness.coordination.intents import Intents
from harness.coordination.operating_point import Rewrites
from harness.coordination.part_settings import calls, change_of
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable
from harness.evaluate.repair import as_text
from harness.runs.records import ASKED, REWRITTEN, Answer, asked_key

OF_AGENT = "plan"  # in a key, before what its sender, an agent, is itself going to do
OF_STREAM = "stream:"  # in a key, before what its sender sent unasked
FROM = "from:"  # in a key, before the id of the other scene that a message comes from


@dataclass(frozen=True)
class FusionAnswers:
    """Hold what egos answered to K sets of messages that they may hear, with A actions.

    Each is a fusion call: the ego's model is asked again, with the messages in its prompt. `codes`,
    (K,), says of each set in which scene who was heard (`codes_of`); `intents`, (K, A), are the
    probabilities of actions after it, and `seconds`, (K,), the time of the call.
    """

    # the decision point of each set and who was heard in it (`codes_of`), ascending, (K,)
    codes: Ints
    intents: Floats  # the intent after each set, (K, A); NaN where the answer failed
    seconds: Floats  # time of each fusion call, (K,)

    def at(self, points: Ints, attackers: Bools | None = None) -> FusionCall:
        """Return a function that answers n decisions, given who of H helpers was heard, `(n, H)`.

        `points`, `(n,)`, has the index of each decision's scene, as in `codes`, and `attackers`,
        `(n, H)`, who attacks, if the prompt depends on it. The function returns intents,
        probabilities of A actions, `(n, A)`, and seconds `(n,)`, NaN where nobody was heard; it
        raises LookupError for a set of messages that the ego was never asked about.
        """
        return partial(self._of_heard, points, attackers)

    def _of_heard(
        self, points: Ints, attackers: Bools | None, on_time: Bools
    ) -> tuple[Floats, Floats]:
        """Return intents (n, A) and seconds (n,) by who was heard (n, H); NaN if nobody was."""
        heard_any = on_time.any(axis=1)
        codes = codes_of(on_time, points, attackers)[heard_any]
        intents = np.full((len(on_time), self.intents.shape[1]), np.nan)
        seconds = np.full(len(on_time), np.nan)
        if len(codes):
            index = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
            if not len(self.codes) or not np.array_equal(self.codes[index], codes):
                raise LookupError(
                    "the ego's model was never asked about a set of messages that was heard"
                )
            intents[heard_any], seconds[heard_any] = self.intents[index], self.seconds[index]
        return intents, seconds


def codes_of(on_time: Bools, points: Ints, attackers: Bools | None = None) -> Ints:
    """Return an integer for each of n decisions, `(n,)`, that says where it is and who was heard.

    Equal integers are one question to the ego's model, when that is asked again with what was
    heard. `on_time`, `(n, H)`, says which of H helpers were heard in time, and `points`, `(n,)`, is
    the index of the decision's scene in a list of the caller's. With `attackers`, `(n, H)`, the
    integer also says which of those heard attack. `heard_in` decodes it.
    """
    flags = on_time if attackers is None else np.concatenate([on_time, on_time & attackers], axis=1)
    return np.asarray(points << flags.shape[1] | flags @ (1 << np.arange(flags.shape[1])))


def heard_in(code: int, helpers: int, attacked: bool = False) -> tuple[int, list[int], list[int]]:
    """Decode an integer of `codes_of`: return the decision's scene, who was heard and who attacks.

    `code` says where a decision is and whom it heard. The scene is an index in the list that the
    codes were made for, and the two lists have indices of helpers, from 0 to `helpers` - 1.
    `attacked` says whether the code was made with `attackers`.
    """
    bits = helpers * (1 + attacked)
    heard = [h for h in range(helpers) if code >> h & 1]
    return code >> bits, heard, [h for h in heard if attacked and code >> (helpers + h) & 1]


def key_of(
    helper: str, rewrites: Rewrites, attacks: bool, source: str = "", unasked: str = ""
) -> str:
    """Return the text that names a helper's message, and how it is shown, in a fusion call's id.

    A fusion call asks the ego's model again, with the messages. `helper` is the sender's id, and
    `rewrites` says how messages are changed and shown; with `attacks`, changes by an attack are
    named, too. Such as `v2`, `v2~blind` (another question), `v3!liar&schema` (changed by attack and
    defence), `v2!text` where it holds words alone, `v2!objects` where the ego's scene graph has its
    objects, or `v2!objects&from:00012-3` where it comes from the scene `source`. A scene graph is
    what one vehicle knows of a scene. `unasked` says what the ego holds of messages that were sent
    unasked (`Stream.heard`), as in `v3!stream:cpm:0.1:12.15&ghost`.
    """
    of_attackers, of_all = rewrites.changes
    changed = [OF_STREAM + unasked] if unasked else []
    changed += [*([of_attackers] if attacks and of_attackers else []), *of_all]
    if rewrites.call:
        changed += [rewrites.call, *([WHOLE] if rewrites.whole else [])]
    if source:
        changed.append(FROM + source)
    key = asked_key(helper, rewrites.question)
    return key + (REWRITTEN + "&".join(changed) if changed else "")


def plan_keys(helpers: Sequence[str], intents: Intents, row: int, on_time: Bools) -> list[str]:
    """Return the texts that name the plans that one agent has heard, for its fusion call's id.

    An agent is a vehicle that decides for itself; here it is that of index `row` in `intents`.
    `helpers` are the ids of the H other vehicles, and `on_time`, `(H,)`, says whom it heard. A text
    is such as `v2!plan:1:0.10,0.70,0.20:3.4:0.0`: the sender's id and number, its intent, and the
    seconds in which it reaches the conflict, and that it has lost. A fusion call asks the ego's
    model again, with the messages that it heard.
    """
    plans = intents.plans
    assert plans is not None
    keys = []
    for h in np.flatnonzero(on_time).tolist():
        intent = ",".join(f"{share:.2f}" for share in intents.helpers[row, h].tolist())
        number, reaches_s, lost_s = (
            each[row, 1 + h] for each in (plans.vehicle, plans.reaches_s, plans.lost_s)
        )
        keys.append(
            f"{helpers[h]}{REWRITTEN}{OF_AGENT}:{number}:{intent}:{reaches_s:.1f}:{lost_s:.1f}"
        )
    return keys


def stream_text(key: str) -> str:
    """Return what the key of a message says of its sender's stream; empty for another message."""
    mark = key.partition(REWRITTEN)[2].partition("&")[0]
    return mark.removeprefix(OF_STREAM) if mark.startswith(OF_STREAM) else ""


def _plan_of(key: str) -> dict[str, Any] | None:
    """Return the plan of a sender's key as a prompt takes it; None for another message."""
    sender, _, change = key.partition(REWRITTEN)
    name, *parts = change.split(":")
    if name != OF_AGENT:
        return None
    try:
        number, intent, reaches_s, lost_s = parts
        return {
            "sender": sender,
            "number": int(number),
            "intent": [float(share) for share in intent.split(",")],
            "reaches_s": None if reaches_s == "inf" else float(reaches_s),
            "lost_s": float(lost_s),
        }
    except ValueError:
        raise UserError(
            f"answers.jsonl has an answer that heard {printable(key)!r}, which is no plan; make "
            "the run again"
        ) from None


class Marks(NamedTuple):
    """Hold what the key of a message that the ego heard (`key_of`) says after the sender's name.

    `changes` names what attacks and defences changed of the message, and `whole` says whether the
    prompt showed all of it. `call` is the kind of question in which only objects or words of it are
    shown, None if the prompt just has the message.
    """

    changes: list[str]  # names of what attacks and defences changed of it, in order
    # the second question to the ego's model that shows objects or words of it; None if the prompt
    # just has the message
    call: Call | None
    whole: bool  # whether the prompt showed the whole message


def marks_of(key: str) -> Marks:
    """Return what the key of a message that the ego heard says of how it was shown.

    The key (`key_of`) is a text such as `v3!liar&schema`: sender, attack and defence.
    """
    changes, call, whole, named = [], None, False, calls()
    for mark in filter(None, key.partition(REWRITTEN)[2].split("&")):
        if mark == WHOLE:
            whole = True
        elif mark in named:
            call = named[mark]
        elif not mark.startswith((FROM, OF_STREAM)):
            changes.append(mark)
    return Marks(changes, call, whole or call is None)


def source_of(scene: str, senders: Sequence[str]) -> str:
    """Return the id of the scene from which an ego's messages came.

    `senders` are the keys of the messages, texts such as `v2` or `v2!objects&from:00012-3`
    (`key_of`). It is `scene`, the ego's own, unless a key says otherwise, as in a control.
    """
    changes = (change for key in senders for change in key.partition(REWRITTEN)[2].split("&"))
    return next((change.removeprefix(FROM) for change in changes if change.startswith(FROM)), scene)


def messages_of(
    answers: Mapping[str, Answer], senders: Sequence[str], actions: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the messages that the ego heard as a prompt template takes them, one dict each.

    `senders` are the messages' keys (`key_of`), and `answers` has the senders' answers by key;
    `actions` are the names of the meta-actions, in order. A message has `sender`, `intent` and the
    fields of its answer; one of words alone `sender` and `evidence`, in one line. An agent's plan
    has `sender`, `number`, `intent`, `reaches_s` (None if it stands or has passed) and `lost_s`. A
    message whose objects are in the ego's graph, or whose answer failed, is left out. An agent is a
    vehicle that decides for itself.
    """
    messages = []
    for sender in senders:
        if stream_text(sender):
            continue  # it is in the graph
        if plan := _plan_of(sender):
            messages.append(plan)
            continue
        key = sender.partition(REWRITTEN)[0]
        changes, call, whole = marks_of(sender)
        if call and not (whole or call.in_words):
            continue  # it is in the graph
        if (answer := answers.get(key)) and answer.intent and answer.message:
            message = {"intent": list(answer.intent), **answer.message}
            for change in changes:
                message = change_of(change).message(message, actions)
            # No special token of a chat template gets through.
            message["evidence"] = as_text(message["evidence"] or "")
            if call and not whole:
                message = {"evidence": as_text(words(call, message["evidence"]))}
            messages.append({"sender": key.partition(ASKED)[0], **message})
    return messages
