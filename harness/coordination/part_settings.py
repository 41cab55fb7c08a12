"""Join what installed parts of conditions have: settings, questions, changes of messages."""

from collections.abc import Collection, Mapping
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any

from harness.coordination.added_parts import added_parts
from harness.coordination.contents import (
    CONTENTS,
    Call,
    is_ours,
)
from harness.coordination.parts import (
    PLAIN,
    Ask,
    Change,
    Cloud,
    Fusion,
    Part,
    Question,
    Radio,
)
from harness.coordination.parts_of_packages import change_by
from harness.core.errors import UserError, printable
from harness.core.extensions import OfExtension, part_of, setting_of_extension

if TYPE_CHECKING:
    from harness.coordination.streams import Stream

OVERRIDES = ("loss", "latency_s", "density_coupled")  # settings that replace a field of the channel
RECORDED = {"further": "radio"}  # settings that records call otherwise: `radio` is the further ones
IN_NO_TEXT = ("profile", "further")  # settings that a condition's text has in another way
PARTS: dict[str, type[Part]] = {
    "radio": Radio,
    "ask": Ask,
    "fusion": Fusion,
    "cloud": Cloud,
}


@cache
def more_parts() -> Mapping[str, type[Part]]:
    """Return the groups of settings that installed extensions add to operating points, by name.

    An operating point is all settings of the radio, of asking helpers and of fusing their messages
    that a decision depends on. Each group is a subclass of `Part`, a class. The extensions'
    packages are imported.
    """
    return added_parts([key for kind in PARTS.values() for key in kind.__struct_fields__])


@cache
def part_of_settings() -> Mapping[str, str]:
    """Return which group each setting of an operating point belongs to, by the setting's name.

    A group, or part, is such as `radio` or `fusion`; the values are its name. The order is that of
    the settings in manifests and run files.
    """
    part_of = [(key, part) for part, kind in PARTS.items() for key in kind.__struct_fields__]
    behind: dict[str, set[str]] = {}  # parts that stand behind the same setting, in their order
    for part, kind in more_parts().items():
        after = 1 + [key for key, _ in part_of].index(kind.behind)
        while after < len(part_of) and part_of[after][1] in behind.get(kind.behind, ()):
            after += 1
        behind.setdefault(kind.behind, set()).add(part)
        part_of[after:after] = [(key, part) for key in kind.__struct_fields__]
    return dict(part_of)


@cache
def typed_settings() -> tuple[str, ...]:
    """Return the names of the settings that a user can type in a condition, such as `tau_nats`.

    A condition is the text of an operating point, such as `6g:tau_nats=0.5`.
    """
    return tuple(key for key in part_of_settings() if key not in IN_NO_TEXT)


@cache
def settings_alone() -> Collection[str]:
    """Return the names of the settings that matter even to an ego that has no radio.

    They are settings of an operating point, all that a decision depends on besides scene and model,
    such as `fallback`, what replaces a failed answer.
    """
    core = ("fallback", "round_trip", "round_trip_s", "window_s")
    of_extensions = [kind.__struct_fields__ for kind in more_parts().values() if kind.of_ego]
    return {*core, *chain(*of_extensions)}


def settings_of_radio() -> tuple[str, ...]:
    """Return the names of the settings that mean nothing to an ego that has no radio.

    They are settings of an operating point, all that a decision depends on besides scene and model,
    such as `loss`, the probability that a transmission is lost.
    """
    of_extensions = [kind.__struct_fields__ for kind in more_parts().values() if kind.of_radio]
    return (*OVERRIDES, *chain(*of_extensions))


def change_of(text: str) -> Change:
    """Return the change of helpers' messages, such as by an attack, that a text names.

    The text stands in the key of the answer to a fusion call, a second question to the ego's model
    that shows it these messages. It is one that some part of an operating point gave by `changes`,
    such as `liar:share=1/3` or `quoted`. Raises UserError if no installed part knows it.
    """
    for kind in more_parts().values():
        if (change := change_by(kind, text)) is not None:
            return change
    raise UserError(f"no part that is installed changes messages by {printable(text)!r}")


def stream_of(text: str) -> "Stream":
    """Return the messages sent unasked of which a text says what an ego heard.

    The text stands in the key of an answer, and is one that some part's stream gave. Raises
    UserError if no installed part knows it.
    """
    for kind in more_parts().values():
        if (stream := kind.unasked_of(text)) is not None:
            return stream
    raise UserError(f"no part that is installed sends messages unasked as {printable(text)!r}")


@cache
def calls() -> Mapping[str, Call]:
    """Return the second questions that show the ego's model what the ego has heard, by name.

    They belong to what messages carry, such as lists of objects, which the first prompt cannot
    show. A package's is left out if some group of settings already changes messages by that name.
    """
    by_name: dict[str, Call] = {}
    for content in CONTENTS.usable().values():
        call = content.call
        if call and (is_ours(call) or not _changes_messages(call.name)):
            by_name[call.name] = call
    return by_name


def _changes_messages(text: str) -> bool:
    return any(change_by(kind, text) is not None for kind in more_parts().values())


@cache
def questions() -> Mapping[str, Question]:
    """Return the questions that helpers' models may be asked, by name.

    The ordinary one, what the ego should do as the helper sees it, has the name ""; extensions add
    others, such as one that shows the helper nothing, as a control.
    """
    others = chain(*(kind.questions for kind in more_parts().values()))
    return {"": PLAIN, **{question.name: question for question in others}}


def question_under(settings: Mapping[str, Any]) -> Question:
    """Return the question that helpers were asked under a condition, as a run has recorded it.

    A condition is all settings of the radio, of asking helpers and of fusing their messages, in
    groups called parts. `settings` are the values of the condition's settings by name, such as
    `tau_nats`. Settings that belong to no installed part are ignored.
    """
    for kind in more_parts().values():
        part_settings = {key: settings[key] for key in kind.__struct_fields__ if key in settings}
        if kind.questions and part_settings:
            return kind(**part_settings).question
    return PLAIN


def without_gone(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recorded condition's settings without those of extensions that are not installed.

    So its run can be read here. A condition is a set of settings that a run scores; `settings` are
    values by name, such as `tau_nats`. Raises UserError if such a setting has another value than
    the one that does nothing.
    """
    kept: dict[str, Any] = {}
    for key, value in settings.items():
        gone = gone_setting(key)
        if not gone:
            kept[key] = value
        elif ("" if value is None else str(value)) != gone.idle:
            raise UserError(lacking_setting(key, value, gone))
    return kept


def gone_setting(setting: str) -> OfExtension | None:
    """Return the extension that a setting belongs to, if it is not installed here; else None.

    `setting` is the name of a setting of a condition, the settings under which a run is scored.
    """
    return None if setting in part_of_settings() else setting_of_extension(setting)


def lacking_setting(setting: str, value: object, gone: OfExtension) -> str:
    """Return the error text on a condition's setting whose extension is not installed, one line.

    A condition is a set of settings that a run scores. `value` is what it has for `setting`; `gone`
    is the extension that it belongs to.
    """
    return f"setting {setting}={printable(value)} of a condition is {part_of(gone.extension)}"
