"""Packages that only some commands need, each in an extra of pyproject.toml.

They are imported where they are used. Where one is missing the command line says, in one line, which, and
the command that installs it: of an import that fails (`without`), and before long work (`need`).
"""

from importlib.util import find_spec

from harness.core.errors import UserError

# The package and its extra, by the module that is imported.
OPTIONAL = {
    "highway_env": ("highway-env", "sim"),
    "matplotlib": ("matplotlib", "report"),
    "PIL": ("pillow", "report"),
    "sklearn": ("scikit-learn", "audit"),
    "inspect_ai": ("inspect-ai", "inspect"),
    "imageio_ffmpeg": ("imageio-ffmpeg", "video"),
    "ray": ("ray", "ray"),
    "llama_cpp": ("llama-cpp-python", "llama-cpp"),
    "torch": ("torch", "transformers"),
    "transformers": ("transformers", "transformers"),
}


def install(extra: str) -> str:
    """The command that installs an extra."""
    return f"pip install 'swarmdrive-harness[{extra}]'"


def need(what: str, *modules: str) -> None:
    """Raise UserError if one of these modules, keys of `OPTIONAL`, is not installed."""
    for module in modules:
        if find_spec(module) is None:
            raise without(what, *OPTIONAL[module])


def without(what: str, package: str, extra: str) -> UserError:
    """The error of what cannot run without a package."""
    return UserError(f"{what} needs {package}, which is not installed; run `{install(extra)}`")
