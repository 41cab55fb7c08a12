"""`harness run video`: an episode of a closed-loop run, drawn."""

from pathlib import Path

import typer

from harness.cli.progress import bar
from harness.core.errors import printable


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
    from harness.extensions.media.stills import find, stills
    from harness.extensions.media.video import check, write_video

    check(out)
    played = find(run, episode, condition, seed)
    with bar("drawing", sum(1 for _ in stills(played))) as progress:
        write_video(played, out, progress)
    typer.echo(f"wrote {printable(out)}")
