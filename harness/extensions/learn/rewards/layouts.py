"""Layouts that may be learnt from, and their trees:
built once, kept on disk, never of report seeds.
"""

import operator
import re
from collections.abc import Callable
from typing import Any

from harness.core import kept
from harness.core.errors import UserError, printable, unknown
from harness.core.files import digest
from harness.core.formats import WORK
from harness.core.parallel import Workers
from harness.core.plugins import package_versions
from harness.core.seeds import FIRST, LAST_SEED, Purpose, purpose
from harness.dataset import rebuilt
from harness.dataset.build import build
from harness.dataset.load import Dataset, find, load
from harness.world.scenario import Scenario
from harness.world.scenario_of_package import is_ours

# What a tree depends on; numbers of it that are kept are of this code alone.
CODE = ("world/**/*.py", "world/**/*.csv", "dataset/*.py")


def seeds(which: str | int, layouts: int) -> range:
    """Return the range of `layouts` layout seeds for training.

    A layout seed draws a start situation. `which` is `train` or `tune`, or the first seed. Raises
    UserError for report seeds, on which results are measured, for seeds of two purposes, or for
    seeds that do not exist.
    """
    if isinstance(which, str) and which not in FIRST:
        raise unknown(
            "seeds", which, [name for name in FIRST if name != "report"], "; or the first seed"
        )
    first = FIRST[which] if isinstance(which, str) else whole("seeds", which)
    layouts = whole("layouts", layouts)
    if not 0 <= first <= LAST_SEED - layouts or layouts < 1:
        raise UserError(
            f"seeds {first}, layouts {layouts}: give a seed from 0 on, and 1 layout or more"
        )
    refuse(purpose(first, layouts), f"seeds={which!r}")
    return range(first, first + layouts)


def whole(what: str, number: Any) -> int:
    """Return a number as a Python int; `what` names it in the message.
    Raises UserError if it is not a whole number.
    """
    try:
        return operator.index(number)
    except TypeError:
        raise UserError(f"{what} {printable(str(number), 40)}: give a whole number") from None


def refuse(kind: Purpose, what: str) -> None:
    """Raise UserError if layouts (start situations) are for reporting results, not for learning.

    `kind` is what they are for, such as `train`; `what` names them in the message.
    """
    if kind == "report":
        raise UserError(
            f"{what}: numbers are reported of layout seeds from {FIRST['report']} on, and nothing "
            "may learn "
            f'from them; give seeds="train" ({FIRST["train"]} to {FIRST["report"] - 1}) or '
            f'seeds="tune"'
        )


def stored(dataset: str) -> Dataset:
    """Read a dataset to learn from, by its folder or name.

    Raises UserError if there is none, or if it has report seeds: layouts (start situations) on
    which results are measured. Some layouts are rebuilt from their seeds, so that a manifest with
    false seeds is refused.
    """
    data = load(find(dataset))
    refuse(purpose(data.manifest.seed, data.manifest.episodes), f"dataset {printable(dataset)}")
    rebuilt.refuse(data)
    return data


def trees(
    scenario: Scenario, of: range, workers: Workers, progress: Callable[[int], None]
) -> Dataset:
    """Return a scenario's layouts of the seeds `of`, with their decision trees, as a dataset.

    A layout is a start situation, and its tree has every course that actions can lead to. Trees
    that are not in the user's cache folder are built; a stopped build resumes. `progress` is called
    with the number of layouts just done. Raises UserError if another process is building them.
    """
    of_code: list[Any] = [kept.code_sha256(*CODE)]
    if not is_ours(scenario.layout):
        of_code.append(package_versions())
    key = digest([scenario.name, scenario.parameters.stated(), *of_code])[:12]
    name = re.sub(r"[^A-Za-z0-9]+", "-", scenario.name)[:60]
    folder = kept.folder() / "trees" / f"{name}-{of.start}-{len(of)}-{key}"
    if not (folder / "manifest.json").is_file() or (folder / WORK).is_dir():
        build(scenario, folder, len(of), of.start, workers, progress, audits=False)
    return load(folder)
