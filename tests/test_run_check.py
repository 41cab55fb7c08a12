"""A run is held against its own answers, and its tables against each other."""

import copy
import json
import shutil
from collections.abc import Callable, Iterator
from html import unescape
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from evaluating import live_spec_of
from evaluating import run as evaluated
from run_on_disk import Row, change, configure, damage

from harness.coordination.named_points import POINTS
from harness.core import extras, resources
from harness.core.errors import UserError
from harness.core.extensions import extensions
from harness.core.versions import DECISIONS
from harness.runs.contradictions import refuse
from harness.runs.digests import LABELS, OF_ALL, digests_of
from harness.runs.folder import read
from harness.runs.records import AGENT
from harness.studies.replayed_run import ReplayedRun

Harness = Callable[..., tuple[int, str, str]]
Tamper = Callable[[Path], object]


@pytest.fixture
def run(two_run: Path, tmp_path: Path) -> Path:
    """A run that a test may change."""
    return Path(shutil.copytree(two_run, tmp_path / "reports/run"))


@pytest.fixture
def longer(proxy_run: Path, tmp_path: Path) -> Path:
    """One of four layouts."""
    return Path(shutil.copytree(proxy_run, tmp_path / "reports/run"))


@pytest.fixture
def mixed(run: Path) -> Row:
    """What the run.json of a run with a model for its helpers states."""
    stated = json.loads((run / "run.json").read_text())
    agent = {name: stated[name] for name in AGENT}
    identity = {**stated["identity"], "helpers": [dict(stated["identity"])]}
    return {**stated, "helpers": [copy.deepcopy(agent)], "identity": identity}


def hurried(row: Row) -> None:
    row["slow_s"] = -0.1


def table(name: str, before: str, after: str) -> Tamper:
    """Replace a text in a CSV table once."""

    def tamper(run: Path) -> None:
        text = (run / name).read_text()
        assert before in text
        (run / name).write_text(text.replace(before, after, 1))

    return tamper


def score(metric: str, column: str, value: object, interval: str = "episodes") -> Tamper:
    """State another number of a figure under 6g."""

    def tamper(run: Path) -> None:
        head, *lines = (run / "summary.csv").read_text().splitlines()
        names = head.split(",")
        rows = [dict(zip(names, line.split(","), strict=True)) for line in lines]
        here = {"condition": "6g", "metric": metric, "interval": interval}
        [row] = [row for row in rows if here.items() <= row.items()]
        row[column] = str(value)
        text = "\n".join([head, *(",".join(row.values()) for row in rows)])
        (run / "summary.csv").write_text(text + "\n")

    return tamper


def added(metric: str, interval: str) -> Tamper:
    """Add a figure that is shown before others."""

    def tamper(run: Path) -> None:
        with (run / "summary.csv").open("a") as file:
            file.write(f"proxy,v2,json,,6g,{metric},0.987,0.98,0.99,200,0,{interval}\n")

    return tamper


def faster(row: Row) -> None:
    row["latency_ms"] = 20.0


def won(row: Row) -> None:
    row |= {"success": True, "failure": "", "outcome": "success"}


# One of each kind; what is like them `make exhaustive` tries.
SOME = (
    "a figure", "success of episodes", "who gave answers", "latency of decisions", "older rules", "a radio's name",
    "rules in another spelling", "a figure that is left out", "which layouts", "a dataset's name",
    "a latency's source", "settings beside it", "an answer that is missing", "errors of an engine",
    "a radio's limits", "a limit of its model", "a limit that nobody typed", "what a model sees",
    "what nothing computes of an answer",
    "lists that were read reversed",
)  # fmt: skip
IN_TABLES = {
    "a figure": (
        score("success_rate", "value", 0.987),
        "summary.csv has success_rate 0.987 in 6g (episodes)",
    ),
    "an end of its interval": (score("success_rate", "ci_low", 0.9), 
        "success_rate, low, 0.9 in 6g"),
    "a figure over seeds": (
        score("latency_proxy_ms", "value", 20.0, "seed means"),
        "has latency_proxy_ms 20.0 in 6g (seed means)",
    ),
    "one that holds at every look": (
        added("success_rate", "any time"), 
            "has success_rate 0.987 in 6g (any "
            "time), which its other tables",
    ),
    "success corrected for difficulty": (
        added("adjusted_success_rate", "episodes"), 
            "has adjusted_success_rate 0.987 "
            "in 6g (episodes), which",
    ),
    "success of episodes": (
        lambda run: damage(run, episode=won), "episodes.csv has another success in ",
    ),
    "a model's name": (
        table("summary.csv", "proxy,", "gpt,"), "summary.csv has model 'gpt', and run.json 'proxy'",
    ),
    "a model for helpers": (
        table("episodes.csv", ",,6g,", ",gpt,6g,"),
            "episodes.csv has helpers 'gpt', and run.json ''",
    ),
    "delays of answers": (
        lambda run: damage(run, answer=hurried), "answers.jsonl has a delay of -0.1 s in 0000",
    ),
    "times of tokens of an answer that was not timed": (
        lambda run: damage(run, answer=lambda row: row.update(first_token_s=0.1)),
            "answers.jsonl has times of tokens of 0000",
    ),
    "who gave answers": (
        lambda run: damage(run, answer=lambda row: row.update(agent=1)),
            "answers.jsonl has agent 1 of 0000",
    ),
    "latency of decisions": (
        lambda run: damage(run, decision=faster), "episodes.csv has another latency_ms in ",
    ),
}  # fmt: skip


def check_finds(case: tuple[Tamper, str], run: Path, harness: Harness) -> str:
    """Tamper with a run, and assert that `run check` names it; return what it says."""
    tamper, said = case
    tamper(run)
    code, out, _ = harness("run", "check", run)
    assert code == 1
    assert said in " ".join(out.split())
    return said


def test_a_run_that_nobody_changed_is_equal(run: Path, harness: Harness) -> None:
    code, out, _ = harness("run", "check", run)
    assert code == 0
    figures, decisions = len(read(run).scores), len(read(run).decisions)
    assert out.endswith(
        f"equal: {figures} figures and {decisions} decisions, computed again from its answers\n"
    )
    code, out, _ = harness("run", "check", run, "--json")
    assert json.loads(out)[0] | {"equal": True, "differences": []} == json.loads(out)[0]


@pytest.mark.parametrize(
    "changed",
    [n if n in SOME else pytest.param(n, marks=pytest.mark.exhaustive) for n in IN_TABLES],
)
def test_tables_that_contradict_each_other_are_named(
    changed: str, run: Path, harness: Harness
) -> None:
    check_finds(IN_TABLES[changed], run, harness)


def test_a_replay_takes_no_delay_that_no_card_declares(
    run: Path, two_path: Path, harness: Harness
) -> None:
    damage(run, answer=hurried)
    code, _, error = harness("eval", "--model", f"replay:{run}", "--dataset", two_path)
    assert code == 2
    assert f"{run} states a delay of -0.1 s in 00000-0-" in error


def test_a_run_that_was_changed_in_part_is_not_replayed(
    run: Path, two_path: Path, harness: Harness
) -> None:
    edited("latency", "ego_s", to=0.001)(run)
    code, _, error = harness("eval", "--model", f"replay:{run}", "--dataset", two_path)
    assert (code, error.count("\n")) == (2, 1)
    assert "contradicts itself: run.json has another digest of run than what it states" in error


@pytest.mark.slow
def test_tables_that_contradict_each_other_are_neither_shown_nor_compared(
    run: Path, proxy_run: Path, harness: Harness
) -> None:
    said = check_finds(IN_TABLES["success of episodes"], run, harness)
    junit = ("run", "export", run, "--junit", "junit.xml")
    swept = ("study", "sweep", run, "--over", "tau", "--grid", "0")
    compared = ("compare", proxy_run, run), ("compare", run, proxy_run)
    for typed in (("report", run), *compared, junit, swept):
        gate = ("--fail-if", "success_rate < 0.9") if typed[0] == "compare" else ()
        code, out, error = harness(*typed, *gate)
        assert (code, out, error.count("\n")) == (2, "", 1)
        assert f"{run} contradicts itself: " in error
        assert said in error
    assert not (run / "report.html").exists()
    assert not Path("junit.xml").exists()


def test_a_study_takes_no_time_that_is_not_its_sources(run: Path) -> None:
    """Though every digest is in order."""
    latency(run, ego_s=0.02, helper_s=0.02, fusion_s=0.02)
    with pytest.raises(UserError, match=r"has another latency than .*, which it names as the s"):
        ReplayedRun(run)


def reworded(answer: Row) -> None:
    """Let the ego be sure to brake."""
    if answer["viewer"] == "v1":
        answer["raw"] = '{"SLOWER": 1.0, "IDLE": 0.0, "FASTER": 0.0}'
        answer["intent"] = (1.0, 0.0, 0.0)


def older(run: Path) -> None:
    """State that the figures are by older rules."""
    stated = json.loads((run / "run.json").read_text())
    configure(run, versions={**stated["versions"], "figures": "1"})
    score("success_rate", "ci_low", 0.9)(run)


def newer(run: Path) -> None:
    configure(run, versions={"figures": "99"})


def without(metric: str) -> Tamper:
    """Leave a figure out that speaks against the run."""

    def tamper(run: Path) -> None:
        lines = (run / "summary.csv").read_text().splitlines(keepends=True)
        (run / "summary.csv").write_text("".join(line for line in lines if metric not in line))

    return tamper


def renamed(run: Path) -> None:
    """Let an easier radio have the name of another."""
    stated = json.loads((run / "run.json").read_text())
    configure(
        run,
        conditions=[
            {**each, "loss": 0.0} if each["profile"] else each for each in stated["conditions"]
        ],
    )


@pytest.mark.parametrize(
    ("setting", "value"), [("loss", 0.0), ("messages", "zork"), ("content", "objects")]
)
def test_a_condition_with_settings_that_its_name_does_not_say_is_not_shown(
    setting: str, value: object, run: Path
) -> None:
    conditions = json.loads((run / "run.json").read_text())["conditions"]
    configure(run, conditions=[{**each, setting: value} for each in conditions])
    with pytest.raises(UserError, match=f"run.json has {setting} {value} in .*, whose name says"):
        refuse(read(run))


def picked(run: Path) -> None:
    """State that some layouts were taken in their order."""
    stated = json.loads((run / "run.json").read_text())["world"]
    configure(run, world={**stated, "limit": 1, "selection": {}})


def called(run: Path) -> None:
    """Give its dataset a grander name."""
    world = json.loads((run / "run.json").read_text())["world"]
    configure(run, world={**world, "name": "hard"})


def latency(run: Path, **stated: object) -> None:
    """State other times, or another source of them."""
    before = json.loads((run / "run.json").read_text())["latency"]
    configure(run, latency={**before, **stated})


def unanswered(run: Path) -> None:
    """Take the last answer away."""
    lines = (run / "answers.jsonl").read_text().splitlines(keepends=True)
    (run / "answers.jsonl").write_text("".join(lines[:-1]))


def sooner(run: Path) -> None:
    """State that a latency is the card's."""
    stated = json.loads((run / "run.json").read_text())
    card = {**stated["model"], "latency": {**stated["model"]["latency"], "inference_s": 0.3}}
    configure(run, model=card)


def overpaid(run: Path) -> None:
    """State a price, and an amount that the tokens do not make by it."""
    stated = json.loads((run / "run.json").read_text())
    price = {"currency": "EUR", "input": 1.0, "output": 1.0}
    cost = {"currency": "EUR", "amount": 1e-3, "asked": 1, "uncounted": 0, "read_tokens": 1}
    model = {**stated["model"], "price": price}
    configure(run, model=model, cost={"proxy": {**cost, "written_tokens": 1}})


def unlimited(run: Path) -> None:
    """State that a radio's model holds for any loss."""
    channels = json.loads((run / "run.json").read_text())["channels"]
    configure(run, channels={**channels, "6g": {**channels["6g"], "limits": {"loss": [0, 1]}}})


def edited(*path: str, to: object) -> Tamper:
    """Change one thing that run.json states, and nothing else."""

    def tamper(run: Path) -> None:
        stated = json.loads((run / "run.json").read_text())
        place = stated
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = to
        (run / "run.json").write_text(json.dumps(stated))

    return tamper


OF_THE_RUN = {
    "older rules": (older, "success_rate, low, 0.9 in 6g"),
    "older rules, without a row": (
        lambda run: (older(run), without("off_lag_rate")(run)), 
            "summary.csv lacks "
            "off_lag_rate in 6g",
    ),
    "older rules, without a row of several": (
        lambda run: (older(run), without("6g,optimal_brier,")(run)), 
            "summary.csv lacks "
            "optimal_brier in 6g",
    ),
    "older rules, with another figure of all decisions": (
        lambda run: (older(run), score("decisions_one_optimal", "value", 5000)(run)),
        "summary.csv has decisions_one_optimal 5000.0 in 6g",
    ),
    "rules in another spelling": (
        lambda run: configure(run, versions={"figures": "01"}), 
            "run.json has figures "
            "of version 01, and",
    ),
    "rules of nobody": (newer, "run.json has figures of version 99, and this harness has"),
    "a parser of nobody": (
        lambda run: configure(run, versions={"parser": "2x"}),
        "run.json has parser of version 2x, and this harness has",
    ),
    "decisions of nobody": (
        lambda run: configure(run, versions={"decisions": ""}),
        "run.json has decisions of version , and this harness has",
    ),
    "a figure that is left out": (without("off_lag_rate"), "summary.csv lacks off_lag_rate in 6g"),
    "n": (score("success_rate", "n", 20000), "success_rate, n, 20000 in 6g"),
    "a radio's name": (renamed, "run.json has loss 0.0 in v2x, whose name says otherwise"),
    "which layouts": (picked, 
        "episodes.csv has other episodes than "
        "run.json says that were selected"),
    "the paper's latency": (
        lambda run: latency(run, source="paper", ego_s=0.02),
        "run.json has another latency than the paper, which it names as the source",
    ),
    "a latency of helpers": (
        lambda run: latency(run, helper_s=0.02), 
            "run.json has another latency "
            "of the helpers than of",
    ),
    "a latency of fusion": (
        lambda run: latency(run, fusion_s=0.02), 
            "run.json has another latency of "
            "a fusion call than of the",
    ),
    "a latency's source": (sooner, "run.json has another latency than its model's card"),
    "settings beside it": (
        table("run.toml", 'prompt = "v2"', 'prompt = "v4"'),
        "run.toml has --prompt v4, and run.json beside it has --prompt v2",
    ),
    "settings that are none": (
        lambda run: (run / "run.toml").write_text("[[["), "run.toml is no TOML: ",
    ),
    "an answer that is missing": (
        unanswered, "answers.jsonl has no answer to 00001-",
    ),
    "errors of an engine": (
        lambda run: configure(run, engine_errors=3),
        "run.json has engine_errors 3, and answers.jsonl has 0",
    ),
    "times of answers": (
        lambda run: configure(run, answer_times={"ego": {"n": 9, "median_s": 1e-4, "p5_s": 1e-4, "p95_s": 1e-4}}),
        "run.json has another answer_times than its answers took",
    ),
    "a cost without a price": (
        lambda run: configure(run, cost={"x": {
            "currency": "EUR", "amount": 1e-3, "asked": 1, "uncounted": 0, "read_tokens": 1, "written_tokens": 1,
        }}),
        "run.json has a cost of x in EUR, and no model of it has such a price",
    ),
    "another cost than tokens make": (overpaid, "run.json has another cost of proxy than its tokens make"),
    "a radio without a record": (
        lambda run: configure(run, channels={}),
        "run.json lacks channel profile 6g, which a condition names",
    ),
    "a radio's limits": (unlimited, "run.json has the limits of channel profile 6g otherwise than here"),
    "a limit of its model": (
        edited("model", "max_new_tokens", to=7),
        "run.json has another digest of ego than what it states makes",
    ),
    "a limit that nobody typed": (
        edited("world", "limit", to=13),
        "run.json has another limit of its scenes than its settings",
    ),
    "what a model sees": (
        edited("model", "privileged", to=True),
        "run.json says of proxy that it sees other than it does",
    ),
    "whether its prompt is released": (
        edited("prompt", "released", to=False),
        "run.json has another digest of ego than what it states makes",
    ),
    "a package's version": (
        edited("versions", "numpy", to="0"),
        "run.json has another digest of run than what it states makes",
    ),
    "what nothing computes of an answer": (
        lambda run: (run / "answers.jsonl").write_text(
            (run / "answers.jsonl").read_text().replace('"batch_size":1', '"batch_size":8')
        ),
        "run.json has another digest of answers.jsonl than that file makes",
    ),
    "lists that were read reversed": (
        lambda run: configure(run, flip=True),
        "answers.jsonl has no flipped, which flip True gives",
    ),
    "a dataset's name": (called, "run.json has another name of its scenes than the dataset"),
}  # fmt: skip


@pytest.mark.parametrize(
    "changed",
    [n if n in SOME else pytest.param(n, marks=pytest.mark.exhaustive) for n in OF_THE_RUN],
)
def test_what_a_run_states_of_itself_is_held_against_its_dataset_and_its_names(
    changed: str, run: Path, harness: Harness
) -> None:
    check_finds(OF_THE_RUN[changed], run, harness)


def leaves(value: object, path: tuple[object, ...] = ()) -> Iterator[tuple[object, ...]]:
    """Yield the path of each thing that a JSON value states."""
    if isinstance(value, dict | list) and value:
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(inner, (*path, name))
    else:
        yield path


def test_each_thing_that_a_run_states_is_in_one_of_its_digests(mixed: Row) -> None:
    """But for its labels, and the digests."""
    before = digests_of(mixed, "0")
    assert [*before] == ["ego", "helper 1", "run", "answers.jsonl"]
    for path in leaves(mixed):
        stated = copy.deepcopy(mixed)
        place = stated
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = "another"
        moved = {name for name, digest in digests_of(stated, "0").items() if digest != before[name]}
        is_held = path[0] not in (*LABELS, "digests") and path != ("world", "path")
        assert bool(moved) == is_held, path
        assert (path[0] in AGENT) <= ("ego" in moved), path
        assert (path[0] in OF_ALL) <= ({"ego", "helper 1"} <= moved), path


def test_a_run_without_digests_says_so(run: Path, harness: Harness) -> None:
    stated = json.loads((run / "run.json").read_text())
    del stated["digests"]
    (run / "run.json").write_text(json.dumps(stated))
    code, out, _ = harness("run", "check", run)
    assert (code, "equal where it can be checked: " in out) == (0, True)
    assert "It has no digests of what it states" in out


def test_answers_are_asked_of_the_rule_that_is_here(run: Path, harness: Harness) -> None:
    damage(run, answer=reworded)
    code, out, _ = harness("run", "check", run)
    assert code == 1
    assert "answers.jsonl has" in out
    assert "otherwise than the rule here" in " ".join(out.split())


def counted(answer: Row) -> None:
    answer["prompt_tokens"] = 7


def failed(answer: Row) -> None:
    answer |= {"status": "no_json", "verdict": "failed", "intent": None}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (failed, "another verdict in 1 answer than its texts say"),
        (
            lambda answer: answer.update(detail="read as it was asked for"),
            "another detail in 1 answer than its texts say",
        ),
        (counted, "another prompt_tokens in 1 answer than the rule here"),
        (
            lambda answer: answer.update(repairs=("fence",)),
            "another repairs in 1 answer than its texts say",
        ),
        (
            lambda answer: answer.update(intent=(0.0, 1.0, 0.0)),
            "another intent in 1 answer than its texts",
        ),
        (lambda answer: answer.update(viewer="v99"), "1 answer to questions that nobody asked"),
    ],
)
def test_what_a_run_says_of_its_answers_is_held_against_their_texts(
    changed: Callable[[Row], None], said: str, run: Path, harness: Harness
) -> None:
    """The rates of parsing follow from it, and a file can state both."""
    lines = (run / "answers.jsonl").read_text().splitlines()
    one = json.loads(lines[-1])
    changed(one)
    more = [] if one["viewer"] != "v99" else lines[-1:]
    (run / "answers.jsonl").write_text("\n".join([*lines[:-1], *more, json.dumps(one)]) + "\n")
    code, out, _ = harness("run", "check", run)
    assert code == 1
    assert said in " ".join(out.split())


def test_a_table_that_agrees_with_the_others_and_not_with_the_answers_is_found(
    run: Path, harness: Harness
) -> None:
    """A column that nothing else follows from."""
    file = run / "decisions.parquet"
    read_table = pq.read_table(file)
    place = read_table.column_names.index("fusion_ms")
    kind = read_table.schema.field("fusion_ms")
    pq.write_table(
        read_table.set_column(place, kind, pa.array([1.0] * len(read_table), kind.type)), file
    )
    code, out, _ = harness("run", "check", run)
    assert code == 1
    assert "decisions.parquet has another fusion_ms in" in out


@pytest.fixture(scope="session")
def driven(once: Callable[..., Path]) -> Path:
    """Two driven episodes, under one condition and seed, of which the proxy fails one."""
    spec = live_spec_of(episodes=3, points=(POINTS["single-local"],), seeds=(0,))
    return once("driven-to-check", lambda folder: evaluated(spec, folder / "run")) / "run"


@pytest.fixture
def drive(driven: Path, tmp_path: Path) -> Path:
    """A driven run that a test may change."""
    return Path(shutil.copytree(driven, tmp_path / "reports/driven"))


OTHERWISE = {"least_gap_m": 1.0, "time_s": 0.5, "hard_brakings": 1}  # each in another episode


def otherwise(row: Row) -> None:
    name = list(OTHERWISE)[row["episode"]]
    row[name] += OTHERWISE[name]


@pytest.mark.slow
def test_a_driven_run_has_its_tables_held_against_each_other_and_the_simulator(
    drive: Path, harness: Harness
) -> None:
    code, out, _ = harness("run", "check", drive)
    words = " ".join(out.split())
    assert code == 0, words
    assert ": equal: " in words
    assert words.endswith("driven again with its answers")
    damage(drive, decision=faster)
    assert harness("run", "check", drive)[0] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("world.scenario", "occluded-intersection:limits=2"),
        ("world.episodes", 200),
        ("engine", "llama-cpp"),
        ("letters", "calibrated"),
    ],
)
def test_settings_of_a_driven_run_are_those_that_it_had(
    place: str, value: object, drive: Path, harness: Harness
) -> None:
    settings = json.loads((drive / "run.json").read_text())["settings"]
    table, _, name = place.rpartition(".")
    changed = {**(settings[table] if table else settings), name: value}
    configure(drive, settings={**settings, table: changed} if table else changed)
    code, out, _ = harness("run", "check", drive)
    assert code == 1
    assert f"run.json has {name} {value} in its settings, and " in " ".join(out.split())
    assert harness("report", drive)[0] == 2


@pytest.mark.exhaustive
def test_ends_of_driven_episodes_that_follow_from_no_action_are_found(
    drive: Path, harness: Harness
) -> None:
    """Though all tables agree with each other."""
    change(drive, episode=otherwise)
    code, out, _ = harness("run", "check", drive)
    assert code == 1
    words = " ".join(out.split())
    for name in OTHERWISE:
        assert f"episodes.csv has another {name} in 1 row than its answers make" in words
    assert "summary.csv" not in words
    assert harness("report", drive)[0] == 0


def test_an_engine_that_is_not_here_is_one_line_that_names_the_run(
    run: Path, harness: Harness
) -> None:
    model = json.loads((run / "run.json").read_text())["model"]
    configure(run, model={**model, "engine": "zork"})
    code, out, error = harness("run", "check", run)
    assert (code, out) == (2, "")
    assert error.startswith(f"harness: unknown engine of {run}: its model 'zork'; known: ")


def test_a_device_that_timed_nothing_is_refused(run: Path, harness: Harness) -> None:
    stated = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(stated | {"device_profile": {"name": "orin"}}))
    code, out, error = harness("report", run)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "device_profile: nothing timed the answers by it" in error


@pytest.mark.slow
def test_a_replay_has_the_delays_that_the_replayed_model_declares(
    two_path: Path, harness: Harness
) -> None:
    first = ("eval", "--dataset", two_path, "--model", "proxy-faulty", "--seeds", "0", "--quiet")
    assert harness(*first, "--out", "first")[0] == 0
    again = ("eval", "--dataset", two_path, "--model", "replay:first", "--seeds", "0", "--quiet")
    assert harness(*again, "--out", "again")[0] == 0
    code, out, _ = harness("run", "check", "again")
    assert (code, "again: equal: " in out) == (0, True)
    helped = ("eval", "--dataset", two_path, "--seeds", "0", "--quiet", "--helper-model")
    assert harness(*helped, "proxy-faulty", "--out", "helped")[0] == 0
    of_helped = (*again[:3], "--model", "replay:helped", *again[5:])
    assert harness(*of_helped, "--out", "of-helped")[0] == 0
    assert harness("run", "check", "of-helped")[0] == 0
    [helper] = read(Path("of-helped")).manifest.answerers.helpers
    assert helper["model"]["name"] == "proxy-faulty"


@pytest.mark.slow
def test_helpers_with_models_of_their_own_have_the_times_that_are_named(
    two_path: Path, harness: Harness
) -> None:
    typed = ("eval", "--dataset", two_path, "--model", "proxy", "--seeds", "0", "--quiet")
    assert harness(*typed, "--helper-model", "proxy-faulty", "--out", "run")[0] == 0
    assert harness("run", "check", "run")[0] == 0
    latency(Path("run"), helper_s=0.001)
    code, out, _ = harness("run", "check", "run")
    assert code == 1
    assert "another latency of the helpers than their cards" in " ".join(out.split())


SLOW = """engine = "proxy"
description = "a rule that takes its time"
[latency]
source = "card"
basis = "declared"
inference_s = 1.9
"""


@pytest.mark.slow
def test_times_of_a_replay_are_held_to_what_it_replays_or_said_to_be_its_own(
    two_path: Path, harness: Harness
) -> None:
    """Times of helpers that have a model of their own, two of two, and of a helper's card."""
    Path(resources.MARKER).touch()
    Path("models").mkdir()
    Path("models/slow.toml").write_text(SLOW)
    usual = ("--dataset", two_path, "--seeds", "0", "--quiet", "--out")
    runs = {
        "alone": ("proxy",), "slow": ("proxy", "--helper-model", "slow"),
        "two": ("proxy", "--helper-model", "slow,proxy"), "of-alone": ("replay:alone",),
        "of-slow": ("replay:slow",), "of-two": ("replay:two",),
        "helps": ("proxy", "--helper-model", "replay:slow"),
    }  # fmt: skip
    for name, models in runs.items():
        assert harness("eval", "--model", *models, *usual, name)[0] == 0, name
        code, out, error = harness("run", "check", name)
        assert (code, error) == (0, ""), name
        alone = "Its helpers' latency of " in out
        assert alone == (name in ("of-slow", "of-two", "helps")), name
    latency(Path("of-alone"), helper_s=0.001)
    code, out, _ = harness("run", "check", "of-alone")
    assert code == 1
    assert "another latency of the helpers than of the ego" in " ".join(out.split())
    latency(Path("of-alone"), helper_s=0.145, source="declared")
    out = " ".join(harness("run", "check", "of-alone")[1].split())
    assert "Its latency of 0.145 s, declared in the run that it replays, is stated by" in out
    Path("models/slow.toml").write_text(SLOW.replace("1.9", "0.1"))
    out = " ".join(harness("run", "check", "slow")[1].split())
    assert "card slow in run.json states 1.9 s (card) for an answer; the one that is here" in out
    Path("models/slow.toml").unlink()
    out = " ".join(harness("run", "check", "slow")[1].split())
    assert "states 1.9 s (card) for an answer, and none of that name is here." in out


def test_more_errors_than_a_result_can_have_are_a_difference(run: Path, harness: Harness) -> None:
    scenes = sorted(read(run).decisions.scenes)
    last = {scene.partition("-")[0]: scene for scene in scenes}.values()

    def failed(row: Row) -> None:
        if row["viewer"] != "v1" and row["scene"] in last:
            row |= {"error": "busy", "raw": "", "intent": None, "verdict": "failed"}
            row |= {"status": "engine_error", "finish_reason": "error", "message": None}

    change(run, answer=failed)
    model = json.loads((run / "run.json").read_text())["model"]
    configure(run, model={**model, "engine": "transformers", "weights": "proxy.safetensors"})
    code, out, error = harness("run", "check", run)
    assert (code, error) == (1, "")
    assert "questions to helpers: too many for a result" in " ".join(out.split())


@pytest.mark.slow
def test_a_driven_run_is_held_against_what_drives_here(drive: Path, harness: Harness) -> None:
    model = json.loads((drive / "run.json").read_text())["model"]
    configure(drive, model={**model, "name": "full-view", "engine": "driver", "privileged": False})
    code, out, _ = harness("run", "check", drive)
    assert code == 1
    assert "run.json says of full-view that it sees other than it does" in " ".join(out.split())


@pytest.mark.slow
def test_answers_of_a_driven_run_are_held_against_their_texts(
    drive: Path, harness: Harness
) -> None:
    change(drive, answer=reworded)
    code, out, _ = harness("run", "check", drive)
    assert code == 1
    assert "than its texts say" in " ".join(out.split())


@pytest.mark.exhaustive
def test_a_latency_of_a_driven_run_is_held_against_its_source(
    drive: Path, harness: Harness
) -> None:
    latency(drive, source="paper", ego_s=0.02)
    code, out, _ = harness("run", "check", drive)
    assert code == 1
    assert "another latency than the paper, which it names as the source" in " ".join(out.split())


def test_a_latency_of_a_card_that_only_the_run_states_is_named(run: Path, harness: Harness) -> None:
    stated = json.loads((run / "run.json").read_text())
    times = {"source": "card", "ego_s": 0.144, "helper_s": 0.144, "fusion_s": 0.144}
    card = {**stated["model"], "latency": {**stated["model"]["latency"], "inference_s": 0.144}}
    configure(run, model=card, latency={**stated["latency"], **times})
    said = harness("run", "check", run)
    words = " ".join(said[1].split())
    here = "for an answer; the one that is here states 0.145 s (card)."
    assert f"The card proxy in run.json states 0.144 s (card) {here}" in words, said
    paper = {"source": "paper", "inference_s": None, "basis": "none declared"}
    times = {"source": "paper", "ego_s": 0.145, "helper_s": 0.145, "fusion_s": 0.145}
    configure(run, model={**card, "latency": paper}, latency={**stated["latency"], **times})
    words = " ".join(harness("run", "check", run)[1].split())
    assert f"The card proxy in run.json states no time {here}" in words


@pytest.mark.slow
def test_a_driven_run_that_cannot_be_driven_again_says_so(
    drive: Path, harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    code, out, _ = harness("run", "check", drive)
    words = " ".join(out.split())
    assert code == 0
    assert "It was not driven again: to drive again needs highway-env" in words
    assert "with its answers" not in words


def test_what_is_no_number_or_none_of_its_scenes_is_a_line_and_no_traceback(
    run: Path, harness: Harness
) -> None:
    damage(run, answer=lambda row: row.update(scene="x") if row["viewer"] == "v2" else None)
    score("success_rate", "value", 1e308)(run)
    code, out, _ = harness("run", "check", run)
    assert code in (1, 2)
    assert "Traceback" not in out


@pytest.mark.parametrize(
    ("table", "name", "value", "needs"),
    [
        ("helpers", "model", "proxy", "mixed_helpers"),
        ("world", "only", "0:1", "selection"),
        ("world", "until_width", 30.0, "early_stop"),
        ("", "control", ["blind"], "controls"),
        ("", "device_profile", "agx-orin", "devices"),
    ],
)
def test_settings_without_what_they_come_to_are_refused(
    table: str, name: str, value: object, needs: str, run: Path, harness: Harness
) -> None:
    if needs not in extensions():
        pytest.skip(f"{needs} is gone")
    stated = json.loads((run / "run.json").read_text())
    settings = stated["settings"][table] if table else stated["settings"]
    assert settings[name] in (None, [])
    settings[name] = value
    (run / "run.json").write_text(json.dumps(stated))
    code, _, error = harness("report", run)
    assert (code, error.count("\n")) == (2, 1)
    assert "and nothing beside them says what that came to" in error


def test_what_nobody_can_check_is_named_and_not_called_equal(
    longer: Path, proxy_run: Path, harness: Harness
) -> None:
    """A figure of a package, and younger figures that a run by older rules does not have."""
    run, stated = longer, json.loads((longer / "run.json").read_text())
    configure(
        run, versions={**stated["versions"], "figures": "1", "decisions": "1", "harness": "0.3"}
    )
    without("optimal_")(run)
    added("comfort", "episodes")(run)
    edited("answer_times", to={"ego": {"n": 9, "median_s": 1e-4, "p5_s": 1e-4, "p95_s": 1e-4}})(run)
    edited("digests", to={})(run)
    said = (
        "Not held, since its figures are by the rules of version 1: run.json has another "
        "answer_times than its answers took.",
        "comfort: as summary.csv states, and not checked, since",
        "Not held: the sentence on each answer, that of harness 0.3.",
        "Its answers are decided by the rules of version 1, as run.json states, and here by those of "
        f"version {DECISIONS}.",
        "Its figures are made by the rules of version 1, as run.json states. It lacks "
        "optimal_action_rate, optimal_brier and optimal_nll_nats, and whether they were left out "
        "cannot be checked.",
    )
    code, out, _ = harness("run", "check", run)
    page = harness("report", run)[0], (run / "report.html").read_text()
    compared = harness("compare", proxy_run, run)[1]
    assert (code, page[0]) == (0, 0)
    assert f"{run}: equal where it can be checked: " in out
    for text in (out, page[1], compared):
        words = " ".join(unescape(text).split())
        assert all(sentence in words for sentence in said)


def test_a_column_that_a_run_by_older_rules_left_empty_is_named(
    longer: Path, harness: Harness
) -> None:
    """Here by a forger, whose regret is not to be seen."""
    run, stated = longer, json.loads((longer / "run.json").read_text())
    change(run, decision=lambda row: row.update(regret=None))
    code, out, _ = harness("run", "check", run)
    assert (code, "decisions.parquet has another regret in" in " ".join(out.split())) == (1, True)
    configure(run, versions={**stated["versions"], "figures": "1"})
    code, out, _ = harness("run", "check", run)
    words = " ".join(out.split())
    assert "equal where it can be checked: " in words
    assert "Columns are empty that its answers fill: regret. Older runs do not have them." in words
