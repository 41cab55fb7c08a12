"""`harness eval --repeats`: one evaluation several times,
with other draws of the model's answers.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from harness.cli.progress import bar
from harness.cli.run import RunGroup, free_folder
from harness.cli.show import finish
from harness.core import work
from harness.core.errors import UserError, in_range, printable

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec

MOST = 100


def check(spec: "Spec", repeats: int) -> None:
    """Raise UserError unless an evaluation can be repeated.

    Its answers must be sampled, and its latency must not be measured.
    """
    from harness.evaluate.latency import MEASURED

    in_range("--repeats", repeats, 2, MOST)
    if not spec.settings.temperature:
        raise UserError(
            f"--repeats {repeats}: greedy answers are the same every time; give a --temperature "
            "above 0, such as 0.7"
        )
    if spec.settings.latency == MEASURED:
        raise UserError(
            f"--latency {MEASURED}: it needs an idle machine, which its own first runs keep busy; "
            "measure once without --repeats, and give the seconds that its run.json has"
        )


def evaluate(
    spec: "Spec", repeats: int, out: Path | None, cache: Path | None, quiet: bool, as_json: bool
) -> None:
    """Evaluate every repeat, write the study of how they differ, and print it."""
    from harness.studies.repeats import MARKER, WRITTEN, each, repeats_study, run_repeats

    group = RunGroup(each(spec, repeats), "finished repeats", MARKER, WRITTEN)
    folder = out or free_folder([spec], f"{spec.source.name}-repeats", group.goes_on)
    group.check(folder)
    name = printable(spec.ego.card.name, 30)
    with (
        work.going_on(folder),
        bar(f"asking {name}, {repeats} repeats", quiet=quiet or as_json, grows=True) as progress,
    ):
        done = run_repeats(spec, repeats, folder, progress, cache)
    finish(repeats_study(done), folder, as_json, quiet)
