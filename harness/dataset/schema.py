"""JSON Schemas of a frozen dataset: published beside it, enforced when it is built and checked."""

from functools import lru_cache
from typing import Any

from harness.road import APPROACHES, ROUTES, SECTORS
from harness.scene import SIZES_M

Schema = dict[str, Any]

VEHICLE_ID = {"type": "string", "pattern": "^v[1-9][0-9]?$"}
NUMBER = {"type": "number"}
NUMBER_OR_NULL = {"type": ["number", "null"]}


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


_VEHICLE = _object(
    id=VEHICLE_ID, kind=_enum(*SIZES_M), part=_enum("ego", "helper", "other"), x_m=NUMBER, y_m=NUMBER,
    heading_rad=NUMBER, speed_mps=NUMBER, approach=_enum(*APPROACHES), route=_enum(*ROUTES),
    crashed={"type": "boolean"},
)  # fmt: skip
_BUILDING = _object(
    id={"type": "string", "pattern": "^b[1-9]$"}, west_m=NUMBER, north_m=NUMBER, east_m=NUMBER, south_m=NUMBER
)
_POINT = _object(forward_m=NUMBER, left_m=NUMBER)
_ARRIVAL = {"arc_m": NUMBER, "time_s": NUMBER_OR_NULL}
_GRAPH = _object(
    viewer=VEHICLE_ID,
    role=_enum("ego", "helper"),
    step={"type": "integer", "minimum": 0},
    self=_object(speed_mps=NUMBER, lane={"type": "string"}, zone_m=NUMBER),
    ego=_object(
        id=VEHICLE_ID, speed_mps=NUMBER, target_speed_mps=NUMBER, zone_m=NUMBER, forward_m=NUMBER,
        left_m=NUMBER,
    ),
    nodes=_list(
        _object(
            id=VEHICLE_ID, type=_enum("vehicle", *SIZES_M), forward_m=NUMBER, left_m=NUMBER,
            heading_deg=NUMBER_OR_NULL, speed_mps=NUMBER, range_rate_mps=NUMBER_OR_NULL,
            lane={"type": "string"}, indicator=_enum("left", "off", None),
            sensors=_list(_enum("camera", "lidar", "radar")),
        )
    ),
    conflicts=_list(
        _object(**{
            "with": VEHICLE_ID, "sector": _enum(*SECTORS), "route": _enum(*ROUTES), "point": _POINT,
            "ego": _object(**_ARRIVAL), "other": _object(**_ARRIVAL, speed_mps=NUMBER),
        })
    ),
    sectors=_list(
        _object(
            sector=_enum(*SECTORS), seen_share=NUMBER, occluded={"type": "boolean"},
            by=_list({"type": "string"}),
        )
    ),
)  # fmt: skip
_OUTCOME = _object(
    result=_enum("cleared", "collision", "time_out", "off_road"),
    time_s=NUMBER,
    partner={"anyOf": [VEHICLE_ID, {"type": "null"}]},
    striker=_enum("ego", "other", "both", "neither", None),
    fault=_enum("ego", "other", None),
    least_gap_m=NUMBER,
    other_crashes={"type": "integer", "minimum": 0},
)


def record_schema(actions: tuple[str, ...]) -> Schema:
    """Schema of one line of `scenes.jsonl`."""
    by_viewer = {"type": "object", "propertyNames": VEHICLE_ID}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "decision point",
        **_object(
            scene={"type": "string", "pattern": "^[0-9]{5}-[0-9]$"},
            episode={"type": "integer", "minimum": 0},
            episode_seed={"type": "integer"},
            step={"type": "integer", "minimum": 0},
            road=_object(
                kind={"type": "string"}, lane_width_m=NUMBER, junction_m=NUMBER, ego={"type": "string"}
            ),
            danger=_object(sector=_enum(*SECTORS, None), vehicle={"anyOf": [VEHICLE_ID, {"type": "null"}]}),
            behaviour=_object(
                action=_enum(*actions), reason=_enum("cruise", "local-view", "full-view", "random", "guard")
            ),
            state=_object(
                scenario={"type": "string"}, episode_seed={"type": "integer"},
                step={"type": "integer", "minimum": 0}, time_s=NUMBER, target_speed_mps=NUMBER,
                vehicles={**_list(_VEHICLE), "minItems": 1}, buildings=_list(_BUILDING),
            ),
            graphs={**by_viewer, "additionalProperties": _GRAPH},
            distance_m={**by_viewer, "additionalProperties": NUMBER},
            outcomes=_object(**dict.fromkeys(actions, _OUTCOME)),
            snapshot=_object(
                frame={"type": "integer", "minimum": 0},
                sections=_list({"type": "integer", "minimum": 0, "maximum": 2}),
                speed_index={"type": "integer", "minimum": 0},
            ),
        ),
    }  # fmt: skip


def manifest_schema() -> Schema:
    """Schema of `manifest.json`."""
    text = {"type": "string"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "dataset manifest",
        **_object(
            format={"const": "swarmdrive-dataset/1"},
            name={"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"},
            scenario=text,
            actions={**_list(text), "minItems": 2},
            parameters={"type": "object"},
            behaviour={"type": "object"},
            episodes={"type": "integer", "minimum": 1},
            decisions={"type": "integer", "minimum": 1},
            seed={"type": "integer"},
            versions={"type": "object", "additionalProperties": text},
            files={"type": "object", "additionalProperties": {"type": "string", "pattern": "^[0-9a-f]{64}$"}},
        ),
    }


@lru_cache(maxsize=8)
def record_validator(actions: tuple[str, ...]) -> Any:
    """Compiled validator of one record."""
    from jsonschema import Draft202012Validator

    return Draft202012Validator(record_schema(actions))
