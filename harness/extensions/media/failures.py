"""Videos of the episodes of a run that failed, for `harness drive --save-video`."""

from pathlib import Path

from harness.cli.progress import bar
from harness.core import extras
from harness.core.files import folder_in


class Failures:
    """Draw the failed episodes of a closed-loop run as videos, for `harness drive --save-video`.

    `write` does it, once the run is finished.
    """

    def ready(self) -> None:
        extras.need("--save-video", "matplotlib")

    def write(self, run: Path, most: int, quiet: bool) -> list[Path]:
        """Draw at most `most` failed episodes of a run as videos; return the files.

        `run` is the folder of a closed-loop run. Episodes are those that failed under its last
        condition (settings of radio, asking and fusion), each with the first channel seed with
        which it did. Files are written to the run's folder `videos`, as .mp4 if that can be written
        here, else as .gif. If `quiet`, no progress is shown.
        """
        from harness.evaluate.replay import played
        from harness.extensions.media.video import formats, write_video
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
                files.append(folder_in(run, "videos") / f"{episode:05d}-seed{seed}{formats()[-1]}")
                write_video(played(driven, episode, last, seed), files[-1], lambda done: None)
                progress(1)
        return files


FAILURES = Failures()
