"""Describe an agent: the model that answers for a vehicle, and how it is asked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from harness.backends.base import BARE, AnswerMode, Letters, Request, Role, Sums
from harness.backends.card import Card
from harness.backends.registry import Capabilities, capabilities
from harness.core.errors import UserError, printable, unknown
from harness.parsing.parse import Status, parse
from harness.prompts import decision, readout
from harness.prompts.versions import Prompt
from harness.world.scene_graph import SceneGraph

ImageMode = Literal["own", "blank", "another", "none"]


@dataclass(frozen=True)
class Agent:
    """Describe who answers for a vehicle: a model, its prompt, and how it is asked.

    `card` is the model's description, `prompt` the prompt version, and `answer` how the model
    answers: free `json`, `constrained` to the schema, a `readout` of letters, or a `decision`.
    `image` is the picture that an image prompt shows, `sums` what becomes of numbers that do not
    sum to 1, and `flip` whether read-outs are asked once more with the actions reversed. Raises
    UserError for settings that the model or the prompt does not support.
    """

    card: Card  # the model
    prompt: Prompt  # the prompt version
    # how the model answers: free `json`, `constrained` to the schema, a `readout` of letters, or a
    # `decision`
    answer: AnswerMode = "json"
    thinking: bool = False  # whether the model thinks before it answers
    # the picture that an image prompt shows: the viewer's `own`, a `blank` one, one of `another`
    # scene, or `none`, which leaves only the text
    image: ImageMode = "own"
    # how a read-out's letters are read: `raw`, once, or `cyclic`, averaged over as many orders of
    # the list as there are actions; None takes the card's, or else cyclic. Always raw for what is
    # no read-out of letters.
    letters: Letters | None = None
    # what becomes of an answer in `json` whose only fault is that its numbers do not sum to 1:
    # `refuse` counts it as failed, `divide` divides them by their sum
    sums: Sums = "refuse"
    # whether each read-out is asked once more with the list of actions reversed, to see whether its
    # likeliest action changes (`harness.evaluate.flip`); the answer is that of the list as it
    # stands
    flip: bool = False

    def __post_init__(self) -> None:
        name = printable(self.card.name)
        if self.letters not in (None, *get_args(Letters)):
            raise unknown("letters", str(self.letters), get_args(Letters))
        lists = self.answer in BARE and self.can.language_model
        if not (lists and "readout" in self.can.answer_modes):
            cyclic = self.letters == "cyclic"
            if (
                option := "--letters cyclic"
                if cyclic
                else "--flip"
                if self.flip and not lists
                else ""
            ):
                reason = "reads no letters" if lists else "is no language model"
                reason = reason if self.answer in BARE else f"answers in {self.answer}"
                raise UserError(
                    f"{option}: {name} {reason}; leave it out, or give a language model and "
                    "--answer readout"
                )
            object.__setattr__(self, "letters", "raw")
        elif self.letters is None:
            object.__setattr__(self, "letters", self.card.letters or "cyclic")
        thinks = self.can.thinks == "always" or (
            self.can.thinks == "card" and self.card.thinking != "none"
        )
        if self.thinking and not thinks:
            raise UserError(f"--thinking: {name} cannot think; leave it out")
        if self.card.thinking == "always":  # its answers hold a thought even if none was asked for
            object.__setattr__(self, "thinking", True)
        if self.image not in get_args(ImageMode):
            raise unknown("image", self.image, get_args(ImageMode))
        if self.image != "own" and self.prompt.image is None:
            raise UserError(
                f"--image {self.image}: prompt {self.prompt.version} shows no picture; leave it out"
            )
        if (
            self.prompt.image
            and self.image != "none"
            and self.can.renders
            and self.card.vision is None
        ):
            raise UserError(
                f"--prompt {self.prompt.version}: it shows a picture, and {name} reads texts alone "
                "(its card has no [vision]); give another model or prompt, or --image none"
            )
        if self.answer not in get_args(AnswerMode):
            raise unknown("answer mode", self.answer, get_args(AnswerMode))
        if self.answer not in self.can.answer_modes:
            reason = "cannot answer so" if self.can.language_model else "is no language model"
            modes = " or ".join(self.can.answer_modes)
            raise UserError(f"--answer {self.answer}: {name} {reason}; use {modes}")
        if self.answer == "decision" and self.prompt.examples:
            raise UserError(
                f"--answer decision: prompt {self.prompt.version} has examples, and a decision is "
                "one question; give a prompt without any"
            )
        if self.sums not in get_args(Sums):
            raise unknown("sums", str(self.sums), get_args(Sums))
        if self.sums == "divide" and self.answer != "json":
            raise UserError(
                f"--sums divide: {name} answers in {self.answer}, whose sums need no declaration; "
                "leave it out, or use --answer json"
            )
        if self.answer != "json" and self.thinking:
            raise UserError(
                f"--answer {self.answer}: {name} thinks first, and only json leaves room for that; "
                "use --answer json"
            )

    @property
    def can(self) -> Capabilities:
        return capabilities(self.card.engine)

    @property
    def sees(self) -> bool:
        return bool(self.prompt.image and self.card.vision) and self.image != "none"

    @property
    def samples(self) -> bool:
        """Return whether its answers are texts that are drawn at a temperature.

        Answers in the modes `readout` (one letter per action) and `decision` (a typed question) are
        probabilities, of which nothing is drawn.
        """
        return self.can.samples and self.answer not in BARE

    @property
    def name(self) -> str:
        """Return model, prompt version and answer mode, as text for people and tables."""
        return f"{self.card.name} · {self.prompt.version} · {self.answer}"

    def most_tokens(self, role: Role) -> int:
        """Return the most tokens of one answer in a role, a thought before it included.

        The role is what a vehicle is asked as, such as `ego` or `helper`.
        """
        answer = self.card.max_new_tokens or self.prompt.most_answer_tokens(role)
        return answer + (self.card.thinking_tokens if self.thinking else 0)

    def blank(self, role: Role, actions: tuple[str, ...]) -> Request:
        """Return a request to the model that has all but what differs from scene to scene.

        It is made once, and copied for each scene with `id`, `messages` and the like
        (`Request.alike`). `role` is whom the prompt addresses, `ego` or `helper`; `actions` are the
        names of the meta-actions, in order.
        """
        return Request(
            id="",
            messages=(),
            role=role,
            actions=actions,
            max_tokens=self.most_tokens(role),
            form=self.prompt.form(role),
            extension=self.prompt.extension.get(role, ""),
            placeholders=self.prompt.placeholders[role],
            answer=self.answer,
            sums=self.sums,
            thinking=self.thinking,
            reasons_first=role in self.prompt.reasons_first,
        )

    def chats(
        self,
        graph: SceneGraph,
        actions: tuple[str, ...],
        words: Mapping[str, str],
        heard: Sequence[Mapping[str, Any]] = (),
    ) -> dict[str, Any]:
        """Return the fields of a request to the model that hold its prompt, by field name.

        They are `messages`, the chat; for a read-out (one letter per action) in several orders of
        its list of actions also `orders` and `flips`; and for a decision (a typed question) its
        `question`.

        Args:
            graph: scene graph of the vehicle that is asked: what it knows of the scene.
            actions: names of the actions, in order.
            words: the scenario's words, which templates take by name.
            heard: helpers' messages to show, as dicts with `sender`, `intent` and the fields of the
                helper's answer (`fusion.messages_of`).
        """
        rendered = self.rendered(graph, actions, heard, words)
        if self.answer != "decision":
            return self.in_orders(
                actions,
                lambda order: in_mode(self.answer, self.prompt, rendered, graph, order, words),
            )
        question = decision.question(rendered, graph, actions, words)
        chats = self.in_orders(
            actions, lambda order: decision.letter_chat(question, rendered, order)
        )
        return {**chats, "question": question}

    def in_orders(
        self,
        actions: tuple[str, ...],
        chat: Callable[[Sequence[str]], tuple[Mapping[str, str], ...]],
    ) -> dict[str, Any]:
        """Return a chat for each order of the list of actions to be asked, as fields of a request.

        A read-out of letters (one per action) is asked with the actions in several orders, since a
        model may prefer a letter. `actions` are their names, in order, and `chat` makes the
        messages for the names in one order. The fields are `messages`, and where there are further
        orders `orders`, and with `flip` the same of the reversed list, `flips`.
        """

        def each(listed: tuple[str, ...]) -> list[tuple[Mapping[str, str], ...]]:
            orders = readout.cyclic(listed) if self.letters == "cyclic" else [listed]
            return [chat(order) for order in orders]

        messages, *further = each(actions)
        chats: dict[str, Any] = {"messages": messages}
        if further:
            chats["orders"] = tuple(further)
        if self.flip:
            chats["flips"] = tuple(each(actions[::-1]))
        return chats

    def rendered(
        self,
        graph: SceneGraph,
        actions: tuple[str, ...],
        heard: Sequence[Mapping[str, Any]],
        words: Mapping[str, str],
    ) -> tuple[Mapping[str, str], ...]:
        """Return the prompt's chat messages about a scene, before the answer mode changes them.

        Args:
            graph: scene graph of the vehicle that is asked: what it knows of the scene.
            actions: names of the actions, in order.
            heard: helpers' messages to show, as dicts (`fusion.messages_of`).
            words: the scenario's words, which templates take by name.
        """
        return sent_messages(
            self.image, self.prompt.render(graph, actions, heard, words, self.answer in BARE)
        )

    def settings(self) -> dict[str, Any]:
        """Return all that decides the answers of this model and prompt, for a run's record.

        They are plain values; the keys are `model`, `prompt`, `thinking`, `answer`, `image`,
        `letters`, `sums` and `flip`.
        """
        return {
            "model": self.card.record(),
            "prompt": {k: getattr(self.prompt, k) for k in ("version", "sha256", "released")},
            "thinking": self.thinking,
            "answer": self.answer,
            **{name: getattr(self, name) for name in ("image", "letters", "sums", "flip")},
        }


def sent_messages(
    image: str, messages: Sequence[Mapping[str, str]]
) -> tuple[Mapping[str, str], ...]:
    """Return a prompt's chat messages as they are sent: without pictures if `image` is `none`.

    `messages` have the keys `role` and `content`, and `image` is which picture the prompt shows
    (`Agent.image`).
    """
    if image != "none":
        return tuple(messages)
    without = []
    for message in messages:
        without.append({key: text for key, text in message.items() if key != "image"})
    return tuple(without)


def in_mode(
    answer: str,
    prompt: Prompt,
    messages: Sequence[Mapping[str, str]],
    graph: SceneGraph,
    actions: Sequence[str],
    words: Mapping[str, str],
) -> tuple[Mapping[str, str], ...]:
    """Return a prompt's chat messages, changed to ask for an answer in the answer mode `answer`.

    In `readout`, the question is for one letter, and the examples answer by one, too. In
    `decision`, what the chat says of the scene stays, and the scenario's `words` ask. Other modes
    change nothing. `graph` is what the vehicle knows of the scene, and `actions` are the names of
    the actions, in order.
    """
    if answer == "decision":
        question = decision.question(messages, graph, actions, words)
        return decision.letter_chat(question, messages, actions)
    if answer != "readout":
        return tuple(messages)
    return readout.letter_chat(messages, actions, example_actions(prompt, graph.role, actions))


def example_actions(prompt: Prompt, role: str, actions: Sequence[str]) -> list[str]:
    """Return the likeliest action in each example answer that a prompt shows the model.

    `role` is whom the prompt addresses, `ego` or `helper`; `actions` are the names of the
    meta-actions, in order. Raises UserError if such an answer cannot be parsed without repairs.
    """
    likeliest = []
    for number, example in enumerate(prompt.examples.of(role) if prompt.examples else (), 1):
        first = role in prompt.reasons_first
        parsed = parse(example.answer, **prompt.shape(role, actions)._asdict(), reasons_first=first)
        if parsed.status is not Status.STRICT or parsed.intent is None:
            raise UserError(
                f"prompt {prompt.version} examples.json: the answer of {role} example {number} is "
                f"not as a model should state it ({parsed.status}: {parsed.detail}); fix it"
            )
        likeliest.append(actions[parsed.intent.index(max(parsed.intent))])
    return likeliest
