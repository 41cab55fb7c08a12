"""A driven episode from above and through cameras, as a moving picture.

Thinking is shown slowly: a still a frame of 20 ms while a decision is open, else ten a second, all
for the same time. So messages can be seen to travel.
"""

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from itertools import chain, repeat
from pathlib import Path

from PIL import Image

from harness.core import extras
from harness.core.arrays import Pixels
from harness.core.errors import UserError, printable
from harness.core.files import replacing, write_whole
from harness.evaluate.replay import ReplayedEpisode
from harness.extensions.media.canvas import Canvas
from harness.extensions.media.stills import Still, stills
from harness.extensions.media.views import views
from harness.report.drawing.geometry import View, shape_of, spots
from harness.report.drawing.pictures import styled
from harness.world.perception.graph import scene_graph
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

STILL_MS, LAST_MS = 100, 2500
COLOURS = 64  # of a GIF


def formats() -> list[str]:
    """Return the endings of video files that can be written here, such as `.gif`, the best last."""
    return [".gif", ".mp4"] if find_spec("imageio_ffmpeg") else [".gif"]


@styled
def write_video(played: ReplayedEpisode, out: Path, progress: Callable[[int], None]) -> None:
    """Draw an episode as a video to a `.gif` or `.mp4` file; `progress` is called with 1 a still.

    `played` is an episode of a closed-loop run, with its decisions; a still is one picture of the
    video.

    Raises:
        UserError: the file's name ends otherwise, or an .mp4 cannot be written here.
    """
    check(out)
    (_mp4 if out.suffix == ".mp4" else _gif)(_pictures(played, progress), out)


def check(out: Path) -> None:
    """Raise UserError if no video can be written to this file, such as for its ending."""
    option = f"--out {printable(out)}"
    if out.suffix not in (".gif", ".mp4"):
        raise UserError(f"{option}: end it in .gif or .mp4")
    if out.suffix == ".mp4":
        extras.need(f"{option}: .mp4", "imageio_ffmpeg")
    if out.is_dir():
        raise UserError(f"{option} is a folder; name a file in it")


def _gif(pictures: Iterable[Pixels], out: Path) -> None:
    first, *others = (
        Image.fromarray(p).quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        for p in pictures
    )
    durations = [STILL_MS] * len(others) + [LAST_MS]
    data = io.BytesIO()
    first.save(
        data, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False
    )
    write_whole(out, data.getvalue())


def _mp4(pictures: Iterator[Pixels], out: Path) -> None:
    from imageio_ffmpeg import write_frames

    first = next(pictures)
    with replacing(out) as part:
        file = write_frames(
            str(part.resolve()),
            first.shape[1::-1],
            fps=1000 / STILL_MS,
            codec="libx264",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-crf", "20", "-movflags", "+faststart", "-f", "mp4"],
        )
        file.send(None)
        last = first
        for last in chain([first], pictures):
            file.send(last)
        for picture in repeat(last, LAST_MS // STILL_MS - 1):
            file.send(picture)
        file.close()


def _pictures(played: ReplayedEpisode, progress: Callable[[int], None]) -> Iterator[Pixels]:
    listed = list(stills(played))
    graphs = list(_graphs(played.scenario, listed))
    canvas = Canvas(played, listed[0].state.buildings, list(listed[0].turns))
    for still, seen, view in zip(
        listed, graphs, _views(played.scenario, listed, graphs), strict=True
    ):
        yield canvas.picture(still, {v: [*graph.seen] for v, graph in seen.items()}, view)
        progress(1)


def _graphs(scenario: Scenario, listed: Iterable[Still]) -> Iterator[dict[str, SceneGraph]]:
    """Yield what each viewer saw when each still's decision began."""
    moment, graphs = None, dict[str, SceneGraph]()
    for still in listed:
        if still.seen != moment:
            moment = still.seen
            graphs = {
                v.id: scene_graph(scenario, moment, v.id) for v in (moment.ego, *moment.helpers)
            }
        yield graphs


def _views(
    scenario: Scenario, listed: Sequence[Still], graphs: Iterable[Mapping[str, SceneGraph]]
) -> Iterable[View]:
    """Return a view for each still: one from each decision to the next,
    then one for each period of these.
    """
    period_s, zone_m = scenario.parameters.decision_period_s, scenario.road().zone_m
    held = []
    for still, seen in zip(listed, graphs, strict=True):
        now = still.since_s < period_s  # later, who was asked last and who was met is of the past
        decisions = [turn.decision for turn in still.turns.values()] if now else []
        senders = [message.sender for decision in decisions for message in decision.messages]
        graph = seen[still.state.ego.id] if now else None
        held.append(spots(still.state, zone_m, graph, (still.danger, *still.turns, *senders)))
    return views(
        held, [int(still.state.time_s / period_s + 1e-6) for still in listed], shape_of(scenario)
    )
