"""Stop a command once its answers have cost so much."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="budget",
    adds={"options": {"max_cost": "harness.extensions.budget.option:MAX_COST"}},
)
