"""`harness prompt optimize`: a search on tune layouts, and one certificate on report layouts."""

import json
import shutil
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from misbehaving import Asked, Server, completion, serving
from relabelling import relabel

from harness.core.errors import UserError
from harness.core.resources import folder
from harness.dataset.load import Dataset, find, load
from harness.extensions.learn.optimize.candidate import chosen, rewritten, space, systems
from harness.extensions.learn.optimize.feedback import of_course, of_decision
from harness.extensions.learn.optimize.layouts import built
from harness.extensions.learn.optimize.search import looks
from harness.extensions.learn.optimize.tuning import TIE, Decision, Played
from harness.prompts import versions as prompts
from harness.prompts.alternatives import counts, resolved
from harness.studies.replayed_run import SILENT

pytestmark = pytest.mark.usefixtures("unrebuilt")

Said = tuple[int, str, str]
Typed = Callable[..., Said]
REPORT = "occluded-intersection-v2"
PACE = "{% either pace %}Creep.{% or %}Look.{% or %}Go.{% endeither %}"
PARTS = "{% order parts %} Be kind.{% or %} Be quick.{% endorder %}"
CARD = """
engine = "openai"
description = "a server of the tests"
weights = "m"
[server]
base_url = "{url}"
kind = "generic"
[latency]
source = "paper"
basis = "none"
"""
POLICIES = {"Creep.": (0.8, 0.1, 0.1), "Go.": (0.1, 0.8, 0.1)}


def policy(chat: str) -> tuple[float, ...]:
    """What the tests' model states: it looks only where its prompt says so."""
    if "Look." in chat:
        return POLICIES["Go." if "none in sight" in chat else "Creep."]
    return POLICIES["Go." if "Go." in chat else "Creep."]


class Model:
    """The tests' model, which dies for good after some answers,
    and what a reflecting model writes.
    """

    def __init__(self) -> None:
        self.chats: list[str] = []
        self.lives, self.written = 10**6, "```\nYou drive. Go.\n```"
        self.lock = threading.Lock()

    def __call__(self, asked: Asked) -> None:
        chat = "\n".join(message["content"] for message in asked.body["messages"])
        with self.lock:
            self.lives -= 1
            if self.lives >= 0:
                self.chats.append(chat)
        if self.lives < 0:
            asked.reply({"error": {"message": "no more today"}}, 400)
        elif "Write only the template" in chat:
            asked.reply(completion(self.written))
        else:
            p = dict(zip(("SLOWER", "IDLE", "FASTER"), policy(chat), strict=True))
            asked.reply(completion(json.dumps({"action_distribution": p})))


@pytest.fixture
def model() -> Model:
    return Model()


@pytest.fixture
def server(model: Model) -> Iterator[Server]:
    with serving(model) as there:
        yield there


def marked(where: Path, pace: str = PACE) -> None:
    """Write the prompt `mine`: `v3` with two choices."""
    shutil.copytree(folder("prompts") / "v3", where / "mine")
    file = where / "mine" / "ego.j2"
    text = file.read_text()
    file.write_text(
        text.replace("{% block system -%}", "{% block system -%}\n" + pace + PARTS + "\n", 1)
    )


@pytest.fixture
def optimize(harness: Typed, tmp_path: Path, small_path: Path, server: Server) -> Typed:
    """The command as typed in a project with the prompt `mine` and the card `m`."""
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "m.toml").write_text(CARD.format(url=server.url))
    marked(tmp_path / "prompts")

    def typed(
        *args: Any, budget: int = 300, out: str = "new", tune: Any = ("--tune", small_path)
    ) -> Said:
        usual = ("--model", "m", "--prompt", "mine", *tune, "--limit", 3, "--no-cache")
        return harness(
            "prompt", "optimize", *usual, "--budget", budget, "--out", out, "--quiet", *args
        )

    return typed


def history(where: Path, name: str = "new") -> Any:
    return json.loads((where / "prompts" / name / "history.json").read_text())


def test_a_mark_is_its_first_alternative_until_another_is_chosen() -> None:
    text = (
        "a {% either x %}b{% or %}c{%or%}{% endeither %} {%order y%}1{% or %}2{% or "
        "%}3{%endorder%}{{ n }}"
    )
    assert resolved(text) == "a b 123{{ n }}"
    assert resolved(text, {"x": 1, "y": 1}) == "a c 132{{ n }}"
    assert resolved(text, {"x": 2, "y": 5}) == "a  321{{ n }}"
    assert counts([text, "{% either x %}{% or %}{% or %}z{% endeither %}"]) == {"x": 3, "y": 6}
    for name in prompts.names():
        for shipped in prompts.load(name).texts.values():
            assert (resolved(shipped), counts([shipped])) == (shipped, {}), (
                "no released prompt has a mark"
            )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{% either x %}a{% endeither %}", "one alternative"),
        (
            "{% either x %}a{% or %}b{% endeither %}{% either x %}a{% or %}b{% or %}c{% endeither "
            "%}",
            "2 and 3",
        ),
        ("{% order x %}1{% or %}2{% or %}3{% or %}4{% or %}5{% endorder %}", "5 parts"),
        (
            "".join(f"{{% either m{n} %}}a{{% or %}}b{{% endeither %}}" for n in range(65)),
            "65 marks; give 64",
        ),
        ("{% either examples %}a{% or %}b{% endeither %}", "another name"),
    ],
)
def test_a_mark_that_cannot_be_chosen_from_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        counts([text])


@pytest.mark.parametrize(
    "text",
    [
        "{% either x %}" * 50_000,
        "{% either x %} {% endorder %}" * 50_000,
        ("{%" + " " * 999) * 1000,
    ],
)
def test_a_strangers_marks_take_one_pass(text: str) -> None:
    begun_s = time.process_time()
    assert resolved(text) == text
    assert time.process_time() - begun_s < 5, "and not one from each that never ends"


def test_an_order_of_long_parts_makes_no_more_than_one_of_them() -> None:
    parts = ["w" * 10**6, "x", "y", "z"]
    text = "{% order x %}" + "{% or %}".join(parts) + "{% endorder %}"
    tracemalloc.start()
    assert resolved(text, {"x": 23}) == "zyx" + parts[0]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * len(text)


def test_a_strangers_history_is_read_or_counts_for_none(tmp_path: Path) -> None:
    marked(tmp_path)
    base = prompts.load("mine", tmp_path)
    for text, expected in (
        ('{"looks": 2}', 2),
        ('{"looks": 1e999}', 0),
        ('{"looks": -5}', 0),
        ("[" * 10**5, 0),
        ("\udcff", 0),
        ("", 0),
    ):
        (tmp_path / "mine" / "history.json").write_bytes(text.encode(errors="surrogateescape"))
        assert looks(base, tmp_path) == expected


def test_what_is_chosen_is_an_ordinary_version(tmp_path: Path, small: Dataset) -> None:
    marked(tmp_path)
    base = prompts.load("mine", tmp_path)
    assert space(base) == {"pace": 3, "parts": 2}
    graph = next(iter(small.scenes([small.forest.ids[0]])[0].graphs.values()))
    words = small.scenario.prompt_words

    def system(prompt: prompts.Prompt) -> str:
        return prompt.render(graph, small.actions, words=words)[0]["content"]

    plain, other = chosen(base), chosen(base, {"pace": 2, "parts": 1})
    assert system(base) == system(plain.prompt)
    assert system(plain.prompt).startswith("Creep. Be kind. Be quick.\n")
    assert system(other.prompt).startswith("Go. Be quick. Be kind.\n")
    assert other.what == "pace 3 of 3, parts 2 of 2"
    assert other.what in other.prompt.changed
    for name in (
        "helper_answer",
        "token_budget",
        "max_answer_tokens",
        "max_objects",
        "reasons_first",
    ):
        assert getattr(other.prompt, name) == getattr(base, name)
    assert rewritten(base, systems(base)).key == plain.key
    assert (
        system(rewritten(base, {"ego": "Hi \\1 {{ words.task }}"}).prompt)
        == f"Hi \\1 {words['task']}"
    )


def test_example_sets_are_a_choice(tmp_path: Path) -> None:
    shutil.copytree(folder("prompts") / "v6", tmp_path / "mine")
    file = tmp_path / "mine" / "prompt.toml"
    text = file.read_text()
    file.write_text(text + "example_sets = [[2], [1, 2], []]\n")
    base, shipped = prompts.load("mine", tmp_path), prompts.load("v6")
    assert shipped.examples
    assert base.examples
    assert [e.layout_seed for e in base.examples.ego] == [shipped.examples.ego[1].layout_seed]
    assert space(base) == {"examples": 3}
    assert chosen(base, {"examples": 1}).prompt.examples == shipped.examples
    assert chosen(base, {"examples": 2}).prompt.examples is None
    assert "examples.json" not in chosen(base, {"examples": 2}).prompt.files
    file.write_text(text + "example_sets = [[3]]\n")
    with pytest.raises(UserError, match=r"example_sets has 3, and examples\.json has 2"):
        prompts.load("mine", tmp_path)


def outcome(dataset: Dataset, does: Callable[[bool], str]) -> tuple[float, float]:
    """Balanced success of a rule that knows whether a conflict is listed,
    and the worth of what it states.
    """
    success, worths = [], []
    for episode in dataset.episodes:
        forest = dataset.of_episodes({episode}).forest
        at, worth = int(forest.root[0]), []
        while at >= 0:
            scene = dataset.scenes([forest.ids[at]])[0]
            p = np.array(POLICIES[does(bool(scene.graphs[scene.viewers[0]].conflicts))])
            if forest.value[at]:
                worth.append(float(p @ forest.worth[at]))
            action = int(p.argmax())
            edge, at = int(forest.edge[at, action]), int(forest.child[at, action])
        success.append(float(forest.succeeds(np.array([edge]), np.array([0]))[0]))
        worths.append(float(np.mean(worth)))
    weight = np.where(
        dataset.dangerous, 0.5 / dataset.dangerous.sum(), 0.5 / (~dataset.dangerous).sum()
    )
    return float(weight @ success), float(weight @ worths)


@pytest.mark.slow
def test_the_best_on_tune_layouts_is_certified_on_report_layouts(
    optimize: Typed, model: Model, tmp_path: Path, small: Dataset
) -> None:
    code, out_text, wrong = optimize()
    assert (code, out_text) == (0, ""), wrong
    record = history(tmp_path)
    rules: dict[str, Callable[[bool], str]] = {
        "first alternatives": lambda meets: "Creep.",
        "pace 2 of 3": lambda meets: "Creep." if meets else "Go.",
        "pace 3 of 3": lambda meets: "Go.",
    }
    tried = {row["wording"]: row for row in record["tried"]}
    for wording, does in rules.items():
        if tried[wording]["layouts"] == len(small.episodes):
            success, worth = outcome(small, does)
            assert tried[wording]["success"] == pytest.approx(success, abs=1e-6), wording
            assert tried[wording]["worth"] == pytest.approx(worth, abs=1e-6), wording
    scores = {name: np.dot((1, TIE), outcome(small, does)) for name, does in rules.items()}
    best = max(scores, key=scores.__getitem__)
    assert best != "first alternatives"
    assert record["chosen"] == best, "the order of parts changes nothing, so the first one stays"
    assert (
        record["questions"] == sum(row["questions"] for row in record["tried"]) <= record["budget"]
    )
    new = prompts.load("new", tmp_path / "prompts")
    assert new.sha256 == record["sha256"]
    assert not space(new)
    assert best in new.changed
    shown = load(find(REPORT), 3)
    a, b = outcome(shown, rules["first alternatives"])[0], outcome(shown, rules[best])[0]
    [family] = record["certificate"]["families"]
    assert record["certificate"]["metric"] == "balanced_success_rate"
    assert family["base"]["value"] == pytest.approx(a)
    assert family["winner"]["value"] == pytest.approx(b)
    assert family["difference"]["value"] == pytest.approx(b - a)
    assert family["difference"]["n"] == 3
    assert len(model.chats) == record["questions"] + record["certificate"]["questions"]
    for cost in (record, record["certificate"]):
        assert cost["tokens"] == 32 * cost["questions"], "the server counts 12 tokens in and 20 out"
    page = (tmp_path / "reports" / "new" / "index.html").read_text()
    assert "read once, after the search" in page
    assert best in page
    assert not (tmp_path / "reports" / "new" / ".work").exists()


@pytest.mark.exhaustive
def test_a_stopped_search_goes_on_and_comes_to_the_same(
    optimize: Typed, model: Model, tmp_path: Path
) -> None:
    assert optimize(out="whole")[0] == 0
    whole, asked = history(tmp_path, "whole"), len(model.chats)
    model.chats.clear()
    for lives in (9, 17, 22):
        model.lives = lives
        code, _, wrong = optimize()
        assert code == 3
        assert "no more today" in wrong
        assert not (tmp_path / "prompts" / "new").exists()
    model.lives = 10**6
    assert optimize(budget=299)[0] == 2, "another budget is another search"
    assert optimize()[0] == 0
    again = history(tmp_path)
    for name in ("tried", "chosen", "questions", "tokens", "certificate", "sha256"):
        assert again[name] == whole[name], name
    assert len(model.chats) == asked, "nothing was asked twice"


def test_tune_layouts_that_a_stopped_search_left_are_those_that_were_asked_for(
    small: Dataset, small_path: Path, tmp_path: Path
) -> None:
    stated, scenario = small.manifest, small.scenario
    out = shutil.copytree(small_path, tmp_path / f"tune-{scenario.name}")
    [source] = built([scenario], tmp_path, stated.episodes, stated.seed, 1, SILENT)
    assert source.dataset.sha256 == small.sha256
    for layouts, seed, said in (
        (stated.episodes - 1, stated.seed, "begun with another episodes"),
        (stated.episodes, stated.seed + 1, "begun with another seed"),
    ):
        with pytest.raises(UserError, match=said):
            built([scenario], tmp_path, layouts, seed, 1, SILENT)
    (out / "layouts.zip").write_bytes(bytes(1000))
    with pytest.raises(UserError, match=r"layouts\.zip: cannot be read"):
        built([scenario], tmp_path, stated.episodes, stated.seed, 1, SILENT)


@pytest.mark.exhaustive
def test_a_suite_is_certified_family_by_family(
    optimize: Typed, tmp_path: Path, small_path: Path
) -> None:
    names = [REPORT, "occluded-intersection-v3"]
    suite = f'[two]\ndescription = "two"\ndatasets = {json.dumps(names)}\n'
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets" / "suites.toml").write_text(suite)
    tune = ("--tune", small_path, "--tune", small_path)
    code, _, wrong = optimize("--dataset", "suite:two", tune=tune, budget=500)
    assert code == 0, wrong
    record = history(tmp_path)
    *each, mean = record["certificate"]["families"]
    assert [family["dataset"] for family in each] == names
    gains = [family["difference"]["value"] for family in each]
    assert mean["dataset"] == "mean"
    assert mean["difference"]["value"] == pytest.approx(np.mean(gains))
    assert record["tried"][0]["layouts"] == 8, "four of each family"


def broken_report(tmp_path: Path) -> Path:
    """Copy the report dataset without anything in its layouts: whoever reads one fails."""
    path = tmp_path / "datasets" / "broken"
    shutil.copytree(find(REPORT), path, ignore=shutil.ignore_patterns("layouts.zip"))
    (path / "layouts.zip").write_bytes(b"")
    return path


@pytest.mark.slow
def test_no_report_layout_is_read_before_a_winner_stands(optimize: Typed, tmp_path: Path) -> None:
    path = broken_report(tmp_path)
    file = tmp_path / "prompts" / "mine" / "ego.j2"
    text = file.read_text()
    file.write_text(text.replace("Creep.{% or %}Look.{% or %}Go.", "Go.{% or %}Creep."))
    code, _, wrong = optimize("--dataset", path)
    assert code == 0, wrong
    assert "no report layout was read" in (tmp_path / "reports" / "new" / "index.html").read_text()
    assert not (tmp_path / "prompts" / "new").exists(), (
        "the base is the best, so there is no new version"
    )
    file.write_text(text)
    code, _, wrong = optimize("--dataset", path, out="other")
    assert (code, "layouts.zip" in wrong) == (2, True), "the winner's certificate reads them"
    assert not (tmp_path / "prompts" / "other").exists()


@pytest.mark.slow
def test_a_winner_is_not_certified_where_it_was_tuned(
    optimize: Typed, small_path: Path, tmp_path: Path
) -> None:
    """Layouts under report seeds that are those of the search, and learnt from by nobody."""
    report = shutil.copytree(small_path, tmp_path / "datasets" / "report")
    count = len(load(small_path).episodes)
    relabel(report, {number: 300_000 + number for number in range(count)})
    code, _, wrong = optimize("--dataset", report)
    assert (code, wrong.count("\n")) == (2, 1), wrong
    assert "and numbers are reported of that; build one of other seeds" in wrong
    assert not (tmp_path / "prompts" / "new").exists()


@pytest.mark.slow
def test_the_budget_is_never_exceeded(optimize: Typed, model: Model, tmp_path: Path) -> None:
    code, _, wrong = optimize(budget=3)
    assert code == 2
    assert "the base alone takes more" in wrong
    assert len(model.chats) <= 3
    assert optimize("--folder", tmp_path / "some", budget=30)[0] == 0
    record = json.loads((tmp_path / "some" / "optimize.json").read_text())
    assert record["questions"] <= 30


def test_an_alternative_that_does_not_render_is_named(
    optimize: Typed, model: Model, tmp_path: Path
) -> None:
    file = tmp_path / "prompts" / "mine" / "ego.j2"
    file.write_text(file.read_text().replace("Look.", "{{ nobody.knows }}"))
    code, _, wrong = optimize()
    assert code == 2
    assert "alternative 2 of pace: prompt mine ego.j2 does not render" in wrong
    assert not model.chats


def test_a_dry_run_asks_nothing_and_writes_nothing(
    harness: Typed, optimize: Typed, model: Model, tmp_path: Path, small_path: Path
) -> None:
    usual = (
        "--model",
        "m",
        "--prompt",
        "mine",
        "--tune",
        small_path,
        "--budget",
        99,
        "--out",
        "new",
    )
    code, out_text, _ = harness("prompt", "optimize", *usual, "--dry-run", "--json")
    record = json.loads(out_text)
    assert code == 0
    assert not model.chats
    assert not (tmp_path / "reports").exists()
    assert record["choices"] == {"pace": 3, "parts": 2}
    assert record["wordings"] == 6
    assert record["wordings_in_a_round"] == 4
    assert record["budget"] == 99
    assert record["questions_a_wording"] >= len(load(small_path).episodes)


def played(small: Dataset, episode: int, step: int, p: tuple[float, ...]) -> Decision:
    """A decision of an ego that has kept its speed so far."""
    dataset = small.of_episodes({episode})
    forest = dataset.forest
    at = int(forest.root[0])
    for _ in range(step):
        at = int(forest.child[at, 1])
    scene = dataset.scenes([forest.ids[at]])[0]
    return Decision(dataset, scene, np.array(p), int(np.argmax(p)), (), "")


def by_hand(small: Dataset, episode: int, at: int) -> list[float]:
    """The share of courses that succeed after each action, counted course by course."""
    forest = small.of_episodes({episode}).forest

    def share(node: int, action: int) -> float:
        child = int(forest.child[node, action])
        if child < 0:
            return float(forest.succeeds(forest.edge[node, action], np.array(0)))
        return sum(share(child, a) for a in range(len(forest.actions))) / len(forest.actions)

    return [share(at, action) for action in range(len(forest.actions))]


def test_feedback_is_exact_and_counterfactual(small: Dataset) -> None:
    lines = []
    for episode in small.episodes:
        for step in (0, 1, 2):
            decision = played(small, episode, step, (0.1, 0.2, 0.7))
            worth = by_hand(small, episode, decision.dataset.forest.place[decision.scene.id])
            text = of_decision(decision)
            assert text.startswith(
                "It stated SLOWER 0.10, IDLE 0.20, FASTER 0.70, and did FASTER. "
            )
            if not max(worth):
                assert "No action could save the episode any more." in text
                continue
            best = worth.index(max(worth))
            assert f"{small.actions[best]} was worth {worth[best]:.2f}" in text
            for action, value in zip(small.actions, worth, strict=True):
                if value < worth[best]:
                    after = ", and nothing could save" if not value else ""
                    assert f"{action} lost {worth[best] - value:.2f}{after}" in text
            lines.append(text)
    hidden = [line for line in lines if "was out of sight" in line]
    assert hidden
    assert all(" m, from " in line and "no message came" in line for line in hidden)


def test_feedback_is_on_the_layouts_own_road() -> None:
    crossing = load(find("sumo-crossing-v1"))
    lines = [of_decision(played(crossing, episode, 0, (0.2,) * 5)) for episode in range(9, 15)]
    assert any("was out of sight" in line for line in lines)


def test_feedback_says_what_no_message_held(small: Dataset) -> None:
    quiet = next(
        decision
        for episode in small.episodes
        if "out of sight" in of_decision(decision := played(small, episode, 0, (0.1, 0.2, 0.7)))
    )
    name = of_decision(quiet).split("out of sight")[0].rsplit(" at ", 1)[0].split()[-1]

    class Heard:
        raw, message = "", {"evidence": "nothing"}

    class Named:
        raw, message = "", {"evidence": f"{name} from left, gap +0.2 s"}

    assert ("it was in no message") in of_decision(quiet._replace(heard=(Heard(),)))  # type: ignore[arg-type]
    assert ("a message named it") in of_decision(quiet._replace(heard=(Heard(), Named())))  # type: ignore[arg-type]


def test_feedback_on_a_course_is_on_its_worst_decision(small: Dataset) -> None:
    first, second = (played(small, 0, step, (0.8, 0.1, 0.1)) for step in (0, 1))

    def lost(decision: Decision) -> float:
        forest = decision.dataset.forest
        worth = forest.worth[forest.place[decision.scene.id]]
        return float(worth.max() - decision.policy @ worth)

    worst, text = of_course(Played(0.0, 0.5, (first, second)))
    assert worst.scene.id == max((first, second), key=lost).scene.id
    assert text.startswith(of_decision(worst))
    assert text.endswith("The episode failed.")


@pytest.mark.exhaustive
def test_gepa_rewrites_the_system_text_by_what_went_wrong(
    optimize: Typed, model: Model, tmp_path: Path, small: Dataset
) -> None:
    pytest.importorskip("gepa")
    code, _, wrong = optimize("--reflect", "m", "--budget", 200, out="whole")
    assert code == 0, wrong
    whole = history(tmp_path, "whole")
    for lives in (0, 40):
        model.lives = lives
        assert optimize("--reflect", "m", "--budget", 200)[0] == 3, "it stops on the way"
    model.lives = 10**6
    assert optimize("--reflect", "m", "--budget", 200)[0] == 0
    record = history(tmp_path)
    for name in ("tried", "chosen", "questions", "tokens", "certificate", "sha256"):
        assert record[name] == whole[name], name
    assert record["engine"] == "GEPA with m"
    assert record["tried"][1]["system"] == {"ego": "You drive. Go."}
    asked = [chat for chat in model.chats if "Write only the template" in chat]
    assert (asked and "{{ words.task }}" in asked[0]) or "{{ graph.ego.id }}" in asked[0]
    assert "was worth" in asked[0]
    assert "The episode" in asked[0]
    new = prompts.load("new", tmp_path / "prompts")
    assert systems(new)["ego"] == "You drive. Go."
    assert record["questions"] <= 200


@pytest.mark.exhaustive
def test_a_lone_surrogate_of_a_reflecting_model_is_a_text_of_its_own(
    optimize: Typed, model: Model, tmp_path: Path
) -> None:
    pytest.importorskip("gepa")
    model.written = "```\nDrive \ud800.\n```"
    code, _, wrong = optimize("--reflect", "m", "--budget", 200)
    assert code == 0, wrong
    assert history(tmp_path)["tried"][1]["system"] == {"ego": "Drive ?."}


@pytest.mark.slow
@pytest.mark.parametrize("written", ["{{ no end", "\ud83d {{ graph.items }}"], ids=ascii)
def test_what_a_reflecting_model_breaks_is_worth_nothing(
    written: str, optimize: Typed, model: Model, tmp_path: Path
) -> None:
    pytest.importorskip("gepa")
    model.written = f"```\n{written}\n```"
    code, _, wrong = optimize("--reflect", "m", "--budget", 200)
    assert code == 0, wrong
    assert "None is better" in (tmp_path / "reports" / "new" / "index.html").read_text()
    assert not (tmp_path / "prompts" / "new").exists()
