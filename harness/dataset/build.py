"""Build a dataset, for `harness dataset build`:
freeze layouts in any number of processes, and resume.

Layouts are frozen some at a time. Each finished one is a file under `.work/`; when all are
finished, they become one `layouts.zip`. Its content depends only on the scenario, the seed, the
number of episodes and the folder's name.
"""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from io import BytesIO
from math import ceil
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import msgspec

from harness import __version__
from harness.core import shards, work
from harness.core.errors import UserError, in_range, printable
from harness.core.figures import amount
from harness.core.files import canonical_json, opened, replacing, sha256_bytes, write_whole
from harness.core.formats import WORK
from harness.core.parallel import Workers, each
from harness.core.plugins import Plugins, package_versions
from harness.core.seals import is_sealed, say_unsealed, write_seal
from harness.core.seeds import LAST_EPISODE, LAST_SEED, purpose, seeds_text
from harness.core.shards import Shard
from harness.core.strangers import worded
from harness.dataset import rebuilt
from harness.dataset.forest import Forest
from harness.dataset.freeze import freeze
from harness.dataset.load import Dataset, load
from harness.dataset.schema import (
    FILE_NAME,
    LAYOUTS,
    Tree,
    manifest_schema,
    record_schema,
    record_type,
    tree_schema,
)
from harness.dataset.verify import level_name, tree_name
from harness.world import scenarios
from harness.world.drivers import drivers_of
from harness.world.families import family_of, keep
from harness.world.reference import drive_all
from harness.world.scenario import Scenario
from harness.world.scenario_of_package import is_ours
from harness.world.seats import refuse_agents

TOGETHER = 8  # the most layouts that are frozen together
CHECKED_EVERY = 10  # layouts whose number this divides are driven in closed loop as well
LEAST_AUDITED = 100  # fewest layouts that are audited; an audit of fewer says little


@runtime_checkable
class Audit(Protocol):
    """Examine the layouts of a dataset that is being built, for a paragraph of its card.

    A layout is the start situation of an episode, the card the page that describes the dataset. An
    audit looks for tells: what gives a hidden danger away. Extensions add audits.
    """

    def ready(self) -> None:
        """Raise UserError if a package that the audit of a dataset needs is missing."""
        ...

    def found(
        self,
        scenario: Scenario,
        layouts: int,
        seed: int,
        progress: Callable[[int], None],
        workers: Workers,
    ) -> str:
        """Return the paragraph about the layouts drawn by the seeds `seed` to `seed + layouts - 1`.

        A layout is a start situation of the scenario. `progress` is called with the number of
        layouts just examined, and `workers` are processes or a cluster.
        """
        ...


AUDITS = Plugins[Audit]("swarmdrive.audits", Audit, {})  # those that extensions add


def build(
    scenario: Scenario,
    out: Path,
    episodes: int,
    seed: int,
    workers: Workers,
    progress: Callable[[int], None],
    audits: bool = True,
    more: Callable[[int], None] = lambda count: None,
    shard: Shard | None = None,
    unreachable: bool = True,
) -> dict[str, Any]:
    """Build a dataset in `out`, or freeze a shard of one, which `harness run merge` combines.

    To freeze is to simulate every course that actions can take from a layout, a start situation.
    Episode e has layout seed `seed + e`, and the folder's name is the dataset's.

    Args:
        scenario: the scenario of the layouts.
        out: the folder of the dataset or of the shard.
        episodes: number of layouts, each with one episode.
        seed: layout seed of episode 0.
        workers: processes or a cluster.
        progress: called with the number of layouts just finished or audited.
        audits: whether the layouts are examined for what gives a danger away (`Audit`), if there
            are at least `LEAST_AUDITED`.
        more: called with the number of layouts to be audited, before that.
        shard: the part of the dataset to make; None for all of it.
        unreachable: whether to keep a dataset in which no course reaches the goal.

    Returns the manifest as a dict; for a shard, the settings that it begins with. Raises UserError
    if the folder holds a finished dataset, one begun with other settings, or something else; the
    seeds are for several purposes; no course reaches the goal, and that was not asked for; or the
    audit needs a package that is missing.
    """
    refuse_agents(scenario, "a dataset")
    # Of worlds that are played elsewhere no danger is known.
    audits = audits and episodes >= LEAST_AUDITED and not scenario.has_own_world and bool(AUDITS)
    if audits and not shard:
        for name in AUDITS:
            AUDITS.ask(name, lambda audit: audit.ready())
    config = _settings(scenario, episodes, seed)
    if not re.fullmatch(FILE_NAME, out.absolute().name):
        raise UserError(
            f"--out {printable(out)} cannot name a dataset; end it in letters, digits, '.', '_' or "
            "'-', a letter or digit first"
        )
    if (out / "manifest.json").exists():
        if not (out / WORK).is_dir():
            raise UserError(
                f"--out {printable(out)} already holds a finished dataset; choose another folder "
                "or delete it"
            )
        # A build was stopped while it tidied up, or somebody made a folder that looks so.
        dataset = dataset_of_stopped(scenario, out, episodes, seed)
        for difference in rebuilt.differences(dataset):
            raise UserError(
                f"--out {printable(out)}: {difference}; delete it, or choose another folder"
            )
        work.tidy(out)
        return dict(msgspec.to_builtins(dataset.manifest))
    part = str(shard or "")
    own_episodes = shard.part(range(episodes)) if shard else range(episodes)
    if start := work.start_of(out, work.WorkStart):
        work.same(out, {**config, "shard": part}, {**start.settings, "shard": start.shard})
    elif scenario.world:
        scenario.at(seed + episodes - 1)  # where layouts are finite, this may be none of them
        scenario.world.examine(scenario, seed)
    with work.working(out, start or work.WorkStart(settings=config, shard=part)) as place:
        own_files = _write_own_files(scenario, out)
        _freeze_missing(scenario, place, seed, own_episodes, workers, progress)
        if shard:
            return config
        manifest = _write_dataset(
            scenario, out, place, config, own_files, workers, progress, audits, more, unreachable
        )
        work.tidy(out)
    return manifest


def dataset_of_stopped(scenario: Scenario, out: Path, episodes: int, seed: int) -> Dataset:
    """Return the dataset that a stopped command left in the folder `out`, which anybody may fill.

    Raises UserError unless its files have its manifest's digests, and it states that `scenario`,
    `episodes` layouts (start situations), and `seed` as the layout seed of the first.
    """
    dataset, config = load(out), _settings(scenario, episodes, seed)
    manifest = msgspec.to_builtins(dataset.manifest)
    work.same(out, config, {key: manifest.get(key) for key in config})
    return dataset


def _settings(scenario: Scenario, episodes: int, seed: int) -> dict[str, Any]:
    """Return what a manifest states of how its dataset is built."""
    versions = {"harness": __version__}
    for package in ("highway-env", "numpy", "shapely"):
        versions[package] = version(package)
    if not is_ours(scenario.layout):
        versions |= package_versions()
    settings = {
        "scenario": scenario.name,
        "actions": list(scenario.actions),
        "parameters": json.loads(canonical_json(scenario.parameters.stated())),
        "episodes": episodes,
        "seed": seed,
        "purpose": purpose(seed, episodes),
        "versions": versions,
    }
    if scenario.world and (config := scenario.world.configuration(scenario)):
        settings["environment"] = config
    for key, text in (("source", scenario.source), ("licence", scenario.licence)):
        if text:
            settings[key] = text
    return settings


def merge(
    folders: Sequence[Path],
    out: Path,
    workers: Workers,
    progress: Callable[[int], None],
    audits: bool = True,
    more: Callable[[int], None] = lambda count: None,
    unreachable: bool = True,
) -> dict[str, Any]:
    """Combine the shards of a dataset, a folder each, into the one that `build` makes without.

    The bytes are the same. Returns the manifest as a dict. A layout is one start situation of a
    scenario.

    Args:
        folders: the shards' folders, all of one build.
        out: the folder of the dataset.
        workers: processes or a cluster.
        progress: called with the number of layouts just finished or audited.
        audits: whether the layouts are examined for what gives a danger away.
        more: called with the number of layouts to be audited, before that.
        unreachable: whether to keep a dataset in which no course reaches the goal.

    Raises UserError if the folders are not all the shards of one build, a shard is unfinished, or
    two hold different bytes for the same layout; if `out` holds something else; or if the audit
    needs a package that is missing.
    """
    starts = shards.read(folders, work.WorkStart)
    config = starts[0].settings
    with shards.made_whole(folders, out):
        in_range("episodes of a shard's dataset", config["episodes"], 1, LAST_EPISODE + 1)
        in_range("seed of a shard's dataset", config["seed"], 0, LAST_SEED)
        episodes = {part_of(e): e for e in range(config["episodes"])}
        parts = shards.owners(folders, starts, list(episodes), lambda part: named(episodes[part]))
        if not (out / "manifest.json").exists():
            whole = work.WorkStart(settings=config)
            if stopped := work.start_of(out, work.WorkStart):
                work.same(out, whole.settings, stopped.settings)
            with work.working(out, whole) as place:
                shards.collect(parts, place)
        keep(config["scenario"], folders[0])
        scenario = scenarios.of_manifest(config["scenario"], config["parameters"])
        count, seed = config["episodes"], config["seed"]
        return build(
            scenario,
            out,
            count,
            seed,
            workers,
            progress,
            audits,
            more,
            unreachable=unreachable,
        )


def _write_own_files(scenario: Scenario, out: Path) -> dict[str, str]:
    """Write what a scenario is made from into the dataset's folder; return each file's digest."""
    files = scenario.world.files(scenario) if scenario.world else {}
    for name, data in files.items():
        write_whole(out / name, data)
    return {name: sha256_bytes(data) for name, data in files.items()}


def _freeze_missing(
    scenario: Scenario,
    place: Path,
    seed: int,
    episodes: Sequence[int],
    workers: Workers,
    progress: Callable[[int], None],
) -> None:
    """Write the file of each layout that is not yet in the working folder `place`."""
    parts = {episode: place / part_of(episode) for episode in episodes}
    unsealed = [part for part in parts.values() if part.exists() and not is_sealed(part)]
    for part in unsealed:
        shutil.rmtree(part) if part.is_dir() else part.unlink()
    if unsealed:
        say_unsealed(place.parent, len(unsealed), "frozen layout", "they are frozen again")
    missing = [episode for episode, part in parts.items() if not part.exists()]
    progress(len(episodes) - len(missing))
    size = TOGETHER
    if isinstance(workers, int):  # no process may have nothing to do
        size = max(1, min(size, ceil(len(missing) / workers)))
    chunks = [missing[at : at + size] for at in range(0, len(missing), size)]

    def keep(index: int, layouts: list[bytes]) -> None:
        for episode, data in zip(chunks[index], layouts, strict=True):
            write_seal(parts[episode], {part_of(episode): data})
            write_whole(parts[episode], data)
            progress(1)

    each(
        partial(_freeze_layouts, scenario, seed),
        chunks,
        workers,
        keep,
        lambda chunk: _named(*chunk),
    )


def _write_dataset(
    scenario: Scenario,
    out: Path,
    place: Path,
    config: dict[str, Any],
    own_files: Mapping[str, str],
    workers: Workers,
    progress: Callable[[int], None],
    audits: bool,
    more: Callable[[int], None],
    unreachable: bool,
) -> dict[str, Any]:
    """Write all files of a dataset from the layouts in `place`; return its manifest.

    `own_files` has the digest of each file of the scenario's own, which is written already.
    """
    name, episodes, seed = out.absolute().name, config["episodes"], config["seed"]
    texts = _join_layouts(place, episodes, out / LAYOUTS)
    trees = [msgspec.json.decode(text, type=Tree) for text in texts]
    forest = Forest.of(trees, scenario.actions, scenario.parameters)
    if is_lost := not forest.value[forest.root].any():
        _keep_unreachable(scenario, episodes, unreachable)
    findings = list[str]()
    for key in AUDITS if audits else ():
        more(episodes)
        findings.append(
            AUDITS.ask(key, lambda audit: audit.found(scenario, episodes, seed, progress, workers))
        )
    command = _command(scenario, name, episodes, seed, audits)
    command += " --unreachable" if is_lost else ""
    files = {
        "README.md": _readme(name, command, config, forest, findings).encode(),
        "scene.schema.json": _pretty(record_schema(scenario)),
        "tree.schema.json": _pretty(tree_schema()),
        "manifest.schema.json": _pretty(manifest_schema()),
    }
    manifest = {
        "format": "swarmdrive-dataset/2",
        "name": name,
        **config,
        "nodes": sum(len(level) for tree in trees for level in tree.levels),
        "files": {**own_files, **{file: sha256_bytes(data) for file, data in files.items()}},
        "trees_sha256": [sha256_bytes(text) for text in texts],
    }
    for file, data in files.items():
        write_whole(out / file, data)
    write_whole(out / "manifest.json", _pretty(manifest))
    return manifest


def _keep_unreachable(scenario: Scenario, layouts: int, unreachable: bool) -> None:
    """Raise UserError unless a dataset in which no course reaches the goal was asked for."""
    if unreachable:
        return
    of_name = printable(scenario.name, 80)
    other = f"declare another, as in {of_name}:goal=6s," if "goal" in scenario.dials else "mend it,"
    raise UserError(
        f"no course of {amount(layouts, 'layout')} of {of_name} reaches the goal "
        f"({printable(scenario.prompt_words['task'])}); {other} or type --unreachable to keep it"
    )


def _freeze_layouts(scenario: Scenario, seed: int, episodes: Sequence[int]) -> list[bytes]:
    """Return the file of each layout, and drive those that are checked."""
    frozen = freeze(scenario, {episode: seed + episode for episode in episodes})
    trees, files = [], []
    for episode, (levels, scenes) in zip(episodes, frozen, strict=True):
        kind = record_type(scenario.at(seed + episode))
        texts = []
        for level in scenes:
            lines = [canonical_json(msgspec.to_builtins(record)) + "\n" for record in level]
            texts.append("".join(lines).encode())
        for line in b"".join(texts).splitlines():  # a record that breaks its own form is a bug
            msgspec.json.decode(line, type=kind)
        digests = [sha256_bytes(text) for text in texts]
        tree = Tree(episode, seed + episode, scenes[0][0].danger, levels, digests)
        data = BytesIO()
        with ZipFile(data, "w") as file:
            file.writestr(_entry(tree_name(episode)), msgspec.json.encode(tree))
            for step, text in enumerate(texts):
                file.writestr(_entry(level_name(episode, step)), text)
        files.append(data.getvalue())
        trees.append(tree)
    checked = [tree for tree in trees if tree.episode % CHECKED_EVERY == 0]
    if checked:
        built_in = is_ours(scenario.layout)
        with worded(f"scenario {printable(scenario.name)}", built_in):
            _check(scenario, checked)
    return files


def _check(scenario: Scenario, trees: Sequence[Tree]) -> None:
    """Drive layouts in closed loop; a reference driver that ends otherwise than in the tree is a
    bug.
    """
    forest = Forest.of(trees, scenario.actions, scenario.parameters)
    layouts = drive_all(scenario, forest.seeds.tolist())
    for driver in drivers_of(scenario):
        last_edges = forest.last_edge(forest.drivers[driver]).tolist()
        success = forest.driver_success(driver).tolist()
        for n, outcomes in enumerate(layouts):
            end, outcome = forest.end(last_edges[n]), outcomes[driver]
            in_tree = success[n], end.time_s, end.partner, end.fault
            if in_tree != (outcome.success, outcome.time_s, outcome.partner, outcome.fault):
                seed = trees[n].episode_seed
                raise RuntimeError(f"layout {seed}: {driver} drives to {outcome}, walks to {end}")


def _join_layouts(work: Path, episodes: int, layouts: Path) -> list[bytes]:
    """Write the layouts' files in the folder `work` to one file; return the text of each tree."""
    trees = []
    with replacing(layouts) as part, ZipFile(part, "w") as file:
        for episode in range(episodes):
            with opened(work / part_of(episode), "rows") as data, ZipFile(data) as layout:
                for name in layout.namelist():
                    file.writestr(_entry(name), layout.read(name))
                trees.append(layout.read(tree_name(episode)))
    return trees


def _entry(name: str) -> ZipInfo:
    entry = ZipInfo(name)  # dated 1980, so that no clock changes a dataset's bytes
    entry.compress_type = ZIP_DEFLATED
    return entry


def part_of(episode: int) -> str:
    """Return the name of an episode's file while a dataset is built: `00042.zip` for episode 42.

    It has the decision tree of the episode's start situation, and lies in the working folder.
    """
    return f"{episode:05d}.zip"


def named(episode: int) -> str:
    """Return how messages name an episode's start situation: `layout 42` for episode 42."""
    return f"layout {episode}"


def _named(first: int, *others: int) -> str:
    return f"layouts {first} to {others[-1]}" if others else named(first)


def _pretty(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def _command(scenario: Scenario, name: str, episodes: int, seed: int, audits: bool) -> str:
    """Return the command that builds a dataset again, where its folder, `name`, lies.

    The new one has the same name, in another folder, and so the same bytes.
    """
    default, p = scenarios.get(scenario.name).parameters, scenario.parameters
    text = scenarios.argument(scenario)
    family = family_of(text)
    typed = family.typed(text, name) if family else [text]
    out = shlex.join(["--out", f"again/{name}"])
    lag = f" --lag {p.decision_lag_s:g}" if p.decision_lag_s != default.decision_lag_s else ""
    unaudited = "" if audits or episodes < LEAST_AUDITED else " --no-audit"
    layouts = f"--episodes {episodes} --seed {seed}"
    return f"harness dataset build {shlex.join(typed)} {layouts}{lag}{unaudited} {out}"


def _origin(config: dict[str, Any]) -> str:
    """Return the card's paragraph on traffic that comes from elsewhere; empty for the harness's."""
    source, licence = config.get("source"), config.get("licence")
    if not source and not licence:
        return ""
    terms = printable(licence or "not stated")
    return f"Traffic from {printable(source or 'a source not stated')}; licence: {terms}.\n\n"


def _readme(
    name: str, command: str, config: dict[str, Any], forest: Forest, findings: Sequence[str]
) -> str:
    """Return a dataset's card; `findings` are those of its audits."""
    seeds, nodes = config["episodes"], len(forest.ids)
    rate = 100 * forest.value[forest.root].mean()
    rows = []
    for driver in forest.drivers:
        rows.append(f"| `{driver}` | {100 * forest.driver_success(driver).mean():.1f} |")
    drivers = "\n".join(rows)
    parameters = config["parameters"]
    audit_text = "\n\n".join(findings) or "Not audited for tells."
    return f"""# {name}

Every course of {seeds} layouts of `{config["scenario"]}`, {seeds_text(config["seed"], seeds)}:
{nodes} decision points, {nodes / seeds:.0f} a layout.
Built by `{command}`.

A decision acts {1000 * parameters["decision_lag_s"]:.0f} ms after its moment, everybody's. When this was
built every reference driver drove every {CHECKED_EVERY}th layout, from layout 0 on, in closed loop too, and
ended as in the trees.

{audit_text}

{_origin(config)}| who decides | success, % of {seeds} layouts |
|---|---|
| the best policy | {rate:.1f} |
{drivers}

- `layouts.zip`: of each layout `tree.json`, where each action leads and what the reference drivers do, and
  for each level of the tree `<step>.jsonl`, a line a decision point, in the order of the tree. Each line
  holds the whole state and every viewer's scene graph.
- `tree.schema.json`, `scene.schema.json`: fields and units of both.
- `manifest.json`: scenario parameters, versions, the sha256 of every file and tree; a tree pins its scenes.

`harness dataset check` verifies all of it, `harness dataset rank` drives the reference drivers again.
"""  # noqa: E501
