"""What a dataclass's docstring says of its fields."""

import inspect
import re


def attributes(kind: type) -> dict[str, str]:
    """Meaning of each field, those of its bases included, out of the sections `Attributes:`."""
    meanings: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        section = str(inspect.getdoc(each)).partition("Attributes:\n")[2]
        meanings |= re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in meanings.items()}
