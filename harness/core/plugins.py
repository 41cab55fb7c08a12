"""Registries of plug-ins: built-in ones, and those that installed packages add by entry points."""

import os
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, cast

from harness.core import resources
from harness.core.errors import UserError, one_line, printable
from harness.core.strangers import aside, watched, worded

T = TypeVar("T")
Said = TypeVar("Said")
# whether a value is one that a plug-in may state, and which are, in words
Allowed = tuple[Callable[[Any], bool], str]
OURS = "swarmdrive-harness"  # the name of this distribution
LOADING_S = 3.0  # after which a line says which package a command waits for


def entries(group: str) -> Mapping[str, Any]:
    """Return the packages' entry points of a group, such as `swarmdrive.rules`, by name.

    Of two with one name, this distribution's or else the first is taken, and stderr says so.
    """
    return _entries(group, tuple(sys.path))


@cache  # a look at all packages takes milliseconds
def _entries(group: str, path: tuple[str, ...]) -> Mapping[str, Any]:
    by_name: dict[str, Any] = {}
    for entry in sorted(_declared(group), key=lambda entry: (not is_ours(entry), entry)):
        first = by_name.setdefault(entry.name, entry)
        if first.value != entry.value:
            name, *places = map(printable, (entry.name, first.value, entry.value))
            print(
                f"harness: {name!r} ({group}) is in two packages, {' and '.join(places)}; the "
                "first is taken",
                file=sys.stderr,
            )
    return by_name


def _declared(group: str) -> list[Any]:
    """Return the entry points of a group.
    Of a package whose metadata cannot be read a line says so.
    """
    from importlib.metadata import distributions  # imported here because it is slow

    try:
        return list(_all_entries(tuple(sys.path)).select(group=group))
    except Exception:  # whatever the metadata of a package hold
        declared: list[Any] = []
    for distribution in distributions():
        try:
            declared += distribution.entry_points.select(group=group)
        except Exception as error:
            what = f"the entry points of package {printable(distribution.name)} cannot be read"
            print(f"harness: {what} ({one_line(error)}); it is left out", file=sys.stderr)
    return declared


@cache  # for a look at all packages takes as long for one group as for all
def _all_entries(path: tuple[str, ...]) -> Any:
    from importlib.metadata import entry_points

    _say_if_hidden()
    return entry_points()


def _say_if_hidden() -> None:
    """Say on stderr if a package that has our name, earlier on the path, hides what ours adds."""
    from importlib.metadata import distributions

    named_as_ours = list(distributions(name=OURS))
    declared = [_of_groups(distribution) for distribution in named_as_ours]
    if not all(each <= declared[0] for each in declared):
        where = printable(named_as_ours[0].locate_file(""))
        say_once(
            f"the package in {where} is called {OURS} as well, and hides what the harness has; "
            "uninstall it"
        )


def _of_groups(distribution: Any) -> set[tuple[str, str]]:
    """Return group and name of each entry point of a distribution that the harness reads."""
    points = [(point.group, point.name) for point in distribution.entry_points]
    return {point for point in points if point[0].startswith("swarmdrive.")}


def is_ours(entry: Any) -> bool:
    """Return whether an entry point is of this distribution, whose names nobody else's replace.

    `entry` is an `importlib.metadata.EntryPoint`, or `Added`. A package's may name an object of the
    harness's: who has the entry point decides.
    """
    return str(entry.value).startswith("harness.") and _name_of(entry.dist) == OURS


def package_of(entry: Any) -> str:
    """Return the name of the package that an entry point belongs to, for messages.

    `entry` is an `importlib.metadata.EntryPoint`, or `Added`.
    """
    return printable(_name_of(getattr(entry, "dist", None)) or "of no name")


@cache  # a distribution reads its metadata at each look
def _name_of(distribution: Any) -> str:
    return str(getattr(distribution, "name", "") or "")


@dataclass(frozen=True)
class Added:
    """Stand in for an entry point: an object that an extension adds to a group of plug-ins.

    `value` is its place, `module:name`, and `dist` the distribution of the extension's package, an
    `importlib.metadata.Distribution`.
    """

    value: str  # its place, `module:name`
    dist: Any  # the package's distribution

    def load(self) -> Any:
        from importlib.metadata import EntryPoint

        return EntryPoint("", self.value, "").load()


@cache
def say_once(line: str) -> None:
    """Print a line on stderr, after `harness: `; the same line is not printed again."""
    print(f"harness: {line}", file=sys.stderr)


def texts(answer: Any, what: str = "its answer") -> list[str]:
    """Return texts that a package gave as plain `str`, without its subclasses' code.

    Raises TypeError, which begins with `what`, for anything but a list of texts.
    """
    each = () if isinstance(answer, str) else tuple(answer)
    if isinstance(answer, str) or not all(isinstance(text, str) for text in each):
        raise TypeError(f"{what} holds what is no text")
    return ["".join((text,)) for text in each]


def line_or_none(answer: Any, what: str) -> str | None:
    """Return a package's text as a plain one of one line, 300 characters at most; None as it is.

    Raises ValueError, which names `what` it is, for what is no text, or an empty one.
    """
    if answer is None:
        return None
    if not isinstance(answer, str) or not answer.strip():
        raise ValueError(f"{what} that is no text, and not None: {printable(repr(answer))}")
    return printable(" ".join("".join((answer,)).split()), 300)


class Failed(UserError):
    """Report, in place of what a plug-in should have said, whose plug-in failed and why."""


def of_type(kind: type) -> Allowed:
    """Return a rule for an attribute of a plug-in: that its value is of one type.

    Rules are given in `Plugins.stated`.
    """
    return lambda value: isinstance(value, kind), kind.__name__


def one_of(*values: object) -> Allowed:
    """Return a rule for an attribute of a plug-in: that its value is one of these.

    Rules are given in `Plugins.stated`.
    """
    return values.__contains__, ", ".join(map(str, values))


def tuple_of(each: Allowed) -> Allowed:
    """Return a rule for an attribute of a plug-in: that it is a tuple of what `each` allows.

    Rules are given in `Plugins.stated`.
    """
    fits, words = each
    return lambda value: isinstance(value, tuple) and all(map(fits, value)), f"a tuple of {words}"


class Plugins(Mapping[str, T], Generic[T]):
    """Hold the plug-ins of one group by name: built-in ones, and those of entry points.

    A package's plug-in is loaded and checked when it is looked up: it must be an instance of `kind`
    (a class or a runtime-checkable protocol), and its attributes must follow the rules `stated` (a
    test and its words, by attribute). Built-in plug-ins cannot be replaced.
    """

    stated: ClassVar[Mapping[str, Allowed]] = {}

    def __init__(self, group: str, kind: Any, built_in: Mapping[str, T]) -> None:
        self.group, self.kind, self.built_in = group, kind, built_in
        self._loaded = dict(built_in)

    def __getitem__(self, name: str) -> T:
        """Raises KeyError for an unknown name and UserError for a package that does not work."""
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def is_ours(self, name: str) -> bool:
        """Return whether a plug-in ships with the harness, so that no package can replace it."""
        from harness.core.extensions import shipped

        return name in self.built_in or name in shipped(self.group)

    def of_package(self, name: str) -> str:
        """Return what messages call a package's plug-in, whose package they name."""
        package = package_of(self._entries()[name])
        return f"plug-in {printable(name)!r} ({self.group}) of package {package}"

    def usable(self) -> dict[str, T]:
        loaded = resources.each(self, self.__getitem__)
        return {
            name: plugin for name, plugin in loaded.items() if not isinstance(plugin, UserError)
        }

    def ask(self, name: str, question: Callable[[T], Said]) -> Said:
        """Return what `question` returns for a plug-in, such as its description for people.

        The plug-in is that called `name`. Raises Failed if it does not load or its code fails, and
        UserError if it raises that.
        """
        try:
            plugin = self[name]
        except UserError as error:
            raise Failed(f"{printable(name)}: {error}") from error
        try:
            with aside(f"{self.group.rpartition('.')[2]} {printable(name)}"):
                return question(plugin)
        except UserError:
            raise
        except Exception as error:  # a package's code
            raise Failed(f"{printable(name)}: its package failed: {one_line(error)}") from error

    def __iter__(self) -> Iterator[str]:
        return iter({**self.built_in, **self._entries()})

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _entries(self) -> Mapping[str, Any]:
        from harness.core.extensions import added

        by_extensions = added(self.group)
        for name in by_extensions.keys() & self.built_in.keys():
            say_once(f"{printable(name)!r} ({self.group}) of an extension is taken; it is left out")
        return {**entries(self.group), **by_extensions}

    def _load(self, name: str) -> T:
        entry = self._entries()[name]
        what = f"plug-in {printable(name)!r} ({self.group}): {printable(entry.value)}"
        repair = "repair or uninstall the package that registers it"
        try:
            with watched(what, LOADING_S), aside(what):
                plugin: T = entry.load()
                # A class has the methods of its instances, and would pass the check of a protocol.
                is_class = isinstance(plugin, type) and self.kind is not object
                fits = isinstance(plugin, self.kind) and not is_class
        except UserError:
            raise
        except Exception as error:  # whatever a package's import raises
            raise UserError(f"{what} does not load ({printable(error)}); {repair}") from error
        if not fits:
            raise UserError(
                f"{what} is of type {type(plugin).__name__} and no {self.kind.__name__}; {repair}"
            )
        for field, (is_allowed, allowed) in self.stated.items():
            if hasattr(plugin, field) and not is_allowed(value := getattr(plugin, field)):
                raise UserError(
                    f"{what} has {field} {printable(repr(value))}; allowed: {allowed}; {repair}"
                )
        if not self.is_ours(name):
            with worded(self.of_package(name), door=aside):
                self.check(name, plugin)
        return plugin

    def check(self, name: str, plugin: T) -> None:
        """Raise any error if a package's plug-in is inconsistent; for subclasses to override."""


class Shipped(Plugins[T]):
    """Hold plug-ins that the core and the shipped extensions have; other packages add none."""

    def _entries(self) -> Mapping[str, Any]:
        return {name: entry for name, entry in super()._entries().items() if is_ours(entry)}


class ChosenBySettings(Protocol):
    """Describe a plug-in that a run's settings of its extension choose."""

    @property
    def chosen_by(self) -> tuple[str, ...]:
        """Return the names of these settings."""
        ...

    def opened(self, settings: Mapping[str, Any], /) -> Any:
        """Return the plug-in as these settings, by name, open it; None if they choose none."""
        ...


Chosen = TypeVar("Chosen", bound=ChosenBySettings)


class ShippedChoices(Shipped[Chosen]):
    """Plug-ins that ship, one of which a run's settings of extensions may choose."""

    def chosen(self, settings: Mapping[str, Any]) -> Chosen | None:
        """Return the plug-in that settings, values by name, choose, opened; None for none."""
        for each in self.values():
            if opened := each.opened(settings):
                return cast(Chosen, opened)
        return None

    def settings(self) -> set[str]:
        """Return the names of the settings that choose."""
        return {name for each in self.values() for name in each.chosen_by}

    def without(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return settings, values by name, without those that choose."""
        choosing = self.settings()
        return {name: value for name, value in settings.items() if name not in choosing}


class FilesAndPlugins(Plugins[T]):
    """Hold plug-ins that may also be TOML files, shipped or in the user's project.

    Built-in ones come first, then files, then packages. `folder` is the name of the folder of these
    files, such as `channels`.
    """

    folder: str  # kind of resource that the files are, such as `channels`

    @abstractmethod
    def read(self, file: Path) -> T:
        """Read a plug-in from its TOML file. Raises UserError if the file is wrong."""

    def file(self, name: str) -> Path | None:
        """Return the TOML file of a plug-in; None if it does not come from a file."""
        if self.is_ours(name) or Path(f"{name}.toml").stem != name:  # a path is no name
            return None
        file = resources.find(self.folder, f"{name}.toml")
        return file if os.path.lexists(file) else None

    def __getitem__(self, name: str) -> T:
        """Raises KeyError for an unknown name and UserError for a file or a package that does not
        work.
        """
        file = self.file(name)
        return self.read(file) if file else super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:
        return iter(
            dict.fromkeys([*self.built_in, *resources.names(self.folder), *self._entries()])
        )
