"""What Vega-Lite specifications are made of: scales, marks and layers that the report's charts share.

Colours are those of the palette (`drawing/colours.py`), and shape or place says the same again. What is drawn
in `currentColor` is light on dark and dark on light.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.report.drawing import colours
from harness.report.drawing.colours import GREY

Spec = dict[str, Any]
Rows = Sequence[Mapping[str, Any]]

# Vega keeps some groups by name in JavaScript objects, in which these are there from the start.
TAKEN = {
    "__proto__", "constructor", "hasOwnProperty", "isPrototypeOf", "propertyIsEnumerable", "toLocaleString",
    "toString", "valueOf", "__defineGetter__", "__defineSetter__", "__lookupGetter__", "__lookupSetter__",
}  # fmt: skip
RULE: Spec = {"type": "rule", "color": "currentColor", "strokeDash": [4, 3]}
NAME: Spec = {
    "type": "text", "align": "left", "dx": 4, "dy": -8, "color": "currentColor", "opacity": 0.8,
    "fontSize": 10.5,
}  # fmt: skip
FOOT: Spec = {"y": {"value": "height"}}
RUN = "run"  # name of the parameter that chooses one of several runs
NUMBER: Spec = {"type": "quantitative"}
BASE: Spec = {
    "$schema": "https://vega.github.io/schema/vega-lite/v5.json",
    "width": "container",
}


def named(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row in which no text is one that Vega stumbles over; what is added is not to be seen."""
    return {key: f"{value} " if value in TAKEN else value for key, value in row.items()}


def layered(*layers: Spec, rows: Rows, height: int = 260, choose: bool = False) -> Spec:
    """Layers over one table, one run of which is chosen where there are several."""
    runs = list(dict.fromkeys(str(row["run"]) for row in rows if "run" in row))
    chart: Spec = {
        **BASE,
        "height": height,
        "data": {"name": "values", "values": list(rows)},
        "layer": [*layers],
    }
    if choose and len(runs) > 1:
        chart["params"] = [
            {"name": RUN, "value": runs[0], "bind": {"input": "select", "options": runs, "name": "run "}}
        ]
        chart["transform"] = [{"filter": f"!isValid(datum.run) || datum.run === {RUN}"}]
    return chart


def x_axis(field: str, title: str) -> Spec:
    """A field along x, where its values are."""
    axis = {"labelOverlap": True, "tickCount": 8}
    return {"field": field, **NUMBER, "title": title, "axis": axis, "scale": {"zero": False, "nice": True}}


def share_axis(field: str, title: str) -> Spec:
    """A share along y, from 0 to 100 %."""
    return {"field": field, **NUMBER, "title": title, "axis": {"format": "%"}, "scale": {"domain": [0, 1]}}


def colour(field: str, colours: Mapping[str, str]) -> Spec:
    """A colour for each value of a field, whose name the legend leaves out."""
    return {
        "field": field, "type": "nominal",
        "scale": {"domain": list(colours), "range": list(colours.values())},
        "legend": {"orient": "top", "title": None},
    }  # fmt: skip


def condition_colours(rows: Rows) -> Spec:
    """The colour of each row's condition."""
    shapes = shapes_of(rows, "condition")
    found = colours.conditions(shapes["scale"]["domain"])
    return {**shapes, "scale": {**shapes["scale"], "range": list(found.values())}}


def shapes_of(rows: Rows, field: str) -> Spec:
    """A shape where `condition_colours` has a colour; of one field, both have one legend."""
    domain = list(dict.fromkeys(str(row[field]) for row in rows))
    return {"field": field, "type": "nominal", "scale": {"domain": domain}, "legend": {"orient": "top"}}


def names_axis(field: str) -> Spec:
    """A name a line along y, in the order in which they come."""
    return {"field": field, "type": "nominal", "sort": None, "title": None}


def point(size: int, **encoding: Spec | list[Spec]) -> Spec:
    """A filled point for each row."""
    return {"mark": {"type": "point", "filled": True, "size": size, "opacity": 1}, "encoding": encoding}


def tooltip(rows: Rows) -> list[Spec]:
    """Every field of a table in its tooltip."""
    return [
        {"field": name, "format": ".3~f"} if isinstance(value, float) else {"field": name}
        for name, value in (rows[0] if rows else {}).items()
    ]


def interval(**encoding: Spec) -> Spec:
    """A line from one end of an interval, along x or y, to the other, which is the channel x2 or y2."""
    return {"mark": {"type": "rule", "strokeWidth": 1.4}, "encoding": encoding}


def band(start: float, end: float, what: str, named: bool = False) -> Spec:
    """A shaded range of x, named at its top or by its tooltip alone."""
    x: Spec = {"x": {"field": "from", **NUMBER}}
    shade: Spec = {
        "mark": {"type": "rect", "color": GREY, "opacity": 0.14},
        "encoding": {**x, "x2": {"field": "to"}, "tooltip": {"field": "what"}},
    }
    return (
        {
            "data": {"values": [{"from": start, "to": end, "what": what}]},
            "layer": [shade, {"mark": NAME, "encoding": {**x, **FOOT, "text": {"field": "what"}}}],
        }
        if named
        else {"data": {"values": [{"from": start, "to": end, "what": what}]}, **shade}
    )


def rules_at(field: str, at: Sequence[float], what: str = "") -> list[Spec]:
    """Vertical lines, named at their top where `what` they are is given, in ms."""
    values = [{field: value, "what": f"{what}, {value:g} ms"} for value in at]
    x: Spec = {"x": {"field": field, **NUMBER}}
    line: Spec = {"mark": RULE, "encoding": x}
    if not values:
        return []
    if not what:
        return [{"data": {"values": values}, **line}]
    name = {"mark": {**NAME, "dy": -24}, "encoding": {**x, **FOOT, "text": {"field": "what"}}}
    return [{"data": {"values": values}, "layer": [line, name]}]
