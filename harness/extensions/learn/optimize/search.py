"""Search the wording of a prompt version on tune layouts,
and certify the winner once on report layouts.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from harness.backends.swarm import open_each, together
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.figures import POINTS, as_mapping, interval_of, within
from harness.core.files import BROKEN, text_of
from harness.core.progress import Progress
from harness.core.seeds import seeds_text
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.evaluate import latency as latencies
from harness.evaluate.run import Opens, read_or_evaluate
from harness.evaluate.spec import Spec
from harness.extensions.learn.optimize.candidate import Candidate, chosen, space, write
from harness.extensions.learn.optimize.engines import Engine
from harness.extensions.learn.optimize.tuning import Record, Spent, Tuning, changed, tokens
from harness.prompts.versions import ROLES, Prompt, load
from harness.report.document import Table
from harness.runs.folder import Run
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric_values import by_episode
from harness.runs.metrics import METRICS
from harness.runs.success import Success, alike, mean_difference, of_families
from harness.studies.study import Study, ends

HISTORY = "history.json"  # beside a version's files: where it comes from; no part of its digest
OLD, NEW = "base", "winner"  # the folders of the two runs on report layouts


@dataclass(frozen=True)
class Search:
    """Describe a search for a better wording of a prompt.

    Wordings are compared by evaluations on tune layouts, start situations for choosing, within a
    budget of questions to the model. The winner is measured once on report layouts, the test set,
    and written as a new prompt version: a folder of prompt templates.
    """

    base: Prompt  # the prompt version whose wording is searched
    # evaluations of the base on tune layouts, one a scenario, each of one condition
    tune: Sequence[Spec]
    # return the same on report layouts; called after the search, if it has a winner
    report: Callable[[], Sequence[Spec]]
    budget: int  # most questions that may be asked on tune layouts
    version: str  # name of the prompt version that is made
    prompts: Path  # the folder of versions that it is written to
    engine: str  # name of the engine, and of what it uses
    command: str  # the words that repeat it


def choices(prompt: Prompt) -> dict[str, int]:
    """Return how many wordings each marked place of a prompt has to try, by the place's name.
    Raises UserError if no place is marked.
    """
    sizes = space(prompt)
    if not sizes:
        raise UserError(
            f"--prompt {prompt.version}: no alternatives are marked in it; mark some, such as "
            "{% either name %}one{% or %}another{% endeither %}, or give --reflect MODEL"
        )
    return sizes


def render_all(spec: Spec) -> None:
    """Render each alternative wording of a prompt once, on one scene, and discard the texts.

    `spec` is the evaluation, which has the prompt and the scenes. Raises UserError, with the
    alternative's name, if one cannot be rendered.
    """
    sizes = space(spec.ego.prompt)
    [scene] = spec.source.trial(1, ego_alone=False)
    graphs = {graph.role: graph for graph in scene.graphs.values()}
    for name, count in sizes.items():
        for number in range(count):
            try:
                prompt = chosen(spec.ego.prompt, {name: number}).prompt
                for role in ROLES:
                    if role in graphs:
                        words = spec.scenario_of(scene).prompt_words
                        prompt.render(graphs[role], spec.actions, words=words)
            except UserError as error:
                raise UserError(f"alternative {number + 1} of {name}: {error}") from None


def search(
    plan: Search,
    engine: Engine,
    out: Path,
    place: Path,
    opens: Opens,
    progress: Progress,
    cache_file: Path | None,
) -> Study:
    """Search a better wording of a prompt, measure it on a test set, and write it as a new version.

    A prompt version is a folder of templates, and a wording is its texts; the search begins with
    that of the version `plan.base`. Wordings compete on tune layouts, start situations for
    choosing; the winner is measured once on report layouts, the test set. If none beats the base on
    tune layouts, no report layout is read and no version written. Returns a study, the tables and
    sentences of a page: which wordings were tried, and what the winner gained over the base.

    Args:
        plan: the base, the layouts, and the budget of questions.
        engine: proposes wordings. It is called once with a `Tuning`, which plays a wording on tune
            layouts and returns its score, and it returns when it has tried all.
        out: the folder in which the runs on report layouts stay, of base and winner.
        place: the folder of the answers so far, from which a stopped search resumes.
        opens: opens a model's backend, the code that runs it.
        progress: is called with the number of questions just asked.
        cache_file: file of stored completions; None for no cache.

    Raises:
        UserError: the budget does not suffice for the base.
    """
    for spec in plan.tune:
        render_all(spec)
    opens = cache(opens)
    first = plan.tune[0]
    models = open_each(first.cards, partial(opens, **first.opening))
    latency = latencies.chosen_latency(first.settings.latency, first.agents, models)
    assert latency  # it is not to be measured
    backend = together(first.cards, models, cache_file)
    base = chosen(plan.base)
    tuning = Tuning(plan.tune, plan.budget, backend, latency, place, progress)
    try:
        tuning.rank(base)
    except Spent:
        raise UserError(
            f"--budget {plan.budget}: the base alone takes more on {len(tuning.layouts)} tune "
            "layouts; give more, or fewer --layouts"
        ) from None
    with suppress(Spent):
        engine(tuning)
    winner = tuning.best()
    report: Sequence[Spec] = ()
    runs: dict[str, list[Run]] = {}
    if winner.key != base.key:
        new, report = replace(winner.prompt, version=plan.version), plan.report()
        for name, prompt in ((OLD, plan.base), (NEW, new)):
            places = [f"{name}-{spec.source.name}" if len(report) > 1 else name for spec in report]
            runs[name] = []
            for spec, folder in zip(report, places, strict=True):
                evaluation = changed(spec, prompt)
                run = read_or_evaluate(evaluation, out / folder, progress, cache_file, opens)
                runs[name].append(run)
    study = _study(plan, tuning, winner, report, runs, getattr(engine, "replies", 0))
    if runs:
        history = json.dumps(study.manifest, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
        write(replace(winner, prompt=new), plan.prompts / plan.version, {HISTORY: history})
        load(plan.version)
    return study


def looks(base: Prompt, where: Path) -> int:
    """Return how often the test set was used to make a prompt version.

    A search measures its winner on report layouts (start situations); the more often, the less an
    unseen result it is. It counts the searches from which `base` came, by the history file in its
    folder under `where`; 0 without one.
    """
    with suppress(*BROKEN):
        return max(0, int(json.loads(text_of(where / base.version / HISTORY))["looks"]))
    return 0


def _success(run: Run) -> Floats:
    """Return success under the one condition, (S, E)."""
    values = by_episode([METRICS[SUCCESS]], run.grid, run.decisions, run.episodes)
    return np.asarray(values[SUCCESS][0])


def _certificate(
    old: Sequence[Run], new: Sequence[Run]
) -> tuple[Success, list[dict[str, Estimate]]]:
    """Return how success counts, and by family (and for all) both prompts' estimates and their
    difference.
    """
    first_seeds = [run.episodes[: len(run.grid.episodes)] for run in old]
    rules = alike([Success.of(episodes, BALANCED) for episodes in first_seeds])
    old_success = [_success(run) for run in old]
    new_success = [_success(run) for run in new]
    pairs = list(zip(rules, new_success, old_success, strict=True))
    rows: list[dict[str, Estimate]] = []
    for rule, after, before in pairs:
        difference = rule.difference(after, before)
        row = {OLD: rule.estimate(before), NEW: rule.estimate(after), "difference": difference}
        rows.append(row)
    if len(rows) > 1:
        old_mean = of_families([row[OLD] for row in rows], rules)
        new_mean = of_families([row[NEW] for row in rows], rules)
        rows.append({OLD: old_mean, NEW: new_mean, "difference": mean_difference(pairs)})
    return rules[0], rows


def _study(
    plan: Search,
    tuning: Tuning,
    winner: Candidate,
    report: Sequence[Spec],
    runs: Mapping[str, Sequence[Run]],
    replies: int,
) -> Study:
    """Return the study of a search: what was tried, and what the winner gained.

    `runs` are those on report layouts, by `OLD` and `NEW`; none where no prompt was better than
    the base. `replies` counts the texts of the model that reflects.
    """
    import pandas as pd

    base, agent = plan.base, plan.tune[0].ego
    tried = [_row(tuning, record) for record in tuning.records.values()]
    tune = []
    for spec in tuning.specs:
        layouts = len(list(spec.source.layout_seeds))
        tune.append({"scenario": spec.scenario.name, "layouts": layouts, "seeds": _seeds(spec)})
    wordings = []
    for wording, record in zip(tried, tuning.records.values(), strict=True):
        texts = record.candidate.rewritten
        wordings.append({**wording, "system": dict(texts)} if texts else wording)
    seeds = ", ".join(sorted({_seeds(spec) for spec in tuning.specs}))
    where = f"{len(tuning.layouts)} tune layouts ({seeds})"
    manifest: dict[str, Any] = {
        "version": plan.version,
        "sha256": winner.key,
        "base": {"version": base.version, "sha256": base.sha256},
        "engine": plan.engine,
        "model": agent.card.record(),
        "answer": agent.answer,
        "condition": plan.tune[0].points[0].name,
        "tune": tune,
        "budget": plan.budget,
        "questions": tuning.spent,
        "tokens": tuning.tokens,
        "reflections": replies,
        "tried": wordings,
        "chosen": winner.what,
        "command": plan.command,
        "versions": versions(),
    }
    best, first = tuning.records[winner.key], tuning.records[chosen(base).key]
    cost = f"{tuning.spent} questions of {plan.budget}, {tuning.tokens} tokens"
    cost += f", {replies} texts of the reflecting model" if replies else ""
    searched = f"{len(tried)} wordings of {base.version} were tried on {where} with {cost}"
    tables, data = [_tried_table(tried)], {"tried": pd.DataFrame(tried)}
    if not runs:
        headline = [
            f"None is better than {base.version} for {agent.name} on the tune layouts, so no "
            "version was written and no report layout was read.",
            f"{searched}.",
        ]
        return Study(
            "optimize",
            f"Wordings of {base.version} for {agent.name}",
            headline,
            [_about(plan)],
            tables,
            data,
            {**manifest, "certificate": None},
            manifest,
        )
    success, rows = _certificate(runs[OLD], runs[NEW])
    names = [spec.source.name for spec in report]
    if len(rows) > len(report):
        names.append("mean")
    report_runs = [run for of_prompt in runs.values() for run in of_prompt]
    answers = [answer for run in report_runs for answer in run.answers]
    look = looks(base, plan.prompts) + 1
    families, cells, estimates = [], [], []
    for name, row in zip(names, rows, strict=True):
        family: dict[str, Any] = {"dataset": name}
        for side, estimate in row.items():
            family[side] = as_mapping(estimate)
            estimates.append({"dataset": name, "side": side, **ends(estimate)})
        families.append(family)
        gained = row["difference"]
        points = interval_of(gained, POINTS, "+")
        cells.append((name, interval_of(row[OLD]), interval_of(row[NEW]), points, str(gained.n)))
    report_seeds = [_seeds(spec) for spec in report]
    certificate = {
        "metric": success.metric,
        "seeds": report_seeds,
        "questions": len(answers),
        "tokens": tokens(answers),
        "families": families,
    }
    manifest |= {"certificate": certificate, "looks": look}
    gain, what = rows[-1]["difference"], success.words
    headline = [
        f"{plan.version} against {base.version}: {interval_of(gain, POINTS, '+')} points of {what} "
        f"on report layouts, {_verdict(gain)} (n = {gain.n} layouts, paired, 95 % interval over "
        f"layouts; {', '.join(report_seeds)}, read once, after the search).",
        f"On the tune layouts that chose it: {100 * _mean(tuning, best):.1f} % against "
        f"{100 * _mean(tuning, first):.1f} %. {searched}; the best is: "
        f"{winner.what}.",
        f"The certificate took {len(answers)} questions and {tokens(answers)} tokens more.",
    ]
    caveats = (
        [
            "Report layouts were read for versions that this one comes from, too: look number "
            f"{look}."
        ]
        if look > 1
        else []
    )
    table = Table(
        "Certificate, on report layouts",
        ("dataset", f"{base.version}, %", f"{plan.version}, %", "difference, points", "n"),
        cells,
        f"{what.capitalize()}, paired by layout, 95 % intervals over layouts.",
        terminal=range(5),
    )
    return Study(
        "optimize",
        f"{plan.version}, from {base.version}, for {agent.name}",
        headline,
        [_about(plan)],
        [table, *tables],
        {**data, "certificate": pd.DataFrame(estimates)},
        manifest,
        manifest,
        caveats=caveats,
    )


def _verdict(gain: Estimate) -> str:
    """Return in words what an interval says of a gain."""
    if gain.low != gain.low:
        return "too few layouts for an interval"
    if gain.low > 0:
        return "clear of zero"
    if gain.high < 0:
        return "clearly worse"
    return f"not clear of zero, but within {within(gain.low, gain.high)}"


def _about(plan: Search) -> str:
    """Return the line of a page that says what the scores of its tables are."""
    return (
        f"Engine: {plan.engine}. Condition: {plan.tune[0].points[0].name}. Score on tune layouts: "
        "success, balanced over layouts with and without a danger where there are both, then the "
        "worth of what is stated (the tree's probability of success if later actions are drawn "
        "evenly), then the shorter text."
    )


def _seeds(spec: Spec) -> str:
    """Return the layout seeds of an evaluation in words."""
    seeds = list(spec.source.layout_seeds)
    return seeds_text(min(seeds), max(seeds) - min(seeds) + 1)


def _mean(tuning: Tuning, record: Record) -> float:
    """Return a candidate's success on the layouts on which it was played."""
    layouts = np.array(sorted(record.played))
    return float(tuning.weights(layouts) @ [record.played[n].success for n in layouts.tolist()])


def _row(tuning: Tuning, record: Record) -> dict[str, Any]:
    """Return what is known of a candidate, a row of the table of wordings."""
    layouts = np.array(sorted(record.played), dtype=int)
    is_played = len(layouts) > 0
    worth = [record.played[n].worth for n in layouts.tolist()]
    return {
        "wording": record.candidate.what,
        "sha256": record.candidate.key,
        "layouts": len(layouts),
        "questions": len(record.asked),
        "characters": record.length,
        "success": round(_mean(tuning, record), 6) if is_played else None,
        "worth": round(float(tuning.weights(layouts) @ worth), 6) if is_played else None,
    }


def _tried_table(tried: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of wordings, a row each."""

    def cell(value: float | None, factor: float, form: str) -> str:
        return "–" if value is None else format(factor * value, form)

    rows = []
    for row in tried:
        success, worth = cell(row["success"], 100, ".1f"), cell(row["worth"], 1, ".3f")
        counts = str(row["questions"]), str(row["characters"])
        rows.append((row["wording"], str(row["layouts"]), success, worth, *counts))
    return Table(
        "Wordings tried, on tune layouts",
        ("wording", "layouts", "success, %", "worth", "questions", "characters"),
        rows,
        "Success is balanced where there are layouts with and without a danger. A wording that "
        "was worse on half of the layouts was not played on the rest. These layouts chose, so "
        "that the best one's figure flatters it. Characters are those of the ego's prompt in the "
        "first decision point.",
        terminal=range(5),
        most=12,
    )
