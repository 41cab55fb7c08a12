"""Figures of studies as Vega-Lite specifications, which a browser draws on the study's page.

The functions are those of `described.Draws`; each returns a chart a panel.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Floats
from harness.core.figures import number_or_none
from harness.report import charts
from harness.report.charts import NAME, NUMBER, TAKEN, Spec, colour, interval, names_axis, point
from harness.report.document import Chart
from harness.report.drawing.colours import GREY, INK, ON_DATA, PALE, SHADES, WHITE, conditions
from harness.runs.headline import IN_WORDS, SUCCESS
from harness.studies.axes import CORE, axis_of
from harness.studies.figures.axes import (
    BESIDE,
    BEST_BAND,
    CLOUD_MS,
    curve_colours,
    interval_of,
    lead_in,
    paper_values,
)
from harness.studies.figures.described import Rows, Steps

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

BAR_PX, CELL_PX = 30, 26  # height of a row
LINES_PX = 260
DASHES = {"--": [6, 4], ":": [2, 3]}
BARS = "Lines are 95 % intervals."
BANDS = "Bands are 95 % intervals."
CROSSES = " ✕ or a thick line: the paper's value or range."
INKED: Spec = {"value": "currentColor"}


def either(
    picture: "Callable[[], Figure]", panels: Callable[[], Sequence[Chart]]
) -> Sequence[Chart]:
    """Draw what one study alone has, by its function `panels`."""
    return panels()


def operating_points(core: "pd.DataFrame", paper: "pd.DataFrame | None" = None) -> Sequence[Chart]:
    """Draw latency, success, messages and the trigger rate, a chart of bars each."""
    metric = lead_in(core)
    panels = (
        ("latency_proxy_ms", 1.0, "latency of a decision, ms", "latency_proxy_ms"),
        (metric, 100.0, f"{IN_WORDS[metric]}, %", SUCCESS),
        ("messages_per_episode", 1.0, "messages per episode", "messages_per_episode"),
        ("trigger_rate", 100.0, "trigger rate, %", "trigger_rate"),
    )
    kind = interval_of(core)
    drawn = []
    for name, scale, title, of_paper in panels:
        rows, marks = [], []
        for row in core[(core.metric == name) & (core.interval == kind)].to_dict("records"):
            condition = str(row["condition"])
            rows.append({"condition": condition, **_estimate(row, scale)})
            marked = paper_values(paper, CORE, of_paper, condition=condition)
            for low, high in zip(marked.low, marked.high, strict=True):
                marks.append({"condition": condition, "low": float(low), "high": float(high)})
        by_name = conditions(row["condition"] for row in rows)
        if name == "latency_proxy_ms":
            cloud = "cloud, cited"
            rows.append({"condition": cloud, "value": CLOUD_MS, "low": None, "high": None})
            by_name[cloud] = PALE
        caption = BARS + CROSSES * bool(marks)
        drawn.append(_chart(_sentence(title), _bars(rows, marks, by_name), caption))
    return drawn


def _bars(rows: charts.Rows, marks: charts.Rows, colours: Mapping[str, str]) -> Spec:
    y = _names("condition", list(colours))
    x = {"field": "value", **NUMBER, "title": None}
    ends = {"x": {**x, "field": "low"}, "x2": {"field": "high"}, "y": y, "color": INKED}
    bars: Spec = {
        "mark": {"type": "bar", "height": {"band": 0.7}, "stroke": GREY, "strokeWidth": 0.7},
        "encoding": {
            "y": {**y, "axis": {"labelLimit": 260}},
            "x": x,
            "color": {**colour("condition", colours), "legend": None},
            "tooltip": charts.tooltip(rows),
        },
    }
    layers = [bars, *_interval_layers(rows, interval(**ends)), *_crosses(marks, "y", y, "x", x)]
    return charts.layered(*layers, rows=rows, height=BAR_PX * len(rows))


def _crosses(marks: charts.Rows, at: str, place: Spec, along: str, axis: Spec) -> list[Spec]:
    """Return layers with values of the paper: a cross, or a thick line for a range.

    `at` and `place` are the channel and encoding of where a mark stands, `along` and `axis` those
    of its value.
    """
    cross = {"type": "point", "shape": "cross", "angle": 45, "size": 70, "filled": True}
    line = {"type": "rule", "strokeWidth": 4, "opacity": 0.6}
    low = {at: place, along: {**axis, "field": "low"}, "color": INKED}
    layers = []
    for mark, encoding, is_single in (
        (line, {**low, f"{along}2": {"field": "high"}}, False),
        ({**cross, "opacity": 1}, low, True),
    ):
        values = [each for each in marks if (each["low"] == each["high"]) == is_single]
        if values:
            layers.append({"data": {"values": values}, "mark": mark, "encoding": encoding})
    return layers


def along(
    panels: "Sequence[pd.DataFrame]",
    paper: "pd.DataFrame | None" = None,
    colours: Mapping[str, str] | None = None,
) -> Sequence[Chart]:
    """Draw success along an axis; loss or trigger rate has an axis of its own at the right."""
    of_curves = curve_colours(panels, colours)
    drawn = []
    for panel in panels:
        variable, metric = str(panel.variable.iloc[0]), lead_in(panel)
        label, is_worded = axis_of(variable).label, axis_of(variable).worded
        x = charts.x_axis("value", label)
        if is_worded:
            axis = {"labelAngle": -30}
            x = {"field": "value", "type": "nominal", "sort": None, "title": label, "axis": axis}
        metrics = {metric: IN_WORDS[metric]}
        if variable in BESIDE:
            beside, words = BESIDE[variable]
            metrics[beside] = words
        rows, of_names = _curves(panel, metrics, of_curves)
        shape = charts.shapes_of(rows, "curve") | {"legend": {"orient": "top", "title": None}}
        layers, has_marks = list[Spec](), False
        for name, words in metrics.items():
            y = {"field": "share", **NUMBER, "title": f"{words}, %", "scale": {"zero": False}}
            if name == "trigger_rate":
                y["scale"] = {"domain": [0, 100]}
            encoding = {"x": x, "color": _coloured("curve", of_names), "shape": shape}
            marks = []
            of_paper = SUCCESS if name == metric else name
            marked = paper_values(paper, str(panel.panel.iloc[0]), of_paper)
            for value, low, high in zip(marked.value, marked.low, marked.high, strict=True):
                marks.append({"value": value, "low": float(low), "high": float(high)})
            has_marks |= bool(marks)
            of_metric = [{"filter": f"datum.metric === '{name}'"}]
            here = [row for row in rows if row["metric"] == name]
            curves = _worded(encoding, y, here) if is_worded else _lines(encoding, y, here)
            parts = [{"transform": of_metric, "layer": curves}, *_crosses(marks, "x", x, "y", y)]
            layers.append({"layer": parts})
        if variable == "tau" and paper is not None:
            best = charts.band(*BEST_BAND, "the paper's best band", named=True)
            layers[0]["layer"].insert(0, best)
        spec = charts.layered(*layers, rows=rows, height=LINES_PX)
        spec["resolve"] = {"scale": {"y": "independent"}}
        caption = (BARS if is_worded else BANDS) + CROSSES * has_marks
        drawn.append(_chart(_sentence(f"{IN_WORDS[metric]} over {label}"), spec, caption))
    return drawn


def _curves(
    panel: "pd.DataFrame", metrics: Mapping[str, str], colours: Mapping[tuple[str, str], str]
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the rows of a panel's curves, and the colour of each curve by its name."""
    rows, of_names = list[dict[str, Any]](), dict[str, str]()
    has_several = panel.source.nunique() > 1
    for source, condition in dict.fromkeys(zip(panel.source, panel.condition, strict=True)):
        curve = panel[(panel.source == source) & (panel.condition == condition)]
        name = f"{source}, {condition}" if has_several else str(condition)
        kind = interval_of(curve)
        for n, (metric, words) in enumerate(metrics.items()):
            label = f"{words}, {name}"
            of_names[label] = GREY if n else colours[source, condition]
            here = curve[(curve.metric == metric) & (curve.interval == kind)]
            for row in here.to_dict("records"):
                value, share = row["value"], _estimate(row, 100.0)
                share["share"] = share.pop("value")
                rows.append({"value": value, "curve": label, "metric": metric, **share})
    return rows, of_names


def _lines(encoding: Mapping[str, Spec], y: Spec, rows: charts.Rows) -> list[Spec]:
    """Return the layers of curves along numbers: bands, lines and points."""
    line = {name: encoding[name] for name in ("x", "color")}
    ends = {"y": {**y, "field": "low"}, "y2": {"field": "high"}}
    band: Spec = {"mark": {"type": "area", "opacity": 0.18}, "encoding": {**line, **ends}}
    return [
        *_interval_layers(rows, band),
        {"mark": {"type": "line", "strokeWidth": 1.5}, "encoding": {**line, "y": y}},
        point(30, **encoding, y=y, tooltip=charts.tooltip(rows)),
    ]


def _worded(encoding: Mapping[str, Spec], y: Spec, rows: charts.Rows) -> list[Spec]:
    """Return the layers of estimates along names: lines for intervals, and points."""
    beside = {**encoding, "xOffset": {"field": "curve", "sort": None}}
    rule = {name: each for name, each in beside.items() if name != "shape"}
    ends = {"y": {**y, "field": "low"}, "y2": {"field": "high"}}
    points = point(50, **beside, y=y, tooltip=charts.tooltip(rows))
    return [*_interval_layers(rows, interval(**rule, **ends)), points]


def heat_map(
    panels: Mapping[str, Floats],
    rows: Sequence[str],
    columns: Sequence[str],
    row: str = "",
    column: str = "",
) -> Sequence[Chart]:
    """Draw a table of coloured cells for each panel, each with its number."""
    every = np.concatenate([percent.ravel() for percent in panels.values()])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    shades = {"domain": [low - 0.1 * (high - low) - 1, high + 1], "range": list(SHADES)}
    is_dark = f"datum.percent > {low + 0.8 * (high - low)}" if high > low else "false"
    ink = {"condition": {"test": is_dark, "value": WHITE}, "value": ON_DATA}
    x = {**_names("column", columns), "title": column or None, "axis": {"labelAngle": -40}}
    places = {"x": x, "y": {**_names("row", rows), "title": row or None}}
    fill = {"field": "percent", **NUMBER, "scale": shades, "legend": None}
    number = {"field": "percent", **NUMBER, "format": ".0f"}
    drawn = []
    for title, percent in panels.items():
        cells = []
        for (i, j), value in np.ndenumerate(percent):
            names = {"row": rows[i], "column": columns[j]}
            cells.append({**names, "percent": number_or_none(float(value))})
        tip = charts.tooltip(cells)
        layers: list[Spec] = [
            {"mark": "rect", "encoding": {**places, "color": fill, "tooltip": tip}},
            {"mark": "text", "encoding": {**places, "text": number, "color": ink}},
        ]
        spec = charts.layered(*layers, rows=cells, height=CELL_PX * len(rows))
        drawn.append(_chart(title, spec, "Success, %."))
    return drawn


def fronts(panels: Sequence[tuple[str, str, Sequence[Steps]]], success: str) -> Sequence[Chart]:
    """Draw step curves of success against a cost, a chart for each of `panels`."""
    drawn = []
    for title, cost, lines in panels:
        rows, layers = list[dict[str, Any]](), list[Spec]()
        by_label = {line.label: line.colour for line in lines if line.label}
        x = charts.x_axis("cost", cost)
        y = {"field": "success", **NUMBER, "title": f"{success}, %", "scale": {"zero": False}}
        for n, line in enumerate(lines):
            for at, height in zip(line.x, line.y, strict=True):
                place = {"cost": float(at), "success": float(height)}
                rows.append({"curve": line.label or line.name, "line": n, **place})
        tip, legend = charts.tooltip(rows), colour("", by_label)
        for n, line in enumerate(lines):
            encoding: Spec = {"x": x, "y": y, "color": {"value": line.colour}}
            if line.label:
                named = {"datum": line.label, "type": "nominal", "legend": legend["legend"]}
                encoding["color"] = {**named, "scale": legend["scale"]}
                encoding["shape"] = {**named, "scale": {"domain": list(by_label)}}
            layers.append(_steps(n, line, encoding, tip))
        spec = charts.layered(*layers, rows=rows, height=LINES_PX)
        drawn.append(_chart(f"{title}: {success} over {cost}" if title else cost, spec))
    return drawn


def _steps(n: int, line: Steps, encoding: Spec, tip: list[Spec]) -> Spec:
    marks: list[Spec] = []
    if line.line:
        steps = {"type": "line", "interpolate": "step-after", "strokeWidth": 1.3}
        steps |= {"strokeDash": DASHES[line.line]} if line.line in DASHES else {}
        joined = {name: each for name, each in encoding.items() if name != "shape"}
        marks.append({"mark": steps, "encoding": joined})
    if line.marker:
        size = round(2.5 * line.size**2)
        marks.append(point(size, **encoding, tooltip=tip))
    if line.name:
        text = {**NAME, "align": "right", "dx": -4}
        last = {"filter": f"datum.cost === {float(line.x[-1])}"}
        named = {"x": encoding["x"], "y": encoding["y"], "text": {"field": "curve"}}
        marks.append({"transform": [last], "mark": text, "encoding": named})
    return {"transform": [{"filter": f"datum.line === {n}"}], "layer": marks}


def intervals(panels: Sequence[Rows], colours: Mapping[str, str]) -> Sequence[Chart]:
    """Draw points with lines for their intervals, a chart for each of `panels`."""
    drawn = []
    for panel in panels:
        rows, ends = list[dict[str, Any]](), [0.0, panel.scale]
        for series, estimates in panel.series.items():
            for name, each in zip(panel.names, estimates, strict=True):
                if each is None or np.isnan(each.value):
                    continue
                row = {"mean": each.value, "ci_low": each.low, "ci_high": each.high}
                rows.append({"name": name, "series": series, **_estimate(row, panel.scale)})
        for row in rows:
            ends += [end for end in (row["value"], row["low"], row["high"]) if end is not None]
        scale = {"domain": [min(ends), max(ends)], "nice": True}
        x = {"field": "value", **NUMBER, "title": None, "scale": scale}
        by_name = {series: colours[series] for series in panel.series}
        place = {
            "y": _names("name", panel.names),
            "yOffset": {"field": "series", "scale": {"domain": list(panel.series)}},
            "color": colour("series", by_name),
        }
        spread = interval(x={**x, "field": "low"}, x2={"field": "high"}, **place)
        tip = charts.tooltip(rows)
        shape = {"field": "series", "type": "nominal", "scale": {"domain": list(by_name)}}
        points = point(45, x=x, **place, shape=shape, tooltip=tip)
        height = len(panel.names) * (8 + 12 * len(panel.series))
        spec = charts.layered(*_interval_layers(rows, spread), points, rows=rows, height=height)
        drawn.append(_chart(panel.quantity, spec, BARS))
    return drawn


def _estimate(row: Mapping[Any, Any], scale: float) -> dict[str, Any]:
    """Return a mean and the ends of its interval, times `scale`; None for what is unknown."""
    names = {"value": "mean", "low": "ci_low", "high": "ci_high"}
    return {name: number_or_none(scale * row[column]) for name, column in names.items()}


def _interval_layers(rows: charts.Rows, ends: Spec) -> list[Spec]:
    """Return the layer that draws the ends of intervals, where any is known."""
    return [ends] if any(row["low"] is not None for row in rows) else []


def _names(field: str, names: Sequence[str]) -> Spec:
    """Return the encoding of a field of names, in their order."""
    return {**names_axis(field), "scale": {"domain": list(names)}}


def _coloured(field: str, colours: Mapping[str, str]) -> Spec:
    """Return the encoding of a field by colour, whose legend is as dark where bands are pale."""
    encoding = colour(field, colours)
    return {**encoding, "legend": {**encoding["legend"], "symbolOpacity": 1}}


def _chart(title: str, spec: Spec, caption: str = "") -> Chart:
    return Chart(title, _on_page(spec), caption)


def _sentence(title: str) -> str:
    return f"{title[:1].upper()}{title[1:]}"


def _on_page(value: Any) -> Any:
    """Return a part of a chart without names of JavaScript objects, and light on dark paper."""
    if isinstance(value, str):
        return "currentColor" if value == INK else f"{value} " if value in TAKEN else value
    if isinstance(value, dict):
        return {name: _on_page(each) for name, each in value.items()}
    return [_on_page(each) for each in value] if isinstance(value, list) else value
