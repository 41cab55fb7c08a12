"""The pages as text. A run's text is hostile: the report's templates escape it all."""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from harness.core.errors import UserError, printable
from harness.core.files import bytes_of, sha256_bytes, text_of
from harness.extensions.view import notes as run_notes
from harness.extensions.view.decision import with_decision
from harness.extensions.view.folder import own_file, whole
from harness.report import suite as suites
from harness.report.compare import page as comparison
from harness.report.compare.difference import compare
from harness.report.compare.pair import pair
from harness.report.page import render
from harness.report.runs import gather
from harness.report.templating import environment, visible
from harness.runs.folder import Run
from harness.runs.folder import read as read_run
from harness.runs.listing import UNREAD, Listed, runs
from harness.runs.suite import SUMMARY, SuiteRun, contents_of, read
from harness.runs.unfinished import Extent, extent

RUNS = ("eval", "drive")
TEMPLATES = Path(__file__).parent / "templates"
LISTED_OF_EACH = 10  # episodes and requests, in a comparison
NEWEST = "-date"
WAY_BACK = (  # a report's navigation begins at the top of its page and would lie over the link
    '<style>.way-back + nav { margin-top: 0; }</style>\n<p class="way-back"><a href="/">← All '
    "runs</a></p>"
)
COLUMNS = ("name", "kind", "model", "prompt", "success", "date")


def report(folders: Sequence[Path], written: Path | None = None, scene: str | None = None) -> str:
    """Return the HTML report of the runs in these folders: the content of `written`, or a new one.

    `written` is a report that lies in the run's folder; None makes a new one. `scene` is the id of
    a decision point, a situation in which the ego decided, all details of which are put in; None
    for none.
    """
    runs = gather(folders)
    page = render(runs) if written is None else whole_text(written)
    return page if scene is None else with_decision(page, runs, scene)


def with_way_back(page: str, links: Sequence[tuple[str, str]] = (), home: str = "/") -> str:
    """Return a run's HTML page with links put in at its top: to the list, and others.

    `page` is the HTML, each of `links` a text and an address, and `home` the address of the list.
    """
    more = "".join(Markup(' · <a href="{}">{}</a>').format(href, text) for text, href in links)
    way_back = WAY_BACK.replace('"/"', f'"{home}"').replace("</p>", f"{more}</p>")
    return page.replace("<body>", f"<body>\n{way_back}", 1)


def whole_text(page: Path) -> str:
    """Return the text of an HTML page that lies in a run's folder, read at once to be whole."""
    return bytes_of(page, "rows").decode("utf-8", "replace")


def compared(folder: Path, a: Path, b: Path) -> str:
    """Return the HTML page that compares run B with run A.

    `a` and `b` are their folders, and `folder` the one of all runs, in which they lie.
    """
    return comparison.render(compare(pair(a, b)), (), LISTED_OF_EACH, partial(_place, folder))


def around(a: str, b: str) -> list[tuple[str, str]]:
    """Return the links of the page that compares runs named `a` and `b`: texts and addresses.

    They lead to the comparison with A and B swapped, and to all answers of both.
    """
    both = [("path", a), ("path", b)]
    differing = urlencode({"decisions": "", "differ": "answers"})
    return [
        ("Swap A and B", f"/compare?{urlencode([*both, ('a', b)])}"),
        ("Answers side by side", f"/report?{urlencode(both)}#{differing}"),
    ]


def suite_of(folder: Path, name: str) -> SuiteRun:
    """Read a suite, one model's runs on several scenarios, by its name in the list of `folder`.

    Raises UserError if a file of it is missing, or may not be read since it lies elsewhere.
    """
    for family in contents_of(folder / name).families.values():
        whole(folder, f"{name}/{family}")
    if own_file(folder, name, SUMMARY) is None:
        raise UserError(f"{printable(name)} has no {SUMMARY} of its own; make the suite again")
    return read(folder / name)


def suite(folder: Path, name: str) -> str:
    """Return the HTML page of a suite of runs, by its name in the list of `folder`.

    A suite is one model's runs on several scenarios.
    """
    done = suite_of(folder, name)
    return suites.render([(done, suites.lines(done))], partial(_place, folder))


def _place(folder: Path, run: Run) -> str:
    return f"/run?{urlencode({'path': run.path.relative_to(folder).as_posix()})}"


def listed(folder: Path, words: str, order: str) -> str:
    """Return the HTML list of the runs in `folder` that match, sorted by a column.

    `words` are separated by spaces; a run matches if its name, kind, state, model, prompt, answer
    mode, condition (settings of radio, asking and fusion) and tags contain each of them. `order` is
    one of `COLUMNS`, with `-` before it for the reverse order. While a run goes on, the page has a
    script, allowed by its digest.
    """
    every = runs(folder)
    how_far = extents(folder, every)
    order = order if order.removeprefix("-") in COLUMNS else NEWEST
    listed_runs = sort([run for run in every if _has(run, words)], order)
    query = {"q": words} if words else {}
    links = {column: urlencode({"sort": _next(column, order), **query}) for column in COLUMNS}
    is_going = any(run.name in how_far and how_far[run.name].going for run in listed_runs)
    return _page(
        "list.html.j2",
        folder=str(folder),
        every=len(every),
        runs=listed_runs,
        words=words,
        order=order,
        links=links,
        kinds=RUNS,
        unread=UNREAD,
        now=now(every, how_far),
        going=is_going,
        script=Markup(script()),
    )


def extents(folder: Path, every: Sequence[Listed]) -> dict[str, Extent]:
    """Return how far each unfinished run is, by its name: its episodes or answers done, and due.

    `every` are all runs in `folder`, finished ones included.
    """
    return {run.name: extent(folder / run.name) for run in every if run.state == "unfinished"}


def now(every: Sequence[Listed], how_far: Mapping[str, Extent]) -> dict[str, Any]:
    """Return what changes in the list of runs while runs go on, as plain values for JSON.

    `every` are all runs listed, and `how_far` says of each unfinished one, by name, what is done
    and due.

    Returns:
        `listed`, a digest that changes once a run begins or ends; `going`, whether one goes on; and
        `unfinished`, how far each is in words, by the run's name.
    """
    states = json.dumps([(run.name, run.state) for run in every])
    return {
        "listed": sha256_bytes(states.encode()),
        "going": any(extent.going for extent in how_far.values()),
        "unfinished": {
            visible(run.name): progress(run, how_far[run.name])
            for run in every
            if run.name in how_far
        },
    }


def progress(run: Listed, extent: Extent) -> str:
    """Return in words how far an unfinished run is, such as how many episodes of how many.

    `extent` has these numbers, and `run` says how to continue it.
    """
    due = "" if extent.due is None else f" of {'at most ' * extent.early}{extent.due}"
    text = f"{extent.done}{due} episodes"
    if extent.answers:
        text += f", {extent.answers} answers for the next"
    return f"going on now: {text}" if extent.going else f"stopped: {text}; {run.why}"


def sort(runs: Sequence[Listed], order: str) -> list[Listed]:
    """Return runs of the list sorted by a column; those without a value are last.

    `order` is the column's name, such as `date`, with `-` before it for the reverse order.
    """
    column = attrgetter(order.removeprefix("-"))
    with_value = [run for run in runs if column(run) is not None]
    unknown = [run for run in runs if column(run) is None]
    return [*sorted(with_value, key=column, reverse=order.startswith("-")), *unknown]


def study(run: Listed, pictures: Sequence[str]) -> str:
    """Return an HTML page of a study's pictures, for a study without a page of its own.

    `run` is the study as the list of runs has it, and `pictures` has the file names in its folder.
    """
    return _page("study.html.j2", run=run, pictures=pictures)


def wrong(reason: str) -> str:
    """Return the HTML page of one line on why a request cannot be answered."""
    return _page("wrong.html.j2", reason=reason)


def style() -> str:
    """Return the CSS of the web application's own pages, such as the list of runs."""
    return environment().get_template("style.css").render() + text_of(TEMPLATES / "list.css")


def to_notes(run: str, scene: str | None = None) -> tuple[str, str]:
    """Return a link, as text and address, to the notes on a run.

    `run` is its name in the list. `scene` is the id of the decision point whose note is to be
    written; None for none.
    """
    where = {"path": run}
    if scene is not None:
        where["scene"] = scene
    return "Notes" if scene is None else "Note on this decision", f"/notes?{urlencode(where)}"


def notes(path: Path, name: str, scene: str) -> str:
    """Return the HTML page of what users noted on a run's decisions, with a form for one note.

    Args:
        path: the run's folder, which holds the notes.
        name: the run's name in the list, which the page shows.
        scene: id of the decision point that the form is for, filled in with its note if it has one;
            empty for an empty form, into which the user types the id.

    Raises UserError if the file of notes is broken.
    """
    every = run_notes.notes(path)
    here = run_notes.note_on(every, scene)
    return _page("notes.html.j2", run=name, notes=every, here=here, longest=run_notes.LONGEST)


def note(path: Path, scene: str, text: str, before: str) -> None:
    """Write the note `text` on a decision of a run, as the form of `notes` sends it.

    Args:
        path: the run's folder.
        scene: id of the decision point.
        text: the note; empty to delete it.
        before: the date of the note that is replaced, as the form showed it; empty if there was
            none.

    Raises UserError if the run has no such point, if the note there has another date by now, or if
    the text is too long or the file of notes cannot be written.
    """
    if scene not in read_run(path).decisions.labels("scene"):
        raise UserError(
            f"{printable(path.name)} has no decision point {printable(scene)!r}; copy one from its "
            "page"
        )
    run_notes.write(path, scene, text, before)


def script() -> str:
    """Return the JavaScript of the page that lists runs, its only script: it shows progress."""
    return text_of(TEMPLATES / "list.js")


def _page(template: str, **values: Any) -> str:
    return environment(TEMPLATES).get_template(template).render(**values)


def _has(run: Listed, words: str) -> bool:
    reason = (
        run.name,
        run.kind,
        run.state,
        run.model,
        run.prompt,
        run.answer,
        run.condition,
        *run.tags,
    )
    text = " ".join(part for part in reason if part is not None).casefold()
    return all(word in text for word in words.casefold().split())


def _next(column: str, order: str) -> str:
    """Return what a click on a column's head asks for:
    numbers and dates begin with the greatest.
    """
    first = f"-{column}" if column in ("success", "date") else column
    return (column if first.startswith("-") else f"-{column}") if order == first else first
