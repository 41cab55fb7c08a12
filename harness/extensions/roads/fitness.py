"""Choose moments of a recording at which its own driver succeeds, among others who react."""

from collections.abc import Iterable
from dataclasses import dataclass

from msgspec import structs

from harness.core.errors import UserError
from harness.core.files import canonical_json, sha256_bytes
from harness.core.progress import Progress
from harness.core.seeds import FIRST
from harness.extensions.roads.driver import NAME
from harness.extensions.roads.family import in_memory
from harness.extensions.roads.moments import NOT_REACHED, Choice, Chooser, Key, key_of
from harness.extensions.roads.tables import Moment, Recording, Scene
from harness.extensions.roads.world import scenario
from harness.world.reference import drive


def choose_fit(
    recording: Recording, scenes: Iterable[Scene], horizon_s: float, progress: Progress
) -> Choice:
    """Return the moments of a recording that are chosen and its recorded driver masters.

    Of those chosen, each is driven; without those at which the driver fails, it is chosen again,
    until it fails at none. `scenes` are the recording's, read once, and `horizon_s` is the time
    that an episode needs. The recording has the window, the target speeds and the period.
    `progress` is told of each moment that is driven.
    """
    chooser = Chooser(recording.window_m, horizon_s)
    for scene in scenes:
        chooser.look(scene)
    passed: set[Key] = set()
    choice = chooser.choice()
    while rest := [moment for moment in choice.moments if key_of(moment) not in passed]:
        progress.more(len(rest))
        failed: set[Key] = set()
        for moment in sorted(rest, key=key_of):  # those of one scene together
            (passed if is_mastered(recording, moment) else failed).add(key_of(moment))
            progress(1)
        chooser.drop(failed, NOT_REACHED)
        choice = chooser.choice()
    return choice


@dataclass(frozen=True, eq=False)
class OneMoment(Recording):
    """Hold a recording that is in memory, of one scene and one moment."""

    whole: Recording | None = None  # from which it is

    def scene(self, name: str) -> Scene:
        assert self.whole is not None
        return self.whole.scene(name)


def is_mastered(recording: Recording, moment: Moment) -> bool:
    """Return whether the recorded driver reaches the goal at a moment, unhurt and in time."""
    first = structs.replace(moment, purpose="tune")
    facts = structs.replace(recording.facts, moments=(first,))
    digest = sha256_bytes(canonical_json([recording.digest, *key_of(moment)]).encode())
    alone = OneMoment(recording.folder, digest, facts, whole=recording)
    with in_memory(alone) as name:
        try:
            return drive(scenario(name), NAME, FIRST["tune"]).success
        except UserError:  # where it is recorded, the map has no way
            return False
