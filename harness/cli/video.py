"""`harness run video`: an episode of a closed-loop run as a video."""

from pathlib import Path

import typer

from harness.cli.progress import bar


def command(
    run: Path = typer.Argument(help="Folder of a finished run of `harness drive`."),
    episode: int = typer.Argument(help="Number of the episode, from 0."),
    condition: str | None = typer.Option(None, help="Condition to draw. Default: the run's last."),
    seed: int | None = typer.Option(None, help="Channel seed to draw. Default: the run's first."),
    out: Path = typer.Option(
        Path("episode.gif"), help="File to write: .gif, or .mp4 if the extra `video` is installed."
    ),
) -> None:
    """Draw an episode of a closed-loop run as a video.

    It shows what is in sight, messages and the ego's policy.
    """
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
    from harness.evaluate.replay import played
    from harness.report.drawing.video import formats, write_video
    from harness.runs.folder import read

    driven = read(run)
    last = driven.conditions[-1]
    failed: dict[int, int] = {}
    for ended in sorted(driven.episodes, key=lambda ended: ended.episode):
        if ended.condition == last and not ended.success and len(failed) < most:
            failed.setdefault(ended.episode, ended.seed)
    files = []
    with bar("drawing failed episodes", len(failed), quiet) as progress:
        for episode, seed in failed.items():
            files.append(run / "videos" / f"{episode:05d}-seed{seed}{formats()[-1]}")
            write_video(played(driven, episode, last, seed), files[-1], lambda done: None)
            progress(1)
    return files
