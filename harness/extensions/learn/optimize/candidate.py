"""A prompt with something of its text chosen or rewritten,
as a version that can be written to a folder.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.core.config import loads
from harness.core.errors import UserError
from harness.core.files import canonical_json, sha256_bytes, write_whole
from harness.prompts.alternatives import EXAMPLES as SETS
from harness.prompts.alternatives import FIRST, counts, resolved
from harness.prompts.examples import EXAMPLES, text_of
from harness.prompts.examples import read as read_examples
from harness.prompts.versions import ROLES, Prompt, made

PROMPT = "prompt.toml"
SYSTEM = re.compile(r"(\{%-?\s*block\s+system\s*-?%\})(.*?)(\{%-?\s*endblock\b)", re.DOTALL)


@dataclass(frozen=True)
class Candidate:
    """Hold one wording of a prompt that a search tries.

    A prompt version is a folder of templates, one for each role: the ego that decides, a helper
    that is asked, and so on. The search begins with one, the base. `prompt` is the wording as a
    version, `what` says in a line how it differs from the base, and `rewritten` has the system
    texts that a model wrote in place of the templates' own, by role.
    """

    prompt: Prompt  # the wording as a prompt version, under the name of the one searched
    what: str  # how it differs from the base, in a line
    # system texts that a model rewrote, by role: each replaces the template's block `system`
    rewritten: Mapping[str, str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return the hex SHA-256 of the prompt's files, by which wordings are told apart."""
        return self.prompt.sha256


def space(prompt: Prompt) -> dict[str, int]:
    """Return how many alternative wordings a prompt has at each choice, by the choice's name.

    A choice is a place in the prompt's files at which the author marked several wordings to try, or
    the sets of examples if there are several. Raises UserError if a mark is malformed.
    """
    try:
        marks = counts(prompt.texts.values())
    except ValueError as error:
        raise UserError(f"--prompt {prompt.version}: {error}") from None
    return marks | ({SETS: len(prompt.example_sets)} if len(prompt.example_sets) > 1 else {})


def chosen(base: Prompt, choice: Mapping[str, int] = FIRST) -> Candidate:
    """Return a prompt with one alternative wording at each marked place, as a candidate.

    The author of `base` marked places, the choices, each with several wordings and a name. `choice`
    has the number of the wording, from 0, by the choice's name; others take the first. Raises
    UserError if the prompt's files are wrong.
    """
    sizes = space(base)
    changes = ", ".join(f"{name} {n + 1} of {sizes[name]}" for name, n in choice.items() if n)
    files = dict(base.files)
    for role in ROLES:
        files[f"{role}.j2"] = resolved(base.texts[role], choice)
    if base.example_sets:
        example_set = base.example_sets[choice.get(SETS, 0)]
        examples = read_examples(files.pop(EXAMPLES), EXAMPLES).only(example_set)
        if examples:
            files[EXAMPLES] = text_of(examples)
    return _candidate(base, files, changes or "first alternatives")


def systems(base: Prompt) -> dict[str, str]:
    """Return the system message of each role's prompt template (its Jinja block `system`), by role.

    A role is who is asked, such as `ego` or `helper`. Where the author marked several wordings, it
    has the first.
    """
    texts = {}
    for role in ROLES:
        match = SYSTEM.search(resolved(base.texts[role]))
        if match:
            texts[role] = match[2]
    return texts


def rewritten(base: Prompt, texts: Mapping[str, str]) -> Candidate:
    """Return a prompt with other system messages, as a candidate.

    `texts` has, by role, what replaces the Jinja block `system` of the role's template. Raises
    UserError if the prompt's files are wrong.
    """
    first, system_texts = chosen(base), systems(base)
    files = dict(first.prompt.files)
    for role, text in texts.items():
        files[f"{role}.j2"] = SYSTEM.sub(
            lambda match, text=text: match[1] + text + match[3],  # type: ignore[misc]
            files[f"{role}.j2"],
            count=1,
        )
    new = {role: text for role, text in texts.items() if text != system_texts[role]}
    if not new:
        return first
    what = (
        f"system text {sha256_bytes(canonical_json(new).encode())[:8]} of the "
        f"{' and the '.join(new)}"
    )
    return replace(_candidate(base, files, what), rewritten=new)


def _candidate(base: Prompt, files: Mapping[str, str], what: str) -> Candidate:
    table = loads(files[PROMPT], PROMPT)
    table.pop("example_sets", None)
    reasons = {"reasons_first": list(base.reasons_first)} if base.reasons_first else {}
    table |= {"changed": f"against {base.version}, by harness prompt optimize: {what}", **reasons}
    text = "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())
    return Candidate(made(base.version, {**files, PROMPT: text}), what)


def _toml(value: Any) -> str:
    """Return a value of a prompt's settings as TOML, which writes all but tables as JSON does."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)


def write(candidate: Candidate, folder: Path, more: Mapping[str, str]) -> None:
    """Write the prompt files of a candidate, one wording of a prompt, to a folder, with more files.

    `more` has the text of each further file by its name; these are not part of the prompt's digest.
    """
    folder.mkdir(parents=True, exist_ok=True)
    ordered: Sequence[str] = [
        *more,
        *(name for name in candidate.prompt.files if name != PROMPT),
        PROMPT,
    ]
    for name in ordered:  # prompt.toml last: without it, there is no version
        write_whole(folder / name, more.get(name) or candidate.prompt.files[name])
