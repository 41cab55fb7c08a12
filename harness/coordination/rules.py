"""Find consensus rules by name, those that other packages add included.

A package adds a rule by an entry point in the group `swarmdrive.rules`; `Pool` makes a rule of a
function of (p, weights). `ego-prompt` is no rule: a fusion call asks the ego's model with the
messages in its prompt (the paper's section III-C).
"""

from harness.coordination.consensus import Pool, Rule, linear_pool, log_pool, median, trimmed_mean
from harness.coordination.precedence import PRECEDENCE
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
    {**{name: Pool(pool) for name, pool in POOLS.items()}, **HEADS, "trust": Trust(), **PRECEDENCE},
)
EGO_PROMPT = "ego-prompt"


def reads_plans(name: str) -> bool:
    """Return whether a rule reads what agents are themselves going to do, and no other intents."""
    return "plans" in getattr(RULES.get(name), "needs", ())


def names() -> tuple[str, ...]:
    """Return the allowed values of an operating point's `consensus`."""
    return (*RULES, EGO_PROMPT)
