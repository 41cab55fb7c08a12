"""Plan for all agents of a layout together, and hold those who drive by themselves to that."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="joint_plans",
    adds={"drives": {"agents": "harness.extensions.joint_plans.drives:DRIVES"}},
)
