"""The dataset and the scenes that were taken by default until 0.3;
figures of many tests are of these.
"""

from harness.world import scenarios
from harness.world.scenario import Scenario

DATASET = "occluded-intersection-v2"
SETTINGS = "witnesses=any,radio_share=0,limits=1,perception=1"
NAME = f"{scenarios.DEFAULT}:{SETTINGS}"
DRIVE = ("drive", "--scenario", NAME)  # words of a command


def scenes(name: str = scenarios.DEFAULT) -> Scenario:
    """A scenario as its bare name was until then."""
    return scenarios.get(f"{name}:{SETTINGS}")


SCENARIO = scenes()
