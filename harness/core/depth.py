"""Bound how deep values nest that files, servers and models state.

Functions that walk such values by recursion would end in a RecursionError, at a depth that depends
on who calls them. So what makes values of a text passes `shallow`.
"""

from typing import TypeVar

MOST_DEPTH = 32  # of a value in lists and objects; what the harness writes has a third of it
T = TypeVar("T")


def shallow(value: T) -> T:
    """Return a value of JSON or TOML, as it is, whose lists and objects nest at most 32 deep.

    Raises ValueError for a deeper one.
    """
    level: list[object] = [value]
    for _ in range(MOST_DEPTH + 1):
        below: list[object] = []
        for each in level:
            if isinstance(each, dict):
                below += each.values()
            elif isinstance(each, list):
                below += each
        if not below:
            return value
        level = below
    raise ValueError(f"it nests more than {MOST_DEPTH} deep")
