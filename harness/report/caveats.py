"""What must be said before a run's numbers: that its answers were not read, or that it read no prompt."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from harness.backends.registry import reads_prompts
from harness.core.errors import UserError, printable
from harness.core.figures import PERCENT, amount
from harness.core.plugins import Plugins
from harness.parsing.status import Status
from harness.prompts.readout import MOST_SHARE
from harness.runs import contradictions, doubts, pinned
from harness.runs.folder import Run
from harness.runs.listing import UNREAD
from harness.runs.metrics import ALL, BALANCED, GAINS, entry
from harness.runs.records import ClosedLoop, Manifest, Score
from harness.runs.unanswered import tally
from harness.world.drivers import BLIND
from harness.world.parameters import Parameters

# What extensions say of a run: sentences for people.
CAVEATS: Plugins[Callable[[Manifest], Iterable[str]]] = Plugins("swarmdrive.caveats", Callable, {})
FEW = 100  # episodes; with fewer a page warns of wide intervals
# By role: whose answers, and what takes their place.
_FAILED = {
    "ego": ("the ego's", "it drives by the fallback, and success says little about the model"),
    "helper": ("the helpers'", "they send no message"),
    "merge": ("the fusion calls'", "the ego keeps the policy it had without them"),
}
_CONTROLS = {
    "shuffled": "what helpers say in another layout, while a decision's page shows what its own helpers say",
    "blind": "helpers that are shown nothing",
}


def caveats(manifest: Manifest, scores: Sequence[Score]) -> list[str]:
    """Return sentences for a run's headline; none for a language model whose answers could be read."""
    first = [*unread(scores), *no_prompt([manifest]), *of_extensions(manifest), *moved_system(manifest)]
    first += by_letter(scores)
    return [*first, *beyond_sources(manifest), *on_device(manifest), *looked_at(manifest)]


def looked_at(manifest: Manifest) -> Iterator[str]:
    """Yield when a run was looked at, and which of its intervals hold though it may have stopped early."""
    looks = manifest.world.looks
    if looks is None:
        return
    what = (
        f"success is known within {100 * looks.width:g} points"
        if looks.width is not None
        else f"success differs from that of {printable(looks.against, 40)}"
    )
    every = f"all {looks.layouts} layouts" if looks.layouts > 1 else "the only layout"
    how = (
        f"It stopped after {looks.at[-1]} of {amount(looks.layouts, 'layout')}, when"
        if looks.enough
        else f"It took {every}, and still it is not so that"
    )
    yield (
        f"{how} {what} in every condition. It was looked at {amount(len(looks.at), 'time')}: intervals of "
        "success and of its gain hold at every look; all others are for a number of layouts fixed before, "
        "and too narrow."
    )


def merged(runs: Mapping[str, Run], of: Callable[[Run], Iterable[str]]) -> list[str]:
    """Return the caveats of runs, each sentence once, with the names of those it is about if not of all."""
    about: dict[str, list[str]] = {}
    for name, run in runs.items():
        for sentence in of(run):
            about.setdefault(sentence, []).append(name)
    return [
        sentence if len(names) == len(runs) else f"{', '.join(names)}: {sentence}"
        for sentence, names in about.items()
    ]


def unread(scores: Sequence[Score]) -> Iterator[str]:
    """Yield whose answers could not be read, half of them or more, and what takes their place."""
    failed = {s.metric: s for s in scores if s.condition == ALL}
    for role, (whose, instead) in _FAILED.items():
        score = failed.get(f"failed_rate_{role}")
        if score is not None and score.value is not None and score.value >= UNREAD:
            share = "None" if score.value == 1 else f"Only {100 * (1 - score.value):.1f} %"
            yield f"{share} of {whose} {score.n} answers could be read: {instead}."


def void(run: Run) -> Iterator[str]:
    """Yield why the numbers of a run are no result."""
    yield from unanswered(run)
    yield from unread(run.scores)


def causes(run: Run) -> Iterator[str]:
    """Yield how many of each role's answers could not be read, and the commonest cause of it."""
    meanings = {str(status): status.meaning for status in Status}
    rates = {role: run.score(ALL, f"failed_rate_{role}") for role in _FAILED}
    for role in [role for role, rate in rates.items() if rate and rate.value]:
        failed, n = run.answered.failed.get(role, Counter()), run.answered.count[role]
        for status, count in failed.most_common(1):
            meaning = meanings.get(status, "it is not said").rstrip(".")
            yield (
                f"{failed.total()} of {_FAILED[role][0]} {n} answers could not be read. The "
                f"commonest cause, {count} of {failed.total()}: {meaning[0].lower()}{meaning[1:]} "
                f"({printable(status, 30)})."
            )


def unanswered(run: Run) -> Iterator[str]:
    """Yield what the questions said that got no answer, where a run cannot do without."""
    if (tallied := tally(run)).missing:
        yield f"{tallied}: the model could not be asked, so that this is no result."


def _saturated(run: Run) -> Iterator[str]:
    """Yield each half of balanced success that is 0 or 100 % under every condition, as it can say nothing."""
    for name, where in zip(entry(BALANCED).halves, ("With a danger", "Without a danger"), strict=True):
        scores = [run.score(condition, name) for condition in run.conditions]
        values = {None if score is None else score.value for score in scores}
        if values in ({0.0}, {1.0}) and len(scores) > 1:
            same = PERCENT.text(values.pop())
            layouts = amount(max(score.n for score in scores if score), "layout")
            yield (
                f"{where}, success is {same} under every condition in {layouts}: none changes that half of "
                "the balance here. In other layouts one may, by as much as the interval of its gain says."
            )


def of_run(run: Run) -> Iterator[str]:
    """What else a reader of a run's page has to know first: few episodes, a stumbling engine, another lag."""
    n = len(run.grid.episodes)
    if n < FEW:
        reach = f"{98 / n**0.5:.0f} points to either side"
        yield f"Only {amount(n, 'episode')}: the interval of a rate may reach {reach}."
    yield from _saturated(run)
    if any(score.metric in GAINS.values() and score.interval == pinned.KIND for score in run.scores):
        yield "Gains have the wider intervals of an earlier version, as the run wrote them."
    yield from contradictions.unchecked(run)
    if run.manifest.settings.temperature:
        yield (
            f"Answers were sampled at temperature {run.manifest.settings.temperature:g} with sampling seed "
            f"{run.manifest.settings.sampling_seed}: another seed gives other answers."
        )
    for role, (whose, _) in _FAILED.items():
        if run.manifest.sums == "divide" and (score := run.score(ALL, f"divided_rate_{role}")):
            yield (
                f"{round((score.value or 0.0) * score.n)} of {whose} {score.n} answers did not sum to 1 and "
                "were divided by their sum, as --sums divide says."
            )
        if score := run.score(ALL, f"flip_rate_{role}"):
            yield (
                f"{round((score.value or 0.0) * score.n)} of {whose} {score.n} read-outs have another "
                "likeliest action when the list of actions is reversed."
            )
    retries = sum(answer.retries for answer in run.answers)
    if (tallied := tally(run)).words and not tallied.missing:
        yield f"{tallied}: each counts as a lost message."
    if retries:
        yield f"The engine had errors: {retries} attempts were repeated."
    for control, heard in _CONTROLS.items():
        if names := doubts.controls(run.manifest.conditions, control):
            yield f"{', '.join(map(printable, names))} is a control: the ego hears {heard}."
    yield from unheard(run)
    yield from lost_at_once(run)
    yield from of_extensions(run.manifest)
    yield from by_letter(run.scores)
    yield from moved_system(run.manifest)
    yield from beyond_sources(run.manifest)
    yield from on_device(run.manifest)
    if off := doubts.lagging(_off_lag(run)):
        yield (
            f"Under {', '.join(off)}, most decisions take longer than these frozen scenes assume: "
            "closed-loop success may differ. harness study fidelity compares the two."
        )
    if all(e.short_ttc is None for e in run.episodes):
        older = "dataset" if run.world == "frozen" else "run"
        yield (
            f"Time to collision and post-encroachment time are unknown: this {older} is older than these "
            "measures."
        )


def doubted(*runs: Run) -> set[str]:
    """Return the conditions of these runs that a warning is about."""
    return {
        name
        for run in runs
        for name in doubts.doubted(run.manifest.conditions, _channels(run.manifest), _off_lag(run))
    }


def _off_lag(run: Run) -> dict[str, float | None]:
    scores = {c: run.score(c, doubts.OFF_LAG) for c in run.conditions}
    return {c: score.value for c, score in scores.items() if score}


def _channels(manifest: Manifest) -> dict[str, doubts.Channel]:
    return {name: (record.parameters, record.limits) for name, record in manifest.channels.items()}


def of_extensions(manifest: Manifest) -> Iterator[str]:
    """Yield what extensions say of a run; one that fails says so itself."""
    for name in CAVEATS:
        try:
            yield from CAVEATS.ask(name, lambda of: list(map(str, of(manifest))))
        except UserError as error:
            yield str(error)


def by_letter(scores: Sequence[Score]) -> Iterator[str]:
    """Yield whose read-outs follow the letter more than all else, where they were read over cyclic orders."""
    of = {s.metric: s for s in scores if s.condition == ALL}
    for role, (whose, _) in _FAILED.items():
        share, follows = of.get(f"letter_share_{role}"), of.get(f"follows_letter_{role}")
        if share and follows and (share.value or 0.0) > MOST_SHARE:
            hits = round((follows.value or 0.0) * follows.n)
            yield (
                f"{100 * (share.value or 0.0):.0f} % of what {whose} read-outs say follows the letter and "
                f"not the action: one letter is the likeliest in every order in {hits} of {follows.n}. The "
                "average over the orders cancels that, and adds no judgement."
            )


def unheard(run: Run) -> Iterator[str]:
    """Yield the conditions under which replies arrive, and every one of them too late to be heard."""
    d = run.decisions
    delivered, on_time = (d.of_messages(name) == 1.0 for name in ("delivered", "on_time"))
    conditions = d.codes("condition", run.conditions)
    for place, name in enumerate(run.conditions):
        arrived = int(delivered[conditions == place].sum())
        if arrived and not on_time[conditions == place].any():
            yield (
                f"Under {printable(name)}, nobody is heard: of {arrived} messages that arrived, none came "
                "within the decision window, so that the ego decided alone."
            )


def lost_at_once(run: Run) -> Iterator[str]:
    """That episodes are lost before the ego's first action, so that no model could have saved them."""
    world = run.manifest.world
    if isinstance(world, ClosedLoop):
        lag_s = world.scenario["parameters"].get("decision_lag_s", Parameters.decision_lag_s)
    else:
        lag_s = world.decision_lag_s
    ended = [(e.episode, e.failure == "collision" and (e.time_s or math.inf) <= lag_s) for e in run.episodes]
    lost = {episode for episode, at_once in ended if at_once}
    lost -= {episode for episode, at_once in ended if not at_once}
    if lost:
        yield (
            f"{len(lost)} of {len(run.grid.episodes)} episodes are lost before the ego's first action, in a "
            "collision that no answer could prevent."
        )


def moved_system(manifest: Manifest) -> Iterator[str]:
    """Yield whose system text stands in the first user turn, since the chat template has no place for it."""
    agents = (manifest.agent(0), *manifest.helpers)
    for name in dict.fromkeys(str(a["model"]["name"]) for a in agents if a["model"].get("system")):
        yield (
            f"{printable(name, 30)} reads the system text at the beginning of the first user turn: its chat "
            "template has no place for a system message."
        )


def on_device(manifest: Manifest) -> Iterator[str]:
    """Whose answers, and on what computer, the times and the joules of a run with a device profile are of."""
    if (device := manifest.device_profile) is None:
        return
    agents = (manifest.agent(0), *manifest.helpers)
    for agent, speed in zip(agents, manifest.latency.speeds, strict=True):
        name = str(agent["model"]["name"])
        if name.partition(":")[0] != speed.model:
            yield (
                f"Times and energy are conditional: the token counts are those of {printable(name, 30)}, the "
                f"speed is that of {printable(speed.model)} on {printable(device.name)}."
            )


def beyond_sources(manifest: Manifest) -> Iterator[str]:
    """Yield conditions whose radio has settings that its model's source never held against anything."""
    for name, sentence in doubts.beyond(manifest.conditions, _channels(manifest)):
        yield f"{printable(name)}: {sentence}"


def no_prompt(manifests: Iterable[Manifest]) -> list[str]:
    """A sentence about the models that read no prompt, and one about those that look at nothing either."""
    rules: dict[str, list[tuple[str, str]]] = {"by the scene graph": [], "without looking": []}
    for agent in (agent for manifest in manifests for agent in (manifest.agent(0), *manifest.helpers)):
        name, engine = str(agent["model"]["name"]), str(agent["model"].get("engine"))
        if not reads_prompts(engine):
            how = "without looking" if engine == "driver" and name in BLIND else "by the scene graph"
            rules[how].append((printable(name, 30), printable(str(agent["prompt"]["version"]), 20)))
    return [_no_prompt(how, *zip(*of, strict=True)) for how, of in rules.items() if of]


def _no_prompt(how: str, models: Sequence[str], prompts: Sequence[str]) -> str:
    *names, last = dict.fromkeys(models)
    versions = " or ".join(dict.fromkeys(prompts))
    if not names:
        return f"{last} reads no prompt: it decides {how}, whatever {versions} says."
    return f"{', '.join(names)} and {last} read no prompt: they decide {how}, whatever {versions} says."
