"""The columns of a published dataset, whose rows are decision points."""

from typing import NamedTuple

import pyarrow as pa

TEXT = pa.string()
MESSAGE = pa.struct({"role": TEXT, "content": TEXT})
TEXTS, NUMBERS, FLAGS = pa.list_(TEXT), pa.list_(pa.float64()), pa.list_(pa.bool_())


class Column(NamedTuple):
    """Describe one column of a published table; a row is a decision point.

    A value that is a list has an entry for each of the row's `viewers` (the vehicles that are
    asked) or for each of its `actions`, in their order.
    """

    name: str  # its name in the table
    kind: pa.DataType  # its type in Arrow
    meaning: str  # its meaning in one line, with units


COLUMNS = (
    Column("scene", TEXT, "id of the decision point: episode, step, digest of the state"),
    Column("scenario", TEXT, "scenario that the layout is of"),
    Column("layout_seed", pa.int64(), "seed of the layout; its range says what it is for"),
    Column(
        "episode", pa.int64(), "number of the layout, from 0; rows of one layout belong together"
    ),
    Column("step", pa.int64(), "how many decisions were taken before; 0 begins an episode"),
    Column("danger_sector", TEXT, "where the hidden danger comes from; null without one"),
    Column("danger_vehicle", TEXT, "id of the vehicle that is the danger; null without one"),
    Column(
        "prompt", pa.list_(MESSAGE), "chat messages that ask the ego, without messages of others"
    ),
    Column("viewers", TEXTS, "ids of the vehicles that can be asked, the ego first"),
    Column("scene_graphs", TEXTS, "what each viewer knows, as JSON: metres, m/s, its own frame"),
    Column("distance_m", NUMBERS, "its distance to the conflict zone, as the ego knows it"),
    Column("range_m", NUMBERS, "its distance to the ego, as the ego knows it; null for the ego"),
    Column("actions", TEXTS, "what the ego may do, the most careful first"),
    Column("safe", FLAGS, "whether the episode can still succeed after the action"),
    Column("avoids_harm", FLAGS, "whether harm can still be avoided after the action"),
    Column("value", NUMBERS, "probability of success after it, if later ones are drawn evenly"),
    Column("delay_s", NUMBERS, "seconds that it costs against the best one; null if not safe"),
    Column("next_scene", TEXTS, "decision point after the action; null where the episode ends"),
    Column("result", TEXTS, "how the episode ends after the action; null where it goes on"),
    Column(
        "drivers",
        TEXT,
        "what each reference driver does here, as JSON; `full-view` sees everything",
    ),
    Column("state", TEXT, "the whole state, as JSON, in sight or not"),
)
SCHEMA = pa.schema([(column.name, column.kind) for column in COLUMNS])
