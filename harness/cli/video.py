"""`harness video`: a driven episode as a moving picture."""

from pathlib import Path
from typing import Annotated

import typer


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished live run.")],
    episode: Annotated[int, typer.Argument(help="Number of the episode.")],
    condition: Annotated[str | None, typer.Option(help="Operating point. Default: the run's last.")] = None,
    seed: Annotated[int | None, typer.Option(help="Channel seed. Default: the run's first.")] = None,
    out: Annotated[Path, typer.Option(help="File to write: .gif, or .mp4 with the extra `video`.")] = Path(
        "episode.gif"
    ),
) -> None:
    """Play a driven episode again and draw it from above: sight, messages on their way, the ego's policy."""
    from harness.cli.progress import bar
    from harness.evaluate.replay import find, stills
    from harness.report.drawing.video import check, write_video

    check(out)
    played = find(run, episode, condition, seed)
    with bar("drawing", sum(1 for _ in stills(played))) as progress:
        write_video(played, out, progress)
    typer.echo(f"wrote {out}")


def write_failures(run: Path, most: int, quiet: bool) -> list[Path]:
    """Videos of a run's first failed episodes under its last condition, each with the first seed that failed.

    They are written to the run's `videos`, the best kind that can be written here; returns the files.
    """
    from harness.cli.progress import bar
    from harness.evaluate.replay import played
    from harness.report.drawing.video import formats, write_video
    from harness.runs.folder import read

    found = read(run)
    last = found.conditions[-1]
    failed: dict[int, int] = {}
    for one in sorted(found.episodes, key=lambda one: one.episode):
        if one.condition == last and not one.success and len(failed) < most:
            failed.setdefault(one.episode, one.seed)
    files = []
    with bar("drawing failed episodes", len(failed), quiet) as progress:
        for episode, seed in failed.items():
            files.append(run / "videos" / f"{episode:05d}-seed{seed}{formats()[-1]}")
            write_video(played(found, episode, last, seed), files[-1], lambda done: None)
            progress(1)
    return files
