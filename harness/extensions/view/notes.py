"""What people noted on decision points of a run, in its folder:
`notes.json`, which `harness view` writes.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from harness.core.errors import UserError, printable
from harness.core.files import BROKEN, text_of, write_whole

FILE = "notes.json"
MOST, LONGEST = 1000, 4000  # notes of a run, and characters of one


class Note(msgspec.Struct, frozen=True, kw_only=True):
    """Hold a user's note on a decision point, one situation of a run in which the ego decided.

    A decision point has one note at most.
    """

    scene: str  # id of the decision point, which has one note at most
    text: str  # what the user wrote
    date: str  # when it was written, UTC, ISO 8601


def notes(run: Path) -> list[Note]:
    """Return the users' notes in a run's folder, sorted by decision point; empty if there are none.

    A decision point is a situation in which the ego decided. Raises UserError if the file of notes
    is broken.
    """
    try:
        return msgspec.json.decode(text_of(run / FILE, "text"), type=list[Note])
    except FileNotFoundError:
        return []
    except BROKEN as error:
        raise UserError(
            f"{printable(run / FILE)} is broken ({printable(error)}); mend it, or delete it"
        ) from None


def note_on(notes: Sequence[Note], scene: str) -> Note:
    """Return the note on the decision point with the id `scene`; an empty one if there is none."""
    return next(
        (note for note in notes if note.scene == scene), Note(scene=scene, text="", date="")
    )


def write(run: Path, scene: str, text: str, before: str) -> None:
    """Write a note on a decision point, in place of the old one; an empty text deletes it.

    Args:
        run: the run's folder.
        scene: id of the decision point.
        text: the note.
        before: the date of the note that is replaced; empty if there is none.

    Raises UserError if the note there has another date, the text is too long, or the file is full,
    broken or cannot be written.
    """
    every = notes(run)
    if note_on(every, scene).date != before:
        raise UserError(
            f"{printable(scene)} has another note than this form began with; go back, copy your "
            "text, and open the notes again"
        )
    kept = [note for note in every if note.scene != scene]
    text = "\n".join(text.split("\r\n")).strip()
    if len(text) > LONGEST or (text and len(kept) >= MOST):
        raise UserError(
            f"a note has {LONGEST} characters at most, and a run {MOST} notes; shorten it, or "
            "delete some"
        )
    if text:
        date = datetime.now(UTC).isoformat(timespec="seconds")
        kept.append(Note(scene=scene, text=text, date=date))
    kept.sort(key=lambda note: note.scene)
    try:
        write_whole(run / FILE, msgspec.json.format(msgspec.json.encode(kept), indent=1) + b"\n")
    except OSError as error:
        raise UserError(
            f"{printable(run / FILE)} cannot be written ({error.strerror}); see whose folder it is"
        ) from None
