"""The report's charts, as Vega-Lite specifications: https://vega.github.io/vega-lite/docs/spec.html."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from harness.report import statistics
from harness.report.drawing import colours
from harness.report.drawing.colours import BAD, FAILURES, GOOD, GREY, LATE, PALE, ROLES
from harness.report.layers import (
    BASE,
    NUMBER,
    RULE,
    Rows,
    Spec,
    band,
    colour,
    condition_colours,
    interval,
    layered,
    names_axis,
    point,
    rules_at,
    shapes_of,
    share_axis,
    tooltip,
    x_axis,
)

REACTION_MS = (150, 250)  # the paper's reaction window in an urban intersection
VERDICTS = {
    "strict": [GOOD],
    "recovered": [LATE],
    "failed": FAILURES,
}
REPLIES = {"on time": GOOD, "late": LATE, "lost": BAD}
ENERGIES = dict(zip(statistics.ENERGIES, (ROLES["ego"], ROLES["helper"], BAD), strict=True))
TIMES = {
    "inference": PALE, "reply on time": GOOD, "reply late": LATE, "reply lost": BAD, "fusion": ROLES["merge"],
    "decision": GREY,
}  # fmt: skip
APART = 0.05  # of success between two names of lines, the height of one
# The paper's table of operating points: ms and success rate.
PAPER = {"single-local": (145.0, 0.689), "v2x": (218.9, 0.835), "6g": (151.4, 0.941)}


def success_latency(rows: Rows, references: Mapping[str, float], window_ms: Sequence[float]) -> Spec:
    """Success over latency, a point a run and condition, and the paper's; references are lines."""
    condition = condition_colours(rows)
    condition["legend"] = {**condition["legend"], "title": None}
    shape = shapes_of(rows, "run" if len({row["run"] for row in rows}) > 1 else "condition")
    shape["legend"] = {**shape["legend"], "title": None}
    x, y = x_axis("latency_ms", "latency of a decision, ms"), share_axis("success", "success rate")
    present = {key for row in rows for key, value in row.items() if value is not None}
    along_x = {"x": {**x, "field": "latency_low"}, "x2": {"field": "latency_high"}, "y": y}
    along_y = {"x": x, "y": {**y, "field": "low"}, "y2": {"field": "high"}}
    ends = {"low": along_y, "latency_low": along_x}
    return layered(
        band(*REACTION_MS, "reaction window of the paper, 150 to 250 ms", named=True),
        _references(references, y),
        *rules_at("latency_ms", window_ms, "decision window"),
        *_paper(dict.fromkeys(str(row["condition"]) for row in rows), x, y),
        *(interval(**along, color=condition) for end, along in ends.items() if end in present),
        point(110, x=x, y=y, color=condition, shape=shape, tooltip=tooltip(rows)),
        rows=rows,
        height=300,
    )


def _paper(conditions: Iterable[str], x: Spec, y: Spec) -> list[Spec]:
    """What the paper reports for its own operating points, as a ring with its name."""
    values = [
        {"paper": f"paper: {name}", "latency_ms": PAPER[name][0], "success": PAPER[name][1]}
        for name in conditions if name in PAPER
    ]  # fmt: skip
    if not values:
        return []
    ring = {"type": "point", "shape": "circle", "filled": False, "size": 60, "color": "currentColor"}
    text = {
        "type": "text",
        "align": "left",
        "dx": 7,
        "color": "currentColor",
        "opacity": 0.8,
        "fontSize": 10.5,
    }
    said = {"tooltip": [{"field": name} for name in ("paper", "latency_ms", "success")]}
    return [
        {
            "data": {"values": values},
            "layer": [
                {"mark": ring, "encoding": {"x": x, "y": y, **said}},
                {"mark": text, "encoding": {"x": x, "y": y, "text": {"field": "paper"}}},
            ],
        }
    ]


def _references(success: Mapping[str, float], y: Spec) -> Spec:
    """A dashed line for each value; names of lines too near for one each stand above the highest."""
    highest_first = sorted(success.items(), key=lambda of: -of[1])
    lines = [{"reference": name, "success": value} for name, value in highest_first]
    names: list[dict[str, Any]] = []
    for n, (name, value) in enumerate(highest_first):
        if n and highest_first[n - 1][1] - value < APART:
            names[-1]["named"] += f", {name}"
        else:
            names.append({"named": name, "success": value})
    text = {"type": "text", "align": "right", "dy": -5, "dx": -4, "color": "currentColor"}
    said = {"tooltip": [{"field": name} for name in ("reference", "success")]}
    return {
        "layer": [
            {"data": {"values": lines}, "mark": {**RULE, "opacity": 0.6}, "encoding": {"y": y, **said}},
            {
                "data": {"values": names}, "mark": text,
                "encoding": {"y": y, "x": {"value": "width"}, "text": {"field": "named"}},
            },
        ],
    }  # fmt: skip


def statuses(rows: Rows) -> Spec:
    """Statuses of answers, a stacked bar a run and role."""
    # A run's file may say anything; what is no verdict is no answer.
    verdicts = [str(row["verdict"]) if row["verdict"] in VERDICTS else "failed" for row in rows]
    met = list(dict.fromkeys((v, str(row["status"])) for v, row in zip(verdicts, rows, strict=True)))
    met.sort(key=lambda one: list(VERDICTS).index(one[0]))
    taken = dict.fromkeys(VERDICTS, 0)
    colours = {}
    for verdict, status in met:
        colours[status] = VERDICTS[verdict][taken[verdict] % len(VERDICTS[verdict])]
        taken[verdict] += 1
    return _stacked(rows, "role", "status", colours, "answers")


def replies(rows: Rows) -> Spec:
    """On time, late and lost replies, a stacked bar a run and condition."""
    return _stacked(rows, "condition", "reply", REPLIES, "replies")


def energies(rows: Rows) -> Spec:
    """What a decision takes, a stacked bar a run and condition."""
    return _stacked(rows, "condition", "part", ENERGIES, "J per decision", amount="joules")


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


def policies(actions: Sequence[str]) -> Spec:
    """One decision's distributions around fusion; the page fills in `values`: who, what, action, p."""
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
                "field": "action", "type": "nominal", "sort": None, "scale": scale,
                "legend": {"orient": "top", "title": None},
            },
            "tooltip": [{"field": f} for f in ("who", "what", "action", "p")],
        },
    }  # fmt: skip


def timeline() -> Spec:
    """When what happens in one decision; the page fills in `values`: who, what, from, to; and `window`."""
    return layered(
        {
            "mark": {"type": "bar", "height": 9, "cornerRadius": 2},
            "encoding": {
                "x": {"field": "from", **NUMBER, "title": "ms from the start of the decision"},
                "x2": {"field": "to"},
                "y": names_axis("who"),
                "color": colour("what", TIMES),
                "tooltip": [{"field": f} for f in ("who", "what", "from", "to")],
            },
        },
        {
            "data": {"name": "window", "values": []},
            "mark": RULE,
            "encoding": {"x": {"field": "window_ms", **NUMBER}, "tooltip": {"field": "what"}},
        },
        rows=[],
    )


def _stacked(
    rows: Rows, by: str, field: str, colours: Mapping[str, str], what: str, amount: str = "share"
) -> Spec:
    """A bar a run and `by`, in parts of the values of a field, in the order of their colours.

    Their lengths are shares, or another `amount` of the rows.
    """
    several = len({row["run"] for row in rows}) > 1
    bars = [
        {
            **row,
            "bar": f"{row['run']}: {row[by]}" if several else str(row[by]),
            "order": list(colours).index(row[field]),
        }
        for row in rows
    ]
    x = {"field": amount, **NUMBER, "stack": "zero", "title": what}
    if amount == "share":
        x |= {"axis": {"format": "%"}, "scale": {"domain": [0, 1]}}
    return {
        **BASE,
        "height": 26 * len({bar["bar"] for bar in bars}),
        "data": {"name": "values", "values": bars},
        "mark": {"type": "bar", "stroke": "white", "strokeWidth": 0.6},
        "encoding": {
            "y": {**names_axis("bar"), "axis": {"labelLimit": 260}},
            "x": x,
            "color": colour(field, colours),
            "order": {"field": "order"},
            "tooltip": tooltip(bars),
        },
    }


def _shares(
    rows: Rows, field: str, title: str, what: str, diagonal: bool = False, rules: Sequence[float] = ()
) -> Spec:
    x, y = x_axis(field, title), share_axis("share", what)
    condition, shape = condition_colours(rows), shapes_of(rows, "condition")
    if not diagonal:
        y["scale"] = {"zero": True, "nice": True}
    layers: list[Spec] = [
        interval(x=x, y={**y, "field": "low"}, y2={"field": "high"}, color=condition),
        {"mark": {"type": "line", "strokeWidth": 1.5}, "encoding": {"x": x, "y": y, "color": condition}},
        point(55, x=x, y=y, color=condition, tooltip=tooltip(rows), shape=shape),
    ]
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
    met = {row[series] for row in rows} if series else set()
    encoding: Spec = {
        "x": {**x_axis(field, title), "bin": {"binned": True, "step": width}},
        "x2": {"field": "to"},
        "y": {"field": "count", **NUMBER, "title": what, "stack": None},
        "tooltip": tooltip(rows),
    }
    mark: Spec = {"type": "bar", "opacity": 0.75, "color": ROLES["ego"]}
    if series == "role":
        encoding["color"] = colour("role", {role: c for role, c in ROLES.items() if role in met})
    elif series:
        encoding["color"] = condition_colours(rows)
    layers: list[Spec] = [{"mark": mark, "encoding": encoding}]
    if within:
        layers.insert(0, band(*within, f"budget, {within[0]} to {within[1]} tokens"))
    return layered(*layers, *rules_at(field, rules), rows=bars, choose=True)
