"""Where the numbers of a run or suite come from, a function a fact;
`findings` has them in their order.
"""

from collections.abc import Callable, Iterable, Iterator

from harness.backends.registry import is_from_file
from harness.core.errors import UserError, printable
from harness.core.figures import Unit
from harness.core.plugins import Plugins
from harness.report.apart import said_of
from harness.runs.estimates import written
from harness.runs.folder import Run
from harness.runs.metric_names import ALL
from harness.runs.records import Latency, Score, role_word, roles
from harness.runs.suite import SuiteRun
from harness.runs.timers import timer

Shown = Run | SuiteRun
# What extensions say of a run's or a suite's figures: lines for people.
NOTES: Plugins[Callable[[Shown], Iterable[str]]] = Plugins("swarmdrive.notes", Callable, {})


def pace(run: Shown) -> Iterator[str]:
    """Yield lines on how long prefill and decode take, by role, measured at batch size 1.

    Prefill is reading the prompt, decode writing the answer. TTFT is the time to first token, TPOT
    the time for each further token, as medians and 95th percentiles in ms. They are of the run's
    own answers, else of those its latency was measured with.
    """
    manifest = run.manifest
    measured_here = {role: took for role, took in manifest.answer_times.items() if took.first_token}
    for role, took in (manifest.latency.sample | measured_here).items():
        first, word = took.first_token, printable(role_word(role))
        if first is None:
            continue
        if first.n == took.n and took.median_s:
            share = 100 * first.median_s / took.median_s
            text = f"{share:.0f} % of the median answer is prefill"
            yield f"{word}: {text} (batch 1, measured where it ran)"
        for name, times in (("TTFT", first), ("TPOT", took.token)):
            if times:
                median = _milliseconds(times.median_s, times.median_ci_s)
                p95 = _milliseconds(times.p95_s, times.p95_ci_s)
                tail = f", p95 {p95}" if times.n > 1 else ""
                yield f"  {word} {name} {median} ms{tail}, n = {times.n}"


def _milliseconds(seconds: float, ends: tuple[float, float] | None) -> str:
    """Return milliseconds with a decimal, two below ten, and their interval where there is one."""
    unit = Unit("ms", 1 if seconds >= 0.01 else 2, 1000.0)
    return unit.interval(seconds, *ends) if ends else unit.number(seconds)


def latency(run: Shown) -> Iterator[str]:
    """Yield a line on the inference times, in ms, by which decisions are timed.

    It says where they come from, too.
    """
    yield f"latency: {latency_source(run.manifest.latency)}"


def latency_source(latency: Latency) -> str:
    """Return a phrase with the inference times of ego, helpers and fusion, in ms, and their source.

    A time is that of one answer of the model; the source is such as the model's file or the paper.
    """
    source = {
        "measured": "measured on the machine of the run, before it",
        "card": "stated by the model card, not measured here",
        "paper": "the paper's, not measured here",
        "declared": "declared by the user, not measured here",
    }.get(latency.source)
    source = source or timer(latency.source).how
    if latency.ego_s is None or latency.fusion_s is None:
        return f"{source} ({printable(latency.basis)})"
    by_role = {
        "ego": (latency.ego_s,),
        "helper": latency.helper_times_s(),
        "ego with messages": (latency.fusion_s,),
    }
    times = []
    for role, seconds in by_role.items():
        milliseconds = [f"{second * 1000:.0f}" for second in seconds]
        times.append(f"{role} {' or '.join(milliseconds)} ms")
    return f"{', '.join(times)}; {source} ({printable(latency.basis)})"


def of_extensions(run: Shown) -> Iterator[str]:
    """Yield the sentences that extensions add on how to read the figures of a run or suite.

    For an extension that fails, it is its error. A suite is a run on each of several scenarios.
    """
    for name in NOTES:
        try:
            yield from said_of(NOTES, name, run)
        except UserError as error:
            yield str(error)


def answer_times(run: Shown) -> Iterator[str]:
    """Yield a line for each role on how long its answers took when the run was made, in ms.

    A role is who answered: `ego`, `helper` or `merge` (the ego after it heard messages). These
    times are not those that latency is computed from.
    """
    from_file = is_from_file(run.manifest.answerers)
    source = ", as their file states" if from_file else ""
    for role, took in run.manifest.answer_times.items():
        median_ms = f"{1000 * took.median_s:.1f} ms"
        spread_ms = f"5-95 %: {1000 * took.p5_s:.1f} to {1000 * took.p95_s:.1f}"
        times = f"{median_ms} ({spread_ms}, n = {took.n})"
        yield f"{printable(role_word(role))} answers took {times}{source}; not used as latency"


def cost(run: Shown) -> Iterator[str]:
    """Yield a line for each model on what its answers cost, in the currency of its price list."""
    for model, cost in (run.manifest.cost or {}).items():
        left_out = f", {cost.uncounted} of which are not in it" if cost.uncounted else ""
        yield (
            f"cost: {cost.amount:.4g} {printable(cost.currency)} for {cost.asked} questions to "
            f"{printable(model, 40)}{left_out}"
        )


def cached(run: Shown) -> Iterator[str]:
    """Yield a line on how many answers an earlier run had stored, so that no model was asked.

    It yields none without any.
    """
    if n := run.manifest.cached_answers:
        yield f"{n} answers came from the cache (--no-cache asks the model again)"


def readings(run: Shown) -> Iterator[str]:
    """Yield lines on how each role's answers were parsed: shares by verdict, repairs and read-outs.

    A verdict is `strict`, `recovered` (after repairs) or `failed`; a read-out is an answer by one
    letter per action. For a suite, runs on several scenarios, shares are means over these.
    """
    means = ", as means over families" if isinstance(run, SuiteRun) else ""
    for role in roles():
        for line in _of_role(run, role):
            yield f"{role_word(role)} {line}{means}"


def _of_role(run: Shown, role: str) -> Iterator[str]:
    verdicts = ("strict", "recovered", "failed")
    shares = [run.score(ALL, f"{verdict}_rate_{role}") for verdict in verdicts]
    if shares[0] is not None:
        percents = [f"{100 * (share.value or 0):.1f}" for share in shares if share is not None]
        yield f"answers {' / '.join(verdicts)}: {' / '.join(percents)} % of {shares[0].n}"
    if divided := run.score(ALL, f"divided_rate_{role}"):
        yield f"answers divided by their sum: {100 * (divided.value or 0):.1f} % of {divided.n}"
    if mass := run.score(ALL, f"label_mass_{role}"):
        yield f"read-outs: {_letters(run, role)}; mass on the letters {mass.value or 0:.2f}"
    for when in ("at_first", "after_repair"):
        if turn := run.score(ALL, f"valid_{when}_rate_{role}"):
            yield f"answers valid {when.replace('_', ' ')}: {written(turn)} % of {turn.n}"


def _letters(run: Shown, role: str) -> str:
    """Return what a role's read-outs owe to the letters and to the order of the list of actions."""
    share = run.score(ALL, f"letter_share_{role}")
    follows = run.score(ALL, f"follows_letter_{role}")
    text = "letters read once"
    if share and follows:
        percent = f"{100 * (share.value or 0):.0f} % follows the letter"
        text = f"{percent}, the likeliest action in {_hits(follows)} of {follows.n}"
    if flip := run.score(ALL, f"flip_rate_{role}"):
        text += f"; the reversed list changes the likeliest action in {_hits(flip)} of {flip.n}"
    return text


def _hits(share: Score) -> int:
    return round((share.value or 0) * share.n)
