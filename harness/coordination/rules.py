"""Find consensus rules by name, those that other packages add included.

A package adds a rule by an entry point in the group `swarmdrive.rules`; `Pool` makes a rule of a
function of (p, weights). `ego-prompt` is no rule: a fusion call asks the ego's model with the
messages in its prompt (the paper's section III-C).
"""

from harness.coordination.consensus import Pool, Rule, linear_pool, log_pool, median, trimmed_mean
from harness.coordination.contents import INTENTS, PLANS, WORDS
from harness.coordination.robust import HEADS
from harness.coordination.trust import Trust
from harness.core.plugins import Plugins

POOLS = {
    "linear": linear_pool,
    "log-pool": log_pool,
    "median": median,
    "trimmed-mean": trimmed_mean,
}
RULES: Plugins[Rule] = Plugins(
    "swarmdrive.rules",
    Rule,
    {**{name: Pool(pool) for name, pool in POOLS.items()}, **HEADS, "trust": Trust()},
)
EGO_PROMPT = "ego-prompt"


def reads(name: str) -> frozenset[str]:
    """Return what messages may carry for a consensus rule to use them: any one of these kinds.

    A consensus rule fuses what the ego hears. The kinds, such as intents or words, are listed in
    `contents.KINDS`. `name` is a value of the setting `consensus`: the name of a rule, or
    `ego-prompt`, by which the ego's model is asked again with the messages.
    """
    if name == EGO_PROMPT:
        return frozenset((WORDS, PLANS))
    of_agents = PLANS in getattr(RULES[name], "needs", ())
    return frozenset((PLANS,) if of_agents else (INTENTS,))


def names() -> tuple[str, ...]:
    """Return the allowed values of the setting `consensus`: all rules, and `ego-prompt`.

    A rule fuses intents by a formula; by `ego-prompt` the ego's model is asked again with them.
    """
    return (*RULES, EGO_PROMPT)
