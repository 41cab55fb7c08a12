"""A published model that is taught: opened as it is evaluated,
its chat template and tokenizer kept.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import transformers
from numpy.typing import NDArray

from harness.backends.card import Card
from harness.backends.cards import argument
from harness.backends.chat import Chat, HubTokenizer
from harness.backends.engine import common_length
from harness.backends.transformers.engine import checkpoint, load
from harness.backends.weights import find_gguf, hub_commit, is_gguf, sha256_weights
from harness.core.errors import UserError, printable
from harness.extensions.learn.training import low_rank

WEIGHTS = "model.safetensors"
OBJECTIVES = {  # by name, what a letter's probability is fitted to
    "imitation": "the soft label",
    "values": "the probability of actions after which the episode succeeds",
}
_TELLING = 1e-3  # largest difference of logits that is rounding


@dataclass(frozen=True)
class Adapt:
    """Describe how a published model is fine-tuned: which weights, how fast, and for what.

    The model learns to answer with a letter for an action, followed by a report in words.
    """

    rank: int | None  # of the LoRA adapter that is trained; None trains all weights
    rate: float  # learning rate of AdamW
    # number format in which its layers compute; weights are float32
    dtype: Literal["float32", "bfloat16"] = "float32"
    # weight of the loss of the words that follow an answer's letter, beside the letter's loss, the
    # KL divergence of its probabilities from the ones to be learnt
    report: float = 0.3


class Published:
    """Hold a published text model while it is fine-tuned, with its tokenizer and chat template.

    It is made from the model's card (the file that describes it), and raises UserError if the
    weights cannot be found or taught. `model` is the transformers model, `card` its card, `sha256`
    the digest of its weights, `end` the piece of text that ends an answer, and `encode` returns a
    text's token ids.
    """

    def __init__(self, card: Card, adapt: Adapt, seed: int, device: str) -> None:
        """Open a card's weights on transformers.
        Raises UserError if they cannot be found or taught.
        """
        where = checkpoint(card)
        hub, self.model = load(card, where, dtype="float32", device=device)
        self.card, self.hub = card, hub
        # whose fused attention goes back more slowly than matrices do
        if torch.device(device).type == "cpu":
            self.model.set_attn_implementation("eager")
        self.sha256 = _digest(card, where)
        self.chat = Chat(card.name, HubTokenizer(hub), None, card.system)
        stops = self.chat.ends or (hub.eos_token_id,)
        self.end = self.chat.pieces(stops[:1])[0]
        self.encode = self.chat.encode
        self._heads: dict[str, list[int]] = {}
        self._check()
        if adapt.rank:
            low_rank.widen(self.model, adapt.rank, seed)
            self.model.to(device)
        if adapt.dtype == "bfloat16":
            trunk = self.model.base_model
            trunk.forward = torch.autocast(torch.device(device).type, torch.bfloat16)(trunk.forward)

    def read(self, messages: Sequence[Mapping[str, str]]) -> tuple[NDArray[np.int32], int, str]:
        """Return a chat's token ids (tokens,), how many are shared, and the key of that beginning.

        Shared are the first tokens, those of all messages but the last: they are equal in all chats
        with the same key, so that a trainer computes them once. `messages` are the chat's, each
        with `role` and `content`.
        """
        ids = self.encode(self.chat.render(messages, thinking=False))
        kind = "\n".join(message["content"] for message in messages[:-1])
        if kind not in self._heads:
            other = ({**message, "content": "?"} for message in messages[-1:])
            other_ids = self.encode(self.chat.render((*messages[:-1], *other), thinking=False))
            self._heads[kind] = ids[: common_length([ids, other_ids])]
        shared = common_length([ids, self._heads[kind]])
        return np.array(ids, dtype=np.int32), shared, f"{shared} {kind}"

    def letters(self, texts: str) -> list[int]:
        """Return the token id of each letter of `texts`, by which the model answers with an action.
        Raises UserError if a letter is not one token.
        """
        tokens = [self.encode(text) for text in texts]
        if any(len(each) != 1 for each in tokens):
            raise UserError(
                f"--base {printable(self.card.name)}: a letter of {texts} is no token of its own"
            )
        return [token for (token,) in tokens]

    def write(self, out: Path, weights: Mapping[str, Any]) -> None:
        """Write the fine-tuned model to the folder `out`.

        That is the LoRA adapter, or if all weights were trained the whole checkpoint with these
        `weights`, by name.
        """
        if any(isinstance(module, low_rank.LowRank) for module in self.model.modules()):
            low_rank.write(self.model, out, base_name(self.card))
            return
        transformers.utils.logging.disable_progress_bar()  # of a file that is written in no time
        self.model.save_pretrained(out, state_dict=weights)
        self.hub.save_pretrained(out)

    def _check(self) -> None:
        """Raise UserError if a model's logits are more than its states times its output
        embedding.
        """
        with torch.no_grad():
            ids = torch.tensor([self.encode("Answer with one letter.")], device=self.model.device)
            states = self.model.base_model(ids).last_hidden_state
            of_states = states @ self.model.get_output_embeddings().weight.T
            logits = self.model(ids).logits
        if (of_states - logits).abs().max() > _TELLING * max(1.0, float(logits.abs().max())):
            raise UserError(
                f"--base {printable(self.card.name)} changes its logits, which is not taught here"
            )


def base_name(card: Card) -> str:
    """Return the name by which `--model` finds a model: its card's path, or its id on the hub.

    A card is a file that describes a model.
    """
    named = argument(card)
    return named.partition(":")[0] if named == card.name else named


def _digest(card: Card, where: Path) -> str:
    """Return the sha256 of a model's weights:
    of its GGUF file or its only shard, else its commit.
    """
    file = find_gguf(card) if is_gguf(card) else where / WEIGHTS
    return sha256_weights(file) if file.is_file() else str(hub_commit(where))


def model_card(name: str, facts: Mapping[str, Any]) -> str:
    """Return the README.md of a fine-tuned published model as Markdown: base, data and losses.

    `name` is the new model's, and `facts` has what was learnt and measured, the dict that `distill`
    returns.
    """
    plan, adapt = facts["plan"], facts["plan"]["adapt"]
    loss_rows = []
    for stage, curve in facts["curves"].items():
        if curve:
            begins, ends = f"{curve[0][1]:.3f}", f"{curve[-1][1]:.3f} | {curve[-1][2]:.3f}"
            loss_rows.append(f"| `{stage}` | {plan['samples'][stage]} | {begins} | {ends} |")
    held_out_rows = []
    for row in facts["held_out"]:
        scenario = row["scenario"]
        held_out_rows.append(
            f"| `{scenario}` | {facts['scenes'][scenario]} | {row['layouts']} | "
            f"{row['questions']} | {row['kl_nats']:.3f} | {row['kl_of_the_mean_nats']:.3f} | "
            f"{row['value']:.3f} | {row['value_of_the_mean']:.3f} | "
            f"{row['value_of_the_likeliest']:.3f} | {_shares(row['likeliest'])} |"
        )
    losses, held_out = "\n".join(loss_rows), "\n".join(held_out_rows)
    kind = (
        f"A LoRA adapter of rank {adapt['rank']} for"
        if adapt["rank"]
        else "All weights, taught, of"
    )
    licence = facts["licence"] or "not stated"
    first, count = facts["first_seed"], facts["layouts"]
    scenarios = "; ".join(f"`{spelling}`" for spelling in facts["spellings"])
    return f"""# {name}

{kind} `{facts["base"]}`, made by `harness model distill` from outcomes in the scenarios
below. {facts["parameters"]:,} weights learnt. The base's weights have sha256
`{facts["base_sha256"]}` and the licence {licence}.

- Data: {count} layouts a scenario, train seeds {first} to {first + count - 1}, decision points drawn from
  each level of their trees; every viewer, and the ego with messages. The last layouts are held out. No report
  seed was read.
- Scenarios: {scenarios}. Prompts: {", ".join(facts["prompts"])}.
- Teacher: outcomes, as soft labels over the actions after which success is possible. A viewer that cannot
  tell scenes apart learns their mean, so what is hidden makes it unsure.
- Seed {plan["seed"]}, batches of {plan["batch"]}, AdamW {adapt["rate"]:g}, layers in {adapt["dtype"]}.
  The words behind a letter weigh {adapt["report"]:g}.
- Objective: `{plan["objective"]}`, {OBJECTIVES[plan["objective"]]}.

The read-out on layouts held out: its KL to the soft labels in nats and its value, the probability that it
gives to actions after which the episode succeeds, layouts with a danger and without weighing alike. Beside
them stand those of always answering the mean label, the value of its likeliest action, and how often each
action is that. `held out` are layouts, and `scenes` are learnt from.

| scenario | scenes | held out | questions | KL | mean's | value | mean's | likeliest's | likeliest action |
|---|---|---|---|---|---|---|---|---|---|
{held_out}

The value of who needs no model, at the same questions:

{references_table(facts)}

| stage | sequences | first loss | last loss | held-out KL at its end |
|---|---|---|---|---|
{losses}

`alone` fits the probabilities of one letter an action and a report in words; `excerpts` before it does so on
prompts that show nothing but the conflicts, `messages` after it with helpers' messages in the ego's prompt.
`answers` is the JSON text, which states the read-out's own distribution. A stage of no sequences was left
out. The losses are of different sums and compare within a stage only; curves are in `training.json`.
"""  # noqa: E501


def references_table(facts: Mapping[str, Any]) -> str:
    """Return a Markdown table of values by scenario: the model's, and those of rule drivers.

    A value is a mean probability of success, and a rule driver one without a model. `facts` has
    what was learnt and measured, the dict that `distill` returns.
    """
    names = dict.fromkeys(name for row in facts["held_out"] for name in row["references"])
    lines = [f"| scenario | the model | {' | '.join(f'`{name}`' for name in names)} |"]
    lines.append("|---|---|" + "---|" * len(names))
    for row in facts["held_out"]:
        values = [row["value"], *(row["references"].get(name) for name in names)]
        cells = ["-" if number is None else f"{number:.3f}" for number in values]
        lines.append(f"| `{row['scenario']}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def _shares(likeliest: Mapping[str, float]) -> str:
    return ", ".join(f"{action} {share:.2f}" for action, share in likeliest.items())
