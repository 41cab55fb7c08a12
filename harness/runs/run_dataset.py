"""Find the dataset of a run, and hold the run's scenes against it."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from harness.core.errors import UserError, in_range, printable
from harness.core.seeds import LAST_EPISODE
from harness.dataset import select
from harness.dataset.load import Dataset, find, load
from harness.dataset.select import Choice
from harness.dataset.verify import read_manifest
from harness.runs.folder import Run
from harness.runs.records import (
    FrozenScenes,
)

OTHER_EPISODES = "episodes.csv has other episodes than run.json says that were selected"
DEEPEST = 8  # folders of a dataset's stated path that are looked for above a run


def dataset_of(run: Run, given: Path | None = None) -> Dataset:
    """Return the dataset of a run on frozen (recorded) scenes, found by its digest.

    It is searched at the path in the run's manifest, at that path below each folder above the run,
    and by its name; if the user names a folder, `given`, only there. Raises UserError if it is not
    found, has another digest or is damaged.
    """
    scenes = run.manifest.world
    assert isinstance(scenes, FrozenScenes)
    folders: list[Path] = []
    for path in [given] if given else dict.fromkeys(_datasets(run, scenes)):
        if given or _holds(path):
            if _sha256_of(path) == scenes.sha256:
                return load(path)
            folders.append(path)
    repair = "restore it, give its folder to a command that has --dataset, or run again"
    if folders:
        # which says what is wrong with it
        sha256 = _sha256_of(folders[0]) or read_manifest(folders[0])[1]
        raise UserError(
            f"dataset {printable(folders[0])} is not the one that {printable(run.path)} was made "
            f"on (sha256 {sha256}, not {printable(scenes.sha256)}); {repair}"
        )
    raise UserError(
        f"{printable(run.path)} was made on dataset {printable(scenes.name, 40)}, which is neither "
        f"at {printable(scenes.path)}, seen from here or from a folder above the run, nor known by "
        f"its name; {repair}"
    )


def choice_of(run: Run, numbers: Sequence[int], dataset: Dataset | None) -> Choice | None:
    """Return what chose a run's episodes, by what it states, out of `numbers`; None for all.

    `dataset` is the run's, None if it was driven. Where the extension that chooses is gone, the
    episodes are those that the run has.
    """
    record = run.manifest.world.selection
    if select.lacking(record):
        pool = tuple(layout.episode for layout in run.layouts) or run.grid.episodes
        return Choice(run.grid.episodes, pool, record)
    selection = select.recorded(record)
    return selection.choice(numbers, dataset) if selection else None


def count_to_select_of(run: Run) -> int:
    """Return of how many episodes those of a driven run were selected, as it states."""
    world = run.manifest.world
    of = int(world.selection.get("of", world.episodes))
    in_range(f"{printable(run.path)}: episodes to select of", of, 1, LAST_EPISODE + 1)
    return of


def check_episodes(run: Run, dataset: Dataset | None) -> None:
    """Raise UserError if a run has other episodes than are selected as it states.

    For a run that something is learnt from, or judged by: nobody knows by what these were chosen.
    `dataset` is that of a run on frozen (recorded) scenes, or a part of it; None of a driven one.
    """
    world, whole = run.manifest.world, dataset and dataset.whole
    numbers: Sequence[int]
    if isinstance(world, FrozenScenes):
        assert whole is not None
        numbers, most = whole.episodes, world.limit
    else:
        numbers, most = range(count_to_select_of(run)), world.episodes
    choice = choice_of(run, numbers, whole)
    if choice:
        numbers = choice.numbers
    if run.grid.episodes != tuple(numbers[:most]):
        raise UserError(f"{printable(run.path)}: {OTHER_EPISODES}; make the run again")


def _datasets(run: Run, scenes: FrozenScenes) -> Iterator[Path]:
    """Yield where a run's dataset may lie."""
    path = Path(scenes.path)
    yield path
    with suppress(UserError):
        yield find(scenes.name)
    # The run may have moved together with its dataset, or be read from another folder.
    parts = [part for part in path.parts if part not in (path.anchor, "..")][-DEEPEST:]
    for above in run.path.resolve().parents:
        yield above / path
        yield from (above.joinpath(*parts[at:]) for at in range(len(parts)))
        yield above / "datasets" / scenes.name


def _sha256_of(path: Path) -> str | None:
    """Return the digest of the dataset in a folder; None if its manifest is broken."""
    try:
        return read_manifest(path)[1]
    except UserError:
        return None


def _holds(path: Path) -> bool:
    try:
        return (path / "manifest.json").is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def check_scenes(run: Run, dataset: Dataset, some: Iterable[str] | None = None) -> None:
    """Raise UserError if a decision or answer of a run is of a scene that is not in its dataset.

    `some` are ids of scenes (decision points), of which alone the decisions are checked; None
    checks all.
    """
    decided = run.decisions.scenes
    scenes_by_file: dict[str, Iterable[str]] = {
        "decisions.parquet": decided
        if some is None
        else (scene for scene in some if scene in decided),
        "answers.jsonl": (scene for scene in run.answers_by_scene if scene not in decided),
    }
    for file, scenes in scenes_by_file.items():
        for scene in scenes:
            if scene not in dataset:
                raise UserError(
                    f"{printable(run.path / file)} has scene {printable(scene)!r}, "
                    "which its dataset has not; make the run again"
                )
