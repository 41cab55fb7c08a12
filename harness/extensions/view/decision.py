"""The page of some runs with everything about the one decision that somebody opened."""

from typing import Any

from harness.core.errors import UserError, printable
from harness.report import library
from harness.report.decisions import replayed
from harness.report.details import Details, prompts_of
from harness.report.remarks import left_out
from harness.report.runs import Runs


def with_decision(page: str, runs: Runs, scene: str) -> str:
    """Return the HTML page of some runs with all details of one decision point put in.

    A decision point is a situation in which the ego decided. `page` is the HTML of the report on
    `runs`, and `scene` the point's id. The details are prompts, answers and pictures, which the
    page itself has for few points. Raises UserError if no run has the point.
    """
    detail = library.packed({scene: everything(runs, scene)})
    return page.replace(
        "<script>", f'<script type="application/gzip" id="opened">{detail}</script>\n<script>', 1
    )


def everything(runs: Runs, name: str) -> dict[str, Any]:
    """Return all details of one decision point as plain values, for the script of a run's page.

    A decision point is a situation in which the ego decided, and `name` is its id. The details are
    prompts, answers, decisions and the picture. Raises UserError if no run has the point.
    """
    if not any(name in run.decisions.scenes for run in runs.runs):
        raise UserError(
            f"no run here has a decision {printable(name, 40)}; see the list on its page"
        )
    scenes = replayed(runs, [name]) if runs.live else {}
    without = [left_out(run) for run in runs.runs]
    details = Details(runs.of_scenes([name]), scenes, frozenset([name]), prompts_of, True, without)
    [[detail]] = details.blocks([name])
    return detail
