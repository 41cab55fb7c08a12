"""The columns of a published dataset, whose rows are decision points."""

from typing import NamedTuple

import pyarrow as pa

TEXT, NUMBER, FLAG = pa.string(), pa.float64(), pa.bool_()


class Column(NamedTuple):
    """One column; a list has an entry for each of `viewers` or for each of `actions`,
    in their order.
    """

    name: str  # its name in the table
    kind: pa.DataType  # its type in Arrow
    meaning: str  # one line, with units


COLUMNS = (
    Column("scene", TEXT, "id of the decision point: episode, step, digest of the state"),
    Column("scenario", TEXT, "scenario that the layout is of"),
    Column("layout_seed", pa.int64(), "seed of the layout; its range says what it is for"),
    Column("episode", pa.int64(), 
        "number of the layout, from 0; rows "
        "of one layout belong together"),
    Column("step", pa.int64(), "how many decisions were taken before; 0 begins an episode"),
    Column("danger_sector", TEXT, "where the hidden danger comes from; null without one"),
    Column("danger_vehicle", TEXT, "id of the vehicle that is the danger; null without one"),
    Column(
        "prompt", pa.list_(pa.struct({"role": TEXT, "content": TEXT})),
        "chat messages that ask the ego, without messages of others",
    ),
    Column("viewers", pa.list_(TEXT), "ids of the vehicles that can be asked, the ego first"),
    Column("scene_graphs", pa.list_(TEXT), 
        "what each viewer knows, as JSON: "
        "metres, m/s, its own frame"),
    Column("distance_m", pa.list_(NUMBER), 
        "its distance to the conflict "
        "zone, as the ego knows it"),
    Column("range_m", pa.list_(NUMBER), 
        "its distance to the ego, as the ego "
        "knows it; null for the ego"),
    Column("actions", pa.list_(TEXT), "what the ego may do, the most careful first"),
    Column("safe", pa.list_(FLAG), "whether the episode can still succeed after the action"),
    Column("avoids_harm", pa.list_(FLAG), "whether harm can still be avoided after the action"),
    Column("value", pa.list_(NUMBER), 
        "probability of success after it, if "
        "later ones are drawn evenly"),
    Column("delay_s", pa.list_(NUMBER), 
        "seconds that it costs against the "
        "best one; null if not safe"),
    Column("next_scene", pa.list_(TEXT), 
        "decision point after the action; "
        "null where the episode ends"),
    Column("result", pa.list_(TEXT), 
        "how the episode ends after the "
        "action; null where it goes on"),
    Column("drivers", TEXT, 
        "what each reference driver does here, as "
        "JSON; `full-view` sees everything"),
    Column("state", TEXT, "the whole state, as JSON, in sight or not"),
)  # fmt: skip
SCHEMA = pa.schema([(column.name, column.kind) for column in COLUMNS])
