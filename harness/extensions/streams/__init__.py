"""Have stations send where they are and what they see unasked, as standards say: what, how often,
and how much the channel lets them.
"""

from harness.core.extensions import Extension

_HERE = "harness.extensions.streams"

EXTENSION = Extension(
    name="streams",
    commands={"radio congestion": f"{_HERE}.command:command"},
    adds={"parts": {"stream": f"{_HERE}.part:Streams"}},
)
