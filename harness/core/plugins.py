"""Registries of plug-ins: built-in ones, and those that installed packages add by entry points."""

import os
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, cast

from harness.core import resources
from harness.core.errors import UserError, one_line, printable
from harness.core.strangers import Ended, aside, watched, worded

T = TypeVar("T")
Said = TypeVar("Said")
# whether a value is one that a plug-in may state, and which are, in words
Allowed = tuple[Callable[[Any], bool], str]
OURS = "swarmdrive-harness"  # the name of this distribution
MOST_TEXTS = 10_000  # that are read of a plug-in that yields texts
LOADING_S = 3.0  # after which a line says which package a command waits for


def entries(group: str) -> Mapping[str, Any]:
    """Return what all installed packages add to a group of plug-ins, by name.

    Each is an `importlib.metadata.EntryPoint`, and a group such as `swarmdrive.rules`. If two have
    one name, this distribution's is taken, or else the first, and a line on stderr says so.
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
    """Return whether an entry point belongs to this distribution, and not to another package.

    `entry` is an `importlib.metadata.EntryPoint`, or `Added`. What it points to does not decide: an
    entry point of another package that names an object of the harness is not ours.
    """
    return str(entry.value).startswith("harness.") and _name_of(entry.dist) == OURS


def package_of(entry: Any) -> str:
    """Return the name of the package that an entry point belongs to, for messages.

    `entry` is an `importlib.metadata.EntryPoint`, or `Added`.
    """
    return printable(_name_of(getattr(entry, "dist", None)) or "of no name")


def package_versions() -> dict[str, str]:
    """Return the versions of other installed packages that add plug-ins, by the package's name.

    A version is what the package states; one that states none is left out.
    """
    versions: dict[str, str] = {}
    try:
        groups = _all_entries(tuple(sys.path)).groups
    except Exception:  # whatever the metadata of a package hold; `entries` says whose it is
        return versions
    for group in filter(lambda group: group.startswith("swarmdrive."), groups):
        for entry in entries(group).values():
            name = _name_of(getattr(entry, "dist", None))
            if not name or name == OURS:  # before the version, for which metadata are read
                continue
            version = getattr(entry.dist, "version", None)
            if isinstance(version, str):
                versions[printable(name)] = printable(version)
    return dict(sorted(versions.items()))


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
    """Return texts that another package gave, as plain `str` without the code of a subclass.

    Raises what `texts_as_given` raises.
    """
    return ["".join((text,)) for text in texts_as_given(answer, what)]


def texts_as_given(answer: Any, what: str = "its answer") -> tuple[str, ...]:
    """Return texts that another package gave, with the classes that it gave them, such as Markup.

    Raises TypeError or ValueError, which begins with `what`, if `answer` is anything but an
    iterable of texts in Unicode, or has more than `MOST_TEXTS` and no length.
    """
    most = None if hasattr(answer, "__len__") else MOST_TEXTS + 1
    each = () if isinstance(answer, str) else tuple(islice(answer, most))
    if isinstance(answer, str) or not all(isinstance(text, str) for text in each):
        raise TypeError(f"{what} holds what is no text")
    if most and len(each) == most:
        raise ValueError(f"{what} holds more than {MOST_TEXTS} texts")
    try:
        "".join(each).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"{what} holds half a character, {error.object[error.start]!a}") from None
    return each


def line_or_none(answer: Any, what: str) -> str | None:
    """Return a text that another package gave, as a plain `str` of one line; None if it gave None.

    It is cut to 300 characters. `what` names the text in messages. Raises ValueError if `answer` is
    neither None nor a text, or an empty one.
    """
    if answer is None:
        return None
    if not isinstance(answer, str) or not answer.strip():
        raise ValueError(f"{what} that is no text, and not None: {printable(repr(answer))}")
    return printable(" ".join("".join((answer,)).split()), 300)


class Failed(UserError):
    """Report which plug-in of a package failed, and why, for a list with a line for each.

    The message begins with the plug-in's name. A plug-in is what a package adds to the harness.
    """


def of_type(kind: type) -> Allowed:
    """Return a rule for an attribute of packages' plug-ins: its value is of one type.

    A rule is a pair: a test of a value, and words for what it allows. Subclasses of `Plugins` list
    rules in `stated`.
    """
    return lambda value: isinstance(value, kind), kind.__name__


def one_of(*values: object) -> Allowed:
    """Return a rule for an attribute of packages' plug-ins: its value is one of these.

    A rule is a pair: a test of a value, and words for what it allows. Subclasses of `Plugins` list
    rules in `stated`.
    """
    return values.__contains__, ", ".join(map(str, values))


def tuple_of(each: Allowed) -> Allowed:
    """Return a rule for an attribute of packages' plug-ins: a tuple whose items fit a rule.

    A rule is a pair: a test of a value, and words for what it allows; `each` is that of the items.
    Subclasses of `Plugins` list rules in `stated`.
    """
    fits, words = each
    return lambda value: isinstance(value, tuple) and all(map(fits, value)), f"a tuple of {words}"


class Plugins(Mapping[str, T], Generic[T]):
    """Hold the plug-ins of one group by name: built-in ones, and those that packages add.

    Packages add them by entry points of the group, such as `swarmdrive.rules`. A package's plug-in
    is loaded and checked when it is looked up: it must be an instance of `kind` (a class or a
    runtime-checkable protocol), and each of its attributes that `stated` names must fit the rule
    there (a test of its value, and words for what is allowed). Built-in plug-ins cannot be
    replaced.
    """

    # by attribute: a test of its value, and words for what is allowed
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
        """Return words for a plug-in in messages: its name, and the package that adds it.

        `name` is the plug-in's, which must be one that an entry point or an extension adds.
        """
        package = package_of(self._entries()[name])
        return f"plug-in {printable(name)!r} ({self.group}) of package {package}"

    def usable(self) -> dict[str, T]:
        loaded = resources.each(self, self.__getitem__)
        return {
            name: plugin for name, plugin in loaded.items() if not isinstance(plugin, UserError)
        }

    def ask(self, name: str, question: Callable[[T], Said]) -> Said:
        """Return what `question` returns for a plug-in, such as its description for people.

        `name` is the plug-in's; `question` is called with the plug-in, and may run a package's
        code. Raises Failed if the plug-in does not load or its code fails; a UserError that its
        code raises passes.
        """
        try:
            plugin = self[name]
        except UserError as error:
            raise Failed(f"{printable(name)}: {error}") from error
        try:
            with aside(f"{self.group.rpartition('.')[2]} {printable(name)}"):
                return question(plugin)
        except Ended as error:
            raise Failed(str(error)) from error
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
        """Check a package's plug-in when it is loaded; any error that this raises refuses it.

        The base class accepts all; subclasses override it.
        """


class Shipped(Plugins[T]):
    """Hold plug-ins that only the core and the shipped extensions add; other packages add none."""

    def _entries(self) -> Mapping[str, Any]:
        return {name: entry for name, entry in super()._entries().items() if is_ours(entry)}


class ChosenBySettings(Protocol):
    """Describe a plug-in that a run uses only if its settings of an extension say so."""

    @property
    def chosen_by(self) -> tuple[str, ...]:
        """Return the names of the settings of runs that choose this plug-in."""
        ...

    def opened(self, settings: Mapping[str, Any], /) -> Any:
        """Return the object that does the plug-in's work under a run's settings; None for none.

        `settings` has the run's settings of extensions, values by name. None means that they do not
        choose this plug-in.
        """
        ...


Chosen = TypeVar("Chosen", bound=ChosenBySettings)


class ShippedChoices(Shipped[Chosen]):
    """Hold plug-ins of shipped extensions of which a run uses one or none, as its settings say."""

    def chosen(self, settings: Mapping[str, Any]) -> Chosen | None:
        """Return what does a plug-in's work in a run, opened; None if its settings choose none.

        `settings` has the run's settings of extensions, values by name; they choose the plug-in.
        """
        for each in self.values():
            if opened := each.opened(settings):
                return cast(Chosen, opened)
        return None

    def settings(self) -> set[str]:
        """Return the names of all settings of runs that choose one of these plug-ins."""
        return {name for each in self.values() for name in each.chosen_by}

    def without(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return a run's settings of extensions without those that choose one of these plug-ins.

        Both are values by name.
        """
        choosing = self.settings()
        return {name: value for name, value in settings.items() if name not in choosing}


class FilesAndPlugins(Plugins[T]):
    """Hold plug-ins that may also be TOML files, shipped or in the user's project.

    A name is looked for among the built-in ones first, then the files, then packages. `folder` is
    the name of the folder of these files, such as `channels`.
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
