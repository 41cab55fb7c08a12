"""Charts of one decision, as Vega-Lite specifications whose values the page fills in."""

from harness.report.drawing.colours import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from harness.report.layers import BASE, NUMBER, RULE, Spec, layered, x_axis

TIMES = {
    "inference": SKY, "reply on time": BLUE, "reply late": ORANGE, "reply lost": VERMILLION, "fusion": PURPLE,
    "decision": GREEN,
}  # fmt: skip


def policies() -> Spec:
    """Distributions before and after fusion; the page fills in `values`: who, what, action, p."""
    return {
        **BASE,
        "data": {"name": "values", "values": []},
        "mark": {"type": "bar", "height": {"band": 0.8}},
        "encoding": {
            "y": {"field": "who", "type": "nominal", "sort": None, "title": None},
            "yOffset": {"field": "action", "sort": None},
            "x": {**x_axis("p", "probability"), "scale": {"domain": [0, 1]}},
            "color": {
                "field": "action", "type": "nominal", "sort": None,
                "scale": {"range": [VERMILLION, BLUE, GREEN]}, "legend": {"orient": "top", "title": None},
            },
            "tooltip": [{"field": f} for f in ("who", "what", "action", "p")],
        },
    }  # fmt: skip


def timeline() -> Spec:
    """When what happens in a decision; the page fills in `values`: who, what, from, to, and the `window`."""
    return layered(
        {
            "mark": {"type": "bar", "height": 9, "cornerRadius": 2},
            "encoding": {
                "x": {"field": "from", **NUMBER, "title": "ms from the start of the decision"},
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
            "encoding": {"x": {"field": "window_ms", **NUMBER}, "tooltip": {"field": "what"}},
        },
        rows=[],
    )
