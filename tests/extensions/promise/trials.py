"""How this extension's study is tried."""

import shutil
from pathlib import Path

from evaluating import run, spec_of
from former import SCENARIO
from studied import ASKED, Once, Trial

from harness.dataset.build import build
from harness.dataset.load import load


def report_run(once: Once) -> Path:
    """Return a folder with `run`, of the proxy on two report layouts, which are in `layouts`."""

    def fill(out: Path) -> None:
        build(SCENARIO, out / "layouts", 2, 200_100, 1, lambda done: None)
        run(spec_of(load(out / "layouts")), out / "run")

    return once("report-to-promise", fill)


def lays(here: Path, once: Once) -> None:
    shutil.copytree(report_run(once), here / "report")


FEW = "--harm failed --at-most 60 --condition 6g"
TRIALS = {
    "promise": Trial(
        "study promise report/run --tune run", FEW, f"{FEW} --seeds 7:8",
        "out holds another promise, with other seeds; name another folder",
        {
            "--at-most 100": "--at-most 100: give percent, between 0.0001 and 100",
            "--harm bad": "unknown --harm 'bad'",
            "--write p.txt --at-most 60": "--write p.txt: end it in .toml",
            "--write p.toml": "--write: a file has one promise; give one --at-most",
        },
        "A promise is of layouts that are drawn as the tune layouts are",
        beside=(*ASKED, "report/run/.more-answers.jsonl.lock", "report/run/more-answers.jsonl"),
        lays=lays,
    ),
}  # fmt: skip
