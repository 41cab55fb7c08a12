"""Files of strangers as bytes and XML elements, and rows of poses as tracks."""

import gzip
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, ClassVar
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError, one_line, printable
from harness.core.files import MOST_TIMES, opened
from harness.extensions.roads.scene import FASTEST_MPS, LONGEST_ID, STILL_M, Track

GZIP = b"\x1f\x8b"
CHUNK = 1 << 18
MOST_OF_ELEMENT = 32 << 20  # bytes of one child of a file's root: a lane, a road user, a time
DEEPEST = 50  # elements in one another
MOVES_M = 0.05  # from one pose to the next: what moves less keeps its heading
SAME_M = 0.001  # by which points of a line that are nearer are one
LONGEST_GAP_S = 1.0  # without a pose, after which a road user counts as another one


def no_use(path: Path, reason: object) -> UserError:
    """Build the error for a file that cannot be read."""
    return UserError(
        f"file {printable(path)}: {printable(reason, 200)}; correct it, or leave it out"
    )


class Unpacked:
    """Read a file, or what a gzip file unpacks to, no more than such files ever do."""

    bytes_read: ClassVar[int] = 0  # of all files in this process, for whoever shows how far it is

    def __init__(self, file: BinaryIO, size: int) -> None:
        is_packed = file.read(2) == GZIP
        file.seek(0)
        self._file: Any = gzip.GzipFile(fileobj=file) if is_packed else file
        self._most = MOST_TIMES * size + (1 << 20) if is_packed else size
        self._count, self.closed = 0, False

    def read(self, size: int = -1) -> bytes:
        data: bytes = self._file.read(CHUNK if size < 0 else size)
        self._count += len(data)
        Unpacked.bytes_read += len(data)
        if self._count > self._most:
            raise ValueError("it unpacks to more than such files do")
        return data

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self.closed = True


@contextmanager
def unpacked(path: Path) -> Iterator[Unpacked]:
    """Enter a context that yields a file's content, unpacked where it is a gzip file.

    Whatever is wrong with the file, in the context as well, is raised as a UserError that names it.
    """
    try:
        with opened(path, "rows") as file:
            size = file.seek(0, 2)
            file.seek(0)
            yield Unpacked(file, size)
    except expat.ExpatError as error:
        raise no_use(path, f"it is no XML: {one_line(error)}") from None
    except (OSError, EOFError, ValueError, OverflowError) as error:
        raise no_use(path, getattr(error, "strerror", None) or one_line(error)) from None


def elements(path: Path, wanted: Callable[[str], bool] = lambda tag: True) -> Iterator[Element]:
    """Yield a file's root element without its children, and then each child with all below it.

    Of other children than the wanted only the tags and attributes are kept. Memory is that of one
    child. A document type, which may define entities, is refused, and so are elements too deep or
    too large. Raises UserError.
    """
    with unpacked(path) as file:
        reader = _Reader(wanted)
        while data := file.read(CHUNK):
            yield from reader.feed(data)
        yield from reader.feed(b"", is_last=True)


def starts(path: Path, take: Callable[[str, dict[str, str]], None]) -> None:
    """Call a function with the tag and attributes of each element of a file, as it begins.

    It is several times as fast as `elements`, for files of millions of rows. Raises UserError.
    """
    parser = _parser()
    parser.StartElementHandler = take
    with unpacked(path) as file:
        while data := file.read(CHUNK):
            parser.Parse(data, False)
        parser.Parse(b"", True)


def _parser() -> expat.XMLParserType:
    """Return a parser that refuses document types, whose entities may stand for anything."""
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = _refuse
    return parser


def _refuse(*_: object) -> None:
    raise ValueError("it has a document type, which is not read; delete its <!DOCTYPE …>")


class _Reader:
    """Turn bytes of XML into the children of its root."""

    def __init__(self, wanted: Callable[[str], bool]) -> None:
        self.wanted, self.depth, self.since = wanted, 0, 0
        self.ready: list[Element] = []
        self.builder: TreeBuilder | None = None
        self.parser = _parser()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text

    def feed(self, data: bytes, is_last: bool = False) -> Iterator[Element]:
        self.parser.Parse(data, is_last)
        self.since += len(data)
        if self.ready:
            self.since = 0
        if self.since > MOST_OF_ELEMENT:
            raise ValueError(f"one element has more than {MOST_OF_ELEMENT >> 20} MB")
        yield from self.ready
        self.ready.clear()

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ValueError(f"its elements stand more than {DEEPEST} in one another")
        if self.depth == 1:
            self.ready.append(Element(tag, attributes))
        elif self.depth == 2:
            self.builder = TreeBuilder() if self.wanted(tag) else None
            if not self.builder:
                self.ready.append(Element(tag, attributes))
        if self.builder:
            self.builder.start(tag, attributes)

    def _end(self, tag: str) -> None:
        self.depth -= 1
        if self.builder:
            element = self.builder.end(tag)
            if self.depth == 1:
                self.ready.append(element)
                self.builder = None

    def _text(self, text: str) -> None:
        if self.builder:
            self.builder.data(text)


def number(element: Element | None, path: str | None = None) -> float:
    """Return the number that an element has as its text; NaN without one.

    `path` is that of an element below it. Raises ValueError for a text that is no number.
    """
    place = element if path is None or element is None else element.find(path)
    text = None if place is None else place.text
    return float("nan") if text is None or not text.strip() else float(text)


def name_of(text: str) -> str:
    """Return a text as a name that every terminal and file system shows."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.")
    return plain[:80] or "scene"


def stem_of(path: Path) -> str:
    """Return a file's name without its endings, of all that are known ones."""
    return re.sub(r"(\.(gz|xml|net|fcd|csv|tsv|txt|cr))+$", "", path.name, flags=re.IGNORECASE)


def tracks_of(
    key: str,
    kind: str,
    size_m: tuple[float, float],
    time_s: Floats,
    poses: Floats,
    step_s: float,
) -> Iterator[Track]:
    """Yield one road user's tracks: more than one where it moved and nothing is known of it.

    `size_m` is its length and width, `poses` (n, 4) are those of `Track`, whose heading or speed
    may be NaN: then they are those of its movement. A later part of it has its id with a tilde and
    a number.
    """
    gaps = np.diff(time_s)
    jumps_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    is_long = (gaps > max(2.5 * step_s, LONGEST_GAP_S)) & (jumps_m > STILL_M)
    is_apart = is_long | (jumps_m > FASTEST_MPS * gaps.clip(0) + 5)
    starts = [0, *(np.flatnonzero(is_apart) + 1).tolist(), len(time_s)]
    for part in range(len(starts) - 1):
        rows = slice(starts[part], starts[part + 1])
        name = key if part == 0 else f"{key[: LONGEST_ID - 8]}~{part + 1}"
        yield Track(name, kind, *size_m, time_s[rows], moving(time_s[rows], poses[rows]))


def moving(time_s: Floats, poses: Floats) -> Floats:
    """Return poses whose unknown headings and speeds are those of the movement, (n, 4).

    Who stands keeps the heading that it had or will have; who never moves has heading 0.
    """
    if np.isfinite(poses[:, 2:]).all():
        return poses
    poses = poses.copy()
    if len(time_s) < 2:
        poses[:, 2:] = np.nan_to_num(poses[:, 2:])
        return poses
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = np.gradient(poses[:, :2], time_s, axis=0)
    steps_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    moves = np.maximum(np.append(steps_m, 0), np.insert(steps_m, 0, 0)) > MOVES_M
    headings = np.arctan2(rates[:, 1], rates[:, 0])
    if moves.any():
        places = np.flatnonzero(moves)
        before = np.searchsorted(places, np.arange(len(time_s)), side="right") - 1
        headings = headings[places[before.clip(0)]]
    else:
        headings = np.zeros(len(time_s))
    speeds = np.hypot(*rates.T)
    poses[:, 2] = np.where(np.isfinite(poses[:, 2]), poses[:, 2], headings)
    poses[:, 3] = np.where(np.isfinite(poses[:, 3]), poses[:, 3], speeds)
    return poses


def distinct(points: Floats) -> Floats:
    """Return a line's points (n, 2) without those that are where the one before is."""
    steps_m = np.hypot(*np.diff(points, axis=0).T)
    return np.asarray(points[np.append(True, ~(steps_m <= SAME_M))[: len(points)]])


def sum_up(counts: dict[str, int], reason: str, amount: int = 1) -> None:
    """Count something that is left out, by its reason."""
    counts[reason] = counts.get(reason, 0) + amount


def sha256_of(path: Path) -> str:
    """Return the hex digest of a source file, whatever it is packed in."""
    from harness.core.files import sha256_file

    try:
        return sha256_file(path, "rows")
    except OSError as error:
        raise no_use(path, error.strerror or one_line(error)) from None


def once(things: Mapping[str, object], key: str, what: str, path: Path) -> None:
    """Raise UserError if a file has two things of one id."""
    if key in things:
        raise no_use(path, f"two {what} have the id {printable(key)}")


def few_enough(amount: int, most: int, what: str) -> None:
    """Raise ValueError as soon as a file has more of something than a scene can have."""
    if amount > most:
        raise ValueError(f"more than {most} {what}: cut the map to one place")
