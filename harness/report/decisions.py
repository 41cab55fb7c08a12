"""What the report shows of a decision: the scene, who answered what to which prompt, and what came of it."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from harness import prompts as versions
from harness import readout
from harness.dataset.load import Scene
from harness.drawing.pictures import uri
from harness.drawing.scene import draw
from harness.drive.folder import Driven
from harness.drive.replay import scene_of
from harness.errors import UserError, printable
from harness.files import digest
from harness.report.choose import Pick, decisions_of
from harness.run.folder import Row, Run, dataset_of

Messages = Sequence[Mapping[str, Any]]
Prompts = Callable[[Scene, str, Messages], Sequence[Mapping[str, str]]]


def prompts_of(run: Run) -> Prompts | None:
    """Gives the chat messages that a viewer was sent; None if the run's prompt is not here as it was."""
    version, actions = str(run.config["prompt"]["version"]), tuple(run.config["actions"])
    if version not in versions.names():
        return None
    prompt = versions.load(version)
    if prompt.sha256 != run.config["prompt"]["sha256"]:
        return None

    def sent(scene: Scene, viewer: str, heard: Messages) -> Sequence[Mapping[str, str]]:
        messages = prompt.render(scene.record["graphs"][viewer], actions, heard)
        return readout.asked(messages, actions) if run.answer == "readout" else messages

    return sent


def cards(run: Run, picks: Sequence[Pick], prompts: Prompts | None) -> Iterator[dict[str, Any]]:
    """What the template shows of each decision."""
    if isinstance(run, Driven):
        for chosen in picks:
            scene = scene_of(run, chosen.row)
            same = scene.id == chosen.row["scene"]  # or this simulator is not what the run's was
            ends = _ends(chosen, run)
            good = {condition: end["result"] == "cleared" for condition, end in ends.items()}
            card = _card(chosen, scene if same else None, run, prompts, good)
            yield {**card, "ends": ends, "seed": chosen.seed}
        return
    scenes = {scene.id: scene for scene in dataset_of(run).scenes}
    for chosen in picks:
        if chosen.row["scene"] not in scenes:
            raise UserError(
                f"{printable(run.path / 'rows.jsonl')} has scene {printable(chosen.row['scene'])!r}, "
                "which its dataset has not; make the run again"
            )
    for chosen in picks:
        scene = scenes[chosen.row["scene"]]
        safe = {d["condition"]: d["safe"] for d in decisions_of(chosen.row, chosen.seed)}
        card = _card(chosen, scene, run, prompts, safe)
        outcomes = _outcomes(scene, run.config["actions"], chosen.row)
        yield {**card, "outcomes": outcomes, "avoidable": any(chosen.row["safe"])}


def _card(
    chosen: Pick, scene: Scene | None, run: Run, prompts: Prompts | None, good: Mapping[str, bool | None]
) -> dict[str, Any]:
    """What decisions of any run have; without a scene there is no picture and no prompt.

    `good` says by condition whether the decision, or what it was a part of, came to a good end.
    """
    actions, row, picture = run.config["actions"], chosen.row, io.BytesIO()
    if scene:
        draw(scene, picture, "svg")

    def prompt(viewer: str, answer: Mapping[str, Any]) -> Sequence[Mapping[str, str]] | None:
        if not scene or not prompts:
            return None
        sent = prompts(scene, viewer.partition("+")[0], _heard(row, viewer))
        return sent if answer.get("prompt_sha256") in (None, digest(sent)) else None

    return {
        "id": row["scene"],
        "danger": row["danger"],
        "why": chosen.why,
        "picture": uri(picture.getvalue()) if scene else None,
        "choices": [
            {**d, "good": good[d["condition"]], "bars": _bars(actions, d["fused"])}
            for d in decisions_of(row, chosen.seed)
        ],
        "answers": [
            {
                **answer,
                "viewer": viewer,
                "bars": _bars(actions, answer.get("intent")),
                "prompt": prompt(viewer, answer),
            }
            for viewer, answer in (*row["answers"].items(), *row.get("merged", {}).items())
        ],
    }


def _outcomes(scene: Scene, actions: Sequence[str], row: Row) -> list[dict[str, Any]]:
    """What each action leads to, in a frozen scene."""
    return [
        {**scene.record["outcomes"][action], "action": action, "safe": safe, "delay_s": delay_s}
        for action, safe, delay_s in zip(actions, row["safe"], row["delay_s"], strict=True)
    ]


def _ends(chosen: Pick, run: Driven) -> dict[str, dict[str, Any]]:
    """What became of the episode in each condition, whether it still came to this moment or not."""
    here = {d["condition"] for d in decisions_of(chosen.row, chosen.seed)}
    return {
        condition: {**run.ends[condition, chosen.seed, chosen.row["episode"]], "here": condition in here}
        for condition in run.conditions
    }


def _heard(row: Row, viewer: str) -> Messages:
    """What an ego that answered a second time had heard, from its key in `merged`: itself and the senders."""
    said = {sender: row["answers"][sender] for sender in viewer.split("+")[1:] if sender in row["answers"]}
    return [{"sender": s, "intent": a["intent"], **(a["message"] or {})} for s, a in said.items()]


def _bars(actions: Sequence[str], p: Sequence[float] | None) -> list[tuple[str, float]]:
    return list(zip(actions, map(float, p), strict=True)) if p else []
