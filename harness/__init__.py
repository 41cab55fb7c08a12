"""SwarmDrive Harness: evaluates prompts, parsing and coordination in cooperative driving.

From Python as from the command line: docs/python.md.
"""

from typing import TYPE_CHECKING, Any

from harness.core.errors import UserError

if TYPE_CHECKING:
    from harness.api import compare, environment, load, ls, run, sweep
    from harness.core.extensions import Extension, Setting

__all__ = ["Extension", "Setting", "UserError", "compare", "environment", "load", "ls", "run", "sweep"]
__version__ = "0.3.0"


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    if name in ("Extension", "Setting"):
        from harness.core import extensions

        return getattr(extensions, name)
    if name in __all__:  # loaded at first use, since pandas and the report take time
        from harness import api

        return getattr(api, name)
    raise AttributeError(f"module 'harness' has no attribute {name!r}; it has {', '.join(__all__)}")
