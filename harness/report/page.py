"""One HTML file about one run or several: opens from disk, needs no network.

Whatever a model, a prompt or a file name says is text: templates escape everything, the page's
script makes text nodes and nothing else of what it reads, characters that show nothing or turn the
line around are spelt out, and the page's own policy lets two scripts run, named by their digests,
and forbids every request.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from harness.coordination.part_settings import question_under
from harness.core.errors import UserError, printable
from harness.core.files import opened, replacing
from harness.core.formats import refuse_data
from harness.core.memory import uncollected
from harness.core.parallel import Workers, each
from harness.parsing.parse import Repair, Status
from harness.report import contents, library, matrix, words
from harness.report.charts import policies, timeline
from harness.report.constancy import tile
from harness.report.decisions import Decisions
from harness.report.details import Part, Prompts, prompts_of
from harness.report.drawing import colours
from harness.report.drawing.geometry import drawn_ground
from harness.report.findings import LAST, Kind, findings, of_runs
from harness.report.panels import panels
from harness.report.remarks import sentences
from harness.report.runs import Runs
from harness.report.sections import sections
from harness.report.templating import environment
from harness.runs.folder import Run
from harness.runs.headline import IN_WORDS
from harness.runs.reliability import LEAST

PARTS_SHARED = 8  # fewest parts for which starting workers takes less time than they save
HEAD = 1 << 14  # bytes of a page within which it states what it lacks
SETTINGS = ("window_s", "consensus", "content")  # of a condition, for the script


@uncollected()
def write_report(
    runs: Runs,
    out: Path,
    prompts: Prompts = prompts_of,
    progress: Callable[[int], None] = lambda done: None,
    workers: Workers = 1,
    full: bool = False,
) -> Path:
    """Write the HTML report of one run, or of several on the same scenes.

    Args:
        runs: the runs to report.
        out: the file to replace.
        prompts: maps a run to a function that returns the chat messages for a scene, a viewer and
            the messages that it had heard, or to None if they are unknown; by default the run's own
            prompt version, if it is installed.
        progress: called with the number of scenes just written.
        workers: processes that prepare the scenes of a large report; if any, `prompts` must pickle.
        full: whether to include prompts of engines that read none, and the camera pictures of every
            decision instead of only those of models with vision.

    Returns:
        The file written.

    Raises:
        UserError: a scene of a run is not in its dataset, `out` cannot be written, or the page
            there shows something that the new one would lack.
    """
    if out.is_dir():
        raise UserError(f"--out {printable(out)} is a folder; name a file in it")
    refuse_other("--out", out)
    decisions = Decisions(runs, prompts, full)
    refuse_less(out, decisions.lacks(), "--out")
    save(_pieces(runs, decisions, progress, workers), out, "--out")
    return out


def refuse_less(out: Path, lacks: Mapping[str, str], option: str) -> None:
    """Raise UserError if a page would replace a run's data, or lacks what the old page has.

    What a page may lack are the prompts or pictures of its scenes.

    Args:
        out: the file to replace.
        lacks: why the new page lacks each of its missing kinds, such as `prompts`, by kind. A page
            names the kinds it lacks in its head.
        option: the command-line option that names the file, for the error.
    """
    refuse_data(option, out)
    if not lacks or not out.is_file():
        return
    with opened(out, "rows") as page:
        head = re.search(rb'<meta name="lacks" content="([a-z ]*)">', page.read(HEAD))
    lacked = head[1].decode().split() if head else []
    for what, why in lacks.items():
        if what not in lacked:
            raise UserError(
                f"{printable(out)} is kept: a new page would lack its {what} ({why}); name another "
                f"file with {option}, or delete it"
            )


def refuse_other(option: str, out: Path) -> None:
    """Raise UserError if a page or a table of tests would replace what is neither, or a run's data.

    An empty file may be replaced. `option` names the command-line option that gave the file.
    """
    refuse_data(option, out)
    if not out.is_file():
        return
    with opened(out, "rows") as file:
        head = file.read(HEAD)
    if head and not re.search(rb"SwarmDrive Harness</title>|<testsuites?[ >]", head):
        raise UserError(
            f"{option} {printable(out)} is a file that no command here wrote, and would be lost; "
            "name another file, or delete it"
        )


def save(pieces: Iterable[str], out: Path, option: str) -> None:
    """Write a page's pieces to a file, which is replaced only once it is whole.

    `pieces` are texts, one after the other. Raises UserError, with the name of the command-line
    option (`option`), if the file cannot be written, or is data of a run.
    """
    refuse_other(option, out)
    try:
        with replacing(out) as part, part.open("w", encoding="utf-8", newline="") as file:
            file.writelines(pieces)
    except OSError as error:
        raise UserError(
            f"{option} {printable(out)} cannot be written ({error.strerror}); name another file"
        ) from None


@uncollected()
def render(
    runs: Runs,
    prompts: Prompts = prompts_of,
    progress: Callable[[int], None] = lambda done: None,
    full: bool = False,
) -> str:
    """Return the HTML text of the report on one run, or on several on the same scenes.

    Args:
        runs: the runs to report.
        prompts: maps a run to a function that returns the chat messages for a scene, a viewer and
            the messages that it had heard, or to None if they are unknown.
        progress: called with the number of scenes just written.
        full: whether to include prompts of engines that read none, and the camera pictures of every
            decision instead of only those of models with vision.

    Raises UserError if a scene of a run is not in its dataset.
    """
    return "".join(_pieces(runs, Decisions(runs, prompts, full), progress, 1))


def _pieces(
    runs: Runs, decisions: Decisions, progress: Callable[[int], None], workers: Workers
) -> Iterator[str]:
    """Return the page in pieces: that of a million decisions weighs as much as all that is read
    for it.
    """
    lines = matrix.lines(runs)
    charts = list(panels(runs))
    by_name = dict(zip(runs.names, runs.runs, strict=True))
    if len(runs.runs) == 1:
        title, headline = runs.names[0], words.headline(runs.runs[0])
        key_figures = [*words.figures(runs.runs[0]), *tile(runs.runs[0])]
    else:
        title, headline = f"{len(runs.names)} runs", matrix.headline(lines)
        key_figures = matrix.figures(lines)
    return (
        environment()
        .get_template("page.html.j2")
        .generate(
            runs=runs,
            title=title,
            policy=library.policy(library.vega(), library.script()),
            lacks=" ".join(decisions.lacks()),
            warnings=of_runs(by_name, Kind.VOID, Kind.CAVEAT),
            limits=of_runs(by_name, Kind.LIMIT),
            size=contents.size(runs),
            headline=headline,
            key_figures=key_figures,
            actions=_actions(runs),
            lines=lines,
            metric=IN_WORDS[lines[0].headline],
            grids=matrix.grids(lines),
            shared=matrix.shared(lines),
            uneven=matrix.uneven(runs),
            summaries=[contents.summary(run) for run in runs.runs],
            answers=contents.answers(runs),
            probabilities=contents.probabilities(runs),
            least=LEAST,
            charts=charts,
            examples=contents.examples(runs),
            remarks=sentences(runs),
            sections=sections(runs),
            notes=[findings(run, *LAST) for run in runs.runs],
            sweeps=[panel for run in runs.runs for panel in contents.sweeps(run)],
            licence=library.licence(),
            vega=library.packed(library.vega()),
            script=library.script(),
            about=library.packed(_about(runs, charts)),
            index=library.packed(decisions.index),
            blocks=_packed(decisions.parts(), progress, workers),
        )
    )


def _packed(
    parts: Sequence[Part], progress: Callable[[int], None], workers: Workers
) -> Iterator[Markup]:
    """Yield the blocks of all parts, compressed; of few parts here, else by workers."""
    if workers == 1 or len(parts) < PARTS_SHARED:
        for part in parts:
            for block in part.details.blocks(part.ids):
                yield library.packed(block)
                progress(len(block))
        return
    done: dict[int, list[Markup]] = {}  # by the part's place

    def keep(place: int, blocks: list[Markup]) -> None:
        done[place] = blocks
        progress(len(parts[place].ids))

    def name(part: Part) -> str:
        return f"scenes {part.ids[0]} to {part.ids[-1]}"

    each(Part.packed, parts, workers, keep, name, False)
    for place in range(len(parts)):
        yield from done.pop(place)


def _about(runs: Runs, charts: Sequence[Any]) -> dict[str, Any]:
    """Return what the page's script has to know of the runs, besides the decisions."""
    return {
        "names": runs.names,
        "runs": [_settings(run) for run in runs.runs],
        "meanings": {str(member): member.meaning for member in (*Status, *Repair)},
        "ground": drawn_ground(runs.scenario),
        "charts": {chart.id: chart.spec for chart in charts},
        "actions": _actions(runs),
        "policies": policies(runs.actions),
        "timeline": timeline(),
    }


def _settings(run: Run) -> dict[str, Any]:
    """Return a run's best condition, its inference times, in s, and all conditions' settings."""
    points = {}
    for condition in run.manifest.conditions:
        point = {name: condition.get(name) for name in SETTINGS}
        points[condition["name"]] = {**point, "question": question_under(condition).name}
    latency = run.manifest.latency
    seconds = {"ego": latency.ego_s, "helper": latency.helper_s}
    return {"best": words.compared(run)[0], "inference_s": seconds, "points": points}


def _actions(runs: Runs) -> dict[str, tuple[str, str]]:
    """Return the colour of each action, and of text on it."""
    fills = colours.actions(runs.actions)
    pairs = {}
    for n, (name, fill) in enumerate(fills.items()):
        pairs[name] = fill, colours.INK if 5 * n < 3 * len(fills) else colours.WHITE
    return pairs
