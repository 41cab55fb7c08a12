"""`harness dataset import`: recorded and simulated traffic as a folder that scenarios read."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core.errors import UserError, in_range, printable, sayable, unknown
from harness.core.figures import amount, some_of
from harness.core.files import making, refuse_taken
from harness.core.progress import Progress

if TYPE_CHECKING:
    from harness.extensions.roads.csv_tracks import Columns
    from harness.extensions.roads.held import Speeds
    from harness.extensions.roads.scene import Scene
    from harness.extensions.roads.tables import Moment, Recording

MOST_FILES = 10_000
MOST_LEFT_OUT = 0.1  # share of road users that are left out since they cannot be so
IN_ANOTHER = "appears where another is"
OTHER_MOVEMENT = "states another speed or heading than it moves with"
SHOWN = 3  # reasons that the screen has
KNOWN = (
    "CommonRoad's XML, SUMO's net, positions (FCD), routes and polygons, and tables of tracks, "
    "lanes or buildings"
)


def command(
    files: list[Path] = typer.Argument(
        help="Files with road users and their map, or folders of them. What stands in a file says "
        f"what it is: {KNOWN}.",
        metavar="FILE...",
    ),
    out: Path = typer.Option(..., help="Folder to make; its name becomes the recording's name."),
    licence: str | None = typer.Option(
        None, help="Under which licence the files may be used, such as CC-BY-4.0; or unknown."
    ),
    source: str = typer.Option("", help="Where the traffic is from, in words for cards."),
    name: str | None = typer.Option(None, help="Name of the recording. Default: the folder's."),
    window: float = typer.Option(80.0, help="Metres around the ego that an episode has."),
    decisions: int = typer.Option(4, help="Number of decisions of an episode, a second each."),
    columns: str | None = typer.Option(
        None,
        help="Which columns a table of tracks has, such as "
        "time_s=frame/25,id=track,x_m=x,y_m=y, or a TOML file of such lines.",
    ),
    show: Path | None = typer.Option(
        None, help="Also draw the scenes and moments to this file: .svg, .pdf or .png."
    ),
    as_json: options.Json = False,
) -> None:
    """Import recorded or simulated traffic, as scenes to decide in.

    The moments at which episodes begin are chosen among all. Whoever cannot be taken is left out
    and counted. Nothing is written if a file is wrong.
    """
    from harness.extensions.roads.csv_tracks import columns_of

    refuse_taken("--out", out)
    in_range("--window", window, 10, 2000)
    in_range("--decisions", decisions, 1, 9)
    about = _About(_name(name, out), _text("--source", source), _licence(licence))
    _refuse_picture(show, out)
    declared = columns_of(columns)
    with bar("sorting files", quiet=as_json) as progress:
        sources = Sources.of(files, progress, declared)
    what = about, window, decisions
    recording, taken = _imported(sources, declared, out, what, show, as_json)
    if as_json:
        _echo_json(recording, taken)
    else:
        _echo(recording, taken, show)


@dataclass(frozen=True)
class _About:
    """Hold what is stated of a recording."""

    name: str
    source: str
    licence: str


@dataclass
class Sources:
    """Hold the files to read, by what stands in them."""

    commonroad: list[Path] = field(default_factory=list)
    sumo: list[Path] = field(default_factory=list)  # nets, routes and polygons
    positions: list[Path] = field(default_factory=list)  # of SUMO's vehicles
    tracks: list[Path] = field(default_factory=list)
    lanes: list[Path] = field(default_factory=list)
    buildings: list[Path] = field(default_factory=list)
    others: list[str] = field(default_factory=list)  # why files of folders are none of these

    @property
    def count(self) -> int:
        """Return how many files have road users."""
        return len(self.commonroad) + len(self.positions) + len(self.tracks)

    @classmethod
    def of(cls, paths: Sequence[Path], progress: Progress, columns: "Columns") -> "Sources":
        """Sort files, and all files of folders, by what stands in them.

        Raises UserError for a file that is none of them; of folders such files are counted, and
        so are tables with none of the declared `columns` of time and place.
        """
        sources = cls()
        for path in paths:
            if not path.is_dir():
                sources._add(path, kind_of(path))
                continue
            for inner in files_of(path):
                try:
                    kind = kind_of(inner)
                    if kind == "tracks":
                        _refuse_without_places(inner, columns)
                except UserError as error:
                    sources.others.append(str(error))
                    continue
                sources._add(inner, kind)
                progress(1)
        if not sources.count and not sources.sumo:
            left_out = f" (left out: {sources.others[0]})" if sources.others else ""
            raise UserError(f"no file has road users{left_out}; give {KNOWN}")
        return sources

    def _add(self, path: Path, kind: str) -> None:
        list_of: list[Path] = getattr(self, kind)
        if path not in list_of:
            list_of.append(path)


def _refuse_without_places(path: Path, columns: "Columns") -> None:
    """Raise UserError for a table of something else, such as one of what recordings are there."""
    from harness.extensions.roads import csv_tracks
    from harness.extensions.roads.sources import no_use

    if not csv_tracks.has_places(csv_tracks.header_of(path), columns):
        raise no_use(path, "it has none of the columns of time and place")


def files_of(folder: Path) -> list[Path]:
    """Return all files of a folder and of folders in it, by name, but hidden ones."""
    files = []
    for path in sorted(folder.rglob("*")):
        inner = path.relative_to(folder).parts
        if path.is_file() and not any(part.startswith(".") for part in inner):
            files.append(path)
        if len(files) > MOST_FILES:
            raise UserError(
                f"folder {printable(folder)} has more than {MOST_FILES} files; give a part of it"
            )
    return files


def kind_of(path: Path) -> str:
    """Return what a file is, a field of `Sources`, by what stands in it.

    Raises UserError for one that is none of them.
    """
    from harness.extensions.roads import commonroad, csv_tracks, sumo_files
    from harness.extensions.roads.sources import no_use, unpacked

    with unpacked(path) as file:
        head = file.read(1 << 12)
    if not head.strip():
        raise no_use(path, "it is empty")
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text.startswith((b"<", b"\xff\xfe", b"\xfe\xff")):
        root = sumo_files.root_of(path)
        kinds = {
            commonroad.ROOT: "commonroad",
            sumo_files.POSITIONS: "positions",
            **dict.fromkeys((sumo_files.NET, *sumo_files.FURTHER), "sumo"),
        }
        if root not in kinds:
            raise no_use(path, f"its root is {printable(root, 40)}; known: {', '.join(kinds)}")
        return kinds[root]
    if b"\0" in head:
        raise no_use(path, f"it is neither XML nor text; known: {KNOWN}")
    header = csv_tracks.header_of(path)
    if csv_tracks.is_lanes(header):
        return "lanes"
    if csv_tracks.is_buildings(header):
        return "buildings"
    if len(header) < len(csv_tracks.NEEDED):
        raise no_use(path, f"its first line names no columns; known: {KNOWN}")
    return "tracks"


def _speeds() -> "Speeds":
    from harness.extensions.roads.held import Speeds

    return Speeds()


@dataclass
class _Taken:
    """Hold what was read, for the screen."""

    kinds: Counter[str] = field(default_factory=Counter)
    still: int = 0
    minutes: float = 0.0
    lanes: int = 0
    lights: int = 0  # scenes with traffic lights
    left_out: Counter[str] = field(default_factory=Counter)
    without: dict[str, str] = field(default_factory=dict)  # files left out, with the reason
    _speeds: "Speeds" = field(default_factory=_speeds)

    def add(self, scene: "Scene") -> None:
        for track in scene.tracks.values():
            self.kinds[track.kind] += 1
            self.still += track.still
        self._speeds.add(scene)
        self.minutes += (scene.end_s - scene.begin_s) / 60
        self.lanes += len(scene.lanes)
        self.lights += scene.lights
        self.left_out.update(scene.left_out)

    def leave_out(self, scene: "Scene", reason: str) -> None:
        """Count a scene that nobody can decide in, and what was left out of it."""
        self.without[scene.file] = reason
        self.left_out.update({**scene.left_out, reason: 1})

    def targets_mps(self) -> tuple[float, float, float]:
        """Return the ego's target speeds."""
        return self._speeds.targets_mps()


def _imported(
    sources: Sources,
    columns: "Columns",
    out: Path,
    what: tuple[_About, float, int],
    show: Path | None,
    quiet: bool,
) -> "tuple[Recording, _Taken]":
    """Write a recording, all of it or nothing, and return it with what was read."""
    from harness.extensions.roads import tables
    from harness.extensions.roads.sources import Unpacked

    taken = _Taken()
    if sources.others:
        taken.left_out["file of another kind"] = len(sources.others)
    about, window_m, decisions = what
    texts = (about.name, about.source, about.licence, window_m)
    try:
        with making(out) as part:
            first_byte = Unpacked.bytes_read
            with bar("reading files", sources.count, quiet) as progress:
                # one file may be all that there is
                progress.spent = lambda: f"{(Unpacked.bytes_read - first_byte) / 1e6:.1f} MB"
                scenes = _watched(_unique(scenes_of(sources, columns)), taken, progress)
                recording = tables.write(part, *texts, scenes, (), {}, decisions=decisions)
            count = len(recording.scenes_stated)
            with bar("choosing moments", count, quiet, grows=True) as progress:
                # the recorded driver must reach the goal with the speeds that the ego will have
                speeds_mps = taken.targets_mps()
                recording = tables.chosen(recording, speeds_mps, (), {})
                moments, choice = _chosen(recording, progress)
            if taken.without:
                choice = {**choice, "files_left_out": taken.without}
            recording = tables.chosen(recording, speeds_mps, moments, choice)
            if show:
                _draw(recording, show)
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be written ({error.strerror}); give another folder"
        ) from None
    return replace(recording, folder=out), taken


def _draw(recording: "Recording", show: Path) -> None:
    from harness.extensions.roads.picture import draw

    try:
        draw(recording, show)
    except OSError as error:
        raise UserError(
            f"--show {printable(show)} cannot be written ({error.strerror}); give another path"
        ) from None


def scenes_of(sources: Sources, columns: "Columns") -> Iterator["Scene"]:
    """Yield the scenes of all files.

    Raises UserError for a broken file, and for road users whose map is not among the files.
    """
    from harness.extensions.roads import commonroad, csv_tracks, sumo_files

    maps = list(sources.commonroad)
    if sources.positions or (sources.sumo and not sources.tracks):
        yield from sumo_files.scenes(*sources.sumo, *sources.positions)
    if sources.tracks:
        lanes, houses, lights = _map_of(sources)
        maps = []
        for path in sources.tracks:
            yield from csv_tracks.scenes(
                path, columns=columns, lanes=lanes, houses=houses, lights=lights
            )
    yield from commonroad.scenes(*maps)


def _map_of(sources: Sources) -> tuple[Any, Any, bool]:
    """Return the lanes, buildings and lights that tables of tracks go with."""
    from harness.extensions.roads import commonroad, csv_tracks, sumo_files

    amounts = len(sources.lanes), len(sources.sumo), len(sources.commonroad)
    if sum(n > 0 for n in amounts) != 1 or amounts[0] > 1 or amounts[2] > 1:
        raise UserError(
            "tables of tracks need one map; give with them a table of lanes (id, x_m, y_m), a net "
            "of SUMO or a file of CommonRoad, and no other"
        )
    more = tuple(house for path in sources.buildings for house in csv_tracks.buildings_of(path))
    if sources.lanes:
        return csv_tracks.lanes_of(sources.lanes[0]), more, False
    if sources.sumo:
        net = sumo_files.map_of(*sources.sumo)
        return net.lanes, (*net.houses, *more), net.lights
    road = commonroad.map_of(sources.commonroad[0])
    return road.lanes, (*road.houses, *more), road.lights


def _unique(scenes: Iterable["Scene"]) -> Iterator["Scene"]:
    """Yield scenes, each with a name that none before it has."""
    names: set[str] = set()
    for scene in scenes:
        name, n = scene.name, 1
        while name in names:
            n += 1
            name = f"{scene.name}-{n}"
        names.add(name)
        yield scene if name == scene.name else replace(scene, name=name)


def _watched(scenes: Iterable["Scene"], taken: _Taken, progress: Progress) -> Iterator["Scene"]:
    """Yield the scenes in which there is something to decide, and take note of all.

    Raises UserError, which says what the first lacks, if there is none such.
    """
    from harness.extensions.roads.scene import checked

    first_without: Scene | None = None
    for scene in scenes:
        progress(1)
        if reason := _lack(scene):
            taken.leave_out(scene, reason)
            first_without = first_without or scene
            continue
        whole = without_few(scene)
        yield whole  # which writes it, and refuses it where it cannot be
        taken.add(whole)
    if first_without and not taken.kinds:
        checked(first_without)


def _lack(scene: "Scene") -> str | None:
    """Return why nobody can decide in a scene that is sound; None if somebody can."""
    if not scene.tracks:
        return "scene without road users"
    return None if scene.lanes else "scene without lanes"


def without_few(scene: "Scene") -> "Scene":
    """Return a scene without those who cannot be so, each kind of them if they are few.

    Such appear where another is, or state another speed or heading than they move with. Many of
    them are a mistake of sizes, positions or units, which `checked` names.
    """
    import numpy as np

    from harness.extensions.roads.scene import other_movement, overlaps

    tracks = dict(scene.tracks)
    for track in tracks.values():
        is_finite = np.isfinite(track.time_s).all() and np.isfinite(track.poses).all()
        if not len(track.time_s) or not is_finite or (np.diff(track.time_s) <= 0).any():
            return scene  # which is refused
    late = {track.id for track, _ in overlaps(list(tracks.values()))}
    others = {track.id for track in tracks.values() if next(other_movement(track), None)}
    left_out = dict(scene.left_out)
    for reason, ids in ((IN_ANOTHER, late), (OTHER_MOVEMENT, others)):
        if 0 < len(ids) <= MOST_LEFT_OUT * len(scene.tracks):
            tracks = {key: track for key, track in tracks.items() if key not in ids}
            left_out[reason] = len(ids)
    return replace(scene, tracks=tracks, left_out=left_out)


def _chosen(
    recording: "Recording", progress: Progress
) -> "tuple[Sequence[Moment], Mapping[str, Any]]":
    """Return the moments of a recording, and how they were chosen."""
    from harness.extensions.roads.fitness import choose_fit
    from harness.extensions.roads.held import horizon_s

    until_s = horizon_s(recording.facts)
    choice = choose_fit(recording, _counted(recording.scenes(), progress), until_s, progress)
    return choice.moments, {**choice.record, "horizon_s": until_s}


def _counted(scenes: Iterator["Scene"], progress: Progress) -> Iterator["Scene"]:
    for scene in scenes:
        yield scene
        progress(1)


def _name(name: str | None, out: Path) -> str:
    from harness.extensions.roads.tables import WORDS

    given = out.name.lower() if name is None else name
    if not WORDS.fullmatch(given):
        raise UserError(
            f"--name {printable(given)!r}; allowed: small letters, digits, `.`, `_` and `-`, "
            "80 at most; give one"
        )
    return given


def _licence(text: str | None) -> str:
    if text is None or not text.strip():
        raise UserError(
            "--licence is missing: it goes on cards of whatever is made from the files; give "
            "theirs, such as CC-BY-4.0, or `--licence unknown`"
        )
    return _text("--licence", text)


def _text(option: str, text: str) -> str:
    from harness.extensions.roads.tables import LONGEST_TEXT

    if len(text) > LONGEST_TEXT:
        raise UserError(f"{option} has {len(text)} characters; give {LONGEST_TEXT} at most")
    return sayable(f"{option}", text, "give another text")


def _refuse_picture(show: Path | None, out: Path) -> None:
    if show:
        if out.resolve() in show.resolve().parents:
            raise UserError(
                f"--show {printable(show)} is in --out {printable(out)}, which has nothing but the "
                "recording; give another path"
            )
        from harness.report.drawing.pictures import FORMATS

        if show.suffix[1:] not in FORMATS:
            endings = [f".{name}" for name in FORMATS]
            raise unknown("--show, a file that ends in", show.suffix, endings)
        refuse_taken("--show", show, "path")


def _echo_json(recording: "Recording", taken: _Taken) -> None:
    import msgspec

    from harness.cli.terminal import echo_json

    facts = msgspec.to_builtins(recording.facts)
    read = {
        "road_users": dict(taken.kinds),
        "still": taken.still,
        "minutes": taken.minutes,
        "left_out": dict(taken.left_out),
    }
    echo_json({"folder": str(recording.folder), "sha256": recording.digest, **facts, **read})


def _echo(recording: "Recording", taken: _Taken, show: Path | None) -> None:
    """Print what was imported, and what to type next."""
    from harness.cli.next_command import echo_next
    from harness.cli.terminal import echo_text
    from harness.core.seeds import FIRST

    facts = recording.facts
    scenes = amount(len(facts.scenes), "scene")
    users = amount(sum(taken.kinds.values()), "road user")
    lanes = amount(taken.lanes, "lane")
    echo_text(
        f"wrote {printable(recording.folder)}: {scenes} of {taken.minutes:.1f} minutes, {users}, "
        f"{lanes}"
    )
    kinds = ", ".join(amount(n, kind) for kind, n in taken.kinds.most_common())
    echo_text(f"road users: {kinds}; {taken.still} of them never move")
    if taken.lights:
        echo_text(f"traffic lights: in {taken.lights} of {scenes}, and their signals are not known")
    if taken.left_out:
        echo_text(f"left out: {_reasons(taken.left_out)}")
    if taken.without:
        names = [printable(name, 40) for name in taken.without]
        echo_text(f"files without road users or lanes: {some_of(names)}")
    slow, middle, fast = facts.speeds_mps
    echo_text(
        f"episodes: {facts.window_m:g} m around the ego, {amount(facts.decisions, 'decision')}, "
        f"target speeds {slow:g}, {middle:g} and {fast:g} m/s"
    )
    _echo_moments(recording)
    if facts.licence == "unknown":
        echo_text("the licence is unknown, and cards of what is made from this say so")
    if show:
        echo_text(f"drew {printable(show)}")
    if facts.moments:
        purposes = Counter(moment.purpose for moment in facts.moments)
        purpose = max(FIRST, key=lambda each: (purposes[each] > 0, FIRST[each]))
        layouts = "--episodes", purposes[purpose], "--seed", FIRST[purpose]
        dataset = Path(f"{recording.folder}-dataset")
        echo_next("dataset", "build", "--recording", recording.folder, *layouts, "--out", dataset)


def _echo_moments(recording: "Recording") -> None:
    from harness.cli.terminal import echo_text
    from harness.core.seeds import FIRST

    facts = recording.facts
    purposes = Counter(moment.purpose for moment in facts.moments)
    by_purpose = ", ".join(f"{n} to {purpose}" for purpose, n in purposes.items()) or "none"
    hidden = sum(moment.hidden is not None for moment in facts.moments)
    echo_text(
        f"moments: {by_purpose}, of {facts.choice.get('candidates', 0)} candidates; in {hidden} "
        "somebody hidden comes into conflict"
    )
    if reasons := facts.choice.get("left_out"):
        echo_text(f"not taken: {_reasons(reasons)}")
    if shared := facts.choice.get("shared"):
        echo_text(
            f"{shared} scenes share traffic with another (cuts of one session that overlap?): "
            "such are one scene for purposes and intervals"
        )
    if without := [purpose for purpose in FIRST if not purposes[purpose]]:
        echo_text(
            f"no moments to {' or '.join(without)}: import more files or longer ones, with fewer "
            "--decisions (an episode takes two seconds more than these), or with another --window; "
            "what moves in a file decides what it is for"
        )


def _reasons(counts: Mapping[str, int]) -> str:
    """Return the most frequent reasons with their counts, as one text."""
    most = Counter(counts).most_common()
    texts = [f"{n} {printable(reason, 60)}" for reason, n in most[:SHOWN]]
    rest = sum(n for _, n in most[SHOWN:])
    return "; ".join([*texts, *([f"{rest} for other reasons"] if rest else [])])
