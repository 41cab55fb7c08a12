"""Find what a prompt's template writes in place of an answer's values:
`max 12 words`, `low|medium|high`.
"""

import re

_JINJA = re.compile(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", re.DOTALL)
_FILLED = "\ue000"  # stands for what Jinja fills in; in no language's text
# A value behind a quoted name: a text, or what stands up to the next member.
_MEMBER = re.compile(r'"[^"\n]*"\s*:\s*("[^"\n]*"(?=\s*[,}\n])|[^,{}\n]+)')


def placeholders(template: str) -> tuple[str, ...]:
    """Return the texts that a template shows in place of values in the JSON that it asks for.

    Such as `max 12 words`; they tell an answer that repeats the prompt from one that has evidence.
    `template` is the template's text. A value ends where Jinja fills something in.
    """
    text = _JINJA.sub(_FILLED, template)
    values = [
        value.partition(_FILLED)[0].strip().strip('"').strip() for value in _MEMBER.findall(text)
    ]
    return tuple(dict.fromkeys(value for value in values if value))
