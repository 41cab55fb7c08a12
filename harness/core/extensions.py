"""Hold what extensions add: one object for those of this distribution and for everybody's packages.

An extension is an entry point of the group `swarmdrive.extensions`; docs/extend.md shows a whole
one. Those that ship are folders of `harness/extensions/`. The distribution's metadata name them and
their commands: without the folder all else works, and says what a command was part of.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from keyword import iskeyword
from math import isfinite
from typing import Any, NamedTuple

from harness.core import formats
from harness.core.errors import UserError, printable
from harness.core.plugins import Added, Plugins, entries, is_ours
from harness.core.strangers import worded

GROUP = "swarmdrive.extensions"
# In the metadata: by command, kind of study and name from Python, the package of the extension that
# has it.
COMMANDS, STUDIES, NAMES = "swarmdrive.commands", "swarmdrive.studies", "swarmdrive.names"
# The same by setting of a condition, with the value that does nothing in brackets; nothing for an
# empty one.
SETTINGS = "swarmdrive.settings"
# And by control, with the setting of a condition that it is in brackets.
CONTROLS = "swarmdrive.controls"
# By kind and name, such as `contents text`, the packages of those that conditions and runs name.
PLUG_INS = "swarmdrive.plugins"
PYTHON = Plugins[Any]("swarmdrive.python", object, {})  # what extensions add to `import harness`
INTERFACE = 1
# The kinds of plug-ins that the core takes from packages; extensions may take others, which they
# name (`Extension.kinds`).
KINDS = frozenset(
    {
        *("audits", "backends", "caveats", "channels", "contents", "counterparts", "exports"),
        *("extras", "metrics", "notes", "parts", "python", "remarks", "rules"),
        *("scenarios", "schedules", "sections", "videos"),
    }
)
# The kinds that it takes from extensions that ship alone.
SHIPPED_KINDS = frozenset(
    {
        *("agents", "channel_models", "drives", "encodings", "families", "options", "panels"),
        *("readers", "selections", "sources", "stopping_rules", "timers"),
    }
)
WORDS = re.compile(r"\w[\w-]*( \w[\w-]*)*")
# An older spelling may also be an option of a command that has become a command.
SPELLINGS = re.compile(rf"{WORDS.pattern}( --\w[\w-]*)?")
TYPED = ("commands", "groups", "studies", "spellings", "short")  # tables of what somebody types
Texts = Mapping[str, str]


@dataclass(frozen=True)
class Setting:
    """Describe a setting of a run that an extension adds, an option of `harness eval` and `drive`.

    A setting of the kind `tuple` holds texts: its option may be repeated, and its default is ().
    `help` is a sentence for people. `behind` names settings, each with its table, such as
    `world.limit`: files and help list this one after the first of them that the world of a run has,
    and in its table. It is empty for a table of their own. `only` names the world that alone has
    the option, `frozen` or `closed-loop`; empty for both. `listed` allows to type it several times.
    """

    kind: type  # str, int, float, bool or tuple, for texts
    # None, which nobody can type, only with `behind`
    default: str | int | float | bool | tuple[()] | None
    help: str  # a sentence for people
    # of one that ships: settings of the core, and of extensions, behind the first of which files
    # and help have it. Empty for the table of all that extensions add
    behind: tuple[str, ...] = ()
    only: str = ""  # the world that alone has its option: `frozen` or `closed-loop`; empty for both
    # of one behind another: where files have it, as `TABLE.KEY`; empty for its name, in that one's
    # table
    place: str = ""
    listed: bool = False  # a text that may be typed several times, which are joined by commas
    models: bool = False  # names of models: a file alone opens only those that have a card

    @property
    def table(self) -> str:
        """Return the table of files in which it stands behind another setting; empty for none."""
        beside = self.place or next(iter(self.behind), "")
        return beside.rpartition(".")[0]

    def path(self, name: str) -> str:
        """Return the key of files that have this setting, behind its table: `world.limit`.

        `name` is the setting's.
        """
        return self.place or f"{self.table}.{name}".lstrip(".")


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Describe what a package adds to the harness: commands, studies, settings and plug-ins.

    `name` is that of its entry point, and `interface` the version of this class it was written for.
    All else are tables by name: `adds` has plug-ins by kind (such as `rules`) and name, `groups`
    the help of groups of commands, `panels` the panel of each command on the first screen, and
    `spellings` what replaces older commands; `kinds` has kinds of plug-ins that others may add to
    this extension. A function or object is given as `module:name`,
    imported at first use.
    """

    name: str  # the same as that of its entry point
    interface: int = INTERFACE  # the version of this class that it was written for
    # What follows are tables by name.
    # what is typed after `harness`, and the function's place
    commands: Texts = field(default_factory=dict)
    # the groups of commands that it opens, and their help
    groups: Texts = field(default_factory=dict)
    # its words of the first screen, and the panel of each
    panels: Texts = field(default_factory=dict)
    # older spellings of its commands, and what replaces them
    spellings: Texts = field(default_factory=dict)
    short: Texts = field(default_factory=dict)  # what is short for one of its commands, for good
    # kinds of study that it writes, and what lists call them; `<kind>.json` marks such a folder
    studies: Texts = field(default_factory=dict)
    # settings of a run by the name of their option, with `_`; a run's `settings.extensions` has
    # their values
    settings: Mapping[str, Setting] = field(default_factory=dict)
    # plug-ins by kind, such as `rules` or `metrics`, and by name; the value is a place
    adds: Mapping[str, Texts] = field(default_factory=dict)
    # kinds of plug-ins that it takes from others, and what each is
    kinds: Texts = field(default_factory=dict)


def extensions() -> Mapping[str, Extension]:
    """Return the installed extensions that work, by name, those of this distribution first.

    For each that does not work, one line on stderr says why, once.
    """
    return _extensions(tuple(sys.path))


def owner(command: str) -> str | None:
    """Return the extension that a command or group of commands belongs to, or None.

    It is read from package metadata, so it is known even if the extension's folder is missing.
    """
    for name, entry in entries(COMMANDS).items():
        if f"{name} ".startswith(f"{command} "):
            return _extension_of(entry)
    return None


def from_python(name: str) -> Any:
    """Return the object that an extension adds to `import harness` under a name; None if none does.

    Raises UserError if the extension that has the name is not installed or does not work.
    """
    if name in PYTHON:
        return PYTHON[name]
    if gone := entries(NAMES).get(name):
        raise UserError(f"`harness.{name}` is {part_of(_extension_of(gone))}")
    return None


class OfExtension(NamedTuple):
    """Name the extension that a setting belongs to, as package metadata states it.

    So it is known even if the extension is not installed. `idle` is the setting's value that does
    nothing, as text; empty for none.
    """

    extension: str  # the extension's name
    idle: str  # the value that does nothing, as text; empty for none


def setting_of_extension(name: str) -> OfExtension | None:
    """Return the extension that adds a setting of conditions (operating points), or None.

    `name` is the setting's; it is looked up in package metadata.
    """
    entry = entries(SETTINGS).get(name)
    return _of_entry(entry) if entry else None


def beside() -> dict[str, Setting]:
    """Return the settings of runs that stand among those of the core, by name.

    They are those that shipped extensions add; the settings of other packages stand in a table of
    their own in files (`Setting.behind`).
    """
    declared = entries(GROUP)
    settings: dict[str, Setting] = {}
    for name, extension in extensions().items():
        if is_ours(declared[name]):
            settings |= {key: each for key, each in extension.settings.items() if each.behind}
    return settings


def in_order(names: Iterable[str]) -> list[str]:
    """Return the names of settings in the order in which files and help list them.

    `names` are those of the core, with the table before each, such as `world.limit`. Those that
    extensions add come behind them; what stands behind none of them is left out.
    """
    core, order, followers = list(names), list[str](), dict[str, list[str]]()
    others = {each.path(name): each for name, each in beside().items()}
    for name, setting in others.items():
        places = [place for place in setting.behind if place in {*core, *others}]
        followers.setdefault(next(iter(places), ""), []).append(name)
    for name in core:
        order += _followed(name, followers)
    return order


def _followed(name: str, followers: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield a name, and all that follow it."""
    yield name
    for each in followers.get(name, ()):
        yield from _followed(each, followers)


def owner_of_plugin(kind: str, name: str) -> str | None:
    """Return the extension that adds a plug-in, or None.

    `kind` is the plug-in's kind, such as `contents`, and `name` its name among these. It is read
    from package metadata, so it is known even if the extension is missing.
    """
    entry = entries(PLUG_INS).get(f"{kind} {name}")
    return _of_entry(entry).extension if entry else None


def setting_of_run(name: str) -> OfExtension | None:
    """Return the extension that adds the setting `name` of runs, and the value that does nothing.

    None if no extension adds it. The name is that of files without its table, or the option's; with
    the table where both differ. It is read from package metadata.
    """
    entry = entries(PLUG_INS).get(f"settings {name}")
    return _of_entry(entry) if entry else None


def tables_of_settings() -> set[str]:
    """Return the names of tables in files of runs whose settings all come from extensions.

    They are read from package metadata, which name such a setting by its table and key as well.
    """
    places = [key.partition(" ")[2] for key in entries(PLUG_INS) if key.startswith("settings ")]
    return {place.partition(".")[0] for place in places if "." in place}


def control_settings() -> dict[str, str]:
    """Return the setting that each control of extensions stands for, by the control's name.

    A control is a condition that replaces what helpers say, to show what cooperation gains; its
    setting is such as `messages=blind`. It is read from package metadata.
    """
    values = {name: str(entry.value).partition(" ")[2] for name, entry in entries(CONTROLS).items()}
    return {name: setting.strip("[]") for name, setting in values.items()}


def part_of(extension: str) -> str:
    """Return the phrase that something is part of an extension which is not installed."""
    return f"part of the extension {printable(extension)}, which is not installed"


def _of_entry(entry: Any) -> OfExtension:
    """Return what an entry of the metadata names by its package and, in brackets, a value."""
    package, _, idle = str(entry.value).partition(" ")
    return OfExtension(package.rpartition(".")[2], idle.strip("[]"))


def _extension_of(entry: Any) -> str:
    """Return the extension that an entry of the metadata names by its package."""
    return _of_entry(entry).extension


def joined(core: Texts, kind: str) -> Mapping[str, Any]:
    """Return one of the core's tables, such as its commands, extended by what extensions add.

    `kind` is the field of `Extension` that has the additions. A name that the table has already is
    not replaced; a line on stderr says so, once.
    """
    return _joined(tuple(core.items()), kind, tuple(sys.path))


def taken(path: str, table: Iterable[str]) -> bool:
    """Return whether a command path equals, begins or extends one of the paths in `table`.

    Paths are words such as `model list`.
    """
    return any(
        f"{each} ".startswith(f"{path} ") or f"{path} ".startswith(f"{each} ") for each in table
    )


def studies() -> Texts:
    """Return the kinds of study and the name that lists give each.

    Kinds that extensions add are there even where the extension is missing.
    """
    gone = {kind: kind for kind in entries(STUDIES)}
    return {**gone, **joined(formats.STUDIES, "studies")}


def added(group: str) -> Mapping[str, Any]:
    """Return what extensions add to a plug-in group such as `swarmdrive.rules`, by name.

    Each is like an entry point, which loads the plug-in.
    """
    if group == GROUP:
        return {}
    kind, declared = group.rpartition(".")[2], entries(GROUP)
    by_name: dict[str, Any] = {}
    for extension in extensions().values():  # those that ship come first
        for name, place in extension.adds.get(kind, {}).items():
            by_name.setdefault(name, Added(place, declared[extension.name].dist))
    return by_name


def shipped(group: str) -> frozenset[str]:
    """Return the names of the plug-ins of a group that this distribution's own extensions add."""
    return _shipped(group, tuple(sys.path))


@cache
def _shipped(group: str, path: tuple[str, ...]) -> frozenset[str]:
    return frozenset(name for name, entry in added(group).items() if is_ours(entry))


@cache
def _extensions(path: tuple[str, ...]) -> Mapping[str, Extension]:
    declared = entries(GROUP)
    loaded = Plugins[Extension](GROUP, Extension, {})
    working: dict[str, Extension] = {}
    for name in sorted(declared, key=lambda name: (not is_ours(declared[name]), name)):
        if is_ours(declared[name]) and not _is_here(declared[name]):
            continue
        try:
            with worded(f"extension {printable(name)}"):
                working[name] = _checked(name, loaded[name])
        except UserError as error:
            print(f"harness: {error}; all else works", file=sys.stderr)
    for name, extension in working.items():
        if not is_ours(declared[name]):
            _say_unknown_kinds(extension, working.values())
    return working


def _say_unknown_kinds(extension: Extension, working: Iterable[Extension]) -> None:
    """Say on stderr which plug-ins of a package's extension nothing takes."""
    allowed = set(KINDS).union(*(each.kinds for each in working)) - SHIPPED_KINDS
    for kind in sorted(extension.adds.keys() - allowed):
        ships = "only extensions that ship add" if kind in SHIPPED_KINDS else "nothing takes"
        what = f"extension {printable(extension.name)} adds {printable(kind)}, which {ships}"
        choices = printable(", ".join(sorted(allowed)), 1000)
        print(f"harness: {what}; allowed: {choices}, or what its kinds name", file=sys.stderr)


def _is_here(entry: Any) -> bool:
    from importlib.util import find_spec

    try:
        return find_spec(entry.module) is not None
    except ModuleNotFoundError:  # the folder of all of them is gone
        return False


def _checked(name: str, extension: Extension) -> Extension:
    """Return a copy of an extension, of plain tables.

    Raises UserError if it is of another interface, or no such record.
    """
    what = f"extension {printable(name)}"
    if extension.interface != INTERFACE:
        raise UserError(
            f"{what} is for version {printable(repr(extension.interface))} of `Extension`, and "
            f"this is version {INTERFACE}; install a version of its package for this harness"
        )
    if extension.name != name:
        raise UserError(f"{what} calls itself {printable(extension.name)}; give both the same name")
    copied: dict[str, Any] = {}
    for table in fields(Extension)[2:]:
        value = getattr(extension, table.name)
        value = copied[table.name] = dict(value) if isinstance(value, Mapping) else value
        if table.name == "settings":
            if not (isinstance(value, Mapping) and all(map(_is_setting, value, value.values()))):
                raise UserError(f"{what}: its settings are no table of Setting; repair its package")
            continue
        tables = [value]
        if table.name == "adds" and isinstance(value, Mapping):
            tables = [dict.fromkeys(value, ""), *value.values()]
        if not all(map(_is_texts, tables)):
            raise UserError(f"{what}: its {table.name} are no table of texts; repair its package")
    for kind in TYPED:
        names = copied[kind]
        replacements = names.values() if kind in ("spellings", "short") else ()
        form = SPELLINGS if kind == "spellings" else WORDS
        for words in (*names, *replacements):
            if not form.fullmatch(words):
                raise UserError(
                    f"{what}: nobody can type {printable(words)!r} of its {kind}; repair its "
                    "package"
                )
    return Extension(name=name, **copied)


def _is_texts(table: Any) -> bool:
    return isinstance(table, Mapping) and all(
        isinstance(text, str) for text in (*table, *table.values())
    )


def _is_setting(name: Any, setting: Any) -> bool:
    """Return whether this is a setting that can be typed, with a default of its kind."""
    return (
        isinstance(name, str)
        and name.isidentifier()
        and name.islower()
        and not iskeyword(name)
        and name != "help"  # which every command has
        and isinstance(setting, Setting)
        and setting.kind in (str, int, float, bool, tuple)
        and isinstance(setting.behind, tuple)
        and (
            type(setting.default) is setting.kind
            or (setting.default is None and bool(setting.behind))
        )
        and (setting.kind is not tuple or not setting.default)
        and setting.only in ("", "frozen", "closed-loop")
        and isinstance(setting.place, str)
        and (not isinstance(setting.default, float) or isfinite(setting.default))
        and isinstance(setting.help, str)
    )


@cache
def _joined(
    core: tuple[tuple[str, Any], ...], kind: str, path: tuple[str, ...]
) -> Mapping[str, Any]:
    table: dict[str, Any] = dict(core)
    for extension in extensions().values():
        for name, value in getattr(extension, kind).items():
            if name in table or (kind == "commands" and taken(name, table)):
                print(
                    f"harness: extension {printable(extension.name)}: {printable(name)} of its "
                    f"{kind} is taken; it is left out, and all else works",
                    file=sys.stderr,
                )
            else:
                table[name] = value
    return table
