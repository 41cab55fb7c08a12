"""The setting `calibration` of a condition:
all answers are corrected before anything is made of them.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from harness.coordination.intents import Intents
from harness.coordination.parts import Kept, Part, RunFacts, Text, wrong
from harness.core.errors import printable
from harness.core.files import sha256_file
from harness.extensions.calibration.calibrations import FOLDER, calibration, file_of, names

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint


class Calibrated(Part, frozen=True, kw_only=True):
    """Hold the setting `calibration` of an operating point: what corrects all answers before use.

    It is the name of a file of `calibrations/`, fitted for the run's model, prompt and scenario;
    empty corrects nothing. An operating point is the settings of radio, asking and fusion. Methods
    are the hooks of `Part`, a group of such settings. `behind` is the setting after which it stands
    in records, `of_ego` says that it matters to an ego that asks nobody, and `named` has what
    returns the names that there are.
    """

    behind: ClassVar[str] = "content"
    of_ego: ClassVar[bool] = True
    named: ClassVar = {"calibration": names}

    # name of a file of `calibrations/`, which corrects every answer before all else; empty for none
    calibration: Text = ""

    def check(self) -> None:
        if self.calibration:
            calibration(self.calibration)

    def check_with(self, point: "OperatingPoint") -> None:
        if point.has_fusion_call:
            allowed = (
                f"left out where {point.asks_twice}, which asks twice: the second question has no "
                "fit"
            )
            raise wrong("calibration", self.calibration, allowed)

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        fitted, what = calibration(self.calibration), f"calibration {printable(self.calibration)}"
        for agent in run.agents:
            if reason := fitted.obstacle(agent.settings(), run.scenario):
                return f"{what} {reason}; fit one with `harness model calibrate`"
        if point.asks and fitted.helper is None and not run.ego_alone:
            return f"{what} was fitted on no helper's answer; fit one on a run with --ask all"
        return None

    def obstacle_of_models(self, identities: Sequence[Mapping[str, Any]]) -> str | None:
        reason = calibration(self.calibration).obstacle_of_models(identities)
        what = f"calibration {printable(self.calibration)}"
        return reason and f"{what} {reason}; fit one with `harness model calibrate`"

    def kept(self) -> Mapping[str, Mapping[str, Kept]]:
        file = file_of(self.calibration)
        return {FOLDER: {self.calibration: Kept(sha256_file(file), file)}}

    def before(self, intents: Intents) -> Intents:
        return calibration(self.calibration).of(intents)
