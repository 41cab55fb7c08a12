"""What people noted on decision points, as rows of `notes.csv`."""

from collections.abc import Sequence

from harness.extensions.view.notes import Note, notes
from harness.runs.exports import Rows
from harness.runs.folder import Run


class Notes(Rows):
    """Give the notes of a run's readers, a row each, for `harness run export --csv`.

    `of` takes the run and returns one row for each noted decision point, in their order; it raises
    UserError if the file of notes is broken.
    """

    columns = Note.__struct_fields__

    def of(self, run: Run) -> list[Sequence[object]]:
        rows = list[Sequence[object]]()
        for note in notes(run.path):
            rows.append([getattr(note, column) for column in self.columns])
        return rows


NOTES = Notes()
