"""The report's charts, as Vega-Lite specifications: https://vega.github.io/vega-lite/docs/spec.html."""

from collections.abc import Mapping, Sequence

from harness.report.drawing.colours import BLUE, ORANGE, PURPLE, SKY, VERMILLION
from harness.report.layers import (
    BASE,
    NUMBER,
    RULE,
    Rows,
    Spec,
    band,
    colours_of,
    interval,
    layered,
    rules_at,
    shapes_of,
    share_axis,
    tooltip,
    x_axis,
)

REACTION_MS = (150, 250)  # the paper's reaction window in an urban intersection
VERDICTS = {
    "strict": [BLUE],
    "recovered": [SKY],
    "failed": [VERMILLION, ORANGE, PURPLE, "#8C510A", "#F0E442", "#B2A1C7", "#999999"],
}
REPLIES = {"on time": BLUE, "late": ORANGE, "lost": VERMILLION}


def success_latency(rows: Rows, references: Mapping[str, float]) -> Spec:
    """Success over latency, a point a run and condition; reference drivers are lines."""
    colour = colours_of(rows, "condition")
    shape = shapes_of(rows, "run" if len({row["run"] for row in rows}) > 1 else "condition")
    x, y = x_axis("latency_ms", "latency of a decision, ms"), share_axis("success", "success rate")
    known = {key for row in rows for key, value in row.items() if value is not None}
    intervals = {
        "low": interval(x=x, y={**y, "field": "low"}, y2={"field": "high"}, color=colour),
        "latency_low": interval(
            x={**x, "field": "latency_low"}, x2={"field": "latency_high"}, y=y, color=colour
        ),
    }
    return layered(
        band(*REACTION_MS, "reaction window, 150 to 250 ms"),
        _references(references, y),
        *(one for end, one in intervals.items() if end in known),
        {
            "mark": {"type": "point", "filled": True, "size": 90, "opacity": 1},
            "encoding": {"x": x, "y": y, "color": colour, "shape": shape, "tooltip": tooltip(rows)},
        },
        rows=rows,
        height=320,
    )


def _references(success: Mapping[str, float], y: Spec) -> Spec:
    """A dashed line for each value, named after all that have it."""
    named: dict[float, list[str]] = {}
    for name, value in success.items():
        named.setdefault(value, []).append(name)
    text = {"type": "text", "align": "right", "dy": -5, "dx": -4, "color": "currentColor"}
    at_edge = {"x": {"value": "width"}, "text": {"field": "drivers"}}
    return {
        "data": {"values": [{"drivers": ", ".join(of), "success": value} for value, of in named.items()]},
        "layer": [
            {"mark": {**RULE, "opacity": 0.6}, "encoding": {"y": y}},
            {"mark": text, "encoding": {"y": y, **at_edge}},
        ],
    }


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
    return _stacked(rows, "role", "status", [status for _, status in met], colours, "answers")


def replies(rows: Rows) -> Spec:
    """On time, late and lost replies, a stacked bar a run and condition."""
    return _stacked(rows, "condition", "reply", list(REPLIES), list(REPLIES.values()), "replies")


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
    return _bars(rows, "tokens", "tokens in the prompt", "prompts", width, series="role", within=budget)


def arrivals(rows: Rows, window_ms: Sequence[float], width: float) -> Spec:
    """When replies arrive, and when the decision window closes."""
    title = "arrival, ms from the start of the decision"
    return _bars(rows, "arrival_ms", title, "replies", width, series="condition", rules=window_ms)


def _stacked(
    rows: Rows, by: str, field: str, domain: Sequence[str], colours: Sequence[str], what: str
) -> Spec:
    """A bar a run and `by`, in parts of the values of a field, in their order in `domain`."""
    several = len({row["run"] for row in rows}) > 1
    bars = [
        {
            **row,
            "bar": f"{row['run']}: {row[by]}" if several else str(row[by]),
            "order": domain.index(row[field]),
        }
        for row in rows
    ]
    x = {"field": "share", **NUMBER, "stack": "zero", "title": what, "axis": {"format": "%"}}
    return {
        **BASE,
        "height": 26 * len({bar["bar"] for bar in bars}),
        "data": {"name": "values", "values": bars},
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
            "tooltip": tooltip(bars),
        },
    }  # fmt: skip


def _shares(
    rows: Rows, field: str, title: str, what: str, diagonal: bool = False, rules: Sequence[float] = ()
) -> Spec:
    x, y, colour = x_axis(field, title), share_axis("share", what), colours_of(rows, "condition")
    if not diagonal:
        y["scale"] = {"zero": True, "nice": True}
    layers: list[Spec] = [
        interval(x=x, y={**y, "field": "low"}, y2={"field": "high"}, color=colour),
        {"mark": {"type": "line", "strokeWidth": 1.5}, "encoding": {"x": x, "y": y, "color": colour}},
        {
            "mark": {"type": "point", "filled": True, "size": 55, "opacity": 1},
            "encoding": {
                "x": x, "y": y, "color": colour, "tooltip": tooltip(rows),
                "shape": shapes_of(rows, "condition"),
            },
        },
    ]  # fmt: skip
    if diagonal:
        ends = [{field: end, "share": end} for end in (0.3, 1.0)]
        line = {"mark": {**RULE, "type": "line"}, "encoding": {"x": x, "y": y}}
        layers.insert(0, {"data": {"values": ends}, **line})
    return layered(*rules_at(field, rules), *layers, rows=rows, choose=True)


def _bars(
    rows: Rows, field: str, title: str, what: str, width: float, *,
    series: str = "", rules: Sequence[float] = (), within: tuple[float, float] | None = None,
) -> Spec:  # fmt: skip
    bars = [{**row, "to": row[field] + width} for row in rows]
    encoding: Spec = {
        "x": {**x_axis(field, title), "bin": {"binned": True, "step": width}},
        "x2": {"field": "to"},
        "y": {"field": "count", **NUMBER, "title": what, "stack": None},
        "tooltip": tooltip(rows),
    }
    mark: Spec = {"type": "bar", "opacity": 0.75, "color": BLUE}
    if series:
        encoding["color"] = colours_of(rows, series)
    layers: list[Spec] = [{"mark": mark, "encoding": encoding}]
    if within:
        layers.insert(0, band(*within, f"budget, {within[0]} to {within[1]} tokens"))
    return layered(*layers, *rules_at(field, rules), rows=bars, choose=True)
