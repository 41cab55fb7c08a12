"""The study of twins: what holds of the answers, and the pairs that are farthest apart."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup, escape

from harness.core.figures import PERCENT, Unit, as_mapping, interval_of
from harness.core.files import write_whole
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.extensions.studies.twins.asking import Questions, lack
from harness.extensions.studies.twins.declared import TWINS, Twin
from harness.extensions.studies.twins.scoring import METRICS, ROLES, Pair, Row, headline
from harness.report.compare.gate import Verdict
from harness.report.compare.words import judged
from harness.report.document import Table
from harness.report.drawing.colours import ROLES as COLOUR_OF_ROLE
from harness.report.templating import environment, visible
from harness.studies.figures.described import Draws, Rows
from harness.studies.study import Study

EXAMPLES = 3  # of each row
DISTANCE = Unit(decimals=2)
HEADS = (
    "twin",
    "role",
    "holds",
    "invariant %, 95 % CI",
    "TV distance",
    "failed %",
    "n",
    "constant answer %",
    "episodes",
    "what is other",
    "examples",
)


def write_pairs(pairs: Sequence[Pair], out: Path) -> None:
    """Write every pair of answers as a line of JSON to the file `pairs.jsonl` in the folder `out`.

    A pair is the answers to a question and to its twin, the same question put another way.
    """
    lines = []
    for pair in pairs:
        values = asdict(pair)
        del values["messages"]
        lines.append(msgspec.json.encode(values) + b"\n")
    write_whole(out / "pairs.jsonl", b"".join(lines))


def twins_study(
    questions: Questions, rows: Sequence[Row], verdicts: Sequence[Verdict], unanswered: str = ""
) -> Study:
    """Return the study of twins (questions put another way) for page, terminal and `--json`.

    `questions` says what was asked, and `rows` have the results by twin and role (who was asked).
    `verdicts` are those of the gates, limits that the user set with `--fail-if`; `unanswered` says
    in words which questions got no answer.
    """
    answer, spec = mapping(questions, rows, verdicts, unanswered), questions.spec
    return Study(
        "twins",
        f"Twins: {spec.ego.name} on {spec.source.name}",
        [headline(rows)],
        [
            "The model is asked each question twice: as it is, and as its twin, which puts the "
            "same situation otherwise. So what must hold of both answers is known without knowing "
            f"the right one. {questions.count()} decision points of "
            f"{len(questions.dataset.episodes)} episodes; n is the number of questions that the "
            "twin changes; 95 % intervals are over episodes. If either answer could not be parsed "
            "(failed), nothing holds, and there is no distance."
        ],
        [
            Table(
                "What holds",
                HEADS,
                [_cells(questions, row) for row in rows],
                "A question is one viewer at one decision point. Invariant: the share of "
                "questions for which what must hold does hold. same: both answers have the same "
                "most probable action (for a mirrored twin, after swapping left and right back). "
                "TV <= x: the distributions are no farther apart than x. TV: total variation "
                "distance, half the sum of the absolute differences, 0 to 1. Constant answer: "
                "what an ego holds that always gives the same answer, and so reads nothing.",
                terminal=range(7),
            )
        ],
        {},
        {**answer, "versions": versions()},
        answer,
        caveats=notes(questions, rows, unanswered),
        more=_examples(spec.actions, rows),
        figures=lambda draws: {"twins": _figure(draws, rows)},
        verdicts=[judged(verdict, "-") for verdict in verdicts],
    )


def _figure(draws: Draws[Any], rows: Sequence[Row]) -> Any:
    """Draw how often each twin holds, and how far apart both answers are, by who was asked."""
    names = list(dict.fromkeys(row.twin.name for row in rows))
    invariance: dict[str, list[Estimate | None]] = {}  # by role, of each name
    distance: dict[str, list[Estimate | None]] = {}
    for role in ROLES:
        of_role = {row.twin.name: row for row in rows if row.role == role}
        if of_role:
            invariance[role], distance[role] = [], []
            for name in names:
                row = of_role.get(name)
                invariance[role].append(None if row is None else row.invariance_rate)
                distance[role].append(None if row is None else row.tv_distance)
    panels = [
        Rows("invariant, %", names, invariance, 100.0),
        Rows("TV distance", names, distance, 1.0),
    ]
    return draws.intervals(panels, COLOUR_OF_ROLE)


def _cells(questions: Questions, row: Row) -> list[str]:
    name = f"{row.twin.name}-{row.role}"
    links = [
        Markup('<a href="#{}-{}">{}</a>').format(name, n, n)
        for n, _ in enumerate(row.broken[:EXAMPLES], 1)
    ]
    return [
        Markup('<span id="{}">{}</span>').format(name, row.twin.name),
        row.role,
        row.twin.holds,
        interval_of(row.invariance_rate),
        interval_of(row.tv_distance, DISTANCE),
        PERCENT.number(row.failed_rate.value),
        str(row.invariance_rate.n),
        "100" if constant_holds(questions, row.twin) else "0",
        str(row.episodes),
        row.twin.says,
        Markup(" ").join(links) or "–",
    ]


def _examples(actions: Sequence[str], rows: Sequence[Row]) -> Markup:
    examples = []
    for row in rows:
        for n, pair in enumerate(row.broken[:EXAMPLES], 1):
            examples.append((row, n, pair, list(difference(*pair.messages))))
    template = environment(Path(__file__).parent).get_template("examples.html.j2")
    return Markup(template.render(actions=actions, examples=examples))


def mapping(
    questions: Questions, rows: Sequence[Row], verdicts: Sequence[Verdict], unanswered: str = ""
) -> dict[str, Any]:
    """Return the result of a study of twins as plain values, with null for unknown numbers.

    A twin is a question put another way. `questions` says what was asked, `rows` have the results
    by twin and role (who was asked), `verdicts` those of the gates, limits that the user set with
    `--fail-if`, and `unanswered` says in words which questions got no answer. In the dict `rows`
    have each twin and role with the share of pairs that hold, the distance of their answers and the
    share that failed; `left_out` has the twins that no question has, and `gates` the verdicts.
    """
    table, gates = list[dict[str, Any]](), list[dict[str, Any]]()
    for row in rows:
        place = {"twin": row.twin.name, "role": row.role, "holds": row.twin.holds}
        of_constant = constant_holds(questions, row.twin)
        counts = {"episodes": row.episodes, "holds_of_constant": of_constant}
        estimates = {metric: as_mapping(getattr(row, metric)) for metric in METRICS}
        table.append({**place, **counts, **estimates})
    for verdict in verdicts:
        failed = dict(verdict.failed)
        gates.append({"gate": verdict.gate, "passed": not failed, "failed": failed})
    result = {
        **questions.spec.ego.settings(),
        "world": questions.spec.source.record(),
        "seed": questions.seed,
        "decision_points": questions.count(),
        "rows": table,
        "left_out": missing(questions, rows),
    }
    if unanswered:
        result["unanswered"] = unanswered
    plain: dict[str, Any] = msgspec.to_builtins({**result, "gates": gates})
    return plain


def missing(questions: Questions, rows: Sequence[Row]) -> dict[str, str]:
    """Return what each twin that applies to no question needs, in words, by the twin's name.

    A twin is a question put another way; one without a row in `rows` applied to none of
    `questions`.
    """
    with_rows = {row.twin.name for row in rows}
    needs = {}
    for name in questions.twins:
        if name not in with_rows:
            needs[name] = lack(questions.spec, TWINS[name]) or TWINS[name].needs
    return needs


def notes(questions: Questions, rows: Sequence[Row], unanswered: str = "") -> list[str]:
    """Return the sentences with which a reader must take the results of a study of twins.

    They say what the twins (questions put another way) do not show, which were left out, and which
    questions got no answer: `unanswered` says so in words.
    """
    by_need = dict[str, list[str]]()
    for name, need in missing(questions, rows).items():
        by_need.setdefault(need, []).append(name)
    sentences = []
    if not questions.spec.ego.can.language_model:
        sentences.append(
            f"{questions.spec.ego.card.name} reads the scene graph and not the text, so this says "
            "nothing about the prompt."
        )
    sentences.append(same_answer(questions, rows))
    for need, names in by_need.items():
        sentences.append(f"Left out, since no question has it: {', '.join(names)} (needs {need}).")
    if unanswered:
        sentences.append(f"No answer to {unanswered}; their pairs are left out.")
    return sentences


def constant_holds(questions: Questions, twin: Twin) -> bool:
    """Return whether an ego that always gives the same answer would pass a twin's test.

    A twin is a question put another way, and its test how the answers to both versions must be
    related. Such an ego reads nothing, so its passing is no merit. If letters that stand for
    actions are asked in several orders and averaged, it always passes: one letter then stands for
    every action alike.
    """
    return twin.constant or questions.spec.ego.letters == "cyclic"


def same_answer(questions: Questions, rows: Sequence[Row]) -> str:
    """Return a sentence on which twins hold for an ego that always gives the same answer.

    A twin, a question put another way, holds if the answers to both versions of a question are
    related as it demands.
    """
    broken = [row.twin.name for row in rows if not constant_holds(questions, row.twin)]
    twins = "every twin"
    if broken:
        names = ", ".join(dict.fromkeys(broken))
        twins = f"every twin but {names}, of which it holds 0 %"
    return (
        f"An ego that always gives the same answer holds 100 % of {twins}: to hold is not to read."
    )


def difference(a: str, b: str) -> Iterator[tuple[str, Markup]]:
    """Yield the lines in which two texts differ, as pairs of a sign and HTML.

    The sign is `-` for a line of `a` and `+` for one of `b`; changed words are marked.
    """
    old, new = a.splitlines(), b.splitlines()
    for kind, i, j, k, n in SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if kind != "equal":
            before, after = "\n".join(old[i:j]).split(" "), "\n".join(new[k:n]).split(" ")
            changes = SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
            removed = [(kind, before[start:end]) for kind, start, end, *_ in changes]
            added = [(kind, after[start:end]) for kind, *_, start, end in changes]
            for sign, line, parts in (("-", before, removed), ("+", after, added)):
                if any(line):
                    pieces = [_word(words, kind) for kind, words in parts if words]
                    yield sign, Markup(" ").join(pieces)


def _word(words: Sequence[str], kind: str) -> Markup:
    text = escape(visible(" ".join(words)))
    return text if kind == "equal" else Markup("<mark>{}</mark>").format(text)
