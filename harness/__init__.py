"""SwarmDrive Harness: evaluates prompts, parsing and coordination in cooperative driving.

From Python as from the command line: docs/files.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from harness.core.errors import UserError

if TYPE_CHECKING:
    from harness.api import compare, load, ls, run, sweep
    from harness.core.extensions import Extension, Setting

# And what extensions add.
__all__ = ["Extension", "Setting", "UserError", "compare", "load", "ls", "run", "sweep"]
__version__ = "0.4.0"


def __dir__() -> list[str]:
    from harness.core.extensions import PYTHON

    return [*__all__, "__version__", *PYTHON]


def __getattr__(name: str) -> Any:
    if name in ("Extension", "Setting"):
        from harness.core import extensions

        return getattr(extensions, name)
    if name in __all__:  # loaded at first use, since pandas and the report take time
        return getattr(import_module("harness.api"), name)
    if not name.startswith("_"):  # those are Python's own questions
        from harness.core.extensions import from_python

        if (added := from_python(name)) is not None:
            return added
    raise AttributeError(f"module 'harness' has no attribute {name!r}; it has {', '.join(__all__)}")
