"""The report's charts, as Vega-Lite specifications: https://vega.github.io/vega-lite/docs/spec.html.

Colours are those of Okabe and Ito, which the colour-blind tell apart, and shape or place says the same again.
What is drawn in `currentColor` is light on dark and dark on light.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.drawing.pictures import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION

Spec = dict[str, Any]
Rows = Sequence[Mapping[str, Any]]

SERIES = [BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY]
REACTION_MS = (150, 250)  # the paper's reaction window in an urban intersection
VERDICTS = {
    "strict": [BLUE],
    "recovered": [SKY],
    "failed": [VERMILLION, ORANGE, PURPLE, "#8C510A", "#F0E442", "#B2A1C7", "#999999"],
}
TIMES = {
    "inference": SKY, "reply on time": BLUE, "reply late": ORANGE, "reply lost": VERMILLION, "fusion": PURPLE,
    "decision": GREEN,
}  # fmt: skip
REPLIES = {"on time": BLUE, "late": ORANGE, "lost": VERMILLION}
# Vega keeps some groups by name in JavaScript objects, in which these are there from the start.
TAKEN = {
    "__proto__", "constructor", "hasOwnProperty", "isPrototypeOf", "propertyIsEnumerable", "toLocaleString",
    "toString", "valueOf", "__defineGetter__", "__defineSetter__", "__lookupGetter__", "__lookupSetter__",
}  # fmt: skip
RULE: Spec = {"type": "rule", "color": "currentColor", "strokeDash": [4, 3]}
INTERVAL: Spec = {"type": "rule", "strokeWidth": 1.4}
RUN = "run"  # name of the parameter that chooses one of several runs


def named(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row in which no text is one that Vega stumbles over; what is added is not to be seen."""
    return {key: f"{value} " if value in TAKEN else value for key, value in row.items()}


def success_latency(rows: Rows, references: Mapping[str, float]) -> Spec:
    """Success over latency, a point a run and condition; reference drivers are lines."""
    colour = _series(rows, "condition")
    shape = _shape(rows, "run" if len({row["run"] for row in rows}) > 1 else "condition")
    x, y = _x("latency_ms", "latency of a decision, ms"), _y("success", "success rate")
    lines = [{"driver": name, "success": value} for name, value in references.items()]
    at_edge = {"x": {"value": "width"}}
    return _chart(
        _band(*REACTION_MS, "reaction window, 150 to 250 ms"),
        {
            "data": {"values": lines},
            "layer": [
                {"mark": {**RULE, "opacity": 0.6}, "encoding": {"y": y}},
                {
                    "mark": {"type": "text", "align": "right", "dy": -5, "dx": -4, "color": "currentColor"},
                    "encoding": {"y": y, "text": {"field": "driver"}, **at_edge},
                },
            ],
        },
        {
            "mark": INTERVAL,
            "encoding": {"x": x, "y": {**y, "field": "low"}, "y2": {"field": "high"}, "color": colour},
        },
        {
            "mark": INTERVAL,
            "encoding": {
                "x": {**x, "field": "latency_low"}, "x2": {"field": "latency_high"}, "y": y, "color": colour,
            },
        },
        {
            "mark": {"type": "point", "filled": True, "size": 90, "opacity": 1},
            "encoding": {"x": x, "y": y, "color": colour, "shape": shape, "tooltip": _told(rows)},
        },
        rows=rows,
        height=320,
    )  # fmt: skip


def statuses(rows: Rows) -> Spec:
    """Statuses of answers, a stacked bar a run and role."""
    # A run's file may say anything; what is no verdict is no answer.
    verdicts = [str(row["verdict"]) if row["verdict"] in VERDICTS else "failed" for row in rows]
    met = list(dict.fromkeys((v, str(row["status"])) for v, row in zip(verdicts, rows, strict=True)))
    met.sort(key=lambda one: list(VERDICTS).index(one[0]))
    taken = dict.fromkeys(VERDICTS, 0)
    colours = []
    for verdict, _ in met:
        colours.append(VERDICTS[verdict][taken[verdict] % len(VERDICTS[verdict])])
        taken[verdict] += 1
    domain = [status for _, status in met]
    bars = [{**row, "bar": _named(row, rows, "role"), "order": domain.index(row["status"])} for row in rows]
    return _stacked(bars, "status", domain, colours, "answers")


def replies(rows: Rows) -> Spec:
    """On time, late and lost replies, a stacked bar a run and condition."""
    order = list(REPLIES)
    bars = [
        {**row, "bar": _named(row, rows, "condition"), "order": order.index(row["reply"])} for row in rows
    ]
    return _stacked(bars, "reply", order, list(REPLIES.values()), "replies")


def reliability(rows: Rows) -> Spec:
    """How often the action taken was safe over how probable it was held; on the diagonal the two agree."""
    return _shares(rows, "certainty", "fused probability of the action taken", "share safe", diagonal=True)


def errors(rows: Rows, tau_nats: Sequence[float]) -> Spec:
    """Unsafe decisions over the entropy of the ego's own intent."""
    return _shares(
        rows, "entropy_nats", "entropy of the ego's own intent, nats", "share unsafe", rules=tau_nats
    )


def entropies(rows: Rows, tau_nats: Sequence[float], width: float) -> Spec:
    """How uncertain the ego's own answers are, and above which entropy it asks."""
    return _bars(
        rows, "entropy_nats", "entropy of the ego's own intent, nats", "answers", width, rules=tau_nats
    )


def tokens(rows: Rows, budget: tuple[float, float], width: float) -> Spec:
    """Lengths of prompts and the budget for them."""
    return _bars(rows, "tokens", "tokens in the prompt", "prompts", width, series="role", band=budget)


def arrivals(rows: Rows, window_ms: Sequence[float], width: float) -> Spec:
    """When replies arrive, and when the decision window closes."""
    title = "arrival, ms from the start of the decision"
    return _bars(rows, "arrival_ms", title, "replies", width, series="condition", rules=window_ms)


def policies() -> Spec:
    """Distributions before and after fusion; the page fills in `values`: who, what, action, p, order."""
    return {
        **_BASE,
        "data": {"name": "values", "values": []},
        "mark": {"type": "bar", "height": {"band": 0.8}},
        "encoding": {
            "y": {"field": "who", "type": "nominal", "sort": None, "title": None},
            "yOffset": {"field": "action", "sort": None},
            "x": {**_x("p", "probability"), "scale": {"domain": [0, 1]}},
            "color": {
                "field": "action", "type": "nominal", "sort": None,
                "scale": {"range": [VERMILLION, BLUE, GREEN]}, "legend": {"orient": "top", "title": None},
            },
            "tooltip": [{"field": f} for f in ("who", "what", "action", "p")],
        },
    }  # fmt: skip


def timeline() -> Spec:
    """When what happens in a decision; the page fills in `values`: who, what, from, to, and the `window`."""
    return _chart(
        {
            "mark": {"type": "bar", "height": 9, "cornerRadius": 2},
            "encoding": {
                "x": {"field": "from", **_number, "title": "ms from the start of the decision"},
                "x2": {"field": "to"},
                "y": {"field": "who", "type": "nominal", "sort": None, "title": None},
                "color": {
                    "field": "what",
                    "type": "nominal",
                    "scale": {
                        "domain": list(TIMES),
                        "range": list(TIMES.values()),
                    },
                    "legend": {"orient": "top", "title": None},
                },
                "tooltip": [{"field": f} for f in ("who", "what", "from", "to")],
            },
        },
        {
            "data": {"name": "window", "values": []},
            "mark": RULE,
            "encoding": {"x": {"field": "window_ms", **_number}, "tooltip": {"field": "what"}},
        },
        rows=[],
    )


_number: Spec = {"type": "quantitative"}
_BASE: Spec = {
    "$schema": "https://vega.github.io/schema/vega-lite/v6.json",
    "width": "container",
}


def _chart(*layers: Spec, rows: Rows, height: int = 260, choose: bool = False) -> Spec:
    """Layers over one table, one run of which is chosen where there are several."""
    runs = list(dict.fromkeys(str(row["run"]) for row in rows if "run" in row))
    chart: Spec = {
        **_BASE,
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


def _x(field: str, title: str) -> Spec:
    return {"field": field, **_number, "title": title, "scale": {"zero": False, "nice": True}}


def _y(field: str, title: str) -> Spec:
    return {"field": field, **_number, "title": title, "axis": {"format": "%"}, "scale": {"domain": [0, 1]}}


def _series(rows: Rows, field: str) -> Spec:
    domain = list(dict.fromkeys(str(row[field]) for row in rows))
    return {
        "field": field, "type": "nominal", "scale": {"domain": domain, "range": SERIES},
        "legend": {"orient": "top"},
    }  # fmt: skip


def _shape(rows: Rows, field: str) -> Spec:
    """A shape where `_series` has a colour; of one field, both have one legend."""
    domain = list(dict.fromkeys(str(row[field]) for row in rows))
    return {"field": field, "type": "nominal", "scale": {"domain": domain}, "legend": {"orient": "top"}}


def _told(rows: Rows) -> list[Spec]:
    """Every field of a table in its tooltip."""
    return [
        {"field": name, "format": ".3~f"} if isinstance(value, float) else {"field": name}
        for name, value in (rows[0] if rows else {}).items()
    ]


def _named(row: Mapping[str, Any], rows: Rows, field: str) -> str:
    several = len({one["run"] for one in rows}) > 1
    return f"{row['run']}: {row[field]}" if several else str(row[field])


def _stacked(rows: Rows, field: str, domain: Sequence[str], colours: Sequence[str], what: str) -> Spec:
    x = {"field": "share", **_number, "stack": "zero", "title": what, "axis": {"format": "%"}}
    return {
        **_BASE,
        "height": 26 * len({row["bar"] for row in rows}),
        "data": {"name": "values", "values": list(rows)},
        "mark": {"type": "bar", "stroke": "white", "strokeWidth": 0.6},
        "encoding": {
            "y": {
                "field": "bar", "type": "nominal", "sort": None, "title": None, "axis": {"labelLimit": 260},
            },
            "x": {**x, "scale": {"domain": [0, 1]}},
            "color": {
                "field": field, "type": "nominal", "scale": {"domain": list(domain), "range": list(colours)},
                "legend": {"orient": "top", "title": None},
            },
            "order": {"field": "order"},
            "tooltip": _told(rows),
        },
    }  # fmt: skip


def _shares(
    rows: Rows, field: str, title: str, what: str, diagonal: bool = False, rules: Sequence[float] = ()
) -> Spec:
    x, y, colour = _x(field, title), _y("share", what), _series(rows, "condition")
    if not diagonal:
        y["scale"] = {"zero": True, "nice": True}
    layers: list[Spec] = [
        {
            "mark": INTERVAL,
            "encoding": {"x": x, "y": {**y, "field": "low"}, "y2": {"field": "high"}, "color": colour},
        },
        {"mark": {"type": "line", "strokeWidth": 1.5}, "encoding": {"x": x, "y": y, "color": colour}},
        {
            "mark": {"type": "point", "filled": True, "size": 55, "opacity": 1},
            "encoding": {
                "x": x, "y": y, "color": colour, "tooltip": _told(rows),
                "shape": _shape(rows, "condition"),
            },
        },
    ]  # fmt: skip
    if diagonal:
        ends = [{field: end, "share": end} for end in (0.3, 1.0)]
        line = {"mark": {**RULE, "type": "line"}, "encoding": {"x": x, "y": y}}
        layers.insert(0, {"data": {"values": ends}, **line})
    return _chart(*_rules(field, rules), *layers, rows=rows, choose=True)


def _bars(
    rows: Rows, field: str, title: str, what: str, width: float, *,
    series: str = "", rules: Sequence[float] = (), band: tuple[float, float] | None = None,
) -> Spec:  # fmt: skip
    bars = [{**row, "to": row[field] + width} for row in rows]
    encoding: Spec = {
        "x": {**_x(field, title), "bin": {"binned": True, "step": width}},
        "x2": {"field": "to"},
        "y": {"field": "count", **_number, "title": what, "stack": None},
        "tooltip": _told(rows),
    }
    mark: Spec = {"type": "bar", "opacity": 0.75, "color": BLUE}
    if series:
        encoding["color"] = _series(rows, series)
    layers: list[Spec] = [{"mark": mark, "encoding": encoding}]
    if band:
        layers.insert(0, _band(*band, f"budget, {band[0]} to {band[1]} tokens"))
    return _chart(*layers, *_rules(field, rules), rows=bars, choose=True)


def _band(start: float, end: float, what: str) -> Spec:
    """A shaded range of x."""
    return {
        "data": {"values": [{"from": start, "to": end, "what": what}]},
        "mark": {"type": "rect", "color": GREY, "opacity": 0.18},
        "encoding": {
            "x": {"field": "from", **_number}, "x2": {"field": "to"}, "tooltip": {"field": "what"},
        },
    }  # fmt: skip


def _rules(field: str, at: Sequence[float]) -> list[Spec]:
    """Vertical lines."""
    values = [{field: value} for value in at]
    line = {"mark": RULE, "encoding": {"x": {"field": field, **_number}}}
    return [{"data": {"values": values}, **line}] if values else []
