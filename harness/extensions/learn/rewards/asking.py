"""What a viewer is asked, and what its answer is worth: texts in, rewards out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.arrays import Ints
from harness.core.seeds import purpose
from harness.dataset.load import Dataset, Scene
from harness.evaluate.chats import Asking
from harness.extensions.learn.rewards.values import Values, optimal
from harness.parsing.parse import parse
from harness.prompts import readout

ANY = "any"  # the viewer is drawn among all


def read_by(asking: Asking, role: str) -> dict[str, Any]:
    """Return how answers of a role (`ego`, `helper`) are parsed, as keyword arguments of `intent`.

    `asking` has the prompt and the answer mode. The keys are `answer` (the answer mode), `role`,
    `actions` (their names), `form` (the form of answer that the prompt asks for), `extension` (JSON
    text of the schemas of further members) and `reasons_first` (whether reasons may stand before).
    """
    shape = asking.prompt.shape(role, asking.scenario.actions)
    return {
        "answer": asking.answer,
        "role": role,
        "actions": list(shape.actions),
        "form": shape.form,
        "extension": shape.extension,
        "reasons_first": role in asking.prompt.reasons_first,
    }


def viewer_of(scene: Scene, viewer: str | None, draw: float) -> str:
    """Return the id of the vehicle that is asked in a scene.

    `viewer` is a vehicle's id, None for the ego, or `any` for a random one: then a uniform `draw`
    in [0, 1) chooses.
    """
    return scene.viewers[int(draw * len(scene.viewers))] if viewer == ANY else scene.viewer(viewer)


def rows(
    data: Dataset, values: Values, constant: int, asking: Asking, viewer: str | None, at: Ints
) -> Iterator[dict[str, Any]]:
    """Yield a training row, for a trainer of text models, for each decision point in `at`, (n,).

    A decision point is a situation in which a vehicle must decide. A row is a dict: `prompt` has
    the chat messages that ask; the other columns are what a reward function needs: `values`, the
    probability of success after each of A actions, (A,), `constant`, and how the answer is parsed.

    Args:
        data: the dataset with the decision points' scenes.
        values: what each action is worth at each decision point.
        constant: index of the action that is always taken, beside which answers are judged.
        asking: the prompt, and how to answer (free text or one letter).
        viewer: who is asked: a vehicle's id, None for the ego, or `any` for a random one.
        at: indices of decision points among all of the dataset, repeats allowed, (n,).
    """
    forest = data.forest
    names = list(dict.fromkeys(forest.ids[n] for n in at.tolist()))
    scenes = dict(zip(names, data.scenes(names), strict=True))
    for n in at.tolist():
        scene, seed = scenes[forest.ids[n]], int(forest.seeds[forest.tree[n]])
        name = viewer_of(scene, viewer, float(noise.uniforms((), "viewer", scene.id)))
        graph = scene.graphs[name]
        yield {
            "prompt": asking.chat(graph, scene.seat),
            "scene": scene.id,
            "viewer": name,
            "values": values.table[n].tolist(),
            "optimal": optimal(values.table[n]).tolist(),
            "constant": constant,
            "scenario": data.scenario.name,
            "layout_seed": seed,
            "purpose": purpose(seed, 1),
            "danger": forest.dangers[forest.tree[n]] is not None,
            **read_by(asking, graph.role),
        }


def intent(
    text: str,
    *,
    answer: str,
    role: str,
    actions: Sequence[str],
    form: str | None = None,
    extension: str = "",
    reasons_first: bool = False,
) -> tuple[float, ...] | None:
    """Return the distribution over A actions, (A,), that an answer's text states.

    It is None if the text cannot be parsed. The arguments but `text` are what `read_by` returns.

    Args:
        text: the raw answer.
        answer: the answer mode: `readout` (one letter for an action), `json` or another.
        role: who answered, `ego` or `helper`.
        actions: names of the A actions, in the order of the result.
        form: the form of answer that the prompt asks for; None for any.
        extension: JSON text of the schemas of further members that the prompt asks for; empty for
            none.
        reasons_first: whether reasons may stand before the answer.
    """
    if answer == "readout":
        letter = readout.spelt(text)[:1]
        letters = readout.letters(actions)
        is_letter = letter and letter in letters and not readout.spelt(text)[1:2].isalnum()
        return tuple(float(each == letter) for each in letters) if is_letter else None
    return parse(
        text,
        role=role,
        actions=tuple(actions),
        form=form,
        extension=extension,
        reasons_first=reasons_first,
    ).intent


# of a distribution, by what actions are worth
Worth = Callable[[Sequence[float], Sequence[float]], float]


def driven(p: Sequence[float], values: Sequence[float]) -> float:
    """Return the worth of an answer as it is driven: that of its likeliest action.

    The worth of an action is the probability of success after it. `p` (A,) is the answer's
    distribution over A actions, `values` (A,) each one's worth. Of equally likely actions it is
    their mean.
    """
    likeliest = np.array(p) == max(p)
    return float(np.mean(np.array(values)[likeliest]))


def expected_success(p: Sequence[float], values: Sequence[float]) -> float:
    """Return the mean of `values` (A,), each action's probability of success, under `p` (A,).

    `p` is a distribution over the A actions. Unlike `driven`, it tells apart distributions with the
    same likeliest action.
    """
    return float(np.dot(p, values))


def earned(
    text: str, values: Sequence[float], constant: int, worth: Worth = driven, **how: Any
) -> float:
    """Return the advantage of an answer: its worth less that of the scenario's constant action.

    The constant action is one that is always taken; `constant` is its index. `values` (A,) has the
    probability of success after each of A actions. `worth` takes a distribution over actions and
    these values, and returns one number, such as `driven`. An answer that cannot be parsed has
    worth 0. `how` are the further arguments of `intent`, by which the text is parsed.
    """
    p = intent(text, **how)
    return (0.0 if p is None else worth(p, values)) - float(values[constant])


READ_BY = ("answer", "role", "actions", "form", "extension", "reasons_first")


def advantage(
    prompts: Sequence[Any],
    completions: Sequence[Any],
    *,
    values: Sequence[Sequence[float]],
    constant: Sequence[int],
    **columns: Any,
) -> list[float]:
    """Return the advantage of each completion: a reward function for TRL's trainers.

    The advantage is the probability of success after the action that the answer makes likeliest,
    less that after one action that is always taken. The arguments but the first two are columns of
    the training rows, with a value for each completion.

    Args:
        prompts: as the trainer has them; not read.
        completions: texts, or chats whose last message is the answer; one without a text cannot be
            parsed, and its worth is 0.
        values: the probability of success after every action, (A,).
        constant: the index of the action that is always taken.
        columns: how answers are parsed; columns of other names are ignored.
    """
    return _rewards(driven, completions, values, constant, columns)


def expected_advantage(
    prompts: Sequence[Any],
    completions: Sequence[Any],
    *,
    values: Sequence[Sequence[float]],
    constant: Sequence[int],
    **columns: Any,
) -> list[float]:
    """Return the advantage of the distribution that each completion states: a reward for TRL.

    The advantage is the mean probability of success under the distribution, less that of one action
    that is always taken. It differs between answers with the same likeliest action, so that few
    samples teach more; but an answer that is unsure and right earns less than one that is sure. The
    arguments but the first two are columns of the training rows, with a value for each completion.

    Args:
        prompts: as the trainer has them; not read.
        completions: texts or chats; one that cannot be parsed states success 0.
        values: the probability of success after every action, (A,).
        constant: the index of the action that is always taken.
        columns: how answers are parsed; columns of other names are ignored.
    """
    return _rewards(expected_success, completions, values, constant, columns)


def _rewards(
    worth: Worth,
    completions: Sequence[Any],
    values: Sequence[Sequence[float]],
    constant: Sequence[int],
    columns: Mapping[str, Any],
) -> list[float]:
    rewards = []
    for n, completion in enumerate(completions):
        how = {name: columns[name][n] for name in READ_BY}
        rewards.append(earned(_text(completion), values[n], constant[n], worth, **how))
    return rewards


def _text(completion: Any) -> str:
    """Return the text of a completion, or of a chat's last message; empty if it has none.

    What a tool or a user said last is not the model's.
    """
    if isinstance(completion, Sequence) and not isinstance(completion, str):
        last = completion[-1] if completion else {}
        by_model = isinstance(last, Mapping) and last.get("role", "assistant") == "assistant"
        completion = last.get("content") if by_model else None
    if isinstance(completion, list):  # a message in parts
        parts = (part.get("text") for part in completion if isinstance(part, Mapping))
        completion = "".join(part for part in parts if isinstance(part, str))
    return completion if isinstance(completion, str) else ""
