"""Requests, prompt tokens and CPU time of whole runs:
all helpers asked, or only those that are used.

    python benchmarks/asked.py [--models proxy swarm-tiny smollm2-135m] [--only TEXT]
                               [--episodes 10] [--seeds 0:5]

Each model evaluates the first layouts of the shipped dataset under `single-local` alone and under
the usual conditions, and drives as many layouts under the usual conditions, with `--ask all` and
`--ask used` in turn; the completion cache is off. CPU time is that of the command and its children,
the page included. The last column says whether the two runs' decisions are the same.
"""

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

from commands import HERE, run

from harness.evaluate.spec import ASKS
from harness.runs import folder

SMALLEST = "--models proxy --only closed --episodes 1 --seeds 0:1"
SCENES = "occluded-intersection:witnesses=any,radio_share=0,limits=1,perception=1"
WORLDS = {
    "frozen, single-local": ["eval", "--limit", "N", "--condition", "single-local"],
    "frozen": ["eval", "--limit", "N"],
    "closed loop": ["drive", "--scenario", SCENES, "--episodes", "N", "--workers", "1"],
}


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--models", nargs="+", default=["proxy", "swarm-tiny"])
    arguments.add_argument("--only", default="", help="only worlds whose name has this text")
    arguments.add_argument("--episodes", type=int, default=10)
    arguments.add_argument("--seeds", default="0:5")
    given = arguments.parse_args()
    heads = (
        "of the ego",
        "of helpers",
        "prompt tokens",
        "CPU s",
        "used / all: requests",
        "tokens",
        "CPU",
    )
    print("| model | world | asked |", " | ".join(heads), "| same decisions |")
    print("|---" * (len(heads) + 4) + "|")
    measured = []
    with tempfile.TemporaryDirectory() as work:
        for model in given.models:
            for world, command in WORLDS.items():
                if given.only not in world:
                    continue
                typed = [str(given.episodes) if part == "N" else part for part in command]
                typed += [
                    "--model",
                    model,
                    "--seeds",
                    given.seeds,
                    "--no-cache",
                    "--quiet",
                    "--out",
                    "OUT",
                ]
                rows = {
                    ask: _measured([*typed, "--ask", ask], Path(work) / ask)
                    for ask in reversed(ASKS)
                }
                tables = [folder.read(Path(work) / ask / "run").decisions.table for ask in ASKS]
                same = bool(tables[0].equals(tables[1]))
                for ask, row in rows.items():
                    ratios = ["", "", "", ""]
                    if ask == "used":
                        pairs = [
                            (row[key], rows["all"][key]) for key in ("requests", "tokens", "cpu_s")
                        ]
                        ratios = [
                            *(f"{a / b:.2f}" if b else "" for a, b in pairs),
                            "yes" if same else "no",
                        ]
                    cells = (
                        row["ego"],
                        row["helper"],
                        row["tokens"] or "",
                        f"{row['cpu_s']:.1f}",
                        *ratios,
                    )
                    print(
                        f"| `{model}` | {world} | {ask} |",
                        " | ".join(map(str, cells)),
                        "|",
                        flush=True,
                    )
                    measured.append(
                        {"model": model, "world": world, "asked": ask, "same": same, **row}
                    )
    print(json.dumps(measured))


def _measured(command: list[str], runs: Path) -> dict[str, float]:
    """Requests by role, prompt tokens (0 where the model counts none) and CPU seconds of a run."""
    cpu_s, _ = run(HERE, command, runs)
    answers = folder.read(runs / "run").answers
    by_role = Counter(answer.role for answer in answers)
    tokens = sum(answer.prompt_tokens or 0 for answer in answers)
    roles = {role: by_role[role] for role in ("ego", "helper")}
    return {**roles, "requests": by_role.total(), "tokens": tokens, "cpu_s": cpu_s}


if __name__ == "__main__":
    main()
