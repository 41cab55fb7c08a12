"""Prompt versions: templates that turn a scene graph into chat messages.

A version is a folder `prompts/<version>/` with `ego.j2`, `helper.j2` (each with the blocks `system`
and `user`; `question` for what ends every question unless a letter is asked for, and `repair` for a
repair turn) and `prompt.toml`; it may have examples, `examples.json`, and further members of its
answers, `answer.json`. Released versions are pinned by digest in `prompts/released.toml`: a changed
text is a new version.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from jinja2 import TemplateSyntaxError

from harness.core.config import Count, convert, loads
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json, sha256_bytes, text_of, write_whole
from harness.core.resources import entries, find
from harness.core.templates import TooMuch
from harness.prompts.alternatives import resolved
from harness.prompts.answer_schema import ROLES as ROLES
from harness.prompts.answer_schema import Shape, closed, longest
from harness.prompts.examples import EXAMPLES, Examples
from harness.prompts.examples import read as read_examples
from harness.prompts.extension import ANSWER
from harness.prompts.extension import read as read_extension
from harness.prompts.placeholders import placeholders
from harness.prompts.template import Template

if TYPE_CHECKING:
    from harness.world.scenario import Scenario
    from harness.world.scene_graph import Conflict, SceneGraph

_compiled = lru_cache(maxsize=64)(Template)  # a process may load a version many times
FILES = ("ego.j2", "helper.j2", "prompt.toml")
OPTIONAL = (EXAMPLES, ANSWER)
NO_WORDS: Mapping[str, str] = MappingProxyType({})
# Digest of v1, which asks for reasons first and was released before prompt.toml could say so.
REASONS_FIRST = {"139fe002c5c6d680d758a35b92e1d6c1a1db69481a4b3a76336829cfceae8df8": ROLES}
# shipped versions that only describe crossings
OF_A_CROSSING = frozenset({"v1", "v2", "v3", "v6", "paper"})


@dataclass(frozen=True)
class Prompt:
    """Hold one prompt version, which turns scene graphs into chats: its templates and settings.

    A version is a folder of templates, one for each role: `ego`, the vehicle that decides, or
    `helper`. A scene graph is what one vehicle, the viewer, sees of a scene, and a conflict a point
    where another vehicle's path meets the ego's.
    """

    version: str  # name of its folder
    sha256: str  # hex digest of its files
    released: bool  # whether it may no longer change; a draft may
    description: str  # one line for people
    # what a helper is asked for: `distribution` over the actions, or `recommendation`, one action
    # with a confidence
    helper_answer: Literal["distribution", "recommendation"]
    # most vehicles that are listed, one fewer if there are messages; those in conflict come first,
    # then the nearest
    max_objects: Count
    token_budget: tuple[Count, Count]  # least and most tokens a rendered prompt may have
    max_answer_tokens: Mapping[str, Count]  # most tokens an answer may have, by role
    changed: str  # what is new in this version
    known_failures: str  # failures that it is known to provoke
    texts: Mapping[str, str]  # text of each template, by role
    # roles that are asked for reasons before the answer; the parser then allows such text
    reasons_first: tuple[Literal["ego", "helper"], ...] = ()
    # what the ego is asked for: `distribution` over the actions, or `maneuver`, one action with a
    # confidence
    ego_answer: Literal["distribution", "maneuver"] = "distribution"
    # most conflicts in the template's variable `conflicts`, the soonest first; None for all
    max_conflicts: Count | None = None
    # earlier turns of the chat with the right answers, from one scenario; None without any
    examples: Examples | None = None
    # sets of examples that may be chosen, by their numbers from 1; the first is shown. Empty for
    # all of them.
    example_sets: tuple[tuple[Count, ...], ...] = ()
    # JSON Schemas of further members of an answer, as JSON text, by role; roles without any are not
    # there
    extension: Mapping[str, str] = field(default_factory=dict)
    # whether the ego's template can show a message that holds words alone, a `sender` and
    # `evidence`
    shows_words: bool = False
    # whether the ego's template can show an agent's plan: `sender`, `number`, `intent`,
    # `reaches_s`, `lost_s`
    shows_plans: bool = False
    # picture before the user's text: `camera`, what the viewer's cameras see; None if there is none
    image: Literal["camera"] | None = None
    # the text of each of its files by name, as they were read
    files: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        least, most = self.token_budget
        if least > most:
            raise ValueError(f"token_budget is [{least}, {most}], wants [least, most]")
        if self.max_answer_tokens.keys() != set(ROLES):
            raise ValueError("max_answer_tokens wants exactly ego and helper")
        if self.image and self.examples:
            raise ValueError(
                "image and examples.json exclude each other: an example shows no picture"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields only, for pickling: compiled templates cannot go to another process."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def _templates(self) -> dict[str, Template]:
        compiled = {}
        for role, text in self.texts.items():
            try:
                compiled[role] = _compiled(resolved(text))
            except ValueError as error:
                raise UserError(f"prompt {self.version} {role}.j2: {printable(error)}") from None
            except TemplateSyntaxError as error:
                raise UserError(
                    f"prompt {self.version} {role}.j2 line {error.lineno} is no Jinja: "
                    f"{printable(error.message)}"
                ) from None
        return compiled

    @cached_property
    def repair_turn(self) -> tuple[str, ...]:
        """Return the roles (`ego`, `helper`) whose unreadable answers are asked for again.

        Their template has a block `repair`, which asks.
        """
        return tuple(role for role in ROLES if "repair" in self._templates[role].blocks)

    def form(self, role: str) -> str:
        return self.ego_answer if role == "ego" else self.helper_answer

    def shape(self, role: str, actions: Sequence[str]) -> Shape:
        extension = self.extension.get(role, "")
        return Shape(role, tuple(actions), self.form(role), extension, self.placeholders[role])

    @cached_property
    def placeholders(self) -> Mapping[str, tuple[str, ...]]:
        """Return the texts that templates show in place of values in the JSON answer, by role.

        Such as `max 12 words`; they tell an answer that repeats the prompt from one that has
        evidence.
        """
        texts = self.texts if self._templates else {}  # which raises what is wrong with a text
        return {role: placeholders(resolved(text)) for role, text in texts.items()}

    def most_answer_tokens(self, role: str) -> int:
        """Return the most tokens that the answer of a role, `ego` or `helper`, may have.

        It is that of `max_answer_tokens`, and one more for each character that the further members
        asked for may have.
        """
        further = self.shape(role, ()).further
        return self.max_answer_tokens[role] + (longest(closed(further)) if further else 0)

    def repair(
        self, role: str, error: str, actions: tuple[str, ...], words: Mapping[str, str]
    ) -> str:
        """Render the message that asks a vehicle again, since its answer could not be parsed.

        `role` is `ego` or `helper`, `error` the reason, `actions` are the names of meta-actions,
        and `words` texts by which the scenario describes itself, by name. Raises UserError if the
        template fails.
        """
        variables = {"error": error, "actions": actions, "words": words}
        [text] = self._rendered(
            role, variables, ("repair",), "its block repair may use error, actions, words"
        )
        return text

    def render(
        self,
        graph: "SceneGraph",
        actions: tuple[str, ...],
        messages: Sequence[Mapping[str, Any]] = (),
        words: Mapping[str, str] = NO_WORDS,
        letter: bool = False,
    ) -> tuple[dict[str, str], ...]:
        """Render the chat messages that ask one vehicle, exactly as a model is sent them.

        Examples follow the system message as earlier turns. A message with the key `image` has a
        picture before its text.

        Args:
            graph: the scene graph of the vehicle that is asked: what it sees. Its `role` chooses
                the template.
            actions: names of the meta-actions.
            messages: those of helpers to the ego, with `sender`, `evidence`, `risk`, `intent`,
                `recommended_maneuver` and `confidence`; with `sender` and `evidence` alone if the
                version `shows_words`; vehicles' plans if it `shows_plans` (`fusion.messages_of`).
            words: texts by which the scenario describes itself, by name.
            letter: whether one letter is asked for (`readout.letter_chat`) in place of the block
                `question`.

        Raises:
            UserError: the template fails.
        """
        system, user = self._render_graph(graph, actions, messages, words, letter, "system", "user")
        turns = self._turns(graph.role, actions, words, letter)
        question = {"role": "user", "content": user} | ({"image": self.image} if self.image else {})
        return ({"role": "system", "content": system}, *turns, question)

    def _turns(
        self, role: str, actions: tuple[str, ...], words: Mapping[str, str], letter: bool
    ) -> tuple[dict[str, str], ...]:
        """Return a role's examples as turns of the chat; they are the same for every question."""
        if self.examples is None:
            return ()
        key = role, actions, letter, *words.items()
        if key not in self._kept_turns:
            self._kept_turns[key] = tuple(
                {"role": part, "content": text}
                for example in self.examples.of(role)
                for part, text in (
                    (
                        "user",
                        *self._render_graph(example.graph, actions, (), words, letter, "user"),
                    ),
                    ("assistant", example.answer),
                )
            )
        return self._kept_turns[key]

    @cached_property
    def _kept_turns(self) -> dict[Any, tuple[dict[str, str], ...]]:
        return {}

    def _render_graph(
        self,
        graph: "SceneGraph",
        actions: tuple[str, ...],
        messages: Sequence[Mapping[str, Any]],
        words: Mapping[str, str],
        letter: bool,
        *blocks: str,
    ) -> list[str]:
        """Render some blocks of a template for a scene graph,
        the last of which ends with the question.
        """
        template, plain = self._templates[graph.role], graph.plain()
        objects = [plain["nodes"][n] for n in listed(graph, self.max_objects - bool(messages))]
        variables = {
            "graph": plain,
            "actions": actions,
            "objects": objects,
            "more": len(graph.nodes) - len(objects),
            "messages": messages,
            "words": words,
        }
        if "conflicts" in template.reads:
            variables["conflicts"] = [
                plain["conflicts"][n] for n in soonest(graph.conflicts)[: self.max_conflicts]
            ]
        needs = (
            "it needs the blocks system and user, and may use graph, actions, objects, more, "
            "conflicts, messages, words"
        )
        if letter or "question" not in template.blocks:
            return self._rendered(graph.role, variables, blocks, needs)
        *head, user, question = self._rendered(graph.role, variables, (*blocks, "question"), needs)
        return [*head, f"{user}\n{question}"]

    def _rendered(
        self, role: str, variables: Mapping[str, Any], blocks: Sequence[str], needs: str
    ) -> list[str]:
        """Render blocks of a role's template. Raises UserError, whose message ends with `needs`."""
        try:
            return self._templates[role].render(variables, blocks)
        except TooMuch as error:
            raise UserError(
                f"prompt {self.version} {role}.j2 does not render: it takes {printable(error)}; "
                "let it loop less, or write less"
            ) from None
        except Exception as error:  # a template is a program and may fail in any way
            raise UserError(
                f"prompt {self.version} {role}.j2 does not render: {printable(error)}; {needs}"
            ) from None


def listed(graph: "SceneGraph", most: int) -> list[int]:
    """Return the indices of the nodes of a scene graph that a prompt lists, at most `most` of them.

    A node is a vehicle that the viewer knows of. Those whose paths meet that of the ego come first,
    then the nearest to the viewer.
    """
    meets = {conflict.vehicle for conflict in graph.conflicts}
    order = [(node.id not in meets, node.forward_m**2 + node.left_m**2) for node in graph.nodes]
    return sorted(range(len(order)), key=order.__getitem__)[:most]


def soonest(conflicts: Sequence["Conflict"]) -> list[int]:
    """Return the indices of conflicts in the order in which the ego reaches them.

    A conflict is a point where another vehicle's path meets that of the ego. Those that it never
    reaches are last.
    """
    order = [
        (math.inf if c.ego.time_s is None else c.ego.time_s, c.ego.arc_m + c.other.arc_m)
        for c in conflicts
    ]
    return sorted(range(len(order)), key=order.__getitem__)


def names(where: Path | None = None) -> list[str]:
    """List the names of prompt versions (folders of templates), sorted.

    They are those that ship and the project's, or those in the folder `where`.
    """
    files = where.glob("*/prompt.toml") if where else entries("prompts", "*/prompt.toml")
    return sorted({file.parent.name for file in files})


def unfit(prompt: Prompt, scenario: "Scenario") -> str | None:
    """Return why a prompt version may not be used in a scenario, as a phrase; None if it may.

    A prompt version is a folder of templates, and a scenario a kind of traffic situation. It may
    not if it speaks of a crossing and there is none, has examples of another scenario, or asks for
    a member of an answer that has the name of an action.
    """
    if prompt.version in OF_A_CROSSING and scenario.prompt not in OF_A_CROSSING:
        return f"speaks of a crossing, which {scenario.name} is not"
    if (
        prompt.examples
        and not prompt.examples.everywhere
        and prompt.examples.scenario != scenario.name
    ):
        return (
            f"has examples of {printable(prompt.examples.scenario)}, which {scenario.name} is not"
        )
    for role, actions in ((role, scenario.actions) for role in ROLES):
        named = {action.casefold() for action in actions}
        if taken := [
            name for name in prompt.shape(role, actions).further if name.casefold() in named
        ]:
            return f"has {taken[0]} in answer.json, which is an action of {scenario.name}"
    return None


def load(version: str, where: Path | None = None) -> Prompt:
    """Load a prompt version by name, from the folder `where`, or else what ships and the project's.

    A prompt version is a folder of templates and settings. Raises UserError if there is no such
    version, its files are wrong, or it was released and has changed.
    """
    if version not in names(where):
        raise unknown("prompt", version, names(where))
    if not version.isprintable():  # it is in many a line
        raise UserError(
            f"prompt {printable(version)} has a name of more than plain signs; rename its folder"
        )
    base = _base(version, where)
    optional = [name for name in OPTIONAL if os.path.lexists(base / version / name)]
    texts = {name: _text(base / version / name) for name in (*FILES, *optional)}
    released = _released(base)
    if version in released and released[version] != digest(texts):
        raise UserError(
            f"prompt {version} was released and its text has changed; restore it, or copy it to a "
            f"new version (its digest is pinned in {printable(base / 'released.toml')})"
        )
    return made(version, texts, version in released)


def made(version: str, texts: Mapping[str, str], released: bool = False) -> Prompt:
    """Return a prompt version made of the texts of its files.

    A prompt version is a folder of templates and settings. `version` is its name, `texts` has the
    files' texts by name, in the order of `FILES`, and `released` says whether it may no longer
    change. Raises UserError if a text is wrong.
    """
    what, sha256 = f"prompt {version} prompt.toml", digest(texts)
    table = {"reasons_first": REASONS_FIRST.get(sha256, ()), **loads(texts["prompt.toml"], what)}
    examples = (
        read_examples(texts[EXAMPLES], f"prompt {version} {EXAMPLES}")
        if EXAMPLES in texts
        else None
    )
    extension = (
        read_extension(texts[ANSWER], f"prompt {version} {ANSWER}") if ANSWER in texts else None
    )
    prompt = convert(
        table,
        Prompt,
        what,
        version=version,
        sha256=sha256,
        released=released,
        texts={role: texts[f"{role}.j2"] for role in ROLES},
        examples=examples,
        extension=extension or {},
        files=texts,
    )
    if not prompt.example_sets:
        return prompt
    n = min(len(examples.of(role)) for role in ROLES) if examples else 0
    if wrong := [number for some in prompt.example_sets for number in some if not 0 < number <= n]:
        raise UserError(
            f"{what}: example_sets has {wrong[0]}, and examples.json has {n} a role; fix one"
        )
    return replace(prompt, examples=examples and examples.only(prompt.example_sets[0]))


def as_it_was(version: str, sha256: str, where: Path | None = None) -> Prompt | None:
    """Load a prompt version if its files still have the digest `sha256` that a run states.

    A prompt version is a folder of templates and settings. None if its files have another digest,
    or if it does not load. `where` is the folder of versions; None for those that ship and the
    project's.
    """
    try:
        prompt = load(version, where)
    except UserError:
        return None
    return prompt if prompt.sha256 == sha256 else None


def lock(version: str, where: Path | None = None) -> str:
    """Release a prompt version, so that it may not change, and return the digest of its files.

    A prompt version is a folder of templates and settings. The digest is pinned in `released.toml`.
    `where` is the folder of versions; None for those that ship and the project's.
    """
    prompt = load(version, where)
    base = _base(version, where)
    pins = _released(base) | {version: prompt.sha256}
    head = (
        "# Digests of released prompt versions (`harness prompt release`). A changed text is a new "
        "version.\n"
    )
    # quoted: v1.1 is one key
    lines = [f'{canonical_json(v)} = "{d}"\n' for v, d in sorted(pins.items())]
    write_whole(base / "released.toml", head + "".join(lines))
    return prompt.sha256


def _base(version: str, where: Path | None) -> Path:
    """Return the folder of versions in which a version lies."""
    return where or find("prompts", version).parent


def digest(texts: Mapping[str, str]) -> str:
    """Return the hex digest of the files of a prompt version, a folder of templates.

    `texts` has their text by name, in the order of `FILES`; files beside those of `FILES` come
    last.
    """
    return sha256_bytes("\0".join(f"{name}\0{text}" for name, text in texts.items()).encode())


def _text(file: Path) -> str:
    try:
        return text_of(file)
    except (OSError, UnicodeDecodeError) as error:
        reason = printable(getattr(error, "strerror", None) or error)
        raise UserError(
            f"prompt file {printable(file)} cannot be read: {reason}; replace the file"
        ) from None


def _released(base: Path) -> dict[str, str]:
    file = base / "released.toml"
    return loads(_text(file), f"prompt file {printable(file)}") if file.is_file() else {}
