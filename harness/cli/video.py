"""`harness video`: a driven episode as a moving picture."""

from pathlib import Path
from typing import Annotated

import typer

from harness.errors import UserError, printable


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished live run.")],
    episode: Annotated[int, typer.Argument(help="Number of the episode.")],
    condition: Annotated[str | None, typer.Option(help="Operating point. Default: the run's last.")] = None,
    seed: Annotated[int | None, typer.Option(help="Channel seed. Default: the run's first.")] = None,
    out: Annotated[Path, typer.Option(help="File to write, .gif.")] = Path("episode.gif"),
) -> None:
    """Play a driven episode again and draw it from above: sight, messages on their way, the ego's policy."""
    if out.suffix != ".gif":
        raise UserError(f"--out {printable(out)}: end it in .gif")
    from harness.cli.progress import bar
    from harness.drawing.video import write_gif
    from harness.drive.replay import find, stills

    played = find(run, episode, condition, seed)
    with bar("drawing", sum(1 for _ in stills(played))) as progress:
        write_gif(played, out, progress)
    typer.echo(f"wrote {out}")
