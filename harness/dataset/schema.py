"""JSON Schemas of a frozen dataset: published beside it, enforced when it is built and checked."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import lru_cache
from typing import Any

from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.state import SIZES_M, indicator

Schema = dict[str, Any]

VEHICLE_ID = {"type": "string", "pattern": "^v[1-9][0-9]?$"}
FILE_NAME = "^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"  # of a dataset and of its files: never a path
LAST_EPISODE, LAST_SEED = 99_999, 2**31 - 1
# No metre, second or share comes near these bounds; infinity and thousand-digit integers do not pass them.
NUMBER = {"type": "number", "minimum": -1e6, "maximum": 1e6}
NUMBER_OR_NULL = {**NUMBER, "type": ["number", "null"]}
EPISODE = {"type": "integer", "minimum": 0, "maximum": LAST_EPISODE}
SEED = {"type": "integer", "minimum": 0, "maximum": LAST_SEED + LAST_EPISODE}
COUNT = {"type": "integer", "minimum": 0, "maximum": 1_000_000}


def _object(**properties: Any) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": sorted(properties),
        "additionalProperties": False,
    }


def _list(items: Any) -> Schema:
    return {"type": "array", "items": items}


def _enum(*values: Any) -> Schema:
    return {"enum": list(values)}


_BUILDING = _object(
    id={"type": "string", "pattern": "^b[1-9]$"}, west_m=NUMBER, north_m=NUMBER, east_m=NUMBER, south_m=NUMBER
)
_POINT = _object(forward_m=NUMBER, left_m=NUMBER)
_ARRIVAL = {"arc_m": NUMBER, "time_s": NUMBER_OR_NULL}
_OUTCOME = _object(
    result=_enum("cleared", "collision", "time_out", "off_road"),
    time_s=NUMBER,
    partner={"anyOf": [VEHICLE_ID, {"type": "null"}]},
    striker=_enum("ego", "other", "both", "neither", None),
    fault=_enum("ego", "other", None),
    least_gap_m=NUMBER,
    other_crashes=COUNT,
)


def _vehicle(road: Road) -> Schema:
    return _object(
        id=VEHICLE_ID, kind=_enum(*SIZES_M), part=_enum("ego", "helper", "other"), x_m=NUMBER, y_m=NUMBER,
        heading_rad=NUMBER, speed_mps=NUMBER, approach=_enum(*_approaches(road)), route=_enum(*_routes(road)),
        crashed={"type": "boolean"},
    )  # fmt: skip


def _graph(road: Road) -> Schema:
    signals = [route for route in _routes(road) if indicator(route) == route]
    return _object(
        viewer=VEHICLE_ID,
        role=_enum("ego", "helper"),
        step=COUNT,
        self=_object(speed_mps=NUMBER, lane={"type": "string"}, zone_m=NUMBER),
        ego=_object(
            id=VEHICLE_ID, speed_mps=NUMBER, target_speed_mps=NUMBER, zone_m=NUMBER, forward_m=NUMBER,
            left_m=NUMBER,
        ),
        nodes=_list(
            _object(
                id=VEHICLE_ID, type=_enum("vehicle", *SIZES_M), forward_m=NUMBER, left_m=NUMBER,
                heading_deg=NUMBER_OR_NULL, speed_mps=NUMBER, range_rate_mps=NUMBER_OR_NULL,
                lane={"type": "string"}, indicator=_enum(*signals, "off", None),
                sensors=_list(_enum("camera", "lidar", "radar")),
            )
        ),
        conflicts=_list(
            _object(**{
                "with": VEHICLE_ID, "sector": _enum(*road.sectors), "route": _enum(*_routes(road)),
                "point": _POINT, "ego": _object(**_ARRIVAL), "other": _object(**_ARRIVAL, speed_mps=NUMBER),
            })
        ),
        sectors=_list(
            _object(
                sector=_enum(*road.sectors), seen_share=NUMBER, occluded={"type": "boolean"},
                by=_list({"type": "string"}),
            )
        ),
    )  # fmt: skip


def _approaches(road: Road) -> list[str]:
    return list(dict.fromkeys(approach for approach, _ in road.paths))


def _routes(road: Road) -> list[str]:
    return list(dict.fromkeys(route for _, route in road.paths))


def record_schema(scenario: Scenario) -> Schema:
    """Schema of one line of `scenes.jsonl`."""
    road, actions = scenario.road(), scenario.actions
    most_sections = max(len(path.lanes) for path in road.paths.values())
    by_viewer = {"type": "object", "propertyNames": VEHICLE_ID}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "decision point",
        **_object(
            scene={"type": "string", "pattern": "^[0-9]{5}-[0-9]$"},
            episode=EPISODE,
            episode_seed=SEED,
            step=COUNT,
            road=_object(**{k: _text_or_number(v) for k, v in road.facts.items()}),
            danger=_object(
                sector=_enum(*road.sectors, None), vehicle={"anyOf": [VEHICLE_ID, {"type": "null"}]}
            ),
            behaviour=_object(
                action=_enum(*actions), reason=_enum("cruise", "local-view", "full-view", "random", "guard")
            ),
            state=_object(
                scenario={"type": "string"}, episode_seed=SEED, step=COUNT, time_s=NUMBER,
                target_speed_mps=NUMBER,
                vehicles={**_list(_vehicle(road)), "minItems": 1}, buildings=_list(_BUILDING),
            ),
            graphs={**by_viewer, "additionalProperties": _graph(road)},
            distance_m={**by_viewer, "additionalProperties": NUMBER},
            outcomes=_object(**dict.fromkeys(actions, _OUTCOME)),
            snapshot=_object(
                frame=COUNT,
                sections=_list({"type": "integer", "minimum": 0, "maximum": most_sections - 1}),
                speed_index={**COUNT, "maximum": len(scenario.parameters.target_speeds_mps) - 1},
            ),
        ),
    }  # fmt: skip


def _text_or_number(value: str | float) -> Schema:
    return {"type": "string"} if isinstance(value, str) else NUMBER


def manifest_schema(scenario: Scenario) -> Schema:
    """Schema of the `manifest.json` of a scenario's dataset."""
    text = {"type": "string", "maxLength": 200}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "dataset manifest",
        **_object(
            format={"const": "swarmdrive-dataset/1"},
            name={"type": "string", "pattern": FILE_NAME},
            scenario=text,
            actions={**_list(text), "minItems": 2, "uniqueItems": True},
            parameters=_object(
                **{
                    name: _list(NUMBER) if isinstance(value, tuple) else NUMBER
                    for name, value in asdict(scenario.parameters).items()
                }
            ),
            behaviour={"type": "object", "additionalProperties": NUMBER},
            episodes={**EPISODE, "minimum": 1, "maximum": LAST_EPISODE + 1},
            decisions={**COUNT, "minimum": 1},
            seed={**SEED, "maximum": LAST_SEED},
            versions={"type": "object", "additionalProperties": text},
            files={
                "type": "object",
                "required": ["scenes.jsonl"],
                "propertyNames": {"pattern": FILE_NAME},
                "additionalProperties": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
            },
        ),
    }


def manifest_validator(scenario: Scenario) -> Any:
    """Validator of a manifest, which says what is wrong."""
    from jsonschema import Draft202012Validator

    return Draft202012Validator(manifest_schema(scenario))


@lru_cache(maxsize=8)
def record_validator(scenario: Scenario) -> Any:
    """Compiled validator of one record; 1.0 is no integer to it."""
    from jsonschema import Draft202012Validator
    from jsonschema.validators import extend

    whole = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    strict: Any = extend(Draft202012Validator, type_checker=whole)  # type: ignore[no-untyped-call]
    return strict(record_schema(scenario))


@lru_cache(maxsize=8)
def fits_record(scenario: Scenario) -> Callable[[Any], bool]:
    """A quick yes to valid records; 1.0 is no integer to it either."""
    valid = _quick_yes(record_schema(scenario))
    return lambda record: valid(record) and all(type(n) is int for n in _integers(record))


def fits_manifest(scenario: Scenario, manifest: Any) -> bool:
    """A quick yes to a valid manifest."""
    return _quick_yes(manifest_schema(scenario))(manifest)


def _integers(record: dict[str, Any]) -> Iterator[Any]:
    """What a record's schema calls integers."""
    state, snapshot = record["state"], record["snapshot"]
    yield from (record["episode"], record["episode_seed"], record["step"])
    yield from (state["episode_seed"], state["step"], snapshot["frame"], snapshot["speed_index"])
    yield from snapshot["sections"]
    yield from (graph["step"] for graph in record["graphs"].values())
    yield from (outcome["other_crashes"] for outcome in record["outcomes"].values())


def _quick_yes(schema: Schema) -> Callable[[Any], bool]:
    """A schema compiled by fastjsonschema, some ten times as fast as jsonschema, and sooner loaded.

    What it says no to, jsonschema looks at: that decides, and says what is wrong and where.
    """
    from fastjsonschema import JsonSchemaValueException, compile

    validate = compile(schema, use_default=False)

    def fits(value: Any) -> bool:
        try:
            validate(value)
        except JsonSchemaValueException:
            return False
        return True

    return fits
