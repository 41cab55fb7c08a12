"""What must be said before a run's numbers, a function a sentence;
`findings` has them in their order.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np

from harness.backends.registry import is_from_file, reads_prompts
from harness.coordination.part_settings import more_parts
from harness.core.errors import UserError, printable
from harness.core.figures import PERCENT, amount
from harness.core.places import text
from harness.core.plugins import Plugins
from harness.core.statistics import FEWEST, too_few
from harness.dataset.select import pick
from harness.parsing.status import Status
from harness.prompts.readout import MOST_SHARE
from harness.report.apart import said_of
from harness.runs import doubts, pinned
from harness.runs.alike import opened
from harness.runs.folder import Run
from harness.runs.headline import BALANCED
from harness.runs.listing import UNREAD
from harness.runs.metric_names import ALL, GAINS
from harness.runs.metrics import entry
from harness.runs.records import ClosedLoop, Manifest, Score
from harness.runs.unanswered import by_condition, tally
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


def stopped(run: Run) -> Iterator[str]:
    """Yield a sentence on a run that might stop early: when it was tested, which intervals hold.

    Such a run is tested after some of its layouts (start situations, one an episode): a rule says
    whether these are enough. Nothing is yielded for other runs.
    """
    record = run.manifest.world.interim_looks
    if record is not None and (rule := run.manifest.stopping_rule):
        yield rule.sentence(record)


def unread(run: Run) -> Iterator[str]:
    """Yield a sentence for each role of which at least half of the answers could not be parsed.

    A role is `ego`, `helper` or `merge` (the ego after it heard messages).
    """
    for role, (whose, instead) in _FAILED.items():
        score = run.score(ALL, f"failed_rate_{role}")
        if score is not None and score.value is not None and score.value >= UNREAD:
            share = "None" if score.value == 1 else f"Only {100 * (1 - score.value):.1f} %"
            yield f"{share} of {whose} {score.n} answers could be read: {instead}."


def causes(run: Run) -> Iterator[str]:
    """Yield for each role how many answers could not be parsed, and the commonest reason.

    A role is `ego`, `helper` or `merge` (the ego after it heard messages).
    """
    meanings = {str(status): status.meaning for status in Status}
    for role, (whose, _) in _FAILED.items():
        rate = run.score(ALL, f"failed_rate_{role}")
        if not rate or not rate.value:
            continue
        failed, n = run.answered.failed.get(role, Counter()), run.answered.count[role]
        for status, count in failed.most_common(1):
            meaning = meanings.get(status, "it is not said").rstrip(".")
            yield (
                f"{failed.total()} of {whose} {n} answers could not be read. The "
                f"commonest cause, {count} of {failed.total()}: {meaning[0].lower()}{meaning[1:]} "
                f"({printable(status, 30)})."
            )


def unanswered(run: Run) -> Iterator[str]:
    """Yield the errors of a run whose model left so many questions unanswered that it is invalid.

    They are the messages of the engine, which runs the model.
    """
    if (tallied := tally(run)).missing:
        yield f"{text(str(tallied))}: the model could not be asked, so that this is no result."


def few(run: Run) -> Iterator[str]:
    """Yield a warning on a run of fewer than `FEW` episodes: the interval of success is wide.

    Where layouts are cut from recordings, these are counted in place of episodes.
    """
    n, unit = len(run.grid.episodes), "episode"
    if run.clusters is not None:
        n, unit = len(np.unique(run.clusters)), "recording"
    if n < FEW:
        reach = f"{98 / n**0.5:.0f} points to either side"
        yield f"Only {amount(n, unit)}: the interval of a rate may reach {reach}."


def clustered(run: Run) -> Iterator[str]:
    """Yield how many recordings a run's layouts are cut from, which intervals count in their place.

    A layout is one start situation; those of one recording of traffic are alike. It also says which
    intervals so few do not allow. It yields nothing if each layout is drawn on its own.
    """
    clusters = run.clusters
    if clusters is None:
        return
    count = len(np.unique(clusters))
    lacking = ""
    if count == 1:
        lacking = " One does not tell how others differ: only shares have an interval, a wide one."
    elif too_few(clusters):
        lacking = (
            f" With fewer than {FEWEST}, percentiles and figures of calibration have no interval."
        )
    yield (
        f"{amount(len(clusters), 'layout')} of {amount(count, 'recording')}: layouts of one are "
        f"alike, so intervals count recordings.{lacking}"
    )


def saturated(run: Run) -> Iterator[str]:
    """Yield a sentence if success with a danger, or without, is always 0 or always 100 %.

    A danger is a vehicle that would meet an ego which keeps its speed. It must be so under every
    condition (set of settings that the run scores), of two or more.
    """
    halves = zip(entry(BALANCED).halves, ("With a danger", "Without a danger"), strict=True)
    for name, where in halves:
        scores = [run.score(condition, name) for condition in run.conditions]
        values = {None if score is None else score.value for score in scores}
        if values in ({0.0}, {1.0}) and len(scores) > 1:
            same = PERCENT.text(values.pop())
            layouts = amount(max(score.n for score in scores if score), "layout")
            yield (
                f"{where}, success is {same} under every condition in {layouts}: none changes that "
                "half of the balance here. In other layouts one may, by as much as the interval "
                "of its gain says."
            )


def earlier_gains(run: Run) -> Iterator[str]:
    """Yield a sentence if a run's intervals of gains are wider than they would be today.

    A gain is a condition's success less that of the condition without a radio; earlier versions of
    the harness computed its interval otherwise. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    gains = [score for score in run.scores if score.metric in GAINS.values()]
    if any(score.interval == pinned.KIND for score in gains):
        yield "Gains have the wider intervals of an earlier version, as the run wrote them."


def sampled(run: Run) -> Iterator[str]:
    """Yield the temperature and sampling seed if answers were sampled, not decoded greedily."""
    settings = run.manifest.settings
    if settings.temperature:
        yield (
            f"Answers were sampled at temperature {settings.temperature:g} with sampling seed "
            f"{settings.sampling_seed}: another seed gives other answers."
        )


def divided(run: Run) -> Iterator[str]:
    """Yield for each role how many answers did not sum to 1 and were divided by their sum.

    A role is `ego`, `helper` or `merge` (the ego after it heard messages).
    """
    for role, (whose, _) in _FAILED.items():
        if run.manifest.sums == "divide" and (score := run.score(ALL, f"divided_rate_{role}")):
            yield (
                f"{_hits(score)} of {whose} {score.n} answers did not sum to 1 and "
                "were divided by their sum, as --sums divide says."
            )


def flipped(run: Run) -> Iterator[str]:
    """Yield for each role how many read-outs change when the list of actions is reversed.

    A read-out is an answer by one letter per action. A role is `ego` or `helper`.
    """
    for role, (whose, _) in _FAILED.items():
        if score := run.score(ALL, f"flip_rate_{role}"):
            yield (
                f"{_hits(score)} of {whose} {score.n} read-outs have another "
                "likeliest action when the list of actions is reversed."
            )


def lost_messages(run: Run) -> Iterator[str]:
    """Yield a sentence with the engine's errors, if they left helpers without an answer.

    The engine is what runs the model. Such a helper counts as one whose message was lost on the
    radio, so the run stays valid; it yields nothing where so many answers are missing that it is
    not.
    """
    if (tallied := tally(run)).words and not tallied.missing:
        yield f"{text(str(tallied))}: each counts as a lost message."
        for name, of_condition in by_condition(run).items():
            if of_condition.missing:
                yield (
                    f"Where {printable(name)} asks, there is no answer to {of_condition.counts()}: "
                    "its figures are of so many more lost messages."
                )


def retried(run: Run) -> Iterator[str]:
    """Yield a sentence on how many requests to the model failed and were repeated."""
    if retries := run.manifest.retries:
        yield f"The engine had errors: {retries} attempts were repeated."


def controls(run: Run) -> Iterator[str]:
    """Yield the conditions that are controls: helpers' messages are replaced, to test cooperation.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    for kind in more_parts().values():
        for control, words in kind.controls.items():
            if names := doubts.under(run.manifest.conditions, control):
                yield f"{', '.join(map(printable, names))} is a control: the ego hears {words}."


def lagging(run: Run) -> Iterator[str]:
    """Yield a warning on conditions whose decisions mostly take longer than the outcomes are for.

    Recorded scenes know the outcome of an action that begins a fixed time after the decision, the
    lag. A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    if off := doubts.lagging(_off_lag(run)):
        yield (
            f"Under {', '.join(off)}, most decisions take longer than these frozen scenes assume: "
            "closed-loop success may differ. harness study fidelity compares the two."
        )


def unmeasured(run: Run) -> Iterator[str]:
    """Yield a sentence if the run, or its dataset, does not have TTC and PET.

    TTC is the time to a collision if vehicles go on as they are, PET the time between one leaving a
    place and another reaching it. Runs and datasets of earlier versions have neither.
    """
    if all(e.short_ttc is None for e in run.episodes):
        older = "dataset" if run.world == "frozen" else "run"
        yield (
            f"Time to collision and post-encroachment time are unknown: this {older} is older than "
            "these measures."
        )


def doubted(*runs: Run) -> set[str]:
    """Return the names of the conditions of some runs that a page warns about.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. A warning have controls (something replaces what helpers say), conditions with another
    lag from decision to action than the dataset's, and radios outside the range for which their
    channel model was validated.
    """
    names = set[str]()
    for run in runs:
        manifest = run.manifest
        names |= set(doubts.doubted(manifest.conditions, _channels(manifest), _off_lag(run)))
    return names


def _hits(share: Score) -> int:
    return round((share.value or 0.0) * share.n)


def _off_lag(run: Run) -> dict[str, float | None]:
    scores = {c: run.score(c, doubts.OFF_LAG) for c in run.conditions}
    return {c: score.value for c, score in scores.items() if score}


def _channels(manifest: Manifest) -> dict[str, doubts.Channel]:
    return {name: (record.parameters, record.limits) for name, record in manifest.channels.items()}


def of_extensions(run: Run) -> Iterator[str]:
    """Yield the warnings that extensions have on a run; for one that fails, its error message."""
    for name in CAVEATS:
        try:
            yield from said_of(CAVEATS, name, run.manifest)
        except UserError as error:
            yield str(error)


def by_letter(run: Run) -> Iterator[str]:
    """Yield a sentence for each role whose read-outs follow the option's letter, not its action.

    A read-out is an answer by one letter per action. It is known only of those that were averaged
    over several (cyclic) orders of the options.
    """
    for role, (whose, _) in _FAILED.items():
        share = run.score(ALL, f"letter_share_{role}")
        follows = run.score(ALL, f"follows_letter_{role}")
        if share and follows and (share.value or 0.0) > MOST_SHARE:
            yield (
                f"{100 * (share.value or 0.0):.0f} % of what {whose} read-outs say follows the "
                "letter and not the action: one letter is the likeliest in every order in "
                f"{_hits(follows)} of {follows.n}. The average over the orders cancels that, and "
                "adds no judgement."
            )


def unheard(run: Run) -> Iterator[str]:
    """Yield a warning on conditions under which messages arrive, but none in time to count.

    In time is within the decision window, the seconds from a decision's start in which replies
    count. A condition is a named set of settings of the radio, of asking helpers and of fusing
    their messages.
    """
    n_arrived, n_on_time = Counter[str](), Counter[str]()
    for d in run.decisions.pieces():
        delivered, on_time = d.of_messages("delivered") == 1.0, d.of_messages("on_time") == 1.0
        conditions = d.codes("condition", run.conditions)
        for place, name in enumerate(run.conditions):
            n_arrived[name] += int(delivered[conditions == place].sum())
            n_on_time[name] += int(on_time[conditions == place].sum())
    for name in run.conditions:
        arrived = n_arrived[name]
        if arrived and not n_on_time[name]:
            yield (
                f"Under {printable(name)}, nobody is heard: of {arrived} messages that arrived, "
                "none came within the decision window, so that the ego decided alone."
            )


def lost_at_once(run: Run) -> Iterator[str]:
    """Yield in how many episodes the ego collides before its first action takes effect.

    No answer could have saved these. They count if it is so under every condition and channel seed.
    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages; a channel seed is the seed of the radio channel's random draws.
    """
    world = run.manifest.world
    if isinstance(world, ClosedLoop):
        lag_s = world.scenario["parameters"].get("decision_lag_s", Parameters.decision_lag_s)
    else:
        lag_s = world.decision_lag_s
    lost, others = set[int](), set[int]()
    for episode in run.episodes:
        at_once = episode.failure == "collision" and (episode.time_s or math.inf) <= lag_s
        (lost if at_once else others).add(episode.episode)
    lost -= others
    if lost:
        yield (
            f"{len(lost)} of {len(run.grid.episodes)} episodes are lost before the ego's first "
            "action, in a collision that no answer could prevent."
        )


def moved_system(run: Run) -> Iterator[str]:
    """Yield a sentence on each model whose system text was put into the first user turn.

    The system text is the prompt's instruction; the model's chat template has no place for it.
    """
    models = [agent["model"] for agent in (run.manifest.agent(0), *run.manifest.helpers)]
    for name in dict.fromkeys(str(model["name"]) for model in models if model.get("system")):
        yield (
            f"{printable(name, 30)} reads the system text at the beginning of the first user turn: "
            "its chat template has no place for a system message."
        )


def stated_elsewhere(run: Run) -> Iterator[str]:
    """Yield a sentence on a run whose answers came from a file that another program wrote."""
    model = run.manifest.model
    if is_from_file(run.manifest.answerers):
        yield (
            f"The answers of {printable(model['name'], 30)} came from a file that another program "
            "wrote: no model was asked here. Its name, and tokens and seconds of answers, are as "
            "stated: nobody here counted or timed them."
        )


def picked(run: Run) -> Iterator[str]:
    """Yield by which options a run's episodes were chosen, if by anything but chance."""
    if chosen := pick(run.manifest.world.selection):
        yield f"The episodes were chosen by {chosen}: figures and intervals are of such alone."


def beyond_sources(run: Run) -> Iterator[str]:
    """Yield each condition with radio parameters outside its channel model's validated range.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    for name, sentence in doubts.beyond(run.manifest.conditions, _channels(run.manifest)):
        yield f"{printable(name)}: {sentence}"


def of_one_name(runs: Mapping[str, Run]) -> list[str]:
    """Return a warning for each radio, network and the like that is another in some of the runs.

    `runs` are by the name that each is shown by. Conditions of one name are then not the same.
    """
    names_by_record: dict[tuple[str, str], dict[bytes, list[str]]] = {}
    for run_name, run in runs.items():
        for what, by_name in opened(run).items():
            for name, record in by_name.items():
                key = msgspec.json.encode(record, order="sorted")
                names_by_record.setdefault((what, name), {}).setdefault(key, []).append(run_name)
    sentences = []
    for (what, name), by_record in names_by_record.items():
        if len(by_record) > 1:
            places = " and ".join(names[0] for names in by_record.values())
            sentences.append(
                f"{what} {printable(name)} is another in {places}: conditions that name it are not "
                "the same."
            )
    return sentences


def no_prompt(runs: Mapping[str, Run]) -> list[str]:
    """Return up to two sentences on models that read no prompt.

    `runs` are by the name that the page shows. One sentence names rules that decide by the scene
    graph, the other drivers that look at nothing.
    """
    looking, blind = list[tuple[str, str]](), list[tuple[str, str]]()  # model and prompt version
    for run in runs.values():
        for agent in (run.manifest.agent(0), *run.manifest.helpers):
            name, engine = str(agent["model"]["name"]), str(agent["model"].get("engine"))
            if not reads_prompts(engine):
                agents = blind if engine == "driver" and name in BLIND else looking
                version = printable(str(agent["prompt"]["version"]), 20)
                agents.append((printable(name, 30), version))
    sentences = []
    if looking:
        sentences.append(_no_prompt("by the scene graph", looking))
    if blind:
        sentences.append(_no_prompt("without looking", blind))
    return sentences


def _no_prompt(how: str, agents: Sequence[tuple[str, str]]) -> str:
    models, prompts = zip(*agents, strict=True)
    *names, last = dict.fromkeys(models)
    versions = " or ".join(dict.fromkeys(prompts))
    if not names:
        return f"{last} reads no prompt: it decides {how}, whatever {versions} says."
    return (
        f"{', '.join(names)} and {last} read no prompt: they decide {how}, whatever {versions} "
        "says."
    )
