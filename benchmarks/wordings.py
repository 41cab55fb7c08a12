"""What a search over marked wordings gains, by read-out:
SmolLM2 with `v9`, and two small models with `v4`.

    python benchmarks/wordings.py [--only TEXT] [--out reports/wordings] [OPTION ...]

It makes a project in the folder, marks alternatives in copies of the prompts, and types `harness
prompt optimize` for each row of `ROWS`, with further options if any are given. What is finished
stays; a stopped search goes on with the same command. SmolLM2 asks its weights of `harness model
pull smollm2-135m`.
"""

import argparse
import os
import shutil
from pathlib import Path
from typing import NamedTuple

from pages import harness

from harness.core.resources import MARKER, folder

SMALLEST = "--only six --layouts 2 --budget 20"
NEEDS = "torch"


class Row(NamedTuple):
    """A search."""

    model: str
    prompt: str  # the released version that is marked
    marks: dict[str, str]  # text of its ego.j2, and with what it is replaced
    options: str
    dataset: str = "blind-merge-v2"


SAFE, QUICK = "Never collide. ", "Do not lose time where nothing is in your way. "
SPEED = "You drive {{ graph.ego.speed_mps }} m/s"
KMH = "Your speed is {{ (graph.ego.speed_mps * 3.6) | round | int }} km/h"
NEAR = " If a car comes your way and the times are less than 2 seconds apart, choose SLOWER."
FREE = " If no car comes your way, choose FASTER."
WORST = "Collisions are worst; needless delay fails too. "
CLOSE = "A conflict where both arrive within 1 s is dangerous. "
SPREAD, CAREFUL = (
    "Where a region is hidden, spread the probabilities.",
    "Where a region is hidden, be careful.",
)
HEAD = "CONFLICTS id how lane: ego m, s / it m, s"
OBJECTS = (
    "OBJECTS id type ahead left speed lane light\n"
    "{% for n in objects -%}\n"
    "{{ n.id }} {{ n.type }} {{ n.forward_m | round | int }} {{ n.left_m | round | int }} "
    "{{ n.speed_mps | round | int }} {{ n.lane }} "
    '{{ "brake" if n.braking is defined and n.braking else n.indicator or "?" }}\n'
    "{% else -%}\nnone\n{% endfor -%}\n"
    "{% if more and not messages %}and {{ more }} farther away\n{% endif -%}\n"
)
SEEN, TENS = (
    "{{ (s.seen_share * 100) | round | int }}",
    "{{ (s.seen_share * 10) | round | int * 10 }}",
)


def either(name: str, *texts: str) -> str:
    return f"{{% either {name} %}}{'{% or %}'.join(texts)}{{% endeither %}}"


def order(name: str, *texts: str) -> str:
    return f"{{% order {name} %}}{'{% or %}'.join(texts)}{{% endorder %}}"


ROWS = {
    "six": Row(
        "swarm-tiny-six",
        "v4",
        {
            WORST + CLOSE: order("goals", WORST, CLOSE),
            SPREAD: either("hidden", SPREAD, "", CAREFUL),
            HEAD: either("head", HEAD, "CONFLICTS"),
        },
        "--layouts 24 --budget 2000",
    ),
    "smollm2": Row(
        "smollm2-135m",
        "v9",
        {
            SAFE + QUICK: order("goals", SAFE, QUICK),
            "you collide.\n": f"you collide.{either('hint', '', NEAR, FREE)}\n",
            SPEED: either("speed", SPEED, KMH),
        },
        "--engine llama-cpp --layouts 4 --budget 80 --limit 6",
    ),
    "objects": Row(
        "swarm-tiny-six-v2",
        "v4",
        {
            OBJECTS: either("objects", OBJECTS, ""),
            SPREAD: either("hidden", SPREAD, CAREFUL, SPREAD + " " + CAREFUL),
            SEEN: either("seen", SEEN, TENS),
            "Distribution:": either("end", "Distribution:", "Careful distribution:"),
        },
        "--layouts 60 --budget 6000",
        "occluded-intersection-v3",
    ),
}


def mark(row: Row, name: str, where: Path) -> str:
    """Write a copy of the row's prompt with its marks into a project, unless it is there;
    return its name.
    """
    if not (where / name).is_dir():
        shutil.copytree(folder("prompts") / row.prompt, where / name)
        file = where / name / "ego.j2"
        text = file.read_text()
        for old, new in row.marks.items():
            assert text.count(old) == 1, f"{row.prompt} has not once: {old}"
            text = text.replace(old, new)
        file.write_text(text)
    return name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--out", type=Path, default=Path("reports/wordings"))
    options, others = parser.parse_known_args()
    project: Path = options.out
    project.mkdir(parents=True, exist_ok=True)
    (project / MARKER).touch()
    os.chdir(project)
    for name, row in ROWS.items():
        if options.only in name and not Path("reports", name, "optimize.json").is_file():
            base = mark(row, f"{row.prompt}-{name}", Path("prompts"))
            harness(
                "prompt",
                "optimize",
                "--model",
                row.model,
                "--prompt",
                base,
                "--answer",
                "readout",
                "--dataset",
                row.dataset,
                "--out",
                name,
                *row.options.split(),
                *others,
            )


if __name__ == "__main__":
    main()
