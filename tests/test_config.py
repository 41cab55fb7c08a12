"""Typed records from tables: what is read, and the one line that every mistake is."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from harness.core.config import convert, toml
from harness.core.errors import UserError

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
    hops: tuple[Hop, ...] = ()
    by_name: dict[str, Link] | None = None


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
        ({"nmae": "x"}, "unknown key in r 'nmae'; known: by_name, hops, link, size"),
        ({"name": "x"}, "unknown key in r 'name'; did you mean 'by_name'? known: by_name, hops, link, size"),
        ({"sise": 1}, "unknown key in r 'sise'; did you mean 'size'? known: by_name, hops, link, size"),
        ({"link": {"los": 1}}, "unknown key in r [link] 'los'; did you mean 'loss'? known: loss, model"),
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
        ({"link": {"model": "wires"}}, "unknown model in r [link] 'wires'; known: ideal, radio"),
        ({"link": {"model": "radio", "loss": "x\n"}}, "r [link]: loss = 'x\\n'; allowed: float"),
        (
            {"link": {"model": "radio", "loss": float("nan")}},
            "r [link]: loss = nan; allowed: a share, 0 to 1",
        ),
        (
            {"link": {"model": "radio", "loss": float("inf")}},
            "r [link]: loss = inf; allowed: a share, 0 to 1",
        ),
        ({"size": True}, "r: size = True; allowed: int"),
        ({"size": 0}, "r: size = 0; allowed: int >= 1"),
        ({"size": "1"}, "r: size = '1'; allowed: int"),
        ({"hops": [{"delay_s": 1}, {"delay_s": "x"}]}, "r [hops.1]: delay_s = 'x'; allowed: float"),
        ({"hops": [{"delay_s": -1}]}, "r [hops.0]: delay_s is negative; give seconds, 0 or more"),
    ],
)
def test_a_mistake_is_one_line_with_place_value_and_what_is_allowed(
    change: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError) as caught:
        convert({**GOOD, **change}, Route, "r", name="r")
    assert str(caught.value) == said


@pytest.mark.parametrize("size", [10**30, -sys.maxsize * 4])
def test_a_number_beyond_all_bounds_is_one_too(size: int) -> None:
    with pytest.raises(UserError, match=r"^r.*size"):
        convert({**GOOD, "size": size}, Route, "r", name="r")


def test_what_is_no_toml_is_said_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "route.toml"
    file.write_text("a = 1")
    assert toml(file, "r") == {"a": 1}
    for data in (b"[a", b"\xff", b"a = " + b"9" * 5000, b"a = " + b"[" * 3000):
        file.write_bytes(data)
        with pytest.raises(UserError, match=r"^r is no TOML: .*; fix the file$"):
            toml(file, "r")


def test_a_folder_a_pipe_a_dangling_link_and_a_device_are_no_toml(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name in ("folder", "pipe", "link", "device"):
        with pytest.raises(UserError, match=r"^r is no TOML: .*; fix the file$"):
            toml(tmp_path / name, "r")
