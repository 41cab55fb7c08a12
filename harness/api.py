"""Evaluate, load and compare runs from Python;
results show themselves in a notebook (docs/files.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from markupsafe import Markup, escape

from harness.core.config import convert
from harness.core.errors import UserError, printable, unknown
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.figures import crossed
from harness.core.files import bytes_of
from harness.runs.records import FrozenScenes, Score
from harness.runs.tables import Tables, tables_of

if TYPE_CHECKING:
    import pandas as pd

    from harness.dataset.load import Scene
    from harness.report.compare.difference import AnswersHeld

MOST_SHOWN = 6  # findings of a comparison where it is shown as text
HEADLINE = {  # metrics of a run's own table, by their heads
    "balanced success": "balanced_success_rate",
    "success": "success_rate",
    "unsafe": "unsafe_rate",
    "latency": "latency_proxy_ms",
    "asked": "trigger_rate",
    "messages": "messages_per_episode",
}


class Run(Tables):
    """Hold a finished run, with its tables as data frames: `decisions`, `answers`, `summary`, etc.

    `path` is its folder, `config` the content of its `run.json` as a dict. A notebook shows its
    outcome in a sentence and a row for each condition (set of settings that is scored).
    """

    def decision(self, scene: str, viewer: str | None = None) -> "DecisionPoint":
        """Return a decision point of the run: a scene in which the ego must choose an action.

        Args:
            scene: its id, as in the column `scene` of `decisions`.
            viewer: id of the vehicle whose view the picture shows; None for the ego's.

        Raises:
            UserError: the run has no such decision point, its dataset is not found,
                or no vehicle of that id answers there.
        """
        if scene not in self.source.decisions.scenes:
            raise unknown("decision point", scene, list(self.source.decisions.scenes))
        if isinstance(self.source.manifest.world, FrozenScenes):
            from harness.runs.run_dataset import check_scenes, dataset_of

            dataset = dataset_of(self.source)
            check_scenes(self.source, dataset, [scene])
            seen = dataset.scene(scene)
        else:
            from harness.evaluate.replay import scenes_of

            [seen] = scenes_of(self.source, [scene])
            if seen.id != scene:
                raise UserError(
                    f"decision point {printable(scene)} comes out otherwise in this simulator"
                )
        seen.viewer(viewer)  # refuses a name that nobody has
        return DecisionPoint(self, seen, viewer)

    def _repr_html_(self) -> str:
        from harness.report import words
        from harness.report.findings import Kind, findings

        def cell(score: Score) -> str:
            texts = words.score_texts(score)
            return texts["value"] + (f" [{texts['interval']}]" if texts["interval"] else "")

        import pandas as pd

        rows = []
        for condition in self.source.conditions:
            row = {"condition": condition}
            for head, metric in HEADLINE.items():
                score = self.source.score(condition, metric)
                if score:
                    row[head] = cell(score)
            rows.append(row)
        void = [finding.sentence for finding in findings(self.source, Kind.VOID)]
        n = f"n = {crossed(len(self.source.grid.episodes), len(self.source.grid.seeds))}"
        sentences = [words.headline(self.source), *void]
        return _page(
            sentences, _frame(pd.DataFrame(rows)), f"{n}; 95 % intervals over episodes; {self.path}"
        )


@dataclass(frozen=True)
class DecisionPoint:
    """Hold one decision point of a run: a scene in which the ego must choose an action.

    `scene` says who is where and what each vehicle sees; `viewer` is the id of the vehicle whose
    view the picture shows, None for the ego. A notebook shows the picture, the models' answers and
    the decisions there.
    """

    run: Run  # the run
    scene: "Scene"  # who is where, and what each vehicle sees
    viewer: str | None = None  # whose view the picture shows; None for the ego's

    @property
    def answers(self) -> "pd.DataFrame":
        """Return the models' answers at this decision point, as rows of `Run.answers`.

        There is one for each vehicle that was asked, and each set of messages with which one was
        asked again.
        """
        return self.run.answers[self.run.answers.scene == self.scene.id]

    @property
    def decisions(self) -> "pd.DataFrame":
        """Return the decisions at this point, as rows of `Run.decisions`.

        There is one for each condition (set of settings that is scored) and channel seed.
        """
        return self.run.decisions[self.run.decisions.scene == self.scene.id]

    @cached_property
    def svg(self) -> str:
        """Return an SVG picture of the scene from above, with what `viewer` sees."""
        from harness.report.drawing.scene import draw

        picture = BytesIO()
        draw(self.scene, picture, "svg", self.viewer)
        return picture.getvalue().decode()

    def _repr_html_(self) -> str:
        from harness.report.library import picture

        image = Markup('<img alt="the scene from above" src="{}">').format(
            picture(self.svg.encode())
        )
        answers = self.answers[["viewer", "role", "verdict", "raw", *self._columns("intent_")]]
        columns = ["condition", "action", "triggered", *self._columns("fused_")]
        groups = self.decisions.groupby(columns, observed=True, dropna=False, sort=False).seed
        decisions = groups.agg(seeds=lambda seeds: ", ".join(map(str, seeds))).reset_index()
        return _page([], image, _frame(answers), _frame(decisions))

    def _columns(self, prefix: str) -> list[str]:
        return [f"{prefix}{action}" for action in self.run.source.actions]


@dataclass(frozen=True)
class Comparison:
    """Hold the comparison of run B with run A, on what both have.

    `report` is what `harness compare --json` prints, as a dict; `findings` says in sentences how
    success changed in each condition (set of settings that is scored); `held` has what both runs
    answered to the same questions. A notebook shows these, and the differences.
    """

    report: Mapping[str, Any] = field(repr=False)  # what `harness compare --json` prints
    findings: tuple[str, ...]  # how success changed in each condition, in a sentence
    held: "AnswersHeld" = field(repr=False)  # what both runs answered to the same questions

    @cached_property
    def answers(self) -> "pd.DataFrame":
        """Return a row for each answer to the same question that changed from run A to run B.

        Its columns are `request` (the question's id) and `role` (who was asked), both texts
        (`raw_a`, `raw_b`) and what the parser made of them (`verdict_a`, `verdict_b`).
        """
        import pandas as pd

        from harness.report.compare.text import ANSWERS, changed_answers

        return pd.DataFrame(changed_answers(self.held), columns=list(ANSWERS))

    def __repr__(self) -> str:
        of = [f"{letter}: {self.report[letter.lower()]['run']}" for letter in "AB"]
        more = "in full: .differences, a row for each condition and metric, and .report"
        return "\n".join(["Comparison of B with A", *of, *self.findings[:MOST_SHOWN], more])

    @cached_property
    def differences(self) -> "pd.DataFrame":
        """Return a row for each condition and metric: both means, B - A and its 95 % interval.

        A condition is a named set of settings of radio channel, asking of helpers and fusion.
        """
        import pandas as pd

        return pd.DataFrame(
            [
                {"condition": each["condition"], "metric": metric, **numbers}
                for each in self.report["conditions"]
                for metric, numbers in each["metrics"].items()
            ]
        )

    def _repr_html_(self) -> str:
        from harness.report.compare.words import answers_held

        names = [f"{letter}: {self.report[letter.lower()]['run']}" for letter in "AB"]
        answers = f"answers: {answers_held(self.held)}"
        return _page(
            [*names, *self.findings, answers, *self.report["caveats"]], _frame(self.differences)
        )


@dataclass(frozen=True)
class Study:
    """Hold a finished study (an evaluation of several settings): its outcome and its data.

    `path` is its folder, `headline` its outcome in sentences, `about` says what they are
    conditional on, and `tables` has its data frames by the name of the file. A notebook shows the
    outcome and its figures.
    """

    path: Path  # its folder, with `index.html`
    headline: Sequence[str]  # the outcome in sentences
    about: Sequence[str]  # n, what intervals are over, and what the outcome is conditional on
    tables: "Mapping[str, pd.DataFrame]"  # its data, by the name of the file

    def _repr_html_(self) -> str:
        from harness.report.library import picture

        image = '<img alt="{}" src="{}">'
        figures = [
            Markup(image).format(file.stem, picture(bytes_of(file, "picture")))
            for file in sorted(self.path.glob("*.svg"))
        ]
        return _page(
            self.headline, *figures, *(Markup("<p>{}</p>").format(text) for text in self.about)
        )


def run(
    *,
    out: str | PathLike[str] | None = None,
    cache: bool = True,
    workers: int = 1,
    quiet: bool = False,
    **options: Any,
) -> Run:
    """Evaluate a model with a prompt, on frozen scenes or in closed loop, and return the run.

    A run that was stopped goes on; the same call where it is finished raises UserError,
    as the command does.

    Args:
        out: the run's folder. Default: the command line's, under `reports`.
        cache: whether answers that an earlier run stored are taken.
        workers: processes; for rules on frozen scenes, and in closed loop.
        quiet: whether progress is left out.
        options: settings of `harness eval`, or of `harness drive` if one of its own is among them,
            such as `scenario`: each by its name there, with `_` for `-`; a list where it is
            repeatable. Options that extensions add there, as well.

    Raises:
        UserError: a setting is unknown or not allowed, or the folder holds something else.
    """
    from harness.backends.cache import default_file
    from harness.cli.run import default_out, evaluate
    from harness.evaluate import resolve
    from harness.evaluate.command_options import OPTIONS, follows, guarded
    from harness.evaluate.spec import Source
    from harness.runs import settings

    names = {}
    for world in settings.WORLDS.values():
        names[world] = {each.name: each for each in settings.options(world)}
    frozen, driven = names.values()
    kind = (
        settings.DriveSettings
        if set(options) & (driven.keys() - frozen)
        else settings.FrozenSettings
    )
    given, of_command = dict[str, Any](), dict[str, Any]()
    for name, value in options.items():
        if name in names[kind]:
            listed = names[kind][name].kind == list[str]
            given[name] = _several(value) if listed else value
        elif name in OPTIONS:
            of_command[name] = _of_option(name, value, OPTIONS[name].kind)
        elif owner := owner_of_plugin("options", name):
            raise UserError(f"setting {name} is {part_of(owner)}")
        else:
            raise unknown("setting", name, [*names[kind], *OPTIONS])
    run_settings = settings.changed(settings.Settings(world=kind()), given)
    settings.check_extensions(run_settings, "settings")
    source: Source
    if isinstance(run_settings.world, settings.FrozenSettings):
        source = resolve.frozen(run_settings, run_settings.world.dataset)
    else:
        source = resolve.driven(run_settings)
    spec = resolve.spec(run_settings, source)
    folder = default_out(spec) if out is None else _path("out", out)
    run_follows, kept = follows(of_command), default_file() if cache else None
    with guarded(of_command, [spec], workers) as [spec]:
        evaluate(spec, folder, cache=kept, quiet=quiet, workers=workers, follows=run_follows)
    return load(folder)


def load(run: str | PathLike[str]) -> Run:
    """Load a finished run.

    Args:
        run: folder made by `harness eval` or `harness drive`.

    Raises:
        UserError: it is no finished run, or a file of it is broken.
    """
    return tables_of(_path("run", run), Run)


def ls(folder: str | PathLike[str] = "reports") -> "pd.DataFrame":
    """Return the runs and studies in a folder as rows, newest first.

    The columns are those of `harness run ls`, such as `name`, `kind`, `state`, `date`, `model` and
    `success`, from 0 to 1.

    Raises:
        UserError: there is no such folder.
    """
    import pandas as pd

    from harness.runs.listing import Listed, runs

    names = list(Listed.__dataclass_fields__)
    rows = []
    for listed in runs(_path("folder", folder)):
        rows.append({name: _encodable(getattr(listed, name)) for name in names})
    return pd.DataFrame(rows, columns=names)


def compare(a: str | PathLike[str] | Run, b: str | PathLike[str] | Run) -> Comparison:
    """Return the comparison of run B with run A, on the episodes, conditions and seeds of both.

    A condition is a set of settings that a run is scored under; a seed fixes its lost messages.

    Args:
        a: the run that is compared with: its folder, or a loaded run.
        b: the run that is compared, likewise.

    Raises:
        UserError: one is no finished run, or they have nothing to be paired by.
    """
    from harness.report.compare.difference import compare as compared
    from harness.report.compare.pair import pair
    from harness.report.compare.text import mapping
    from harness.report.compare.words import outcomes

    first, second = _folder_of("a", a), _folder_of("b", b)
    difference = compared(pair(first, second))
    return Comparison(
        mapping(difference, (), most=10),
        tuple(sentence for sentence, _ in outcomes(difference)),
        difference.held,
    )


def sweep(
    run: str | PathLike[str] | Run,
    over: str | Sequence[str] = (),
    grid: str | Sequence[str] = (),
    *,
    condition: str | Sequence[str] = "6g",
    seeds: str | None = None,
    out: str | PathLike[str] | None = None,
    quiet: bool = False,
) -> Study:
    """Score a run's stored answers at other operating points; write the study and return it.

    An operating point is a set of settings of radio channel, asking of helpers and fusion.

    Args:
        run: the run. Its model is asked only where it has no answer.
        over: settings to vary, as `harness study sweep --over` takes them; several are crossed.
        grid: the values of each, such as `0:1:0.25` (first, last, step).
        condition: names of the operating points whose settings are varied.
        seeds: channel seeds, which fix the messages that get lost, such as `0:5`. Default: the
            run's.
        out: the study's folder. Default: the command line's, in the run's folder.
        quiet: whether progress is left out.

    Raises:
        UserError: an axis, a value or a condition is unknown, or the folder holds another study.
    """
    from harness.cli.progress import bar
    from harness.runs.settings import parse_seeds
    from harness.studies.replayed_run import ReplayedRun
    from harness.studies.study import write_study
    from harness.studies.sweep import folder_of, panels_over, run_sweep

    path = _folder_of("run", run)
    with bar("grid points", quiet=quiet, grows=True) as progress:
        replayed = ReplayedRun(path, progress=progress)
        typed = {"over": over, "grid": grid, "condition": condition}
        for name, value in typed.items():
            typed[name] = _of_option(name, value, list[str]) or ()
        panels = panels_over([replayed], typed["over"], typed["grid"], typed["condition"])
        progress.more(sum(map(len, panels.values())))
        folder = folder_of(path, panels) if out is None else _path("out", out)
        draws = parse_seeds(seeds) if seeds else replayed.seeds
        study = run_sweep([replayed], panels, draws, folder, progress, progress.say)
    return Study(write_study(study, folder).parent, study.headline, study.about, study.data)


def _encodable(value: Any) -> Any:
    """Return a value; of a text, lone surrogates are escaped, which no table can hold."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _folder_of(name: str, run: Any) -> Path:
    """Return the folder of a run, which an argument of this name is or names."""
    return run.path if isinstance(run, Run) else _path(name, run)


def _path(name: str, value: Any) -> Path:
    """Return the path that an argument of this name gives. Raises UserError for what is none."""
    if not isinstance(value, str | PathLike):
        raise UserError(f"{name} = {printable(repr(value))}; allowed: a path, as text or a Path")
    return Path(value)


def _of_option(name: str, value: Any, kind: Any) -> Any:
    """Return the value of an option that an extension adds to commands; None where it is None."""
    if value is None:
        return None
    table = {name: _several(value) if kind == list[str] else value}
    return getattr(convert(table, msgspec.defstruct("Options", [(name, kind)]), "options"), name)


def _several(value: str | Sequence[str]) -> Sequence[str]:
    return [value] if isinstance(value, str) else value


def _page(sentences: Sequence[str], *parts: Markup | str) -> str:
    paragraphs = [Markup("<p>{}</p>").format(sentence) for sentence in sentences]
    return Markup("").join(paragraphs + [escape(part) for part in parts])


def _frame(frame: "pd.DataFrame") -> Markup:
    # it escapes texts
    return Markup(frame.to_html(index=False, na_rep="–", float_format="{:.4g}".format))
