"""The settings `careful_nats` and `promise` of a condition:
when the ego is careful, and what that promises.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from harness.coordination.parts import Kept, Part, RunFacts, Text, wrong
from harness.coordination.trigger import entropy_nats
from harness.core.arrays import Floats
from harness.core.errors import printable
from harness.core.files import sha256_file
from harness.extensions.promise.promises import FOLDER, Nats, file_of, names, promise

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint

_AGAIN = "make one with `harness study promise`"


class Careful(Part, frozen=True, kw_only=True):
    """Hold the settings of an ego that is careful where it is unsure, and of the promise on that.

    They belong to an operating point, which has those of radio, asking and fusion. Methods are the
    hooks of `Part`, a group of such settings. `behind` is the setting after which they stand in
    records, `of_ego` says that they matter to an ego that asks nobody, and `named` has what returns
    the names that there are.
    """

    behind: ClassVar[str] = "content"
    of_ego: ClassVar[bool] = True
    named: ClassVar = {"promise": names}

    # entropy of the policy, in nats, from which the ego takes its most careful action, the first;
    # 0 is always, None never
    careful_nats: Nats | None = None
    # name of a file of `promises/`, which sets `tau_nats` and `careful_nats`; empty for none
    promise: Text = ""

    def check(self) -> None:
        if self.promise:
            promise(self.promise)

    def implies(self) -> Mapping[str, Any]:
        return promise(self.promise).implied if self.promise else {}

    def check_with(self, point: "OperatingPoint") -> None:
        if not self.promise:
            return
        where = f"where promise is {printable(self.promise)}"
        for key, value in self.implies().items():
            if point.setting(key) != value:
                allowed = "left out" if value is None else f"left out, or {value},"
                raise wrong(key, point.setting(key), f"{allowed} {where}")
        if other := promise(self.promise).other_setting(point):
            key, now, then = other
            allowed = "left out" if then in (None, "") else printable(then)
            thresholds = [f"{n}={v:g}" for n, v in self.implies().items() if v is not None]
            raise wrong(
                key,
                now,
                f"{allowed} {where}, which was made so; to vary it without what is promised, give "
                f"{','.join(thresholds)} in place of the promise",
            )

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        if not self.promise:
            return None
        what, file = f"promise {printable(self.promise)}", promise(self.promise)
        if run.several_decide:
            return f"{what} is of one ego; leave out --agents"
        for agent in run.agents:
            settings = agent.settings()
            if reason := file.obstacle(settings, run.scenario):
                version = printable(settings["prompt"]["version"], 40)
                return f"{what} {reason}; {_AGAIN}, of runs of this model with --prompt {version}"
        setup = {"ties": run.ties, "temperature": run.temperature, "flip": run.agents[0].flip}
        reason = file.obstacle_of_setup(point, **setup)
        return reason and f"{what} {reason}; {_AGAIN}"

    def obstacle_of_models(self, identities: Sequence[Mapping[str, Any]]) -> str | None:
        if not self.promise:
            return None
        reason = promise(self.promise).obstacle_of_models(identities)
        return reason and f"promise {printable(self.promise)} {reason}; {_AGAIN}"

    def kept(self) -> Mapping[str, Mapping[str, Kept]]:
        if not self.promise:
            return {}
        file = file_of(self.promise)
        return {FOLDER: {self.promise: Kept(sha256_file(file), file)}}

    def after_fusion(self, policies: Floats) -> Floats:
        if self.careful_nats is None:
            return policies
        careful = np.zeros_like(policies)
        careful[..., 0] = 1.0
        unsure = entropy_nats(policies) >= self.careful_nats
        return np.where(unsure[..., None], careful, policies)
