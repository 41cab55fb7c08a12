"""Optional packages, which only some commands need; each is in an extra of pyproject.toml.

They are imported where they are used. If one is missing, a one-line error names it and the command
that installs it: `need` checks before long work, and `without` builds the error of a failed import.
"""

from importlib.util import find_spec

from harness.core.errors import UserError
from harness.core.plugins import Plugins

# The package and its extra, by the module that is imported.
OPTIONAL = Plugins[tuple[str, str]]("swarmdrive.extras", tuple, {
    "highway_env": ("highway-env", "sim"),
    "matplotlib": ("matplotlib", "report"),
    "PIL": ("pillow", "report"),
    "libsumo": ("libsumo", "sumo"),
    "ray": ("ray", "ray"),
    "llama_cpp": ("llama-cpp-python", "llama-cpp"),
    "sparrow_decider": ("sparrow-decider", "sparrow"),
    "torch": ("torch", "transformers"),
    "transformers": ("transformers", "transformers"),
})  # fmt: skip


def install(extra: str) -> str:
    """Return the shell command that installs an optional extra of this distribution.

    `extra` is its name in the distribution's metadata, such as `inspect`.
    """
    return f"pip install 'swarmdrive-harness[{extra}]'"


def need(what: str, *modules: str) -> None:
    """Raise UserError if one of some optional modules is not installed.

    `what` names the command or option that needs them, for the message; `modules` are keys of
    `OPTIONAL`, which has the extra that installs each.
    """
    for module in modules:
        if find_spec(module) is None:
            raise without(what, *OPTIONAL[module])


def without(what: str, package: str, extra: str) -> UserError:
    """Build the error for a command or option (`what`) that needs a missing package.

    `extra` is the name of this distribution's optional extra that installs it.
    """
    return UserError(f"{what} needs {package}, which is not installed; run `{install(extra)}`")
