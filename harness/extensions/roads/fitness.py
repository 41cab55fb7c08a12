"""Choose moments of a recording at which its own driver succeeds, among others who react."""

from collections.abc import Iterable, Set
from dataclasses import dataclass
from functools import lru_cache

from msgspec import structs

from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, sha256_bytes
from harness.core.progress import Progress
from harness.core.seeds import FIRST
from harness.dataset.select import spot_check
from harness.extensions.roads.driver import NAME
from harness.extensions.roads.family import in_memory
from harness.extensions.roads.held import horizon_s
from harness.extensions.roads.moments import NOT_REACHED, Choice, Chooser, Key, key_of
from harness.extensions.roads.scene import Scene
from harness.extensions.roads.tables import FACTS, Moment, Recording
from harness.extensions.roads.world import scenario
from harness.world.reference import drive

DRIVEN = 30  # of a recording's moments


def choose_fit(
    recording: Recording,
    scenes: Iterable[Scene],
    until_s: float,
    progress: Progress,
    mastered_keys: Set[Key] = frozenset(),
) -> Choice:
    """Return the moments of a recording that are chosen and its recorded driver masters.

    Of those chosen, each is driven; without those at which the driver fails, it is chosen again,
    until it fails at none. `scenes` are the recording's, read once, and `until_s` is the time
    that an episode needs. The recording has the window, the target speeds and the period.
    `progress` is told of each moment that is driven; those of `mastered_keys` are not.
    """
    chooser = Chooser(recording.window_m, until_s, by_file=recording.is_former)
    for scene in scenes:
        chooser.look(scene)
    passed = set(mastered_keys)
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


@lru_cache(maxsize=16)
def other_choice(recording: Recording) -> str | None:
    """Return what a recording states of its moments that its rule does not give; None if nothing.

    The rule chooses again. Of stated moments up to `DRIVEN`, which nobody else can foresee, are
    driven, and so are others that it would choose: a second for some ten. Whoever drives the other
    stated ones is taken to reach the goal, and in released recordings everybody is.
    """
    stated_keys = {key_of(moment) for moment in recording.moments}
    until_s = horizon_s(recording.facts)
    choice = choose_fit(recording, recording.scenes(), until_s, Progress(), stated_keys)
    keys = {key_of(moment) for moment in choice.moments}
    words = f"recording {printable(recording.folder / FACTS)} states "
    count = 0 if recording.is_former else DRIVEN
    for number in spot_check(range(len(recording.moments)), recording.digest, count):
        moment = recording.moments[number]
        if not is_mastered(recording, moment):
            return f"{words}a moment of {_text(key_of(moment))}, and {NOT_REACHED}"
    for key in sorted(keys - stated_keys):
        return f"{words}no moment of {_text(key)}, which its rule chooses"
    for key in sorted(stated_keys - keys):
        return f"{words}a moment of {_text(key)}, which its rule does not choose"
    if recording.moments != choice.moments:
        return f"{words}its moments in another order than that of its rule"
    for name, value in choice.record.items():
        if recording.choice.get(name) != value:
            return f"{words}another {name} of its choice than its moments have"
    return None


def _text(key: Key) -> str:
    scene, vehicle, time_s = key
    return f"{printable(scene, 60)}, {printable(vehicle, 60)} at {time_s:g} s"


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
