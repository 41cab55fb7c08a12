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
        *("agents", "channel_models", "csv_rows", "drives", "encodings", "families", "logs"),
        *("options", "panels", "readers", "selections", "sources", "stopping_rules", "timers"),
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

    `kind` is the type of its values: str, int, float, bool, or tuple for several texts. `default`
    is the value where none is typed, and `help` a sentence for people. `only` names the kind of run
    that alone has the option: `frozen` (recorded scenes) or `closed-loop` (driving); empty for
    both. `listed` is true for a text that may be typed several times and is joined by commas,
    `models` for names of models.

    Extensions that ship with the harness also say where files and help list the setting. `behind`
    names other settings, each with its table in the file, such as `world.limit`; this one follows
    the first of them that a run has. `place` is its own place as `TABLE.KEY`; empty for its name,
    in the table of the setting that it follows. Both are empty for settings of other packages,
    which stand in one table of their own.
    """

    kind: type  # of its values: str, int, float, bool, or tuple for several texts
    # the value where none is typed; None, which nobody can type, only with `behind`
    default: str | int | float | bool | tuple[()] | None
    help: str  # a sentence for people
    # other settings, such as `world.limit`, of which files and help list this one behind the first
    # that a run has; only of extensions that ship. Empty for the table of all that extensions add
    behind: tuple[str, ...] = ()
    only: str = ""  # the world that alone has its option: `frozen` or `closed-loop`; empty for both
    # of one behind another: where files have it, as `TABLE.KEY`; empty for its name, in the table
    # of the setting that it is listed behind
    place: str = ""
    listed: bool = False  # a text that may be typed several times, which are joined by commas
    models: bool = False  # names of models: a file alone opens only those that have a card

    @property
    def table(self) -> str:
        """Return the name of the table that has this setting in a run's TOML file, such as `world`.

        It is empty for a setting that follows no setting of the core there (`behind` is empty).
        """
        beside = self.place or next(iter(self.behind), "")
        return beside.rpartition(".")[0]

    def path(self, name: str) -> str:
        """Return where a run's TOML file has this setting: table and key, such as `world.limit`.

        `name` is the setting's name, which is the key unless `place` states another.
        """
        return self.place or f"{self.table}.{name}".lstrip(".")


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Describe what a package adds to the harness: commands, studies, settings and plug-ins.

    `name` is the same as that of its entry point of the group `swarmdrive.extensions`, and
    `interface` the version of this class that it was written for. All else are dicts. A function or
    object is given as a text `module:name`, which is imported at first use.

    `commands` has the function of each command (what is typed after `harness`), `groups` the help
    of each group of commands, `panels` the heading under which the command list shows each,
    `spellings` the new words for a command's older ones, and `short` the whole command for a short
    one. `studies` has the name in lists of each kind of study (an evaluation of several runs) that
    it writes. `settings` has options of runs by name. `adds` has plug-ins by kind (such as `rules`)
    and by name, and `kinds` a description of each kind of plug-in that others may add to this
    extension.
    """

    name: str  # the same as that of its entry point
    interface: int = INTERFACE  # the version of this class that it was written for
    # What follows are dicts. A place is the text `module:name` of a function or object.
    # words typed after `harness`, and the place of the function that they call
    commands: Texts = field(default_factory=dict)
    # the groups of commands that it opens, and their help
    groups: Texts = field(default_factory=dict)
    # its words in the list of commands, and the heading that each stands under
    panels: Texts = field(default_factory=dict)
    # older spellings of its commands, and what replaces them
    spellings: Texts = field(default_factory=dict)
    short: Texts = field(default_factory=dict)  # short words, and the command of each
    # kinds of study (evaluations of several runs) that it writes, and what lists call each;
    # `<kind>.json` marks such a study's folder
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
    """Return the name of the extension that a command or group of commands belongs to, or None.

    It is for messages on a command that is not installed. `command` is what is typed after
    `harness`. The answer is read from package metadata, so it is known even if the extension's
    folder is missing.
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
    """Name the extension that a setting belongs to, even if it is not installed here.

    Package metadata states it. `idle` is the setting's value that does nothing, as text, such as
    `0`; empty if there is none.
    """

    extension: str  # the extension's name
    idle: str  # the value that does nothing, as text; empty for none


def setting_of_extension(name: str) -> OfExtension | None:
    """Return the extension that adds a setting of conditions, or None if none does.

    A condition is a named set of settings that a run is scored under: of the radio, of asking
    helpers and of fusing their messages. `name` is the setting's name. It is looked up in package
    metadata, so the extension need not be installed.
    """
    entry = entries(SETTINGS).get(name)
    return _of_entry(entry) if entry else None


def beside() -> dict[str, Setting]:
    """Return the settings that shipped extensions list among the core's own, by name.

    In files and help they stand between those of the core (`Setting.behind`). The settings of other
    packages stand in a table of their own, and are not returned.
    """
    declared = entries(GROUP)
    settings: dict[str, Setting] = {}
    for name, extension in extensions().items():
        if is_ours(declared[name]):
            settings |= {key: each for key, each in extension.settings.items() if each.behind}
    return settings


def in_order(names: Iterable[str]) -> list[str]:
    """Return the names of settings of runs in the order in which files and help list them.

    `names` are the core's settings as table and key, such as `world.limit`. The result has them
    with the settings that extensions add (`beside`, by name alone), each after the setting that it
    follows; one that follows none of `names` is left out.
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
    """Return the name of the extension that adds a plug-in, or None if none does.

    `kind` is the plug-in's kind, such as `contents` or `rules`, and `name` its name among these. It
    is read from package metadata, so it is known even if the extension is missing.
    """
    entry = entries(PLUG_INS).get(f"{kind} {name}")
    return _of_entry(entry).extension if entry else None


def setting_of_run(name: str) -> OfExtension | None:
    """Return the extension that adds a setting of runs, and the value of it that does nothing.

    None if no extension adds it. `name` is the setting's: the key that a run's file has without its
    table, or the option's name; if these two differ, also table and key as `TABLE.KEY`. It is read
    from package metadata, so the extension need not be installed.
    """
    entry = entries(PLUG_INS).get(f"settings {name}")
    return _of_entry(entry) if entry else None


def tables_of_settings() -> set[str]:
    """Return the names of the tables in runs' TOML files whose keys all come from extensions.

    They are read from package metadata, so that a file's table is known even if the extension that
    it belongs to is not installed.
    """
    places = [key.partition(" ")[2] for key in entries(PLUG_INS) if key.startswith("settings ")]
    return {place.partition(".")[0] for place in places if "." in place}


def control_settings() -> dict[str, str]:
    """Return the setting that each control of extensions stands for, by the control's name.

    A control is a set of settings under which a run is scored too, and that replaces what helpers
    say, to show what cooperation gains; its setting is such as `messages=blind`. It is read from
    package metadata.
    """
    values = {name: str(entry.value).partition(" ")[2] for name, entry in entries(CONTROLS).items()}
    return {name: setting.strip("[]") for name, setting in values.items()}


def part_of(extension: str) -> str:
    """Return words for a message on what an extension has that is not installed here.

    They say that it is part of `extension`, which is the extension's name.
    """
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

    `core` is that table, texts by name, and `kind` the field of `Extension` that has the additions,
    such as `commands`. A name that the table has already keeps its value; a line on stderr says so,
    once.
    """
    return _joined(tuple(core.items()), kind, tuple(sys.path))


def taken(path: str, table: Iterable[str]) -> bool:
    """Return whether a command's words equal, begin or extend one of the commands in `table`.

    Both are words as typed after `harness`, such as `model list`: it begins `model list all`, and
    extends `model`. Then a command of that name would hide another.
    """
    return any(
        f"{each} ".startswith(f"{path} ") or f"{path} ".startswith(f"{each} ") for each in table
    )


def studies() -> Texts:
    """Return the name that lists give to each kind of study, by the kind, such as `sweep`.

    A study is an evaluation made of several runs, or of one run under several settings. Kinds that
    extensions add are there even where the extension is missing.
    """
    gone = {kind: kind for kind in entries(STUDIES)}
    return {**gone, **joined(formats.STUDIES, "studies")}


def added(group: str) -> Mapping[str, Any]:
    """Return the plug-ins that extensions add to a group, by name, each loaded at first use.

    A plug-in is what a package adds to the harness; a group has one kind of them, such as
    `swarmdrive.rules`. Each is an `Added`, which stands in for an entry point.
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
    """Return the names of a group's plug-ins that the harness's own extensions add.

    A plug-in is what a package adds to the harness; `group` is the name of a group of entry points,
    such as `swarmdrive.rules`.
    """
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
        and _can_be_kept(setting.default)
        and isinstance(setting.help, str)
    )


def _can_be_kept(default: Any) -> bool:
    """Return whether files can hold a setting's default, as they can what is typed."""
    if isinstance(default, str):
        return default == printable(default, len(default) + 1)
    if isinstance(default, int | float):
        return -(2**63) < default < 2**63  # NaN is not
    return True


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
