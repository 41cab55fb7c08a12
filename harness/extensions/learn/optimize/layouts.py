"""The tune layouts that a search of wordings plays, and how many questions it asks there."""

from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.formats import WORK
from harness.core.parallel import Workers
from harness.core.progress import Progress
from harness.core.seeds import FIRST, Purpose, purposes, seeds_text
from harness.dataset import load, rebuilt
from harness.dataset.schema import Manifest
from harness.dataset.verify import scenario_of
from harness.evaluate import resolve
from harness.evaluate.dry_run import count
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.spec import Spec
from harness.runs.settings import Settings
from harness.world.scenario import Scenario


def only_for(wanted: Purpose, option: str, name: str, first: int, count: int) -> None:
    """Raise UserError unless `count` layout seeds from `first` on are all for the purpose `wanted`.

    A layout seed draws a start situation; its number says what it is for, such as `tune`. `option`
    and `name` name the dataset in the message.
    """
    if purposes(first, count) != [wanted]:
        raise UserError(
            f"{option} {printable(name)}: {seeds_text(first, count)}; a prompt is searched on tune "
            f"seeds ({FIRST['tune']} to {FIRST['train'] - 1}) and certified on report seeds (from "
            f"{FIRST['report']})"
        )


def given(names: Sequence[str], reported: Sequence[Manifest]) -> list[FrozenSource]:
    """Return the user's datasets of tune layouts, one for each dataset of report layouts.

    A search chooses on tune layouts (start situations) and is measured on report layouts. `names`
    are the datasets to read, and `reported` the manifests of those of report layouts. Raises
    UserError unless both are of the same scenarios in the same order, share no layout, and hold the
    layouts that their seeds draw.
    """
    if len(names) != len(reported):
        raise UserError(
            f"--tune: {len(names)} given for {len(reported)} datasets; give one each, in order"
        )
    sources = [resolve.frozen(Settings(), name) for name in names]
    for name, source, other in zip(names, sources, reported, strict=True):
        scenario = scenario_of(other)
        manifest = source.dataset.manifest
        only_for("tune", "--tune", name, manifest.seed, manifest.episodes)
        if source.scenario.name != scenario.name:
            raise UserError(
                f"--tune {printable(name)}: it is of {source.scenario.name}, and not of "
                f"{scenario.name} as --dataset is; give one of the same scenario"
            )
        if not set(manifest.trees_sha256).isdisjoint(other.trees_sha256):
            raise UserError(
                f"--tune {printable(name)}: it has a layout of {printable(other.name)}, where the "
                "winner is certified; build one of other seeds"
            )
        rebuilt.refuse(source.dataset)
    return sources


def built(
    scenarios: Sequence[Scenario],
    place: Path,
    layouts: int,
    first_seed: int,
    workers: Workers,
    progress: Progress,
) -> list[FrozenSource]:
    """Return a dataset of tune layouts for each scenario, built in the folder `place` if missing.

    Each has `layouts` layouts (start situations), with seeds from `first_seed` on. `progress` is
    told how many there are, and called with the number just built. Raises UserError if one that a
    stopped search left is not what its seeds give, or has a layout that numbers are reported of.
    """
    from harness.dataset.build import build, dataset_of_stopped

    sources = []
    for scenario in scenarios:
        out = place / f"tune-{scenario.name}"
        if not (out / "manifest.json").is_file() or (out / WORK).is_dir():
            rebuilt.refuse_drawn(scenario, range(first_seed, first_seed + layouts))
            progress.more(layouts)
            build(scenario, out, layouts, first_seed, workers, progress, audits=False)
            dataset = load.load(out)
        else:
            dataset = dataset_of_stopped(scenario, out, layouts, first_seed)
            rebuilt.refuse(dataset)
        sources.append(FrozenSource(dataset))
    return sources


def counted(
    specs: Sequence[Spec],
    sizes: Mapping[str, int],
    budget: int,
    layouts: int,
    episodes: Sequence[int],
    tokenizer: Path | None,
) -> dict[str, Any]:
    """Return what a search is expected to ask, as the dict that `--dry-run` prints.

    Its keys: `choices`, the alternatives of each marked choice; `wordings`, all their combinations;
    `wordings_in_a_round`, those that one round over the choices tries; `budget`; numbers of
    requests for one wording (`questions_a_wording`) and for the comparison on report layouts
    (`certificate_questions`); and `prompt_tokens` by dataset.

    Args:
        specs: evaluations on a few tune layouts (start situations), from which it counts.
        sizes: how many alternatives each choice has, by its name; empty if a model rewrites.
        budget: most questions that may be asked.
        layouts: number of layouts of each tune dataset; 0 for as many as `specs` have.
        episodes: number of layouts of each report dataset.
        tokenizer: file of a tokenizer that counts tokens; None to count none.
    """
    of_family = [count(spec, spec.source.dataset, tokenizer) for spec in specs]  # type: ignore[attr-defined]
    here = [len(list(spec.source.layout_seeds)) for spec in specs]
    each = [c["requests"] / n for c, n in zip(of_family, here, strict=True)]
    return {
        "choices": dict(sizes),
        "wordings": prod(sizes.values()) if sizes else None,
        "wordings_in_a_round": 1 + sum(n - 1 for n in sizes.values()) if sizes else None,
        "budget": budget,
        "questions_a_wording": round(
            sum(q * (layouts or n) for q, n in zip(each, here, strict=True))
        ),
        "certificate_questions": 2 * round(sum(q * n for q, n in zip(each, episodes, strict=True))),
        "prompt_tokens": [c["prompt_tokens"] for c in of_family],
    }
