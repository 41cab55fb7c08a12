"""What the runs of earlier versions lack, and how it is read: the one place that knows of them.

A format's number goes up only when an earlier harness would misread a run. Otherwise files grow:
whoever adds a setting or a column adds an entry here, which says what a run without it did; whoever
renames one maps the old name. `tests/test_records.py` reads kept runs of earlier commits and fails
without the entry.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import PurePath
from typing import Any, NamedTuple

from harness.core import extensions
from harness.core.errors import UserError, printable
from harness.core.extensions import part_of
from harness.runs import role_agents
from harness.world.families import FAMILIES

NUMBER = 2
EXTENSIONS = "extensions"  # the table of settings that extensions add
LOOKS = "looks"  # in `world`: what a rule that may stop the run states of its interim looks
NO_TEXTS: tuple[Any, ...] = ([], ())  # of a setting of texts that nobody sets
WORLD = "world"  # the table of settings that choose a run's scenes, which it states itself
UNSET = "unset"  # stands for `msgspec.UNSET`: a folder is listed without loading msgspec
FORMAT = f"swarmdrive-run/{NUMBER}"
# Older formats, and the version of the harness that reads each.
READ_BY = {"swarmdrive-run/1": "0.1", "swarmdrive-drive/1": "0.1"}


# Settings that run.json states beside the table `settings`, too, by their key there: readers of its
# first versions have no table. A new setting is not one of them.
BESIDE: Mapping[str, str] = {
    "ask": "ask",
    "ties": "ties",
    "batch_size": "batch_size",
    "dtype": "dtype",
    "temperature": "temperature",
    "sampling_seed": "sampling_seed",
    "latency_source": "latency",
}

# Settings that a user types in several ways, by a name, a path or a URL: a name is held to what it
# names. So are those of extensions that name models.
TYPED = ("model", "world.dataset", "world.scenario")


class Added(NamedTuple):
    """Describe a setting or column that a later version added to the files of runs.

    `since` is the day that added it, `absent` its value in an older run, and `why` says why.
    """

    since: str  # the day that added it
    absent: Any  # its value in a run without it
    why: str  # what was added, and why older runs have that value


# Of run.json beside its settings.
MANIFEST: Mapping[str, Added] = {
    "channels": Added(
        "2026-11-23", {}, "channel profiles became files; older runs used those that ship"
    ),
    "networks": Added("2026-11-23", {}, "a cloud behind a measured network"),
    "schedules": Added("2026-11-23", {}, "learnt schedules, by the digest of their file"),
    "kept": Added(
        "2026-11-29", {}, "what settings of extensions name; see `upgraded` for `calibrations`"
    ),
    "helpers": Added(
        "2026-11-23", (), "agents of their own for helpers; the ego's answered for all"
    ),
    "beside": Added("2026-11-29", {}, "what settings of extensions opened; see `upgraded`"),
}
# Of its settings that open nothing; the command alone stated servers and a device.
SETTINGS: Mapping[str, Added] = {
    "temperature": Added("2026-11-23", 0.0, "sampling; all answers were greedy"),
    "sampling_seed": Added("2026-11-23", 0, "sampling"),
    "ask": Added("2026-11-26", "all", "asking only helpers whose answer counts; all were asked"),
    "ties": Added(
        "2026-11-26", "first", "drawing between the likeliest actions; the first was taken"
    ),
    "extensions": Added("2026-11-29", {}, "settings of extensions; there were none"),
    "answers": Added("2026-11-30", None, "answers of a file; models were asked"),
}
# Of the ego's agent, in run.json itself, and of each of `helpers`.
AGENT: Mapping[str, Added] = {
    "thinking": Added("2026-11-23", False, "helpers that think"),
    "image": Added("2026-11-23", "own", "pictures in prompts, and controls of them"),
    "letters": Added(
        "2026-11-26", "raw", "read-outs over several orders of letters; there was one"
    ),
    "sums": Added("2026-11-26", "refuse", "dividing a sum that is off 1; such an answer failed"),
    "flip": Added("2026-11-26", False, "asking with the list of actions reversed"),
}
MODEL: Mapping[str, Added] = {
    "vision": Added("2026-11-23", None, "models that take pictures"),
    "projector": Added("2026-11-23", None, "the file that turns pictures into tokens"),
    "system": Added("2026-11-25", None, "chat templates without a place for the system text"),
}
CONDITION: Mapping[str, Added] = {
    "radio": Added("2026-11-23", "", "any setting of a channel in a condition"),
    "schedule": Added("2026-11-23", "entropy", "schedules beside the paper's trigger"),
    "threshold": Added("2026-11-23", None, "a schedule's threshold"),
    "round_trip": Added("2026-11-23", "", "a cloud behind a measured network"),
    "round_trip_s": Added("2026-11-23", None, "a cloud behind a constant round trip"),
    "edge": Added(
        "2026-11-23", "none", "antennas with a place; see `_condition` for `roadside_edge`"
    ),
    "edge_delay_s": Added("2026-11-23", 0.0, "antennas with a place"),
    "edge_x_m": Added("2026-11-23", 0.0, "antennas with a place"),
    "edge_y_m": Added("2026-11-23", 0.0, "antennas with a place"),
    "edge_antenna_m": Added("2026-11-23", 5.0, "antennas with a place"),
    "attack": Added("2026-11-23", "", "attacks; all helpers were honest"),
    "defence": Added("2026-11-23", "", "guarded fusion prompts"),
    "content": Added("2026-11-27", "intent", "messages that hold objects; all held intents"),
    "encoding": Added("2026-11-27", "json", "the standards' sizes of messages; all were JSON"),
    "rounds": Added("2026-11-27", 1, "several rounds of negotiation; all had one"),
    "weight_cap": Added("2026-11-23", 1.0, "a cap on one helper's weight"),
}
# Of `versions`, in run.json and in the record that a run begins with.
VERSIONS: Mapping[str, Added] = {
    "parser": Added("2026-11-26", "1", "the version of what answers are read as"),
    "decisions": Added("2026-11-26", "1", "the version of what answers are decided to"),
}
# Of the record that a run begins with; `lifecycle.RunStart` has the same defaults.
START: Mapping[str, Added] = {
    "command": Added(
        "2026-11-23", (), "the command that repeats a run; the one that resumes it is stated"
    ),
    "versions": Added("2026-11-23", {}, "versions of packages; those that resume it are stated"),
}
# Of a line of answers.jsonl; `records.Answer` has the same defaults.
ANSWER: Mapping[str, Added] = {
    "first_token_s": Added("2026-11-23", None, "time to the first token"),
    "token_s": Added("2026-11-23", None, "time per output token"),
    "first": Added("2026-11-23", UNSET, "repair turns; also unset without one"),
    "image_sha256": Added("2026-11-23", UNSET, "pictures in prompts; also unset without one"),
    "agent": Added(
        "2026-11-26", UNSET, "asking only helpers whose answer counts; the order of answers said"
    ),
    "letter_share": Added("2026-11-26", UNSET, "read-outs over several orders of letters"),
    "follows_letter": Added("2026-11-26", UNSET, "read-outs over several orders of letters"),
    "flipped": Added("2026-11-26", UNSET, "asking with the list of actions reversed"),
    "faults": Added(
        "2026-11-26", UNSET, "all faults of an answer; older ones have the status alone"
    ),
    "extension": Added("2026-11-26", UNSET, "what a prompt asks for beside the decision"),
}
# Columns of decisions.parquet, those of messages without their number; a missing one is null.
COLUMNS: Mapping[str, Added] = {
    "trust": Added("2026-11-23", None, "rules that judge helpers"),
    "attacker": Added("2026-11-23", None, "attacks"),
    "busy_ratio": Added(
        "2026-11-23", None, "load of the channel; also missing where it is not known"
    ),
    **dict.fromkeys(
        ("unasked", "unasked_bits", "unasked_ms"),
        Added("2026-11-30", None, "streams; also missing where helpers send nothing unasked"),
    ),
    **dict.fromkeys(
        ("miss", "false_alarm"),
        Added("2026-11-27", None, "misses and false alarms; also missing in closed loop"),
    ),
    **dict.fromkeys(
        ("ttc_s", "pet_s", "short_ttc", "short_pet"),
        Added("2026-11-27", None, "conflicts in time; also missing on trees of older datasets"),
    ),
    "agent": Added("2026-11-27", None, "swarms; also missing where only egos decide"),
    "broke_word": Added("2026-11-27", None, "plans; also missing where none is sent"),
}
# Columns of episodes.csv; `records.Episode` has the same defaults.
EPISODE: Mapping[str, Added] = {
    **dict.fromkeys(
        ("outcome", "time_lost_s", "miss", "false_alarm"),
        Added(
            "2026-11-27",
            None,
            "the price of caution; also empty in closed loop, and `outcome` under limits 1",
        ),
    ),
    **dict.fromkeys(
        ("least_ttc_s", "short_ttc", "least_pet_s", "short_pet"),
        Added("2026-11-27", None, "conflicts in time; also empty on trees of older datasets"),
    ),
    **dict.fromkeys(
        ("witnesses", "danger_radio"),
        Added("2026-11-27", None, "who sees the danger; also empty where none is declared"),
    ),
    **dict.fromkeys(
        ("agents", "arrived", "met", "agents_lost_s", "most_lost_s", "gave_way"),
        Added("2026-11-27", None, "swarms; also missing where only egos decide"),
    ),
    "journeys": Added(
        "2026-11-27", None, "how each agent ended; also missing where only egos decide"
    ),
    "cluster": Added(
        "2026-11-30", None, "layouts of one recording; also missing where each is of its own"
    ),
}

# Columns that are missing where no episode has a value.
SPARSE = (
    "agents",
    "arrived",
    "met",
    "agents_lost_s",
    "most_lost_s",
    "gave_way",
    "journeys",
    "cluster",
)


def upgraded(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of an older `run.json`, or of a run's first record, in today's form.

    `record` has it as plain values. Missing keys get what the run did without them, and renamed
    ones their new name. Values of a wrong type are left as they are, for the reader to refuse. A
    driven scenario is named without the settings typed after its name, which are among its
    parameters; `kept` has the table `calibrations`, which stood beside it; what became settings of
    extensions, which stands among others in files, gets tables of its own.
    """
    if isinstance(calibrations := record.get("calibrations"), dict) and "kept" not in record:
        record = {**record, "kept": {"calibrations": calibrations} if calibrations else {}}
    if "beside" not in record:
        names_beside = [name for name, each in extensions.beside().items() if not each.table]
        opened = {name: record[name] for name in names_beside if record.get(name) is not None}
        others = {name: value for name, value in record.items() if name not in names_beside}
        record = {**_without_gone(others), "beside": opened}
    if isinstance(table := record.get("settings"), Mapping):
        record = {**record, "settings": gathered(table, of_run=True)}
    older = {key: SETTINGS[name].absent for key, name in BESIDE.items() if name in SETTINGS}
    settings = _agent(_with(MANIFEST, {**older, **record}))
    if isinstance(model := settings.get("identity"), dict):
        settings["identity"] = identity(model)
    for name, upgrade in (("helpers", _agent), ("conditions", _condition)):
        if isinstance(tables := settings.get(name), list | tuple):
            settings[name] = [
                upgrade(table) if isinstance(table, dict) else table for table in tables
            ]
    match settings.get("world"):
        case {"scenario": {"name": str(name)}}:
            from harness.world import scenarios  # imports NumPy, which listing runs does not need

            world = settings["world"]
            driven = {**world["scenario"], "name": scenarios.split(name)[0]}
            settings["world"] = {**world, "scenario": driven}
    settings["settings"] = _table(settings, table)
    return settings


def gathered(settings: Mapping[str, Any], of_run: bool = False) -> dict[str, Any]:
    """Return a table of settings, values by name, as this version of the program holds it.

    In files some settings of extensions stand among those of the core, or in one of its tables.
    Here all of them stand in a table `extensions`, without those at their default and without empty
    lists.

    Args:
        settings: the table as a file has it.
        of_run: whether a finished run states it; then settings of its scenes whose extension is not
            installed are left out, since the run states its scenes itself.

    Raises UserError for a setting of an extension that is not installed.
    """
    beside, entries = extensions.beside(), {}
    tables = {name: value for name, value in settings.items() if isinstance(value, Mapping)}
    for name, setting in beside.items():
        place = tables.get(setting.table, {}) if setting.table else settings
        value = place.get(_key(name, setting))
        if value is not None:
            entries[name] = value
    table = _without_gone(_without(settings, ""))
    for name, inner in tables.items():
        if name != EXTENSIONS:
            others = _without_gone(_without(inner, name), name, of_run and name == WORLD)
            table[name] = others
            if not others and name in extensions.tables_of_settings():
                del table[name]
    by_name = table.get(EXTENSIONS, {})
    if isinstance(by_name, Mapping):
        unset = [(name, setting.default) for name, setting in beside.items()]
        by_name = {
            each: value
            for each, value in {**by_name, **entries}.items()
            if value not in NO_TEXTS and (each, value) not in unset
        }
    return {**table, EXTENSIONS: by_name}


def _key(name: str, setting: extensions.Setting) -> str:
    """Return the key of files, in its table, that has this setting of an extension."""
    return setting.path(name).rpartition(".")[2]


def _without(table: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the table of this name without the settings of extensions that stand in it."""
    beside = extensions.beside()
    others = {_key(each, setting) for each, setting in beside.items() if setting.table == name}
    return {key: value for key, value in table.items() if key not in others}


def _without_gone(
    table: Mapping[str, Any], name: str = "", of_scenes: bool = False
) -> dict[str, Any]:
    """Return the table of this name without settings whose extension is not installed.

    Raises UserError for one that does something, but not of those `of_scenes` of a run.
    """
    kept = {}
    for key, value in table.items():
        places = [place for place in (key, f"{name}.{key}") if extensions.setting_of_run(place)]
        owner = extensions.setting_of_run(places[0]) if places else None
        if owner is None or owner.extension in extensions.extensions():
            kept[key] = value
        elif (
            not of_scenes
            and value is not None
            and value not in NO_TEXTS
            and str(value) != owner.idle
        ):
            raise UserError(f"setting {places[0]} is {part_of(owner.extension)}")
    return kept


def as_file(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `run.json` as plain values, given a manifest's values by name.

    A manifest holds all settings of extensions in tables of their own; in the file some stand
    behind settings of the core, where their extension says so, and what they opened stands at the
    top.
    """
    table: dict[str, Any] = {}
    for name, value in manifest.items():
        if name != "beside":
            table[name] = settings_as_file(value) if name == "settings" else value
            table |= _behind(BESIDE.get(name), manifest["beside"])
    return table


def settings_as_file(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of settings, values by name, in the form that `run.json` has it.

    There, some settings of extensions stand behind those of the core, where their extension says
    so; the others stay in the table `extensions`. It undoes `gathered`.
    """
    of_extensions, beside = settings[EXTENSIONS], extensions.beside()
    table = _in_order(settings, of_extensions, "")
    for name, inner in settings.items():
        if isinstance(inner, Mapping):
            table[name] = _in_order(inner, of_extensions, f"{name}.")
    table[EXTENSIONS] = {name: value for name, value in of_extensions.items() if name not in beside}
    return table


def _in_order(
    table: Mapping[str, Any], of_extensions: Mapping[str, Any], prefix: str
) -> dict[str, Any]:
    """Return a table with the settings of extensions that stand in it; `prefix` is its name."""
    beside, full = extensions.beside(), dict[str, Any]()
    names = {setting.path(name): name for name, setting in beside.items()}
    for path in extensions.in_order(f"{prefix}{name}" for name in table):
        *outer, key = path.removeprefix(prefix).split(".")
        if not outer and key in table:
            full[key] = table[key]
        else:
            inner = full.setdefault(outer[0], {}) if outer else full
            inner[key] = of_extensions.get(names[path], beside[names[path]].default)
    return full


def _behind(name: str | None, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of extensions' settings that stand behind one of the core, null if not set."""
    return {each: values.get(each) for each in extensions.in_order([name])[1:]} if name else {}


def _table(record: Mapping[str, Any], in_file: Any) -> Any:
    """Return the table of settings; of an older run, which has none,
    it is made of what stands beside it.

    Raises ValueError if it, or the table as the file has it, `in_file`, says otherwise than what
    stands beside it.
    """
    beside = {name: record[key] for key, name in BESIDE.items() if key in record}
    # which the reader finds, and names
    with suppress(KeyError, TypeError, AttributeError, IndexError):
        beside |= _opened(record)
    table = record["settings"] if "settings" in record else gathered(beside, of_run=True)
    if not isinstance(table, Mapping):
        return table  # for the reader to refuse
    flat = _flat(table)
    if isinstance(in_file, Mapping):
        flat = {**_flat(in_file), **flat}
    if "settings" in record:  # and states none of these, where there is none
        flat = {**dict.fromkeys(map(_extensions_key, role_agents.settings())), **flat}
    of_extensions = extensions.beside().items()
    by_model = [_extensions_key(name) for name, setting in of_extensions if setting.models]
    of_ego = _places(record)
    helpers = record.get("helpers")
    of_helpers = [_places(each) for each in helpers] if isinstance(helpers, Sequence) else []
    for name, there in _flat(beside).items():
        typed = flat.get(name, there)
        is_place = name == "model" and typed in of_ego
        if name in by_model and isinstance(typed, str) and isinstance(there, str):
            parts = zip(typed.split(","), there.split(","), of_helpers, strict=False)
            is_place = all(part == called or part in places for part, called, places in parts)
            is_place = is_place and typed.count(",") == there.count(",")
        may_be = name in (*TYPED, *by_model) and (is_place or _may_be(typed, there))
        if typed != there and not may_be:
            both = f"{printable(flat[name], 60)}, and beside them it is {printable(there, 60)}"
            raise ValueError(f"its settings have {_place(name)} {both}")
    if "settings" in record:
        for name in _without_record(record):
            default = extensions.beside()[name].default
            value = flat.get(_extensions_key(name), default)
            if value is not None and value != default and value not in NO_TEXTS:
                raise ValueError(
                    f"its settings have {name} {printable(value, 60)}, and nothing beside them says"
                    " what that came to"
                )
    return _with(SETTINGS, table)


def _without_record(record: Mapping[str, Any]) -> set[str]:
    """Return the settings of extensions that would have left something in a run, and have not.

    They choose helpers' agents, episodes, when a run stops, what times answers, or counterparts of
    conditions.
    """
    from harness.coordination.counterparts import COUNTERPARTS
    from harness.dataset.select import SELECTIONS
    from harness.runs.stopping import STOPPING_RULES
    from harness.runs.timers import TIMERS

    names = {*COUNTERPARTS}  # which conditions state by their names
    world = record.get("world")
    scenes = world if isinstance(world, Mapping) else {}
    if not record.get("helpers"):
        names |= {*role_agents.settings()}
    if not scenes.get("selection"):
        names |= SELECTIONS.settings()
    if not scenes.get(LOOKS):
        names |= STOPPING_RULES.settings()
    opened = record.get("beside")
    if not any(map(opened.get, TIMERS.settings()) if isinstance(opened, Mapping) else ()):
        names |= TIMERS.settings()
    return names & extensions.beside().keys()


def _extensions_key(name: str) -> str:
    """Return what `_flat` calls a setting of an extension."""
    return f"{EXTENSIONS}.{name}"


def _place(name: str) -> str:
    """Return the place in files of a setting that `_flat` calls so: `model`, or `world.limit`."""
    table, _, key = name.partition(".")
    beside = extensions.beside()
    return beside[key].path(key) if table == EXTENSIONS and key in beside else name


def _places(agent: Any) -> list[str]:
    """Return the weights and the adapter of the model of an agent of a record, as typed."""
    card = agent.get("model") if isinstance(agent, Mapping) else None
    if not isinstance(card, Mapping):
        return []
    both = [card.get("weights"), card.get("adapter")]
    return [place for place in both if isinstance(place, str)]


def _may_be(typed: Any, names: Any) -> bool:
    """Return whether what a user typed may open what has these names;
    a server's or a replayed one may.
    """
    if not (isinstance(typed, str) and isinstance(names, str)):
        return typed is None or names is None
    if "://" in typed or typed.startswith("replay:"):
        return True
    if (prefix := typed.partition(":")[0]) in FAMILIES:  # whose names have colons and commas
        family = FAMILIES[prefix]
        return family.split(typed)[0] == family.split(names)[0]
    each_name = names.split(",")
    each_typed = typed.split(",", len(each_name) - 1)
    pairs = zip(each_typed, each_name, strict=False)
    return len(each_typed) == len(each_name) and all(_is_called(text, name) for text, name in pairs)


def _is_called(text: str, name: str) -> bool:
    """Return whether a text is this name, with settings or without, or a path that ends in it."""
    place, bare = PurePath(text), PurePath(name.partition(":")[0]).name
    return text == name or bare in (place.name, place.stem) or text.startswith(f"{name}:")


def _opened(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that opened what a run states, each as it is called there."""
    seeds, world = record["seeds"], record["world"]
    opened = dict.fromkeys(extensions.beside()) | record["beside"]
    names = {name: _name_of(value) for name, value in opened.items()}
    names |= role_agents.recorded(record["helpers"])
    scenes = {"kind": world["kind"], "dataset": world.get("path"), **world.get("selection", {})}
    if "scenario" in world:
        scenes |= {"scenario": world["scenario"]["name"], "first_seed": world["first_seed"]}
    return {
        **{name: record[name] for name in ("answer", "thinking", "image", "flip", "sums")},
        "model": record["model"]["name"],
        "prompt": record["prompt"]["version"],
        "seeds": ",".join(map(str, seeds)) if len(seeds) > 1 else f"{seeds[0]}:{seeds[0] + 1}",
        "condition": [point["name"] for point in record["conditions"]],
        EXTENSIONS: {name: value for name, value in names.items() if value is not None},
        "world": scenes,
    }


def _name_of(opened: Any) -> Any:
    """Return what a setting says that opened this: its name, or itself where nothing is opened."""
    return opened["name"] if isinstance(opened, Mapping) else opened


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table's values by name; of a table in it by both names."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}.{inner}": of for inner, of in value.items()}
        else:
            flat[name] = list(value) if isinstance(value, tuple) else value
    return flat


def versions(stated_versions: Mapping[str, str]) -> dict[str, str]:
    """Return the versions of programs and rules, by name, that a run states, with missing ones.

    A run of an earlier version of this harness states fewer; it gets those that there were then.
    """
    return _with(VERSIONS, stated_versions)


def identity(stated_identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return what identifies a run's models, as plain values by name, in today's form.

    `stated_identity` is that of a `run.json`, perhaps of an older version. `answers` is the version
    of a rule's answers, 1, the oldest, where it states none. What only older versions stated is
    left out.
    """
    kept = {
        name: value
        for name, value in stated_identity.items()
        if name not in ("proxy_model_version", "harness")
    }
    if isinstance(helpers := stated_identity.get("helpers"), list):
        kept["helpers"] = [
            identity(helper) if isinstance(helper, dict) else helper for helper in helpers
        ]
    return {"answers": 1, **kept}


def _with(added: Mapping[str, Added], table: Mapping[str, Any]) -> dict[str, Any]:
    return {**table, **{name: entry.absent for name, entry in added.items() if name not in table}}


def _agent(table: Mapping[str, Any]) -> dict[str, Any]:
    agent = _with(AGENT, table)
    if isinstance(model := agent.get("model"), dict):
        agent["model"] = _with(MODEL, model)
    return agent


def _condition(table: Mapping[str, Any]) -> dict[str, Any]:
    """2026-11-23: `edge` replaced `roadside_edge`, which sent replies once more, as `relay` does.

    2026-11-29: settings of extensions are left out where they do nothing.
    """
    from harness.coordination.operating_point import as_here

    renamed = {name: value for name, value in table.items() if name != "roadside_edge"}
    if table.get("roadside_edge") is True:
        renamed["edge"] = "relay"
    complete = _with(CONDITION, renamed)
    return as_here({**_plain_condition(), **complete})


@cache
def _plain_condition() -> Mapping[str, Any]:
    """Return the core's settings of a condition, by name, at their defaults."""
    from harness.coordination.operating_point import OperatingPoint

    plain = OperatingPoint("any").record()
    del plain["name"]
    return plain


def checked(version: object, file: object) -> None:
    """Raise UserError if the format `version` that a `run.json` states is not `FORMAT`.

    `file` is its path, for the error.
    """
    if version == FORMAT:
        return
    old = READ_BY.get(version) if isinstance(version, str) else None
    newer = re.fullmatch(r"swarmdrive-run/(\d{1,6})", str(version), re.ASCII)
    raise UserError(
        f"{printable(file)} has format {printable(version)!r}, not {FORMAT!r}; "
        + (
            f"harness {old} reads it: run again, or install that version"
            if old
            else "a newer harness made it: install that"
            if newer and int(newer[1]) > NUMBER
            else "give a folder made by `harness eval` or `harness drive`"
        )
    )
