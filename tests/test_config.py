"""Typed records from tables: what is read, and the one line that every mistake is."""

import os
import sys
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, Struct, defstruct

from harness.core.config import convert, toml
from harness.core.errors import UserError, printable

Share = Annotated[float, Meta(ge=0, le=1, description="a share, 0 to 1")]


@dataclass(frozen=True)
class Link:
    """An inner record."""

    model: Literal["ideal", "radio"]
    loss: Share | None = None


class Hop(Struct, frozen=True):
    """A record of the other kind."""

    delay_s: float

    def __post_init__(self) -> None:
        if self.delay_s < 0:
            raise ValueError("delay_s is negative; give seconds, 0 or more")


@dataclass(frozen=True)
class Route:
    """A record with what records may have."""

    name: str
    link: Link
    size: Annotated[int, Meta(ge=1, le=9)] = 1
    text: str = ""
    hops: tuple[Hop, ...] = ()
    by_name: dict[str, Link] | None = None
    most: int | Literal["auto"] = "auto"


GOOD: dict[str, Any] = {"link": {"model": "radio"}}


def test_a_record_is_made_of_nested_tables_and_what_the_program_gives() -> None:
    table = {
        "link": {"model": "radio", "loss": 1},
        "hops": [{"delay_s": 0.5}],
        "by_name": {"a": {"model": "ideal"}},
    }
    assert convert(table, Route, "r", name="r") == Route(
        "r", Link("radio", 1.0), hops=(Hop(0.5),), by_name={"a": Link("ideal")}
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"nmae": "x"}, "unknown key in r 'nmae'; known: by_name, hops, link, most, size, text"),
        (
            {"name": "x"},
            "unknown key in r 'name'; did you mean 'by_name'? known: by_name, hops, link, most, size, text",
        ),
        (
            {"sise": 1},
            "unknown key in r 'sise'; did you mean 'size'? known: by_name, hops, link, most, size, text",
        ),
        (
            {"link": {"los": 1}},
            "unknown key in r [link] 'los'; did you mean 'loss'? known: loss, model",
        ),
        (
            {"hops": [{"delay": 1}]},
            "unknown key in r [hops.0] 'delay'; did you mean 'delay_s'? known: delay_s",
        ),
        (
            {"by_name": {"a": {"los": 1}}},
            "unknown key in r [by_name.a] 'los'; did you mean 'loss'? known: loss, model",
        ),
        ({"link": {}}, "r [link] has no model; add it"),
        ({"link": 3}, "r: link = 3; allowed: a table"),
        ({"hops": 3}, "r: hops = 3; allowed: a list"),
        ({"text": "a\0"}, "r: text = a\\x00; allowed: a text without NUL"),
        ({"by_name": {"a\n": 3}}, "r [by_name]: a\\n = 3; allowed: a table"),
        (
            {"by_name": {"a\n": {"los": 1}}},
            "unknown key in r [by_name.a\\n] 'los'; did you mean 'loss'? known: loss, model",
        ),
        ({"link": {"model": "wires"}}, "unknown model in r [link] 'wires'; known: ideal, radio"),
        ({"link": {"model": "radio", "loss": "x\n"}}, "r [link]: loss = 'x\\n'; allowed: a number"),
        (
            {"link": {"model": "radio", "loss": float("nan")}},
            "r [link]: loss = nan; allowed: a share, 0 to 1",
        ),
        (
            {"link": {"model": "radio", "loss": float("inf")}},
            "r [link]: loss = inf; allowed: a share, 0 to 1",
        ),
        ({"size": True}, "r: size = True; allowed: a whole number"),
        ({"size": 0}, "r: size = 0; allowed: a whole number >= 1"),
        ({"size": "1"}, "r: size = '1'; allowed: a whole number"),
        ({"most": "all"}, "r: most = 'all'; allowed: a whole number or auto"),
        ({"most": 1.5}, "r: most = 1.5; allowed: a whole number or auto"),
        (
            {"hops": [{"delay_s": 1}, {"delay_s": "x"}]},
            "r [hops.1]: delay_s = 'x'; allowed: a number",
        ),
        ({"hops": [{"delay_s": -1}]}, "r [hops.0]: delay_s is negative; give seconds, 0 or more"),
    ],
)
def test_a_mistake_is_one_line_with_place_value_and_what_is_allowed(
    change: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError) as caught:
        convert({**GOOD, **change}, Route, "r", name="r")
    assert str(caught.value) == said


@pytest.mark.parametrize("size", [10**30, -sys.maxsize * 4, 10**400, -(10**400)])
def test_a_number_beyond_all_bounds_is_one_too(size: int) -> None:
    with pytest.raises(UserError, match=r"^r.*size"):
        convert({**GOOD, "size": size}, Route, "r", name="r")


def test_what_is_no_toml_is_said_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "route.toml"
    file.write_text("a = 1")
    assert toml(file, "r") == {"a": 1}
    for data in (
        b"[a",
        b"\xff",
        b"a = " + b"9" * 5000,
        b"a = 0x" + b"f" * 5000,
        b"a = " + b"[" * 3000,
        b"a = " + b"[" * 40 + b"]" * 40,
        b"".join(b"a" + b".a" * 90 + b" = {" for _ in range(9)) + b"}" * 9,
    ):
        file.write_bytes(data)
        with pytest.raises(UserError, match=r"^r is no TOML: .*; fix the file$"):
            toml(file, "r")


def test_a_folder_a_pipe_a_dangling_link_and_a_device_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name in ("folder", "pipe", "link", "device"):
        with pytest.raises(UserError, match=r"^r cannot be read: [^;]*; replace the file$"):
            toml(tmp_path / name, "r")


LEAVES: dict[Any, Any] = {
    int: 1, float: 0.5, str: "x", bool: True, Share: 0.5, Literal["ideal", "radio"]: "radio",
    Annotated[str, Meta(pattern="^x")]: "x",
}  # fmt: skip
NAMES = st.sampled_from(["a", "rate_hz", "b2"])
KEYS = st.sampled_from(["a", "x.y", "[0]", "...", "with blank", "`"])


@st.composite
def kinds(draw: st.DrawFn, depth: int = 3) -> tuple[Any, Any]:
    """A type, and a value that fits it."""
    shape = draw(
        st.sampled_from(["leaf", "list", "pair", "table", "optional", "dataclass", "struct"])
    )
    if not depth or shape == "leaf":
        leaf: tuple[Any, Any] = draw(st.sampled_from(list(LEAVES.items())))
        return leaf
    if shape in ("dataclass", "struct"):
        names = sorted(draw(st.sets(NAMES, min_size=1)))
        fields = {name: draw(kinds(depth - 1)) for name in names}
        make: Any = make_dataclass if shape == "dataclass" else defstruct
        record = make(f"Record{depth}", [(name, kind) for name, (kind, _) in fields.items()])
        return record, {name: value for name, (_, value) in fields.items()}
    kind, value = draw(kinds(depth - 1))
    if shape == "list":
        return GenericAlias(list, (kind,)), [value] * draw(st.integers(1, 3))
    if shape == "pair":
        return GenericAlias(tuple, (str, kind)), ["x", value]
    if shape == "table":
        return GenericAlias(dict, (str, kind)), dict.fromkeys(
            draw(st.sets(KEYS, min_size=1)), value
        )
    return kind | None, value


def paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all leaves of a value."""
    pairs: Any = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value if isinstance(value, list) else ())
    )
    return [leaf for key, inner in pairs for leaf in paths(inner, (*path, key))] or [path]


def with_other(value: Any, path: tuple[Any, ...], other: Any) -> Any:
    """A value with something else at a path."""
    if not path:
        return other
    if isinstance(value, dict):
        return {**value, path[0]: with_other(value[path[0]], path[1:], other)}
    return [
        with_other(each, path[1:], other) if n == path[0] else each for n, each in enumerate(value)
    ]


@given(st.data())
@pytest.mark.slow
def test_a_wrong_leaf_anywhere_in_any_record_is_one_line_that_names_it(data: st.DataObject) -> None:
    kind, good = data.draw(kinds())
    record, table = defstruct("Whole", [("whole", kind)]), {"whole": good}
    convert(table, record, "r")
    path = data.draw(st.sampled_from(paths(table)))
    wrong = data.draw(st.sampled_from([{"wrong": 1}, [[1]]]))
    with pytest.raises(UserError) as caught:
        convert(with_other(table, path, wrong), record, "r")
    *tables, key = map(str, path)
    where = f"r [{'.'.join(tables)}]" if tables else "r"
    assert str(caught.value).startswith(
        (f"{where}: {key} = {wrong}; allowed: ", f"unknown {key} in {where} ")
    )


@pytest.mark.parametrize(
    "number", [float("nan"), float("inf"), 1e300, 2**63, 10**30, pytest.param(10**400, id="huge")]
)
def test_a_number_is_no_larger_than_computers_count_also_where_it_has_no_bounds(
    number: float,
) -> None:
    with pytest.raises(UserError) as caught:
        convert({**GOOD, "hops": [{"delay_s": number}]}, Route, "r", name="r")
    assert str(caught.value) == (
        f"r [hops.0]: delay_s = {printable(number)}; allowed: a finite number, of a size of at "
        "most 9.2e+18"
    )


def test_the_tags_of_a_union_are_named() -> None:
    class One(Struct, tag="one", tag_field="kind"):
        n: int

    class Two(Struct, tag="two", tag_field="kind"):
        n: Share

    whole = defstruct("Whole", [("part", One | Two)])
    with pytest.raises(UserError, match=r"unknown kind in r \[part\] 'three'; known: one, two"):
        convert({"part": {"kind": "three", "n": 1}}, whole, "r")
    with pytest.raises(UserError, match=r"r \[part\]: n = 3; allowed: a share, 0 to 1"):
        convert({"part": {"kind": "two", "n": 3}}, whole, "r")
