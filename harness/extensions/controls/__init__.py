"""Take from messages what helpers see, as controls do: of what helps the ego, what is left?"""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="controls",
    adds={"parts": {"messages": "harness.extensions.controls.part:Controlled"}},
)
