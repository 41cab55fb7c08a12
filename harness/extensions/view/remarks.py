"""What people noted on decision points, on the page of a run."""

from collections.abc import Iterator
from pathlib import Path

from markupsafe import Markup

from harness.extensions.view.notes import notes
from harness.report.remarks import LeftOut
from harness.report.runs import Runs
from harness.report.templating import environment
from harness.runs.folder import Run


class Remarks:
    """Show users' notes on single decisions, on the page of their run.

    Its methods are those of `harness.report.remarks.Remarks`, which the page asks for sentences.
    """

    def sentences(self, runs: Runs) -> Iterator[Markup]:
        """Yield each note on a decision point of these runs, as HTML with a link to it."""
        template = environment(Path(__file__).parent).get_template("remark.html.j2")
        for place, run in enumerate(runs.runs):
            if noted := notes(run.path):
                scenes = set(run.decisions.labels("scene"))
                for note in noted:
                    if note.scene in scenes:
                        yield Markup(template.render(note=note, place=place, runs=runs))

    def left_out(self, run: Run) -> LeftOut:
        """Return an empty mapping, as notes do not say what was left out of a prompt.

        The page asks all that may remark on decisions for it. `run` is not read.
        """
        return {}


REMARKS = Remarks()
