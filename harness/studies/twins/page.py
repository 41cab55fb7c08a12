"""The folder and the page of a study of twins."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup, escape

from harness.core.errors import printable
from harness.core.figures import as_mapping, shown
from harness.core.files import write_whole
from harness.core.versions import versions
from harness.report.compare.gate import Verdict
from harness.report.compare.words import judged
from harness.report.page import environment, visible
from harness.studies.twins.asking import RESULT, Study, lack
from harness.studies.twins.declared import TWINS, Twin
from harness.studies.twins.scoring import METRICS, Pair, Row, headline

FORMAT = "swarmdrive-twins/1"
TEMPLATES = Path(__file__).parent.parent / "templates"
EXAMPLES = 3  # of each row


def write(
    study: Study, pairs: Sequence[Pair], rows: Sequence[Row], verdicts: Sequence[Verdict], out: Path,
    lost: str = "",
) -> Path:  # fmt: skip
    """Write `pairs.jsonl`, the page, which is returned, and last `twins.json`.

    `lost` says how many questions got no answer.
    """
    lines = [{k: v for k, v in asdict(pair).items() if k != "messages"} for pair in pairs]
    write_whole(out / "pairs.jsonl", b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    page = environment(TEMPLATES).get_template("twins.html.j2").render(
        study=study, spec=study.spec, rows=rows, headline=headline(rows), notes=notes(study, rows, lost),
        points=decision_points(study), examples=EXAMPLES, verdicts=verdicts, judged=judged, cell=shown,
        difference=difference, of_constant=of_constant,
    )  # fmt: skip
    write_whole(out / "index.html", page)
    content = {"format": FORMAT, **mapping(study, rows, verdicts, lost), "versions": versions()}
    write_whole(out / RESULT, msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n")
    return out / "index.html"


def mapping(
    study: Study, rows: Sequence[Row], verdicts: Sequence[Verdict], lost: str = ""
) -> dict[str, Any]:  # fmt: skip
    """The result as plain values; null where there is no number."""
    table = [
        {
            "twin": row.twin.name, "role": row.role, "holds": row.twin.holds, "episodes": row.episodes,
            "holds_of_constant": of_constant(study, row.twin),
            **{metric: as_mapping(getattr(row, metric)) for metric in METRICS},
        }
        for row in rows
    ]  # fmt: skip
    gates = [{"gate": v.gate, "passed": not v.failed, "failed": dict(v.failed)} for v in verdicts]
    return {
        **study.spec.ego.settings(), "world": msgspec.to_builtins(study.spec.source.record()),
        "seed": study.seed, "decision_points": decision_points(study), "rows": table,
        "left_out": missing(study, rows), **({"unanswered": lost} if lost else {}), "gates": gates,
    }  # fmt: skip


def decision_points(study: Study) -> int:
    """How many were drawn."""
    return sum(map(len, study.points().values()))


def missing(study: Study, rows: Sequence[Row]) -> dict[str, str]:
    """The twins that no question has, and what they need."""
    had = {row.twin.name for row in rows}
    return {n: lack(study.spec, TWINS[n]) or TWINS[n].needs for n in study.twins if n not in had}


def notes(study: Study, rows: Sequence[Row], lost: str = "") -> list[str]:
    """What a reader must know besides the rows."""
    who, by_need = printable(study.spec.ego.card.name), dict[str, list[str]]()
    for name, need in missing(study, rows).items():
        by_need.setdefault(need, []).append(name)
    said = [
        f"left out, since no question has it: {', '.join(of)} (needs {need})" for need, of in by_need.items()
    ]
    if lost:
        said.append(f"no answer to {printable(lost)}; their pairs are left out")
    said.insert(0, same_answer(study, rows))
    if not study.spec.ego.can.language_model:
        said.insert(0, f"{who} reads the scene graph and not the text, so this says nothing about the prompt")
    return said


def of_constant(study: Study, twin: Twin) -> bool:
    """Whether a twin holds of an ego that always gives the same answer: every time, or never.

    Over cyclic orders one letter is every action alike, which is the same for the twin.
    """
    return twin.constant or study.spec.ego.letters == "cyclic"


def same_answer(study: Study, rows: Sequence[Row]) -> str:
    """What these twins would say of an ego that reads nothing."""
    broken = list(dict.fromkeys(row.twin.name for row in rows if not of_constant(study, row.twin)))
    but = f" of every twin but {', '.join(broken)}, of which it holds 0 %" if broken else " of every twin"
    return f"an ego that always gives the same answer holds 100 %{but}: to hold is not to read"


def difference(a: str, b: str) -> Iterator[tuple[str, Markup]]:
    """The lines that two texts do not share, `-` of the first and `+` of the other, with words marked."""
    old, new = a.splitlines(), b.splitlines()
    for kind, i, j, k, n in SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if kind != "equal":
            before, after = "\n".join(old[i:j]).split(" "), "\n".join(new[k:n]).split(" ")
            changes = SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
            sides = (
                ("-", before, [(kind, start, end) for kind, start, end, *_ in changes]),
                ("+", after, [(kind, start, end) for kind, *_, start, end in changes]),
            )
            for sign, words, parts in sides:
                if any(words):
                    shown = (_word(words[start:end], kind) for kind, start, end in parts if start < end)
                    yield sign, Markup(" ").join(shown)


def _word(words: Sequence[str], kind: str) -> Markup:
    shown = escape(visible(" ".join(words)))
    return shown if kind == "equal" else Markup("<mark>{}</mark>").format(shown)
