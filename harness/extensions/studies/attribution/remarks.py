"""What a run's page says of the decision points that `harness study attribute` drew."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup

from harness.extensions.studies.attribution.record import of_run
from harness.report.remarks import LeftOut
from harness.report.runs import Runs
from harness.report.templating import environment
from harness.runs.folder import Run

MOVED = 5  # decision points whose answers moved most


class Remarks:
    """Tell a run's page what an attribution found: what answers are without an object or message.

    Its methods are those of `harness.report.remarks.Remarks`, which the page asks for sentences.
    """

    def sentences(self, runs: Runs) -> Iterator[Markup]:
        """Yield a sentence, as HTML, for each of these runs that has an attribution.

        A decision point is a situation in which the ego must act. An attribution says what answers
        become without one object or message. The sentence says how many decision points were drawn,
        and at which of them answers moved most.
        """
        template = environment(Path(__file__).parent).get_template("remark.html.j2")
        for n, run in enumerate(runs.runs):
            if a := of_run(run):
                by_shift = sorted(a.left_out, key=lambda each: -(each.shift or 0.0))
                scenes = list(dict.fromkeys(each.scene for each in by_shift))[:MOVED]
                drawn = {
                    "run": n,
                    "condition": a.condition,
                    "n": a.decision_points,
                    "scenes": scenes,
                }
                yield Markup(template.render(text=drawn, runs=runs))

    def left_out(self, run: Run) -> LeftOut:
        """Return, by decision point's id, the objects and messages left out, what moved most first.

        A decision point is a situation in which the ego must act. Each item is a dict with the
        fields of `record.LeftOut`, such as `item`, `action`, `instead` and `shift`, which say what
        changed without it, and the `condition` (settings of radio, asking and fusion). The mapping
        is empty for a run without attribution.
        """
        of: dict[str, list[dict[str, Any]]] = {}
        if a := of_run(run):
            for each in sorted(a.left_out, key=lambda each: -(each.shift or 0.0)):
                plain = {**msgspec.to_builtins(each), "condition": a.condition}
                of.setdefault(each.scene, []).append(plain)
        return of


REMARKS = Remarks()
