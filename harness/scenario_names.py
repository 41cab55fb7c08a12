"""Which meta-actions a scenario has, by the scenario's name."""

from harness import errors

ACTIONS = {"occluded-intersection": ("SLOWER", "IDLE", "FASTER")}


def actions_of(scenario: str) -> tuple[str, ...]:
    """Meta-action names in the environment's order. Raises `UserError` for an unknown scenario."""
    if scenario not in ACTIONS:
        raise errors.unknown("scenario", scenario, ACTIONS)
    return ACTIONS[scenario]
