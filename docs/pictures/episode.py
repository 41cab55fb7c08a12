"""Draw an episode that is lost alone and won with messages, side by side: `lost-episode.gif`.

    harness drive --model proxy --episodes 6 --seeds 0 --condition single-local --condition 6g \
        --out reports/lost
    python docs/pictures/episode.py reports/lost 5

It takes the `dev` extra. What stands above each half is read from the run's tables.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
from PIL import Image, ImageDraw, ImageFont, ImageSequence

HERE = Path(__file__).parent
HALF, EVERY, COLOURS, CAPTION, LAST = 450, 4, 64, 44, 6
FONT = ImageFont.load_default(16)


def moving(run: Path, episode: int, condition: str, folder: Path) -> list[Image.Image]:
    """Return every fourth still of an episode under a condition, without the cameras."""
    video = folder / f"{condition}.gif"
    typed = [sys.executable, "-m", "harness", "run", "video", run, str(episode)]
    typed += ["--condition", condition, "--seed", "0", "--out", video]
    subprocess.run(list(map(str, typed)), check=True)
    with Image.open(video) as opened:
        stills = [still.convert("RGB") for still in ImageSequence.Iterator(opened)]
    return [still.crop((0, 0, HALF, still.height)) for still in stills[::EVERY]]


def captions(run: Path, episode: int) -> tuple[str, str]:
    """Return what is said of the episode alone, and with messages, from the run's tables."""
    ends = pd.read_csv(run / "episodes.csv").query("episode == @episode").set_index("condition")
    decisions = pd.read_parquet(run / "decisions.parquet").query("episode == @episode")
    by_step = decisions.set_index(["condition", "step"])["action"]
    steps = range(int(decisions["step"].max()))
    first = next(s for s in steps if by_step["single-local", s] != by_step["6g", s])
    at = {}
    for name in ("single-local", "6g"):
        at[name] = f"step {first}: {by_step[name, first]}, then "
    alone, heard = ends.loc["single-local"], ends.loc["6g"]
    return (
        f"alone, {at['single-local']}{alone['failure']} at {alone['time_s']:.1f} s",
        f"with messages, {at['6g']}{heard['outcome']}",
    )


run, number = Path(sys.argv[1]), int(sys.argv[2])
with tempfile.TemporaryDirectory() as name:
    halves = [moving(run, number, each, Path(name)) for each in ("single-local", "6g")]
length = max(map(len, halves))
frames = []
for place in range(length + LAST):
    frame = Image.new("RGB", (2 * HALF, halves[0][0].height + CAPTION), "white")
    pen = ImageDraw.Draw(frame)
    for side, (stills, caption) in enumerate(zip(halves, captions(run, number), strict=True)):
        frame.paste(stills[min(place, len(stills) - 1)], (side * HALF, CAPTION))
        pen.text((side * HALF + 10, 12), caption, "black", FONT)
    frames.append(frame)
palette = frames[len(frames) // 2].quantize(COLOURS)  # one for all, so that no colour changes
pictures = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
pictures[0].save(
    HERE / "lost-episode.gif", save_all=True, append_images=pictures[1:], duration=400, loop=0
)
