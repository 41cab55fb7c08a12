"""The parts of an operating point that extensions add."""

import sys
from collections.abc import Collection, Mapping
from inspect import getattr_static

from harness.coordination.contents import NAME
from harness.coordination.parts import PACKAGES_PARTS, Part, Question
from harness.core.errors import UserError, printable
from harness.core.extensions import added
from harness.core.plugins import is_ours, package_of, texts
from harness.core.strangers import aside, worded

GROUP = "swarmdrive.parts"
# hooks whose results nothing checks
OF_PARTS_THAT_SHIP = ("again", "unasked", "unasked_of")


def added_parts(taken: Collection[str]) -> Mapping[str, type[Part]]:
    """Return the groups of settings that installed extensions add to operating points, by name.

    An operating point is the settings that a decision depends on. Each group of these, a part, is a
    subclass of `Part`. Those that ship with the harness come first. `taken` has the names of
    settings in use already. A part that cannot be loaded, repeats a setting or refuses its own
    defaults is left out, and a line on stderr says why. The result has the classes by the parts'
    names.
    """
    kinds: dict[str, type[Part]] = {}
    settings = set(taken)
    for name, entry in added(GROUP).items():
        what = f"part {printable(name)} of package {package_of(entry)}"
        try:
            with worded(what, door=aside):
                kind = entry.load()
                _check(what, kind, settings)
                if not is_ours(entry):
                    for hook in OF_PARTS_THAT_SHIP:
                        if getattr_static(kind, hook) is not getattr_static(Part, hook):
                            raise ValueError(
                                f"it has `{hook}`, which only parts that ship may have"
                            )
                    PACKAGES_PARTS[kind] = what
                kind()  # its defaults are allowed
        except UserError as error:
            print(f"harness: {error}; all else works", file=sys.stderr)
            continue
        settings.update(kind.__struct_fields__)
        kinds[name] = kind
    return kinds


def _check(what: str, kind: object, taken: Collection[str]) -> None:
    if not (isinstance(kind, type) and issubclass(kind, Part)):
        raise UserError(f"{what} is no subclass of Part; repair its package")
    if lost := [key for key in kind.__struct_fields__ if key in taken]:
        raise UserError(
            f"{what} has setting {lost[0]}, which another part has; give it another name"
        )
    texts((*kind.controls, *kind.controls.values()), "controls")
    texts((*kind.usual, *kind.usual.values()), "usual")
    for question in kind.questions:
        if not isinstance(question, Question) or not NAME.fullmatch(question.name):
            raise ValueError("questions hold what is no Question with a plain word for its name")
    if kind.behind not in taken:
        raise UserError(f"{what} stands behind {printable(kind.behind)!r}, which is no setting")
