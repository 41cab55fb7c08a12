"""Tables of studies: a row a grid point, seed and episode, of which there may be millions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Floats
from harness.studies.axes import Setting

if TYPE_CHECKING:
    import pandas as pd

NAMES = ("source", "panel", "condition", "variable")
PLACE = (*NAMES, "value")
EPISODE_METRICS = (
    "success_rate", "trigger_rate", "latency_proxy_ms", "messages_per_episode", "effective_loss",
)  # fmt: skip


def of_episodes(
    source: str, panel: str, settings: Sequence[Setting], found: Sequence[Mapping[str, Floats]]
) -> "pd.DataFrame":
    """The table of a panel's episodes, from `EPISODE_METRICS`, `seed` and `episode` of each grid point, (n,).

    Names are kept once.
    """
    import pandas as pd

    column = {name: np.concatenate([of[name] for of in found]) for name in found[0]}
    point = np.repeat(np.arange(len(settings)), [len(of["seed"]) for of in found])

    def named(names: list[Any]) -> "pd.Categorical[Any]":
        return pd.Categorical(names).take(point)

    values = [np.nan if s.value is None else s.value for s in settings]
    kind = object if any(isinstance(v, str) for v in values) else float
    return pd.DataFrame({
        "source": named([source] * len(settings)),
        "panel": named([panel] * len(settings)),
        "condition": named([s.condition for s in settings]),
        "variable": named([s.variable for s in settings]),
        "value": np.array(values, dtype=kind)[point],
        "seed": column["seed"],
        "episode": column["episode"].astype(int),
        "success": column["success_rate"].astype(bool),
        "trigger_rate": column["trigger_rate"],
        "latency_ms": column["latency_proxy_ms"].round(3),
        "messages": column["messages_per_episode"].astype(int),
        "effective_loss": column["effective_loss"].round(6),
    })  # fmt: skip


def joined(tables: "Sequence[pd.DataFrame]") -> "pd.DataFrame":
    """Tables of episodes, one below the other; what says where they belong is kept once."""
    import pandas as pd
    from pandas.api.types import union_categoricals

    found = {name: union_categoricals([t[name] for t in tables]) for name in NAMES}
    rest = pd.concat([t.drop(columns=list(NAMES)) for t in tables], ignore_index=True)
    return pd.concat([pd.DataFrame(found), rest], axis=1)
