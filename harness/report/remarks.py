"""What extensions say of single decision points,
which a run's page says where it lists and shows these.

An extension adds such remarks by `adds={"remarks": {"name": "module:OBJECT"}}`. They are no section
of the page: each is about one decision point, or leads to some.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Protocol, runtime_checkable

from markupsafe import Markup, escape

from harness.core.plugins import Failed, Plugins, texts_as_given
from harness.report.apart import apart
from harness.report.runs import Runs
from harness.report.templating import visible
from harness.runs.folder import Run

# By decision point, what was left out of a prompt or the fusion, and what that changed. Of each:
# its `item`; of whom: `role`, `viewer`, `condition`, `seed` or null; the likeliest `action` with
# it; and, null without an answer, that `instead`, the `change` of the probability of `action`, the
# `shift` of the distribution.
LeftOut = Mapping[str, Sequence[Mapping[str, Any]]]


@runtime_checkable
class Remarks(Protocol):
    """Describe what an extension says on a run's page about single scenes.

    A scene is one decision point: a situation in which decisions are due.
    """

    def sentences(self, runs: Runs) -> Iterable[Markup]:
        """Return sentences, as HTML, to show above the page's list of decision points.

        In them `<a data-scene=… data-run=…>` is a link to a decision point, by its id and the index
        of its run.
        """
        ...

    def left_out(self, run: Run) -> LeftOut:
        """Return how answers and decisions change if one object or message is left out.

        By scene id, a scene has a list of dicts: `item`, what is left out; `role`, `viewer`,
        `condition` and `seed`, whose answer or decision it is; `action`, the likeliest with it;
        and, None without an answer, `instead`, the likeliest without it, `change`, the difference
        in that action's probability, and `shift`, how far the whole distribution moves.
        """
        ...


REMARKS: Plugins[Remarks] = Plugins("swarmdrive.remarks", Remarks, {})


def sentences(runs: Runs) -> list[Markup]:
    """Return the sentences of all extensions that stand above the page's list of decision points.

    An extension that fails gets a sentence with its error. Raises UserError if a file of a run is
    broken.
    """

    def escaped(name: str, remarks: Remarks) -> list[Markup]:
        written = remarks.sentences(apart(runs, REMARKS.is_ours(name)))
        return [escape(sentence) for sentence in texts_as_given(written)]

    sentences: list[Markup] = []
    for name in REMARKS:
        try:
            sentences += REMARKS.ask(name, partial(escaped, name))
        except Failed as error:
            sentences.append(escape(visible(str(error))))
    return sentences


def left_out(run: Run) -> LeftOut:
    """Return what all extensions know of how answers change without one object or message.

    By scene id, each scene has a list of dicts, one for an object or message: who answered, the
    likeliest action with it and without it, and by how much probabilities change. An extension that
    fails adds nothing. Raises UserError if a file of the run is broken.
    """
    joined: dict[str, list[Mapping[str, Any]]] = {}
    for name in REMARKS:
        with suppress(Failed):
            copied = apart(run, REMARKS.is_ours(name))
            by_scene = REMARKS.ask(name, partial(_left_out, copied))
            for scene, rows in by_scene.items():
                joined.setdefault(scene, []).extend(rows)
    return joined


def _left_out(run: Run, remarks: Remarks) -> LeftOut:
    return _plain(remarks.left_out(run))


def _plain(left_out: LeftOut) -> LeftOut:
    """Return the same as dictionaries.

    Raises TypeError or ValueError if a page cannot hold a value as JSON.
    """
    plain = {}
    for scene, rows in left_out.items():
        plain[scene] = [dict(row) for row in rows]
    json.dumps(plain, allow_nan=False)
    return plain
