"""Plug-ins: what a room has built in, and what installed packages add by entry points."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from harness.core import resources
from harness.core.errors import UserError, printable

T = TypeVar("T")


class Plugins(Mapping[str, T], Generic[T]):
    """Things by name. A package adds one by an entry point; it loads when it is looked up by name.

    What is built in cannot be replaced.

    Attributes:
        group: the entry points' group.
        built_in: what the harness has itself.
    """

    def __init__(self, group: str, kind: Any, built_in: Mapping[str, T]) -> None:
        """`kind` is the class or the runtime-checkable protocol that every plug-in has to be of."""
        self.group, self.kind, self.built_in = group, kind, built_in
        self._loaded = dict(built_in)

    def __getitem__(self, name: str) -> T:
        """Raises KeyError for an unknown name and UserError for a package that does not work."""
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self.built_in, **self._entries()})

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _entries(self) -> dict[str, Any]:
        from importlib.metadata import entry_points  # only a look-up pays for it

        return {entry.name: entry for entry in sorted(entry_points(group=self.group))}

    def _load(self, name: str) -> T:
        entry = self._entries()[name]
        what = f"plug-in {printable(name)!r} ({self.group}): {printable(entry.value)}"
        repair = "repair or uninstall the package that registers it"
        try:
            plugin: T = entry.load()
        except Exception as error:  # whatever a package's import raises
            raise UserError(f"{what} does not load ({printable(error)}); {repair}") from error
        # A class has its instances' methods, and so would pass for one of them.
        if isinstance(plugin, type) or not isinstance(plugin, self.kind):
            raise UserError(
                f"{what} is of type {type(plugin).__name__} and no {self.kind.__name__}; {repair}"
            )
        return plugin


class FilesAndPlugins(Plugins[T]):
    """Plug-ins; behind what is built in and before packages come TOML files, shipped and a project's."""

    folder: str
    """The files' kind of resource."""

    @abstractmethod
    def read(self, file: Path) -> T:
        """What a file holds. Raises UserError for one that does not work."""

    def file(self, name: str) -> Path | None:
        """The file that holds a thing; None for one that no file holds."""
        there = name not in self.built_in and name in resources.names(self.folder)
        return resources.find(self.folder, f"{name}.toml") if there else None

    def __getitem__(self, name: str) -> T:
        """Raises KeyError for an unknown name and UserError for a file or a package that does not work."""
        file = self.file(name)
        return self.read(file) if file else super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self.built_in, *resources.names(self.folder), *self._entries()]))
