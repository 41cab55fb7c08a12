"""The sections that extensions add to a run's page.

An extension adds one by `adds={"sections": {"name": "module:function"}}`. The function takes a
finished run and returns a `Section`, or None where it has nothing to say of that run.
"""

from collections.abc import Callable

from markupsafe import Markup

from harness.core.errors import UserError, printable
from harness.core.plugins import Plugins, texts
from harness.report.apart import apart
from harness.report.document import Section
from harness.report.runs import Runs
from harness.report.templating import environment
from harness.runs.folder import Run

SECTIONS: Plugins[Callable[[Run], Section | None]] = Plugins("swarmdrive.sections", Callable, {})


def sections(runs: Runs) -> list[tuple[str, Markup]]:
    """Return title and HTML of each section that extensions add to a page about these runs.

    Every extension's function is called with each run. One that fails gets a section with its error
    message instead; the rest of the page is unaffected.
    """
    written = [_written(name, run) for name in SECTIONS for run in runs.runs]
    return [section for section in written if section is not None]


def _written(name: str, run: Run) -> tuple[str, Markup] | None:
    try:
        copied = apart(run, SECTIONS.is_ours(name))
        return SECTIONS.ask(name, lambda of: _titled(of(copied)))
    except UserError as error:
        return printable(name), _content(Section(name, warnings=[str(error)]))


def _titled(section: Section | None) -> tuple[str, Markup] | None:
    """Return a section's title and content, as what no package can change or raise any more."""
    if section is None:
        return None
    if not isinstance(section, Section):
        raise TypeError(f"it returns a {type(section).__name__} and no Section")
    for table in section.tables:
        for cells in (table.heads, *table.rows):
            texts(cells, "a row of its tables")
        texts((table.title, table.note), "the title or note of a table")
    for name in ("headline", "about", "warnings", "caveats"):
        texts(getattr(section, name), f"its {name}")
    [title] = texts((section.title,), "its title")
    return title, _content(section)


def _content(section: Section) -> Markup:
    macros = environment().get_template("macros.html.j2").module
    return Markup(macros.outcome(section, "h3"))  # type: ignore[attr-defined]
