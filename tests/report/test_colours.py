"""The palette: a colour has one meaning, and is seen on white and on dark paper,
by the colour-blind too.
"""

import csv
import re
from importlib.resources import files
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.report.charts import PAPER
from harness.report.drawing import colours

PAPERS = ("#FFFFFF", "#16181B")
ACTIONS = colours.actions(("SLOWER", "IDLE", "FASTER"))
ROLES = {name: colour for name, colour in colours.ROLES.items() if name != "other"}
FAMILIES = (colours.CONDITIONS, colours.OUTCOMES, ROLES, ACTIONS)
# Machado, Oliveira and Fernandes 2009, severity 1, of linear RGB.
SEEN_BY = {
    "all cones": np.eye(3),
    "no long": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998],
    ],
    "no medium": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881],
    ],
}  # fmt: skip
XYZ = np.array([[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])


def linear(colour):
    rgb = np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def contrast(one, other):
    low, high = sorted(float(XYZ[1] @ linear(colour)) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def lab(rgb):
    x, y, z = np.cbrt(XYZ @ np.clip(rgb, 0, 1) / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_no_colour_has_two_meanings():
    every = [colour for family in FAMILIES for colour in family.values()]
    assert len(set(every)) == len(every)


def test_no_colour_stands_outside_the_palette():
    """Pages, charts, figures and pictures name their colours."""
    room = Path(colours.__file__).parents[1]
    places = [
        p for name in ("report", "studies") for p in (room.parent / name).rglob("*") if p.is_file()
    ]
    written = {
        str(p) for p in places
        if p.suffix in (".py", ".css", ".j2", ".js") and re.search(r"#[0-9A-Fa-f]{3,6}\b", p.read_text())
    }  # fmt: skip
    assert written == {str(room / "drawing" / "colours.py")}


@pytest.mark.parametrize("paper", PAPERS)
def test_conditions_outcomes_and_roles_stand_out_from_the_paper(paper):
    for family in (colours.CONDITIONS, colours.OUTCOMES, ROLES):
        assert {name: c for name, c in family.items() if contrast(c, paper) < 3} == {}


@pytest.mark.parametrize("paper", PAPERS)
def test_what_only_studies_draw_stands_out_too_and_has_no_colour_of_another_meaning(paper):
    *drawn, ink = colours.COLOURS
    assert ink == colours.INK, "dark pages turn it light"
    assert [c for c in drawn if contrast(c, paper) < 3] == []
    assert not {*drawn} & {c for family in FAMILIES for c in family.values()}


@pytest.mark.parametrize("eyes", SEEN_BY)
def test_the_colour_blind_tell_apart_what_stands_side_by_side(eyes):
    for family in (*(family.values() for family in FAMILIES), colours.COLOURS):
        for one, other in combinations(family, 2):
            seen = [lab(np.array(SEEN_BY[eyes]) @ linear(colour)) for colour in (one, other)]
            assert np.linalg.norm(seen[0] - seen[1]) > 10, (one, other)


@given(st.lists(st.sampled_from(["single-local", "v2x", "6g", "6g:loss=0.2", "mine"]), unique=True))
def test_the_papers_conditions_keep_their_colours_and_no_two_share_one(names):
    found = colours.conditions(names)
    assert len(set(found.values())) == len(names)
    if not {"6g:loss=0.2", "mine"} & set(names):
        assert found == {name: colours.CONDITIONS[name] for name in names}


def test_the_papers_points_are_those_of_its_numbers():
    rows = csv.DictReader((files("harness.studies") / "paper_numbers.csv").read_text().splitlines())
    core = {
        (row["condition"], row["metric"]): row["paper_value"]
        for row in rows
        if row["panel"] == "core"
    }
    names = {"single-local": "single_local", "v2x": "swarm_v2x", "6g": "swarm_6g"}
    for name, (latency_ms, success) in PAPER.items():
        assert float(core[names[name], "latency"]) == latency_ms
        assert float(core[names[name], "success"]) == round(100 * success, 1)
