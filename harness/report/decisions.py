"""What a page knows of each decision: an index of all, and details in blocks that are read when opened."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.files import digest
from harness.dataset.load import Scene
from harness.evaluate.replay import scene_of
from harness.parsing.parse import Status, spans
from harness.prompts import readout, versions
from harness.report import scenes
from harness.report.choose import failures, pick
from harness.report.runs import Runs
from harness.runs.driven_folder import Driven
from harness.runs.folder import Row, Run, answers_of
from harness.world import scenarios

BLOCK = 24  # scenes that are compressed and read together
REPLAYED = 60  # moments of a live run that are played again, for their picture and prompts

Messages = Sequence[Mapping[str, Any]]
Sent = Callable[[Scene, str, Messages], Sequence[Mapping[str, str]]]
Prompts = Callable[[Run], Sent | None]
GOOD, SLOW, BAD, BLAMELESS, ABSENT = "s", "d", "u", "n", "-"
KEPT = (
    "role", "raw", "finish_reason", "error", "status", "verdict", "repairs", "detail", "intent", "mass",
    "message", "prompt_tokens", "completion_tokens", "seconds", "label_mass", "retries", "cached",
)  # fmt: skip
LEFT_OUT = ("seed", "safe", "delay_s", "fusion_ms", "effective_loss", "observed_loss", "normalised_entropy")


def prompts_of(run: Run) -> Sent | None:
    """Gives the chat messages that a viewer was sent; None if the run's prompt is not here as it was."""
    version, actions = str(run.config["prompt"]["version"]), tuple(run.config["actions"])
    if version not in versions.names():
        return None
    prompt = versions.load(version)
    if prompt.sha256 != run.config["prompt"]["sha256"]:
        return None

    def sent(scene: Scene, viewer: str, heard: Messages) -> Sequence[Mapping[str, str]]:
        words = scenarios.get(scene.state.scenario).words
        messages = prompt.render(scene.record["graphs"][viewer], actions, heard, words)
        return readout.asked(messages, actions) if run.answer == "readout" else messages

    return sent


class Decisions:
    """Everything that runs have to say of single scenes, in order of episode and step.

    Attributes:
        ids: of the scenes that any run has.
        index: what the list shows and filters by, for the page.
    """

    def __init__(self, runs: Runs, prompts: Prompts = prompts_of) -> None:
        self._runs = runs
        self._prompts = [prompts(run) for run in runs.runs]
        self._rows = [{str(row["scene"]): row for row in run.rows} for run in runs.runs]
        first = {scene: row for rows in reversed(self._rows) for scene, row in rows.items()}
        order = sorted(first.items(), key=lambda one: (one[1]["episode"], one[1]["step"], one[0]))
        self.ids = [scene for scene, _ in order]
        failed = [failures(run) for run in runs.runs]
        self._scenes = self._frozen() if runs.dataset else self._played(failed)
        self.index = {
            "actions": runs.actions,
            "scenes": [[scene, row["episode"], row["step"], row["danger"]] for scene, row in order],
            "block": BLOCK,
            "live": runs.live,
            "statuses": list(map(str, Status)),
            "runs": [
                self._indexed(run, rows, [str(run.rows[i]["scene"]) for i in first_failures])
                for run, rows, first_failures in zip(runs.runs, self._rows, failed, strict=True)
            ],
        }

    def _frozen(self) -> dict[str, Scene]:
        assert self._runs.dataset is not None
        found = {scene.id: scene for scene in self._runs.dataset.scenes}
        for run in self._runs.runs:
            for row in run.rows:
                if row["scene"] not in found:
                    raise UserError(
                        f"{printable(run.path / 'rows.jsonl')} has scene {printable(row['scene'])!r}, "
                        "which its dataset has not; make the run again"
                    )
        return found

    def _played(self, failed: Sequence[Mapping[int, int]]) -> dict[str, Scene]:
        """The telling moments, played again; none where this simulator is not what the run's was."""
        telling = [
            str(chosen.row["scene"])
            for run, of in zip(self._runs.runs, failed, strict=True)
            for chosen in pick(run.rows, of, REPLAYED)
        ]
        found: dict[str, Scene] = {}
        for name in dict.fromkeys(telling):
            here = [
                (run, of[name]) for run, of in zip(self._runs.runs, self._rows, strict=True) if name in of
            ]
            # Who asks nobody, such as a driver, sees a moment with fewer eyes.
            scene = scene_of(*max(here, key=lambda one: len(one[1]["answers"])))
            if scene.id == name:
                found[name] = scene
        return found

    def _indexed(self, run: Run, rows: Mapping[str, Row], first_failures: Iterable[str]) -> dict[str, Any]:
        """One run's part of the index: a letter a scene, condition and seed, in this order."""
        actions, statuses = list(run.config["actions"]), list(map(str, Status))
        acted, ended, asked, verdicts = [], [], [], []
        place = {scene: n for n, scene in enumerate(self.ids)}
        for scene in self.ids:
            row = rows.get(scene)
            made = {(d["condition"], d["seed"]): d for d in row["decisions"]} if row else {}
            for key in ((c, s) for c in run.conditions for s in run.config["seeds"]):
                d = made.get(key)
                acted.append(str(actions.index(d["action"])) if d else ABSENT)
                ended.append(_end(run, row, d) if row and d else ABSENT)
                asked.append("1" if d and d["triggered"] else "0")
            met = {a["status"] for a in answers_of(row).values()} if row else ()
            verdicts.append(sum(1 << statuses.index(status) for status in met if status in statuses))
        return {
            "conditions": run.conditions, "seeds": run.config["seeds"], "acted": "".join(acted),
            "ended": "".join(ended), "asked": "".join(asked), "statuses": verdicts,
            "first": [place[scene] for scene in first_failures],
        }  # fmt: skip

    def blocks(self) -> Iterator[list[dict[str, Any]]]:
        """Details of the scenes, so many a block."""
        for start in range(0, len(self.ids), BLOCK):
            yield [self._detail(scene) for scene in self.ids[start : start + BLOCK]]

    def _detail(self, name: str) -> dict[str, Any]:
        scene, rows = self._scenes.get(name), [of.get(name) for of in self._rows]
        sent: dict[str, Any] = {}
        told = [self._told(n, row, scene, sent) if row else None for n, row in enumerate(rows)]
        row = next(row for row in rows if row)
        return {
            "world": scene and scenes.world(scene),
            "outcomes": scenes.outcomes(scene, self._runs.actions, row) if scene and "safe" in row else None,
            "prompts": list(sent.values()),
            "runs": told,
        }

    def _told(self, n: int, row: Row, scene: Scene | None, sent: dict[str, Any]) -> dict[str, Any]:
        run, prompts = self._runs.runs[n], self._prompts[n]
        answers = []
        for viewer, answer in answers_of(row).items():
            shown = {
                key: v for key in KEPT if (v := answer.get(key)) is not None and v is not False and v != []
            }
            found = _read_in(answer, run) if answer["repairs"] else []
            asked = None
            if scene and prompts:
                messages = prompts(scene, viewer.partition("+")[0], _heard(row, viewer))
                key = digest(messages)
                if answer.get("prompt_sha256") in (None, key):
                    sent.setdefault(key, messages)
                    asked = list(sent).index(key)
            answers.append({**shown, "viewer": viewer, "spans": found, "prompt": asked})
        decisions: dict[str, dict[str, Any]] = {}  # seeds that came to the same are told once
        for d in row["decisions"]:
            made = {key: value for key, value in d.items() if key not in LEFT_OUT} | {
                "end": _end(run, row, d)
            }
            decisions.setdefault(repr(made), {**made, "seeds": []})["seeds"].append(d["seed"])
        ends = None
        if isinstance(run, Driven):
            ends = [
                {"condition": c, "seed": s, **run.ends[c, s, row["episode"]]}
                for c in run.conditions for s in run.config["seeds"]
            ]  # fmt: skip
        return {"answers": answers, "decisions": list(decisions.values()), "ends": ends}


def _read_in(answer: Row, run: Run) -> list[tuple[int, int]]:
    """Where in a recovered completion its answers stand."""
    role = "helper" if answer["role"] == "helper" else "ego"
    return spans(answer["raw"], role, run.config["actions"], bool(run.config.get("thinking")))


def _end(run: Run, row: Row, d: Row) -> str:
    """What came of a decision; live, what its episode came to."""
    if isinstance(run, Driven):
        result = run.ends[d["condition"], d["seed"], row["episode"]]["result"]
        return {"cleared": GOOD, "late": SLOW}.get(result, BAD)
    if not any(row["safe"]):
        return BLAMELESS
    if not d["safe"]:
        return BAD
    return SLOW if d["delay_s"] else GOOD


def _heard(row: Row, viewer: str) -> Messages:
    """What an ego that answered a second time had heard, from its key in `merged`: itself and the senders."""
    said = {sender: row["answers"][sender] for sender in viewer.split("+")[1:] if sender in row["answers"]}
    return [{"sender": s, "intent": a["intent"], **(a["message"] or {})} for s, a in said.items()]
