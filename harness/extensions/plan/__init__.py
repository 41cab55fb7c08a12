"""Let vehicles that decide for themselves tell each other what they are going to do."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.plan"

EXTENSION = Extension(
    name="plan",
    adds={
        "contents": {"plan": f"{_HERE}.content:PLAN"},
        "parts": {"rounds": f"{_HERE}.rounds:Negotiated"},
        "rules": {
            "yield-by-time": f"{_HERE}.precedence:BY_TIME",
            "yield-by-id": f"{_HERE}.precedence:BY_NUMBER",
            "auction": f"{_HERE}.precedence:BY_BID",
        },
    },
)
