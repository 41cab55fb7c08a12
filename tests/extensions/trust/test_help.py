"""The help of `harness study trust`."""

import re
from collections.abc import Callable

from harness.coordination.contents import INTENTS
from harness.coordination.rules import RULES, reads
from harness.extensions.trust.attacks import ATTACKS

Said = tuple[int, str, str]


def test_the_help_of_trust_names_every_attack_and_rule(harness: Callable[..., Said]) -> None:
    said = set(
        re.findall(r"[a-z-]+", re.sub(r"-\n +", "-", harness("study", "trust", "--help")[1]))
    )
    assert {*ATTACKS, *(rule for rule in RULES if INTENTS in reads(rule))} <= said
