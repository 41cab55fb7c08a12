"""A dataset or a run many times over, for benchmarks:
every copy has other episodes, and other prompts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from msgspec import structs

from harness.dataset.load import Dataset, Scene, Trees
from harness.dataset.schema import Branching, Tree
from harness.runs import folder, writer
from harness.runs.decisions import Decisions, Labels
from harness.runs.folder import Run


@dataclass(frozen=True)
class Copies(Dataset):
    """Copies of a dataset. The ego's distance to the zone, which every prompt states,
    differs by a decimetre.

    Attributes:
        original: the dataset.
    """

    original: Dataset | None = field(default=None, compare=False)

    def scenes(self, ids: Sequence[str]) -> list[Scene]:
        """The scenes of decision points, made anew, so that nothing is remembered."""
        return [self._copied(name) for name in ids]

    def _copied(self, name: str) -> Scene:
        assert self.original is not None
        apart = len(self.original.trees)
        again = int(name[:5]) // apart
        [scene] = self.original.scenes([shifted(name, -again * apart)])
        graphs = {
            viewer: structs.replace(
                graph,
                ego=structs.replace(graph.ego, zone_m=round(graph.ego.zone_m + again / 10, 1)),
            )
            for viewer, graph in scene.graphs.items()
        }
        episode_seed = scene.record.episode_seed + again * apart
        return scene.changed(
            scene=name, episode=int(name[:5]), episode_seed=episode_seed, graphs=graphs
        )


def copies(dataset: Dataset, n: int) -> Copies:
    """The dataset n times."""
    apart = len(dataset.trees)
    trees = Trees(
        range(n * apart),
        lambda number: _tree(dataset.trees[number % apart], number // apart * apart),
    )
    return Copies(
        dataset.path, dataset.manifest, dataset.sha256, trees, dataset.trusted, original=dataset
    )


def _tree(tree: Tree, by: int) -> Tree:
    def moved(point: Branching) -> Branching:
        return structs.replace(point, scene=shifted(point.scene, by))

    return structs.replace(
        tree,
        episode=tree.episode + by,
        episode_seed=tree.episode_seed + by,
        levels=[list(map(moved, level)) for level in tree.levels],
    )


def shifted(scene: str, by: int) -> str:
    """A scene's id in an episode that much further."""
    episode, _, rest = scene.partition("-")
    return f"{int(episode) + by:05d}-{rest}"


def repeated(run: Run, times: int, apart: int, out: Path) -> Run:
    """A run n times, in a folder of its own: its episodes, each time so many numbers further."""
    d, ids = run.decisions, list(run.decisions.scenes)
    codes, shifts = d.codes("scene", ids), range(0, times * apart, apart)

    def moved(by: int) -> Decisions:
        scenes = Labels(codes, [shifted(scene, by) for scene in ids])
        return d.replace(scene=scenes, episode=d.whole("episode") + by)

    world = structs.replace(run.manifest.world, episodes=times * run.manifest.world.episodes)
    writer.write(
        out,
        structs.replace(run.manifest, world=world),
        Decisions.concat([moved(by) for by in shifts]),
        [
            structs.replace(episode, episode=episode.episode + by)
            for episode in run.episodes
            for by in shifts
        ],
        (
            writer.lines([structs.replace(a, scene=shifted(a.scene, by)) for a in run.answers])
            for by in shifts
        ),
        run.scores,
    )
    return folder.read(out)
