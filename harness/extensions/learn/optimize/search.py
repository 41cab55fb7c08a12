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
from harness.core.figures import POINTS, as_mapping, shown, within
from harness.core.files import BROKEN, text_of
from harness.core.progress import Progress
from harness.core.seeds import stated
from harness.core.statistics import Estimate, mean_of
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
from harness.runs.leading import BALANCED, SUCCESS
from harness.runs.metrics import METRICS, by_episode
from harness.runs.success import Success, alike, mean_difference
from harness.studies.study import Study, ends

HISTORY = "history.json"  # beside a version's files: where it comes from; no part of its digest
OLD, NEW = "base", "winner"  # the folders of the two runs on report layouts


@dataclass(frozen=True)
class Search:
    """What is searched, and where it is written."""

    base: Prompt
    # evaluations of the base on tune layouts, one a family, each of one condition
    tune: Sequence[Spec]
    # the same on report layouts: they are opened when a winner stands, and not before
    report: Callable[[], Sequence[Spec]]
    budget: int  # most questions on tune layouts
    version: str  # name of the version that is made
    prompts: Path  # the folder of versions that it is written to
    engine: str  # name of the engine, and of what it uses
    command: str  # the words that repeat it


def choices(prompt: Prompt) -> dict[str, int]:
    """Return the number of alternatives of each choice of a prompt.
    Raises UserError if there are none.
    """
    sizes = space(prompt)
    if not sizes:
        raise UserError(
            f"--prompt {prompt.version}: no alternatives are marked in it; mark some, such as "
            "{% either name %}one{% or %}another{% endeither %}, or give --reflect MODEL"
        )
    return sizes


def render_all(spec: Spec) -> None:
    """Render each alternative once. Raises UserError if one does not render."""
    sizes = space(spec.ego.prompt)
    [scene] = spec.source.trial(1, ego_alone=False)
    graphs = {graph.role: graph for graph in scene.graphs.values()}
    for name, count in sizes.items():
        for number in range(count):
            try:
                prompt = chosen(spec.ego.prompt, {name: number}).prompt
                for role in ROLES:
                    if role in graphs:
                        words = spec.scenario.prompt_words
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
    """Search, certify, write the version, and return what was tried and what it gained.

    `place` is the folder of what is kept until the end. The two runs on report layouts stay in
    `out`. If no candidate is better than the base on tune layouts, no report layout is read and no
    version written.
    """
    for spec in plan.tune:
        render_all(spec)
    opens = cache(opens)
    first = plan.tune[0]
    models = open_each(first.cards, partial(opens, **first.opening))
    latency = latencies.known(first.settings.latency, first.agents, models)
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
            runs[name] = [
                read_or_evaluate(changed(spec, prompt), out / place, progress, cache_file, opens)
                for spec, place in zip(report, places, strict=True)
            ]
    study = _study(plan, tuning, winner, report, runs, getattr(engine, "replies", 0))
    if runs:
        history = json.dumps(study.manifest, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
        write(replace(winner, prompt=new), plan.prompts / plan.version, {HISTORY: history})
        load(plan.version)
    return study


def looks(base: Prompt, where: Path) -> int:
    """Return how often report layouts were read for the versions that a prompt comes from.

    It is 0 where no history of this program says so.
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
    rules = alike([Success.of(run.episodes[: len(run.grid.episodes)], BALANCED) for run in old])
    rows = [
        {OLD: rule.estimate(a), NEW: rule.estimate(b), "difference": rule.difference(b, a)}
        for rule, a, b in zip(rules, map(_success, old), map(_success, new), strict=True)
    ]
    if len(rows) > 1:
        both = {name: mean_of([row[name] for row in rows]) for name in (OLD, NEW)}
        pairs = zip(rules, map(_success, new), map(_success, old), strict=True)
        rows.append({**both, "difference": mean_difference([*pairs])})
    return rules[0], rows


def _study(
    plan: Search,
    tuning: Tuning,
    winner: Candidate,
    report: Sequence[Spec],
    runs: Mapping[str, Sequence[Run]],
    replies: int,
) -> Study:
    import pandas as pd

    base, agent = plan.base, plan.tune[0].ego
    tried = [_row(tuning, record) for record in tuning.records.values()]
    tune = [
        {
            "scenario": s.scenario.name,
            "layouts": len(list(s.source.layout_seeds)),
            "seeds": _seeds(s),
        }
        for s in tuning.specs
    ]
    where = (
        f"{len(tuning.layouts)} tune layouts "
        f"({', '.join(sorted({_seeds(s) for s in tuning.specs}))})"
    )
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
        "tried": [
            {**row, **({"system": dict(r.candidate.rewritten)} if r.candidate.rewritten else {})}
            for row, r in zip(tried, tuning.records.values(), strict=True)
        ],
        "chosen": winner.what,
        "command": plan.command,
        "versions": versions(),
    }
    best, first = (tuning.records[key] for key in (winner.key, chosen(base).key))
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
    names = [spec.source.name for spec in report] + (["mean"] if len(rows) > len(report) else [])
    answers = [answer for side in runs.values() for run in side for answer in run.answers]
    again = looks(base, plan.prompts) + 1
    certificate = {
        "metric": success.metric,
        "seeds": [_seeds(spec) for spec in report],
        "questions": len(answers),
        "tokens": tokens(answers),
        "families": [
            {"dataset": name, **{side: as_mapping(e) for side, e in row.items()}}
            for name, row in zip(names, rows, strict=True)
        ],
    }
    manifest |= {"certificate": certificate, "looks": again}
    last = rows[-1]
    gain, what = last["difference"], success.words
    unclear = f"not clear of zero, but within {within(gain.low, gain.high)}"
    verdict = "clear of zero" if gain.low > 0 else "clearly worse" if gain.high < 0 else unclear
    verdict = verdict if gain.low == gain.low else "too few layouts for an interval"
    headline = [
        f"{plan.version} against {base.version}: {shown(gain, POINTS, '+')} points of {what} on "
        f"report layouts, {verdict} (n = {gain.n} layouts, paired, 95 % interval over layouts; "
        f"{', '.join(map(_seeds, report))}, read once, after the search).",
        f"On the tune layouts that chose it: {100 * _mean(tuning, best):.1f} % against "
        f"{100 * _mean(tuning, first):.1f} %. {searched}; the best is: "
        f"{winner.what}.",
        f"The certificate took {len(answers)} questions and {tokens(answers)} tokens more.",
    ]
    caveats = (
        [
            "Report layouts were read for versions that this one comes from, too: look number "
            f"{again}."
        ]
        if again > 1
        else []
    )
    table = Table(
        "Certificate, on report layouts",
        ("dataset", f"{base.version}, %", f"{plan.version}, %", "difference, points", "n"),
        [
            (
                name,
                shown(row[OLD]),
                shown(row[NEW]),
                shown(row["difference"], POINTS, "+"),
                str(row["difference"].n),
            )
            for name, row in zip(names, rows, strict=True)
        ],
        f"{what.capitalize()}, paired by layout, 95 % intervals over layouts.",
        terminal=range(5),
    )
    flat = [
        {"dataset": name, "side": side, **ends(e)}
        for name, row in zip(names, rows, strict=True)
        for side, e in row.items()
    ]
    return Study(
        "optimize",
        f"{plan.version}, from {base.version}, for {agent.name}",
        headline,
        [_about(plan)],
        [table, *tables],
        {**data, "certificate": pd.DataFrame(flat)},
        manifest,
        manifest,
        caveats=caveats,
    )


def _about(plan: Search) -> str:
    return (
        f"Engine: {plan.engine}. Condition: {plan.tune[0].points[0].name}. Score on tune layouts: "
        "success, balanced over layouts with and without a danger where there are both, then the "
        "worth of what is stated (the tree's probability of success if later actions are drawn "
        "evenly), then the shorter text."
    )


def _seeds(spec: Spec) -> str:
    seeds = list(spec.source.layout_seeds)
    return stated(min(seeds), max(seeds) - min(seeds) + 1)


def _mean(tuning: Tuning, record: Record) -> float:
    layouts = np.array(sorted(record.played))
    return float(tuning.weights(layouts) @ [record.played[n].success for n in layouts.tolist()])


def _row(tuning: Tuning, record: Record) -> dict[str, Any]:
    layouts = np.array(sorted(record.played), dtype=int)
    known = len(layouts) > 0
    worth = [record.played[n].worth for n in layouts.tolist()]
    return {
        "wording": record.candidate.what,
        "sha256": record.candidate.key,
        "layouts": len(layouts),
        "questions": len(record.asked),
        "characters": record.length,
        "success": round(_mean(tuning, record), 6) if known else None,
        "worth": round(float(tuning.weights(layouts) @ worth), 6) if known else None,
    }


def _tried_table(tried: Sequence[Mapping[str, Any]]) -> Table:
    def cell(value: float | None, factor: float, form: str) -> str:
        return "–" if value is None else format(factor * value, form)

    return Table(
        "Wordings tried, on tune layouts",
        ("wording", "layouts", "success, %", "worth", "questions", "characters"),
        [
            (
                row["wording"],
                str(row["layouts"]),
                cell(row["success"], 100, ".1f"),
                cell(row["worth"], 1, ".3f"),
                str(row["questions"]),
                str(row["characters"]),
            )
            for row in tried
        ],
        "Success is balanced where there are layouts with and without a danger. A wording that "
        "was worse on half of the layouts was not played on the rest. These layouts chose, so "
        "that the best one's figure flatters it. Characters are those of the ego's prompt in the "
        "first decision point.",
        terminal=range(5),
        most=12,
    )
