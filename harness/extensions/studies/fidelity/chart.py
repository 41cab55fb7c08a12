"""Closed-loop success over success on frozen scenes, as a chart of the study's page."""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.report import charts
from harness.report.charts import NUMBER, Spec
from harness.report.document import Chart

WHOLE: Spec = {"domain": [0, 100]}
CAPTION = "Lines are 95 % intervals. Where both succeed alike, a point is on the dashed line."


def chart(rows: Sequence[Mapping[str, Any]]) -> Chart:
    """Return a chart with a point for each model and condition, with 95 % intervals.

    `rows` have `model` and `condition`, and success in percent in both worlds, `frozen` and
    `closed`, with the ends of each in `_low` and `_high`.
    """
    x = {"field": "frozen", **NUMBER, "title": "success on frozen scenes, %", "scale": WHOLE}
    y = {"field": "closed", **NUMBER, "title": "success in closed loop, %", "scale": WHOLE}
    colour = charts.condition_colours(rows)
    shape = {**charts.shapes_of(rows, "model"), "legend": {"orient": "top", "title": None}}
    named = [charts.named(row) for row in rows]
    same = [{"frozen": end, "closed": end} for end in (0, 100)]
    layers: list[Spec] = [
        {
            "data": {"values": same},
            "mark": {**charts.RULE, "type": "line"},
            "encoding": {"x": x, "y": y},
        },
        charts.interval(
            x={**x, "field": "frozen_low"}, x2={"field": "frozen_high"}, y=y, color=colour
        ),
        charts.interval(
            x=x, y={**y, "field": "closed_low"}, y2={"field": "closed_high"}, color=colour
        ),
        charts.point(60, x=x, y=y, color=colour, shape=shape, tooltip=charts.tooltip(rows)),
    ]
    spec = charts.layered(*layers, rows=named, height=360)
    return Chart("Success in closed loop over success on frozen scenes", spec, CAPTION)
