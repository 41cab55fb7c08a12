"""Hold how code reads to ceilings that only fall:
`python readable.py`, and `--lower` where there are fewer.

`readable.toml` has, by rule and room of `harness/`, how many places break it; a room that is not
there has none. CONTRIBUTING.md says what the rules are for.
"""

import ast
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent
CEILINGS = ROOT / "readable.toml"
SHOWN = 30  # places that are listed
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
RULES = {
    "nested": "a comprehension inside another, or one of three clauses",
    "spread": "`*map(…)`, or `**(… if … else …)`",
    "walrus": "`:=` outside the test of an if or while",
    "unformatted": "`fmt: skip` or `fmt: off`",
    "word": "a variable, parameter or function named by a participle or a pronoun alone",
}
ALONE = {
    *("asked", "begun", "found", "going", "its", "known", "lead", "leading", "leads", "own"),
    *("said", "shown", "stated", "theirs", "told"),
}
Place = tuple[str, int]  # a rule, and the line that breaks it


def broken(source: str) -> Iterator[Place]:
    """Yield each rule that a file breaks, and the line where it does."""
    for number, line in enumerate(source.splitlines(), 1):
        if "# fmt: skip" in line or "# fmt: off" in line:
            yield "unformatted", number
    tree = ast.parse(source)
    in_tests = {id(node) for test in _tests(tree) for node in ast.walk(test)}
    fields = {id(field) for field in _fields(tree)}
    for node in ast.walk(tree):
        if isinstance(node, COMPREHENSIONS):
            inner = [each for each in ast.walk(node) if isinstance(each, COMPREHENSIONS)]
            if len(inner) > 1 or len(node.generators) > 2:
                yield "nested", node.lineno
        elif isinstance(node, ast.NamedExpr) and id(node) not in in_tests:
            yield "walrus", node.lineno
        elif _is_spread(node):
            yield "spread", getattr(node, "lineno", 0)
        if _named(node).strip("_") in ALONE and id(node) not in fields:
            yield "word", getattr(node, "lineno", 0)


def _named(node: ast.AST) -> str:
    """Return the name that a node gives a variable, a parameter or a function; else nothing."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return node.name
    if isinstance(node, ast.arg):
        return node.arg
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        return node.id
    return ""


def _tests(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield the tests of all if and while statements."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If | ast.While):
            yield node.test


def _fields(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield the names of fields of classes: they are read behind the name of their object."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield from (each.target for each in node.body if isinstance(each, ast.AnnAssign))


def _is_spread(node: ast.AST) -> bool:
    if isinstance(node, ast.Starred):
        called = node.value.func if isinstance(node.value, ast.Call) else None
        return isinstance(called, ast.Name) and called.id == "map"
    if isinstance(node, ast.keyword):
        return node.arg is None and isinstance(node.value, ast.IfExp)
    if isinstance(node, ast.Dict):
        pairs = zip(node.keys, node.values, strict=True)
        return any(key is None and isinstance(value, ast.IfExp) for key, value in pairs)
    return False


def room_of(file: Path) -> str:
    """Return a file's room: a folder of `harness/`, of an extension with its name."""
    parts = file.relative_to(ROOT / "harness").parts[:-1]
    deep = 2 if parts[:1] == ("extensions",) else 1
    return "/".join(parts[:deep]) or "."


def found() -> dict[tuple[str, str], list[str]]:
    """Return by rule and room the places in `harness/` that break it, as `file:line`."""
    places: dict[tuple[str, str], list[str]] = {}
    for file in sorted((ROOT / "harness").rglob("*.py")):
        for rule, line in broken(file.read_text()):
            place = f"{file.relative_to(ROOT)}:{line}"
            places.setdefault((rule, room_of(file)), []).append(place)
    return places


def main() -> int:
    """Print what is above or below its ceiling, and return 1 if anything is."""
    places = found()
    if sys.argv[1:] == ["--lower"]:
        return _lower(places)
    stated = tomllib.loads(CEILINGS.read_text())
    ceilings = {
        (rule, room): count for rule, rooms in stated.items() for room, count in rooms.items()
    }
    differing = 0
    for rule, room in sorted({*places, *ceilings}):
        there, ceiling = places.get((rule, room), []), ceilings.get((rule, room), 0)
        if len(there) > ceiling:
            print(f"harness/{room}: {RULES[rule]}: {len(there)} places, and at most {ceiling}:")
            print(*(f"  {place}" for place in there[:SHOWN]), sep="\n")
        elif len(there) < ceiling:
            print(
                f"harness/{room}: {rule}: {len(there)} of {ceiling}; type `python readable.py "
                f"--lower`"
            )
        differing += len(there) != ceiling
    return int(differing > 0)


def _lower(places: dict[tuple[str, str], list[str]]) -> int:
    stated = tomllib.loads(CEILINGS.read_text()) if CEILINGS.is_file() else None
    total = Counter[str]()
    lines = ["# Written by `python readable.py --lower`: a number here never grows."]
    for rule in RULES:
        lines += ["", f"[{rule}]"]
        for room in sorted(room for broken_rule, room in places if broken_rule == rule):
            count = len(places[rule, room])
            ceiling = count if stated is None else min(count, stated.get(rule, {}).get(room, 0))
            total[rule] += ceiling
            lines.append(f'"{room}" = {ceiling}')
    CEILINGS.write_text("\n".join([*lines, ""]))
    print(*(f"{rule} {count}" for rule, count in total.items()), sep=", ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
