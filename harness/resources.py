"""Where prompts, model cards and datasets lie: the checkout's top level, or inside the wheel."""

from pathlib import Path

DATASET = "occluded-intersection-v1"  # the one that ships

_PACKAGE = Path(__file__).resolve().parent


def root() -> Path:
    """Folder that holds `prompts/`, `models/` and `datasets/`."""
    checkout = _PACKAGE.parent
    return checkout if (checkout / "pyproject.toml").is_file() else _PACKAGE / "_data"


def folder(kind: str) -> Path:
    """Folder of one kind of resource: `prompts`, `models` or `datasets`."""
    return root() / kind
