"""Load a run as pandas tables, for notebooks and scripts: `harness.load`.
docs/fields.md has the columns.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
from msgspec import structs

from harness.core.files import bytes_of
from harness.runs.folder import Run, read, whole
from harness.runs.records import TURNS, Answer
from harness.world.outcome import End

if TYPE_CHECKING:
    import pandas as pd

# Names stay text: a model may be called "null" and a prompt "1".
TEXT = (
    "model",
    "prompt",
    "answer",
    "condition",
    "metric",
    "interval",
    "danger",
    "failure",
    "partner",
    "striker",
    "fault",
)
# a helper's answer without its intent
MESSAGE = ("risk", "evidence", "recommended_maneuver", "confidence")
T = TypeVar("T", bound="Tables")
PLACE = ["scene", "episode", "step", "danger"]


@dataclass(frozen=True)
class Tables:
    """Hold a finished run, on frozen (recorded) scenes or in closed loop, as pandas tables.

    `path` is its folder, `config` the content of its `run.json`, and `source` the run's records.
    Each table is read on first use, and raises UserError if its file is missing or broken.
    """

    path: Path  # the run's folder
    config: Mapping[str, Any] = field(repr=False)  # the content of run.json
    source: Run = field(repr=False)  # the run's records

    @cached_property
    def summary(self) -> "pd.DataFrame":
        """Return `summary.csv`: one row for each condition, metric and kind of interval.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        return self._csv("summary.csv")

    @cached_property
    def episodes(self) -> "pd.DataFrame":
        """Return `episodes.csv`: one row for each episode, condition and seed.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        return self._csv("episodes.csv")

    @cached_property
    def agents(self) -> "pd.DataFrame":
        """Return one row for each agent of an episode: the column `journeys` of `episodes.csv`.

        An agent is a vehicle that decides for itself; there is no row where only the ego does. The
        column `gave_way` says whether it lost the most time.
        """
        import pandas as pd

        def read_rows(file: Path) -> list[tuple[Any, ...]]:
            rows: list[tuple[Any, ...]] = []
            for e in self.source.episodes:
                if e.journeys is None:
                    continue
                key = e.condition, e.seed, e.episode
                for end in msgspec.json.decode(e.journeys, type=tuple[End, ...]):
                    rows.append((*key, *structs.astuple(end), end.agent == e.gave_way))
            return rows

        columns = ["condition", "seed", "episode", *End.__struct_fields__, "gave_way"]
        return pd.DataFrame(whole(self.path / "episodes.csv", read_rows), columns=columns)

    @cached_property
    def decisions(self) -> "pd.DataFrame":
        """Return `decisions.parquet`: one row for each decision point, condition and seed.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        return self.source.decisions.frame()

    @cached_property
    def answers(self) -> "pd.DataFrame":
        """Return `answers.jsonl`: one row for each answer, with its scene's episode and step."""
        import numpy as np
        import pandas as pd

        answers, actions = list(self.source.answers), self.config["actions"]
        columns = {}
        for name in (*Answer.__struct_fields__, *TURNS):
            if name not in ("heard", "repairs", "intent", "message", "first", "extension"):
                columns[name] = [answer.cell(name) for answer in answers]
        unknown = (np.nan,) * len(actions)
        intents = np.array([answer.intent or unknown for answer in answers]).reshape(
            -1, len(actions)
        )
        table = pd.DataFrame(
            {
                **columns,
                "heard": ["+".join(answer.heard) for answer in answers],
                "repairs": [" ".join(answer.repairs) for answer in answers],
                **{f"intent_{action}": intents[:, place] for place, action in enumerate(actions)},
            }
        )
        for key in MESSAGE:
            table[key] = [(answer.message or {}).get(key) for answer in answers]
        table = table.astype(dict.fromkeys(table.columns[table.isna().all()], float))
        places = self.decisions[[*PLACE, "agent"]].rename(columns={"agent": "decider"})
        if places.decider.isna().all():  # only the ego decides
            places = places.drop(columns="decider")
        places = places.drop_duplicates("scene").astype({"scene": str})
        return places.merge(table, "right", "scene")

    def _csv(self, name: str) -> "pd.DataFrame":
        import pandas as pd

        return whole(
            self.path / name,
            lambda file: pd.read_csv(
                BytesIO(bytes_of(file, "rows")),
                dtype=dict.fromkeys(TEXT, str),
                keep_default_na=False,
                na_values=[""],
                float_precision="round_trip",
            ),
        )


def tables_of(run: Path, kind: type[T]) -> T:
    """Load the run in the folder `run` as pandas tables, an object of the class `kind`.

    `kind` is `Tables` or a subclass. Raises UserError if the folder holds no finished run, or one
    of another format version.
    """
    source = read(run)
    return kind(run, msgspec.json.decode(msgspec.json.encode(source.manifest.as_file())), source)
