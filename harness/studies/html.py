"""Pages of studies: self-contained, everything escaped, in the report's style."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """A page from one of this package's templates."""
    environment = Environment(
        loader=PackageLoader("harness.studies"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    style = (files("harness.report") / "templates" / "style.css").read_text(encoding="utf-8")
    return environment.get_template(template).render(style=style, **values)
