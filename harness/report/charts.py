"""The report's charts, as Vega-Lite specifications:
https://vega.github.io/vega-lite/docs/spec.html.

Colours are those of the palette (`drawing/colours.py`), and shape or place says the same again.
What is drawn in `currentColor` is light on dark and dark on light.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from harness.report.drawing import colours
from harness.report.drawing.colours import BAD, FAILURES, GOOD, GREY, LATE, PALE, ROLES

Spec = dict[str, Any]
Rows = Sequence[Mapping[str, Any]]

# Vega keeps some groups by name in JavaScript objects, in which these are there from the start.
TAKEN = {
    "__proto__",
    "constructor",
    "hasOwnProperty",
    "isPrototypeOf",
    "propertyIsEnumerable",
    "toLocaleString",
    "toString",
    "valueOf",
    "__defineGetter__",
    "__defineSetter__",
    "__lookupGetter__",
    "__lookupSetter__",
}
RULE: Spec = {"type": "rule", "color": "currentColor", "strokeDash": [4, 3]}
NAME: Spec = {
    "type": "text",
    "align": "left",
    "dx": 4,
    "dy": -8,
    "color": "currentColor",
    "opacity": 0.8,
    "fontSize": 10.5,
}
FOOT: Spec = {"y": {"value": "height"}}
RUN = "run"  # name of the parameter that chooses one of several runs
NUMBER: Spec = {"type": "quantitative"}
BASE: Spec = {"$schema": "https://vega.github.io/schema/vega-lite/v5.json", "width": "container"}
REACTION_MS = (150, 250)  # the paper's reaction window in an urban intersection
VERDICTS = {"strict": [GOOD], "recovered": [LATE], "failed": FAILURES}
REPLIES = {"on time": GOOD, "late": LATE, "lost": BAD}
TIMES = {
    "inference": PALE,
    "reply on time": GOOD,
    "reply late": LATE,
    "reply lost": BAD,
    "fusion": ROLES["fusion"],
    "decision": GREY,
}
APART = 0.05  # of success between two names of lines, the height of one
# The paper's table of operating points: ms and success rate.
PAPER = {"single-local": (145.0, 0.689), "v2x": (218.9, 0.835), "6g": (151.4, 0.941)}


def success_latency(
    rows: Rows, references: Mapping[str, float], window_ms: Sequence[float], label: str
) -> Spec:
    """Return a scatter plot of success over latency in ms: a point for each run and condition.

    Args:
        rows: one for each point, with `run`, `condition`, `latency_ms`, `success`, the ends of
            their intervals and `n` (`panels.success`).
        references: success, from 0 to 1, of each reference driver (a rule without a model) by its
            label, drawn as horizontal lines.
        window_ms: decision windows, the times in which replies count, drawn as vertical lines.
        label: the metric of success in words, such as balanced success.
    """
    untitled = {"legend": {"orient": "top", "title": None}}
    several_runs = len({row["run"] for row in rows}) > 1
    condition = condition_colours(rows) | untitled
    shape = shapes_of(rows, "run" if several_runs else "condition") | untitled
    x, y = x_axis("latency_ms", "latency of a decision, ms"), share_axis("success", f"{label} rate")
    conditions = dict.fromkeys(str(row["condition"]) for row in rows)
    layers = [
        band(*REACTION_MS, "the paper's reaction window", named=True),
        _references(references, y),
        *rules_at("latency_ms", window_ms, "decision window"),
        *_paper(conditions, x, y, condition),
    ]
    if any(row.get("low") is not None for row in rows):
        low, high = {**y, "field": "low"}, {"field": "high"}
        layers.append(interval(x=x, y=low, y2=high, color=condition))
    if any(row.get("latency_low") is not None for row in rows):
        low, high = {**x, "field": "latency_low"}, {"field": "latency_high"}
        layers.append(interval(x=low, x2=high, y=y, color=condition))
    layers.append(point(110, x=x, y=y, color=condition, shape=shape, tooltip=tooltip(rows)))
    return layered(*layers, rows=rows, height=300)


def _paper(conditions: Iterable[str], x: Spec, y: Spec, colour: Spec) -> list[Spec]:
    """Return what the paper reports for its own operating points, as a ring in their colour."""
    values = []
    for name in conditions:
        if name in PAPER:
            latency_ms, success = PAPER[name]
            row = {"paper": "paper", "condition": name, "latency_ms": latency_ms}
            values.append({**row, "success": success})
    if not values:
        return []
    ring = {
        "type": "point",
        "shape": "circle",
        "filled": False,
        "opacity": 1,
        "size": 60,
    }
    text = {key: value for key, value in NAME.items() if key != "dy"} | {"dx": 7}
    tip = {"tooltip": [{"field": name} for name in ("condition", "latency_ms", "success")]}
    layer = [
        {"mark": ring, "encoding": {"x": x, "y": y, "color": colour, **tip}},
        {"mark": text, "encoding": {"x": x, "y": y, "text": {"field": "paper"}}},
    ]
    return [{"data": {"values": values}, "layer": layer}]


def _references(success: Mapping[str, float], y: Spec) -> Spec:
    """Return a dashed line for each value;
    names of lines too near for one each stand above the highest.
    """
    lines: list[dict[str, Any]] = [
        {"reference": name, "success": success[name]}
        for name in sorted(success, key=lambda n: -success[n])
    ]
    names: list[dict[str, Any]] = []
    for above, line in zip([None, *lines], lines, strict=False):
        if above and above["success"] - line["success"] < APART:
            names[-1]["named"] += f", {line['reference']}"
        else:
            names.append({"named": line["reference"], "success": line["success"]})
    text = {"type": "text", "align": "right", "dy": -5, "dx": -4, "color": "currentColor"}
    tip = {"tooltip": [{"field": name} for name in ("reference", "success")]}
    named = {"y": y, "x": {"value": "width"}, "text": {"field": "named"}}
    rules: Spec = {
        "data": {"values": lines},
        "mark": {**RULE, "opacity": 0.6},
        "encoding": {"y": y, **tip},
    }
    labels: Spec = {"data": {"values": names}, "mark": text, "encoding": named}
    return {"layer": [rules, labels]}


def statuses(rows: Rows) -> Spec:
    """Return a chart of how answers were parsed: one stacked bar for each run and role.

    Each of `rows` is a part of a bar: `run`, the run's name, `role`, who answered, `status`, the
    outcome of parsing such as `strict` or `bad_sum`, `count`, the number of answers, and `share`,
    of all in that role.
    """
    statuses: dict[str, dict[str, None]] = {verdict: {} for verdict in VERDICTS}
    for row in rows:
        # A run's file may say anything; what is no verdict is no answer.
        verdict = row["verdict"] if row["verdict"] in VERDICTS else "failed"
        statuses[verdict][str(row["status"])] = None
    colours = {}
    for verdict, shades in VERDICTS.items():
        for n, status in enumerate(statuses[verdict]):
            colours[status] = shades[n % len(shades)]
    return stacked(rows, "role", "status", colours, "answers")


def policies(actions: Sequence[str]) -> Spec:
    """Return a bar chart of the probability distributions in one decision, before and after fusion.

    `actions` are the names of the actions, in order. It has no data: the page's script fills in
    rows of `who`, `what`, `action` and `p`.
    """
    scale = {"domain": list(actions), "range": list(colours.actions(actions).values())}
    return {
        **BASE,
        "data": {"name": "values", "values": []},
        "mark": {"type": "bar", "height": {"band": 0.8}, "stroke": GREY, "strokeWidth": 0.7},
        "encoding": {
            "y": names_axis("who"),
            "yOffset": {"field": "action", "sort": None},
            "x": {**x_axis("p", "probability"), "scale": {"domain": [0, 1]}},
            "color": {
                "field": "action",
                "type": "nominal",
                "sort": None,
                "scale": scale,
                "legend": {"orient": "top", "title": None},
            },
            "tooltip": [{"field": f} for f in ("who", "what", "action", "p")],
        },
    }


def timeline() -> Spec:
    """Return a chart of the phases of one decision over time, in ms.

    It has no data: the page's script fills in rows of `who`, `what`, `from` and `to`, and a row
    with `window`, the time in which replies count.
    """
    spans: Spec = {
        "mark": {"type": "bar", "height": 9, "cornerRadius": 2},
        "encoding": {
            "x": {"field": "from", **NUMBER, "title": "ms from the start of the decision"},
            "x2": {"field": "to"},
            "y": names_axis("who"),
            "color": colour("what", TIMES),
            "tooltip": [{"field": field} for field in ("who", "what", "from", "to")],
        },
    }
    window: Spec = {
        "data": {"name": "window", "values": []},
        "mark": RULE,
        "encoding": {"x": {"field": "window_ms", **NUMBER}, "tooltip": {"field": "what"}},
    }
    return layered(spans, window, rows=[])


def stacked(
    rows: Rows, by: str, field: str, colours: Mapping[str, str], what: str, amount: str = "share"
) -> Spec:
    """Return a chart of stacked bars: one for each run and value of the rows' field `by`.

    Rows have the run's name as `run`. A bar's segments are the values of the field `field`, in the
    order and colours of `colours`, a colour by value. Their lengths are the rows' field `amount`,
    by default shares, which are shown in percent. `what` is the axis title.
    """
    several_runs, order = len({row["run"] for row in rows}) > 1, list(colours)
    bars = []
    for row in rows:
        name = f"{row['run']}: {row[by]}" if several_runs else str(row[by])
        bars.append({**row, "bar": name, "order": order.index(row[field])})
    x = {"field": amount, **NUMBER, "stack": "zero", "title": what}
    if amount == "share":
        x |= {"axis": {"format": "%"}, "scale": {"domain": [0, 1]}}
    encoding = {
        "y": {**names_axis("bar"), "axis": {"labelLimit": 260}},
        "x": x,
        "color": colour(field, colours),
        "order": {"field": "order"},
        "tooltip": tooltip(bars),
    }
    return {
        **BASE,
        "height": 26 * len({bar["bar"] for bar in bars}),
        "data": {"name": "values", "values": bars},
        "mark": {"type": "bar", "stroke": "white", "strokeWidth": 0.6},
        "encoding": encoding,
    }


def shares(
    rows: Rows,
    field: str,
    title: str,
    what: str,
    diagonal: bool = False,
    rules: Sequence[float] = (),
) -> Spec:
    """Return a line chart of the rows' `share` over a numeric field, with intervals.

    There is one line for each value of the rows' field `condition`. `field` is the name of the
    numeric one, `title` and `what` are the titles of the x and y axes, `rules` the x of vertical
    lines; `diagonal` adds the line on which x and y are equal.
    """
    x, y = x_axis(field, title), share_axis("share", what)
    condition, shape = condition_colours(rows), shapes_of(rows, "condition")
    if not diagonal:
        y["scale"] = {"zero": True, "nice": True}
    layers: list[Spec] = [
        interval(x=x, y={**y, "field": "low"}, y2={"field": "high"}, color=condition),
        {
            "mark": {"type": "line", "strokeWidth": 1.5},
            "encoding": {"x": x, "y": y, "color": condition},
        },
        point(55, x=x, y=y, color=condition, tooltip=tooltip(rows), shape=shape),
    ]
    if diagonal:
        ends = [{field: end, "share": end} for end in (0.3, 1.0)]
        line = {"mark": {**RULE, "type": "line"}, "encoding": {"x": x, "y": y}}
        layers.insert(0, {"data": {"values": ends}, **line})
    return layered(*rules_at(field, rules), *layers, rows=rows, choose=True)


def bars(
    rows: Rows,
    field: str,
    title: str,
    what: str,
    width: float,
    *,
    series: str = "",
    rules: Sequence[float] = (),
    within: tuple[float, float] | None = None,
) -> Spec:
    """Return a histogram of the rows' `count` over a numeric field, whose bins begin at its values.

    Args:
        rows: one for each bin.
        field: the field with the lower end of the bin.
        title: title of the x axis.
        what: title of the y axis.
        width: width of every bin.
        series: `role` or `condition`, to colour bars by that field; empty for one colour.
        rules: x of vertical dashed lines.
        within: both ends of a range to shade, in tokens; None for none.
    """
    bars = [{**row, "to": row[field] + width} for row in rows]
    encoding: Spec = {
        "x": {**x_axis(field, title), "bin": {"binned": True, "step": width}},
        "x2": {"field": "to"},
        "y": {"field": "count", **NUMBER, "title": what, "stack": None},
        "tooltip": tooltip(rows),
    }
    mark: Spec = {"type": "bar", "opacity": 0.75, "color": ROLES["ego"]}
    if series == "role":
        roles = {row["role"] for row in rows}
        encoding["color"] = colour("role", {name: c for name, c in ROLES.items() if name in roles})
    elif series:
        encoding["color"] = condition_colours(rows)
    layers: list[Spec] = [{"mark": mark, "encoding": encoding}]
    if within:
        layers.insert(0, band(*within, f"budget, {within[0]} to {within[1]} tokens"))
    return layered(*layers, *rules_at(field, rules), rows=bars, choose=True)


def named(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row whose texts that are names of JavaScript objects (`TAKEN`) end with a space.

    Vega would mistake them otherwise.
    """
    return {key: f"{value} " if value in TAKEN else value for key, value in row.items()}


def layered(*layers: Spec, rows: Rows, height: int = 260, choose: bool = False) -> Spec:
    """Return a chart of layers, Vega-Lite specifications, that share one table of rows.

    `choose` adds a selector of the run if the rows are of several, by their field `run`; `height`
    is in pixels.
    """
    runs = list(dict.fromkeys(str(row["run"]) for row in rows if "run" in row))
    data = {"name": "values", "values": list(rows)}
    chart: Spec = {**BASE, "height": height, "data": data, "layer": [*layers]}
    if choose and len(runs) > 1:
        bind = {"input": "select", "options": runs, "name": "run "}
        chart["params"] = [{"name": RUN, "value": runs[0], "bind": bind}]
        chart["transform"] = [{"filter": f"!isValid(datum.run) || datum.run === {RUN}"}]
    return chart


def x_axis(field: str, title: str) -> Spec:
    """Return the Vega-Lite encoding of a numeric field on the x axis, which need not begin at 0.

    `field` is its name in the rows of the chart, and `title` that of the axis.
    """
    axis = {"labelOverlap": True, "tickCount": 8}
    return {
        "field": field,
        **NUMBER,
        "title": title,
        "axis": axis,
        "scale": {"zero": False, "nice": True},
    }


def share_axis(field: str, title: str) -> Spec:
    """Return the Vega-Lite encoding of a field from 0 to 1 on the y axis, shown in percent.

    `field` is its name in the rows of the chart, and `title` that of the axis.
    """
    return {
        "field": field,
        **NUMBER,
        "title": title,
        "axis": {"format": "%"},
        "scale": {"domain": [0, 1]},
    }


def colour(field: str, colours: Mapping[str, str]) -> Spec:
    """Return the Vega-Lite encoding of a field by colour; the legend has no title.

    `field` is its name in the rows of the chart, and `colours` maps each value of it to its colour.
    """
    return {
        "field": field,
        "type": "nominal",
        "scale": {"domain": list(colours), "range": list(colours.values())},
        "legend": {"orient": "top", "title": None},
    }


def condition_colours(rows: Rows) -> Spec:
    """Return the Vega-Lite encoding of the rows' field `condition` by colour.

    A condition is a named set of settings under which decisions are played; each has one colour.
    """
    shapes = shapes_of(rows, "condition")
    by_name = colours.conditions(shapes["scale"]["domain"])
    return {**shapes, "scale": {**shapes["scale"], "range": list(by_name.values())}}


def shapes_of(rows: Rows, field: str) -> Spec:
    """Return the Vega-Lite encoding of a field by the shape of points.

    `field` is its name in `rows`; values are in the order of these. The legend is that of
    `condition_colours`, so that a chart with both has one.
    """
    domain = list(dict.fromkeys(str(row[field]) for row in rows))
    return {
        "field": field,
        "type": "nominal",
        "scale": {"domain": domain},
        "legend": {"orient": "top"},
    }


def names_axis(field: str) -> Spec:
    """Return the Vega-Lite encoding of a field of names on the y axis, in the order of the rows.

    `field` is its name in the rows of the chart.
    """
    return {"field": field, "type": "nominal", "sort": None, "title": None}


def point(size: int, **encoding: Spec | list[Spec]) -> Spec:
    """Return a layer with a filled point for each row; `size` is its area in square pixels.

    `encoding` has the Vega-Lite encoding of each channel, such as `x`, `y` and `color`.
    """
    return {
        "mark": {"type": "point", "filled": True, "size": size, "opacity": 1},
        "encoding": encoding,
    }


def tooltip(rows: Rows) -> list[Spec]:
    """Return the Vega-Lite encoding of a tooltip that shows every field of the rows."""
    fields = []
    for name, value in (rows[0] if rows else {}).items():
        field = {"field": name}
        if isinstance(value, float):
            field["format"] = ".3~f"
        fields.append(field)
    return fields


def interval(**encoding: Spec) -> Spec:
    """Return a layer that draws a line for each row, from x to x2 or from y to y2.

    `encoding` has the Vega-Lite encoding of each of these channels, such as `x` and `x2`.
    """
    return {"mark": {"type": "rule", "strokeWidth": 1.4}, "encoding": encoding}


def band(start: float, end: float, what: str, named: bool = False) -> Spec:
    """Return a layer that shades x from `start` to `end`, in the unit of the axis.

    `what` is its tooltip; `named` says whether that is also written at its top.
    """
    x: Spec = {"x": {"field": "from", **NUMBER}}
    data = {"data": {"values": [{"from": start, "to": end, "what": what}]}}
    shade: Spec = {
        "mark": {"type": "rect", "color": GREY, "opacity": 0.14},
        "encoding": {**x, "x2": {"field": "to"}, "tooltip": {"field": "what"}},
    }
    name = {"mark": NAME, "encoding": {**x, **FOOT, "text": {"field": "what"}}}
    return {**data, "layer": [shade, name]} if named else {**data, **shade}


def rules_at(field: str, at: Sequence[float], what: str = "") -> list[Spec]:
    """Return layers with a vertical line at each x in `at`; none if there are none.

    They mark times such as the end of a decision window. `field` is the name of the field on the x
    axis. If `what` is given, a line is labelled with it and its x, in ms.
    """
    if not at:
        return []
    values = [{field: value, "what": f"{what}, {value:g} ms"} for value in at]
    data = {"data": {"values": values}}
    x: Spec = {"x": {"field": field, **NUMBER}}
    line: Spec = {"mark": RULE, "encoding": x}
    name = {"mark": {**NAME, "dy": -24}, "encoding": {**x, **FOOT, "text": {"field": "what"}}}
    return [{**data, "layer": [line, name]} if what else {**data, **line}]
