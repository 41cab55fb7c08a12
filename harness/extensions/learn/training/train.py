"""Training in four stages, each from the weights of the one before.

1. `excerpts`: prompts that show nothing but the conflicts, so that reading the numbers is learnt on
   short sequences. The read-out (one letter) is fitted to the soft label by KL, and a report in
   words follows it, which names the gap between two arrivals.
2. `alone`: the same with whole prompts, of every viewer.
3. `messages`: the ego with its helpers' read-outs as messages, the same loss; stage 2 is rehearsed.
4. `answers`: the text. It states the read-out's own distribution:
   greedy text taught on the labels would give their mode, not their mean.

All along the prompts' own tokens are learnt as well: a label is a bit or two a prompt, and reading
the numbers in it has to come from somewhere. For the same reason each token of a picture says what
it shows (`answers.cells`), in every stage. A batch shares its system message, which is computed
once.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from harness.core.arrays import Floats
from harness.core.files import replacing
from harness.core.work import kept_file
from harness.extensions.learn.training.answers import cells
from harness.extensions.learn.training.model import image_processor
from harness.extensions.learn.training.muon import Muon
from harness.extensions.learn.training.published import Adapt
from harness.world.perception.camera import Sight

Objective = Literal["imitation", "values"]
STAGES = ("excerpts", "alone", "messages", "answers")
# of the cross-entropy of the prompt's own tokens, for a model that cannot read yet
PROMPT_WEIGHT = 0.3
# of that of the answer's: two thirds of these say nothing, and would drown the numbers
TEXT_WEIGHT = 3.0
LOG_STEPS = 50  # the loss is averaged over so many steps
CELLS_WEIGHT = 1.0  # of the cross-entropy of what each token of a picture shows
SEEN_WEIGHT = 4.0  # of the read-out of a picture, which is small beside what else it is fitted to
KEEP_S = 60.0  # a killed run loses at most so much


@dataclass(frozen=True)
class Sample:
    """Hold one training sequence: token ids of a prompt and its answer, and the answer's target.

    The target is what the model should answer, probabilities of the letters of A actions, (A,);
    None where the answer is a text. The first `shared` tokens are equal in all samples of a `kind`,
    and are computed once. The answer starts at the index `answer_at` of `ids` (tokens,). `weight`
    is relative to other samples', and `image` the picture whose tokens are among `ids`.
    """

    ids: NDArray[np.int32]  # token ids, (tokens,), the shared beginning included
    shared: int  # number of tokens of the shared beginning, equal in all samples of a `kind`
    kind: str  # key of that beginning
    answer_at: int  # index in `ids` at which the answer starts
    # what the read-out there, the probabilities of the actions' letters, should be, (A,), of one
    # length in a `kind`; None where the answer is a text from its first token
    target: Floats | None
    weight: float = 1.0  # sampling weight, relative to that of other samples
    # the picture behind the system message, whose tokens are among `ids`; all of a `kind` have one,
    # or none has
    image: Sight | None = None


@dataclass(frozen=True)
class Plan:
    """Describe a training: its length, batch size, learning rates, seed and objective.

    A stage is a part of the training with questions of its own, such as those without messages.
    """

    samples: dict[str, int]  # sequences per stage, by name
    batch: int = 16  # sequences a step
    muon_lr: float = 3e-3  # learning rate of the matrices (Muon)
    adam_lr: float = 3e-3  # learning rate of embeddings and norms (AdamW)
    seed: int = 0  # of the initial weights and of the order of samples
    adapt: Adapt | None = None  # how a published model is changed; None for one of ours
    objective: Objective = "imitation"  # what a letter's probability is fitted to

    def settings(self) -> dict[str, Any]:
        """Return as plain values, by name, the settings that a resumed training must not change.

        They are the fields of this plan, without the objective if it is the default.
        """
        settings = asdict(self)
        # trainings that were begun before there was another say nothing
        if self.objective == "imitation":
            del settings["objective"]
        return settings


# sequences seen, mean loss, and held-out KL and value if they are watched
Curve = list[tuple[Any, ...]]


def run_stage(
    model: Any,
    samples: Sequence[Sample],
    letters: Sequence[int],
    digits: Sequence[int],
    count: int,
    plan: Plan,
    progress: Callable[..., None],
    checkpoint: Path,
    watch: Callable[[], Sequence[float]] = tuple,
) -> Curve:
    """Train a model for one stage, and return the loss curve.

    Every 50 steps the curve gets a tuple: the sequences seen, the mean loss since then, and what
    `watch` returns.

    Args:
        model: a transformers model, trained in place.
        samples: what is drawn from, by their weights and the seed of `plan`.
        letters: ids of the tokens that stand for actions.
        digits: ids of the tokens that state how near the vehicle is which an image token shows.
        count: number of sequences to train on.
        plan: batch size, learning rates, seed and objective.
        progress: called with the numbers of each tuple.
        checkpoint: file of this stage, from which a killed call resumes.
        watch: returns further numbers for the curve, such as a loss on questions that are not
            learnt.
    """
    device = next(model.parameters()).device
    opts, rates = _optimizers(model, plan)
    batches = _batches(samples, count, plan)
    start, curve = 0, []
    losses: list[Any] = []
    if checkpoint.is_file():
        with kept_file(checkpoint):
            # where AdamW counts its steps
            state = torch.load(checkpoint, weights_only=True, map_location="cpu")
            restore(model, state["model"])
            for opt, kept in zip(opts, state["opts"], strict=True):
                opt.load_state_dict(kept)
            start, curve = state["step"], [tuple(point) for point in state["curve"]]
            losses = [loss.to(device) for loss in state.get("losses", ())]
    letter_ids, digit_ids = (torch.tensor(ids, device=device) for ids in (letters, digits))
    model.train()
    kept_s = time.monotonic()
    for step in range(start, len(batches)):
        scale = max(
            0.02, min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / len(batches)))
        )
        for opt, rate in zip(opts, rates, strict=True):
            opt.param_groups[0]["lr"] = rate * scale
        batch = [samples[i] for i in batches[step]]
        loss = loss_of(model, batch, letter_ids, digit_ids, plan)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        for opt in opts:
            opt.step()
            opt.zero_grad(set_to_none=True)
        losses.append(loss.detach())  # not yet a number: a GPU need not wait for it
        if (step + 1) % LOG_STEPS == 0 or step + 1 == len(batches):
            mean = float(torch.stack(losses).double().mean())
            curve.append(((step + 1) * plan.batch, mean, *watch()))
            model.train()
            progress(*curve[-1])
            losses = []
        if time.monotonic() - kept_s > KEEP_S and step + 1 < len(batches):
            states = [opt.state_dict() for opt in opts]
            save(
                {
                    "model": learnt(model),
                    "opts": states,
                    "step": step + 1,
                    "curve": curve,
                    "losses": losses,
                },
                checkpoint,
            )
            kept_s = time.monotonic()
    return curve


def _optimizers(model: Any, plan: Plan) -> tuple[list[Any], list[float]]:
    """Return what moves the weights that learn, and its learning rates."""
    learning = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
    if plan.adapt:
        every = [p for _, p in learning]
        return [
            torch.optim.AdamW(every, lr=plan.adapt.rate, weight_decay=0.0, betas=(0.9, 0.98))
        ], [plan.adapt.rate]
    blocks = [p for n, p in learning if p.ndim == 2 and "embed" not in n]
    rest = [p for n, p in learning if p.ndim != 2 or "embed" in n]
    return [
        Muon(blocks, lr=plan.muon_lr, weight_decay=0.05),
        torch.optim.AdamW(rest, lr=plan.adam_lr, weight_decay=0.0, betas=(0.9, 0.98)),
    ], [plan.muon_lr, plan.adam_lr]


def learnt(model: Any) -> dict[str, Any]:
    """Return the trainable part of a PyTorch model's state for a checkpoint: tensors by name."""
    # an output embedding may be the input's as well
    every = model.named_parameters(remove_duplicate=False)
    frozen = {name for name, p in every if not p.requires_grad}
    return {name: value for name, value in model.state_dict().items() if name not in frozen}


def restore(model: Any, state: Mapping[str, Any]) -> None:
    """Load the trainable tensors of a checkpoint, by name in `state`, into a PyTorch model."""
    model.load_state_dict({**model.state_dict(), **state})


def _batches(samples: Sequence[Sample], count: int, plan: Plan) -> NDArray[np.int64]:
    """Return each step's samples by number, (steps, batch):
    of one kind and like length, in random order.
    """
    rng = np.random.default_rng(plan.seed)
    weights = np.array([sample.weight for sample in samples])
    order = rng.choice(len(samples), count, p=weights / weights.sum())
    kinds = np.array([samples[i].kind for i in order])
    lengths = np.array([len(samples[i].ids) for i in order])
    parts = []
    for kind in sorted(set(kinds)):
        same = order[kinds == kind]
        size = lengths[kinds == kind]
        window = plan.batch * 32
        for start in range(0, len(same), window):
            part = same[start : start + window]
            part = part[np.argsort(size[start : start + window], kind="stable")]
            short = -len(part) % plan.batch
            part = np.concatenate([part, part[rng.integers(0, len(part), short)]])
            parts.append(part.reshape(-1, plan.batch))
    batches = np.concatenate(parts)
    return batches[rng.permutation(len(batches))][: max(1, count // plan.batch)]


def hidden_states(model: Any, batch: Sequence[Sample]) -> Any:
    """Return the last hidden states behind a batch's shared tokens, (n, longest rest, hidden).

    That is a tensor for n samples, the tokens of the longest one behind the shared ones, and the
    features of a hidden state. `model` is a transformers model, and the samples are of one `kind`.
    States at padding mean nothing.
    """
    from transformers import DynamicCache

    device = next(model.parameters()).device
    shared = batch[0].shared
    cache = DynamicCache(config=model.config)
    ids = _padded([s.ids for s in batch]).to(device)
    model.base_model(ids[:1, :shared], past_key_values=cache, use_cache=True)
    cache.batch_repeat_interleave(len(batch))
    options = _pictures(model, batch, ids)
    states = model.base_model(ids[:, shared:], past_key_values=cache, use_cache=True, **options)
    # in which letters are told apart, whatever layers compute in
    return states.last_hidden_state.float()


def _pictures(model: Any, batch: Sequence[Sample], ids: Any) -> dict[str, Any]:
    """Return what a model that sees takes beside tokens (n, width):
    patches, and where each token stands.
    """
    images = [s.image.pixels for s in batch if s.image is not None]
    if not images:
        return {}
    patches = image_processor()(images=images, return_tensors="pt").to(ids.device)
    places, _ = model.model.get_rope_index(
        ids,
        mm_token_type_ids=(ids == model.config.image_token_id).int(),
        image_grid_thw=patches["image_grid_thw"],
    )
    return {**patches, "position_ids": places[:, :, batch[0].shared :]}


def loss_of(model: Any, batch: Sequence[Sample], letters: Any, digits: Any, plan: Plan) -> Any:
    """Return the training loss of a batch of samples of one `kind`, a scalar tensor.

    It is the loss of the read-out beside its target (`fitting`), plus mean cross-entropies of
    prompt text, answer text and image tokens. `letters` and `digits` are tensors of token ids: of
    the letters of actions, and of the classes that image tokens are to state. `plan` has the
    objective.
    """
    hidden = hidden_states(model, batch)
    weight, device, shared = model.get_output_embeddings().weight, hidden.device, batch[0].shared
    rest = _padded([s.ids[shared:] for s in batch]).to(device)
    # a model of texts has no such token
    picture = rest == getattr(model.config, "image_token_id", -1)
    pictures = [s.image for s in batch if s.image is not None]  # of all or of none
    total = hidden.new_zeros(())
    if not plan.adapt:  # a published model can read
        total = PROMPT_WEIGHT * _prompt_loss(hidden, weight, batch, rest, picture)
    if pictures:
        total = total + CELLS_WEIGHT * _cells_loss(hidden[picture] @ weight[digits].T, pictures)
    targets = {i: s.target for i, s in enumerate(batch) if s.target is not None}
    if targets:
        reading = list(targets)
        at = torch.tensor([batch[i].answer_at - shared - 1 for i in reading], device=device)
        logits = hidden[torch.tensor(reading, device=device), at] @ weight.T
        target = torch.from_numpy(np.stack(list(targets.values()))).to(logits)
        letters = letters[: target.shape[1]]
        fit = fitting(logits[:, letters], target, plan.objective)
        # Beside the letters nothing should be likely where a letter is asked for.
        outside = torch.logsumexp(logits, -1) - torch.logsumexp(logits[:, letters], -1)
        fit_weight = SEEN_WEIGHT if pictures else 1.0
        total = total + (fit_weight * fit + 0.1 * outside.mean()) * len(reading) / len(batch)
    answers = [(i, s.answer_at + (s.target is not None), len(s.ids)) for i, s in enumerate(batch)]
    writing = [(i, start, end) for i, start, end in answers if start < end]
    if writing:
        rows = np.concatenate([np.full(end - start, i) for i, start, end in writing])
        columns = np.concatenate([np.arange(start, end) for _, start, end in writing])
        ids = np.concatenate([batch[i].ids[start:end] for i, start, end in writing]).astype(
            np.int64
        )
        row, column = (torch.from_numpy(at).to(device) for at in (rows, columns - shared - 1))
        text = F.cross_entropy(
            hidden[row, column] @ weight.T, torch.from_numpy(ids).to(device), reduction="none"
        )
        weights = np.full(len(batch), TEXT_WEIGHT)
        if plan.adapt:
            weights[list(targets)] = plan.adapt.report
        text = text * torch.from_numpy(weights[rows]).to(text)
        total = total + text.mean() * len(writing) / len(batch)
    return total


def fitting(logits: Any, labels: Any, objective: Objective) -> Any:
    """Return the mean loss of letter logits (n, A) beside soft labels (n, A).

    Soft labels are the probabilities of actions to be learnt. There are n answers and A actions,
    each with a letter. `imitation` is the KL divergence from the label, in nats. `values` is 1 -
    sum_a p(a) v(a), where p is the softmax of the logits and v(a) is 1 if the episode succeeds
    after action a: its gradient is the exact policy gradient.
    """
    if objective == "imitation":
        return F.kl_div(F.log_softmax(logits, -1), labels, reduction="batchmean")
    return (1 - (torch.softmax(logits, -1) * (labels > 0)).sum(-1)).mean()


def _prompt_loss(hidden: Any, weight: Any, batch: Sequence[Sample], ids: Any, picture: Any) -> Any:
    """Return the cross-entropy of the prompt's own tokens behind the shared ones:
    it teaches numbers.

    Tokens that stand for a `picture` are none of them; like `ids`, that mask is (n, longest rest).
    """
    places = torch.arange(ids.shape[1])
    ends = torch.tensor([s.answer_at - s.shared for s in batch])
    there = (places[None, 1:] < ends[:, None]).to(hidden.device) & ~picture[:, 1:]
    return F.cross_entropy((hidden[:, :-1][there]) @ weight.T, ids[:, 1:][there])


def _cells_loss(logits: Any, pictures: Sequence[Sight]) -> Any:
    """Return the cross-entropy of what each picture's tokens show;
    vehicles and nobody weigh alike.
    """
    classes = np.concatenate([cells(picture) for picture in pictures])
    target = torch.from_numpy(classes).to(logits.device)
    weight = torch.full(
        (logits.shape[1],), 1.0 / max(1, int((classes > 0).sum())), device=logits.device
    )
    weight[0] = 1.0 / max(1, int((classes == 0).sum()))
    return F.cross_entropy(logits, target, weight=weight, reduction="sum") / 2


def read_out(
    model: Any, samples: Sequence[Sample], letters: Sequence[int], batch: int = 64
) -> list[Floats]:
    """Return the model's distribution over A action letters at each sample's answer, (A,) each.

    `letters` has the letters' token ids; `batch` is the number of samples computed at once.
    """
    model.eval()
    device = next(model.parameters()).device
    of_letters = model.get_output_embeddings().weight[torch.tensor(letters, device=device)]
    p: dict[int, Floats] = {}
    order = sorted(range(len(samples)), key=lambda i: (samples[i].kind, samples[i].answer_at))
    for _, group in groupby(order, key=lambda i: samples[i].kind):
        same = list(group)
        target = samples[same[0]].target
        assert target is not None
        weight = of_letters[: len(target)]
        for start in range(0, len(same), batch):
            some = same[start : start + batch]
            prompts = [
                replace(samples[i], ids=samples[i].ids[: samples[i].answer_at]) for i in some
            ]
            last = torch.tensor([len(s.ids) - s.shared - 1 for s in prompts], device=device)
            with torch.no_grad():
                hidden = hidden_states(model, prompts)
                logits = hidden[torch.arange(len(some), device=device), last] @ weight.T
            p.update(zip(some, torch.softmax(logits.double(), -1).cpu().numpy(), strict=True))
    return [p[i] for i in range(len(samples))]


def _padded(rows: Sequence[NDArray[np.int32]]) -> Any:
    ids = np.zeros((len(rows), max(map(len, rows))), dtype=np.int64)
    for row, values in zip(ids, rows, strict=True):
        row[: len(values)] = values
    return torch.from_numpy(ids)


def save(state: Mapping[str, Any], path: Path) -> None:
    """Write a training checkpoint to the file `path`, whole or not at all.

    `state` is what a resumed training needs, by name: anything that PyTorch's `save` can write.
    """
    with replacing(path) as part:
        torch.save(state, part)
