"""Read and state promises, files `promises/*.toml`: thresholds with which a model does little harm.

`harness study promise` writes one. It holds for one model, prompt, scenario and condition.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import RECORDED, part_of_settings
from harness.core import resources
from harness.core.config import Count, convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json, digest, read_once
from harness.extensions.promise.risk import LEAST, least_p, units_needed
from harness.runs.fit import Fit, check_seeds, first_unlike, weights_of
from harness.runs.records import MEASURED
from harness.world.scenario import Scenario

FOLDER = "promises"
WHAT = "a promise"  # in messages
# settings that a promise chooses; all others are the condition's that it was made under
CHOSEN = ("name", "promise", "careful_nats", "tau_nats")
Harm = Literal["unsafe", "failed"]
Nats = Annotated[float, Meta(ge=0, le=100, description="nats, 0 or more")]
Share = Annotated[float, Meta(ge=0, le=1, description="a share from 0 to 1")]


@dataclass(frozen=True, kw_only=True)
class Promise(Fit):
    """Hold a file of `promises/`: thresholds with which a model's mean harm is at most `at_most`.

    The sentence is wrong in a share `delta` of all draws of tune layouts, at most. `obstacle` and
    `obstacle_of_models` say for which model, prompt and scenario it holds, `other_setting` for
    which condition.
    """

    harm: Harm  # what counts: `unsafe`, an episode that ends unsafely; `failed`, one that fails
    at_most: Share  # of harm, mean over layouts and the channel's draws
    delta: Share  # probability, over draws of tune layouts, that the promise is wrong, at most
    settings: dict[str, bool | int | float | str]  # the condition's others, by flat name
    parameters: dict[str, str]  # the scenario's, by name (`parameters_of`)
    # of the run what else decides, by name: `ties`, `temperature`, `flip` and `latency`
    setup: dict[str, str]
    # digests of what the condition opens (`opened_of`)
    opened: dict[str, str] = field(default_factory=dict)
    tau_nats: Nats  # entropy of the ego's answer above which it asks
    careful_nats: Nats | None = None  # entropy from which the ego is careful; None for never
    units: Count  # number of tune layouts, or of scenes that these are cut from
    mean_harm: Share  # on the tune layouts
    channel_seeds: tuple[int, ...]  # over which harm was averaged
    dataset_sha256: str  # digest of the tune layouts' scenes

    @property
    def implied(self) -> dict[str, Any]:
        """Return the settings of a condition that keep this promise, values by flat name."""
        return {"tau_nats": self.tau_nats, "careful_nats": self.careful_nats}

    def other_setting(self, point: OperatingPoint) -> tuple[str, object, object] | None:
        """Return a setting of a condition with which the promise was not made; None if none is.

        Returned are its flat name, its value in the condition, and that of the promise.
        """
        plain = _every_setting(OperatingPoint(point.name))
        return first_unlike(_every_setting(point), {**plain, **self.settings})

    def obstacle(self, agent: Mapping[str, Any], scenario: Scenario) -> str | None:
        reason = super().obstacle(agent, scenario)
        return reason or _reason(self.parameters, parameters_of(scenario))

    def obstacle_of_setup(self, point: OperatingPoint, **setup: object) -> str | None:
        """Return in words what a condition opens, or a run decides by, otherwise than it was made.

        `setup` has values of the run by their names in `Promise.setup`; those that are None, since
        nothing states them, do not count. Returned is None if all are alike.
        """
        now = {name: str(value) for name, value in setup.items() if value is not None}
        then = {name: self.setup.get(name) for name in now}
        return _reason(then, now) or _reason(self.opened, opened_of(point))

    def obstacle_of_models(self, identities: Iterable[Mapping[str, Any]]) -> str | None:
        ego, *others = identities
        if not self.weights and weights_of(ego):
            return "was made of a model without digests of weights, and this one has some"
        reason = super().obstacle_of_models([ego, *others])
        if reason or "latency" not in ego:
            return reason
        return _reason({"latency": self.setup.get("latency")}, {"latency": times_of(ego)})


def _reason(then: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    unlike = first_unlike(then, now)
    if unlike is None:
        return None
    words = ("nothing" if value is None else value for value in unlike)
    name, value, other = (printable(word, 80) for word in words)
    return f"was made with {name} {value}, not {other}"


def parameters_of(scenario: Scenario) -> dict[str, str]:
    """Return a scenario's parameters as texts by name, as those of its datasets are stated."""
    return {name: str(value) for name, value in scenario.parameters.stated().items()}


def times_of(facts: Mapping[str, Any]) -> str:
    """Return the seconds of answers as one text, of the `latency` that `facts` has.

    Times that were measured are each run's own, and count as alike.
    """
    latency = facts["latency"]
    if latency["source"] == MEASURED:
        return MEASURED
    words = ("source", "basis", "sample")
    return canonical_json({name: each for name, each in latency.items() if name not in words})


def opened_of(point: OperatingPoint) -> dict[str, str]:
    """Return digests of what a condition opens, by kind and name, such as `channels 6g`.

    They are of files, and of what a radio does; the promise itself is none of them.
    """
    from harness.evaluate.spec import files_of

    files = files_of([point])
    by_kind = {**files, **files["kept"]}
    del by_kind["kept"]
    by_kind.pop(FOLDER, None)
    digests = {}
    for kind, by_name in by_kind.items():
        for name, record in by_name.items():
            if kind == "channels":
                record = [record["model"], record["parameters"]]
            digests[f"{kind} {name}"] = digest(record)
    return digests


def settings_of(point: OperatingPoint) -> dict[str, Any]:
    """Return the settings of a condition that a promise does not choose, those that are not None.

    They are values by flat name, as in records of runs.
    """
    record: Mapping[str, Any] = point.record()
    return {k: v for k, v in record.items() if v is not None and k not in CHOSEN}


def _every_setting(point: OperatingPoint) -> dict[str, Any]:
    """Return what `settings_of` does, and defaults of parts that records leave out, too:
    one that is typed brings its part's others into the record.
    """
    every = {RECORDED.get(key, key): point.setting(key) for key in part_of_settings()}
    return {k: v for k, v in every.items() if v is not None and k not in CHOSEN}


def names() -> list[str]:
    """Return the names of all files of `promises/`, those that ship and the project's."""
    return resources.names(FOLDER)


def file_of(name: str) -> Any:
    """Return the path of a promise's file, by its name. Raises UserError if it is unknown."""
    if name not in names():
        raise unknown("promise", name, names(), "; `harness study promise --write` makes one")
    return resources.find(FOLDER, f"{name}.toml")


def promise(name: str) -> Promise:
    """Load a promise by the name of its file. Raises UserError if it is unknown or wrong."""
    return _read(file_of(name))


@read_once
def _read(path: Any) -> Promise:
    where = f"promise file {printable(path)}"
    table = toml(path, where)
    for name in ("parameters", "setup"):
        if name not in table:
            raise UserError(
                f"{where}: it has no [{name}], without which a promise says not of what it is; "
                "make it again"
            )
    record = convert(table, Promise, where)
    check_seeds(where, WHAT, record.first_seed, record.last_seed)
    if not all(LEAST <= share < 1 for share in (record.at_most, record.delta)):
        raise UserError(
            f"{where}: at_most and delta are shares between {LEAST:g} and 1; make it again"
        )
    layouts, seeds = record.last_seed - record.first_seed + 1, record.channel_seeds
    if record.units > layouts:
        raise UserError(
            f"{where}: {record.units} layouts are more than {layouts} layout seeds; make it again"
        )
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise UserError(
            f"{where}: channel_seeds are {printable(seeds, 40)}; allowed: different whole numbers, "
            "0 or more, at least one; make it again"
        )
    p = least_p(record.mean_harm, record.units, record.at_most)
    if p > record.delta:
        needed = units_needed(record.at_most, record.delta)
        raise UserError(
            f"{where}: a mean harm of {record.mean_harm:g} on {record.units} layouts promises no "
            f"{record.at_most:g} (p = {p:.2g}, above delta = {record.delta:g}; needed: "
            f"{needed} layouts, all without harm, or more); make it again"
        )
    return record
