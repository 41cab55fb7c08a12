"""Single transmissions of another simulator as a channel: by name and time, or by distance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from channel_checks import check_channel, links_and_draws

from harness.core.errors import UserError
from harness.extensions.roads.transmissions import Transmissions, from_profile
from harness.radio.channel import REPLY, REQUEST, Draws, Links, Site
from harness.radio.fading import Trips

# a asks b at 5.0 s and is answered; at 6.0 s its request is lost. From c nothing comes back.
NAMED = """time_s,tx,rx,delay_ms,received
5.0,a,b,2,1
5.1,b,a,3,1
6.0,a,b,,0
6.1,b,a,5,1
5.0,a,c,4,1
5.1,c,a,,0
"""
FAR = "time_s,tx,rx,delay_ms,received,distance_m\n" + "".join(
    f"{n},x,y{n % 3},{n},{int(n < 60)},{n}\n" for n in range(100)
)


def load(tmp_path: Path, text: str, file: str = "log.csv") -> Transmissions:
    (tmp_path / file).write_text(text)
    return from_profile({"file": file}, tmp_path, "profile")


def links(distances_m: list[float], names: list[str] | None, time_s: float) -> Links:
    n = len(distances_m)
    xy_m = np.stack([np.array([0.0, *distances_m]), np.zeros(1 + n)], axis=-1)
    site = Site(xy_m, np.zeros(n, int), np.zeros(n), np.full((n, 2), np.nan))
    if names:
        in_scene = [f"s/{name}" for name in names]
        site = replace(site, names=np.array(in_scene), time_s=np.array(time_s))
    asked, ready_s = np.full(n, True), np.full(n, 0.1)
    return Links(asked, ready_s, ready_s, ready_s, asked, asked, 400.0, site)


def draws(share: float, n: int) -> Draws:
    return Draws(
        np.full((n, 2), share), np.zeros(n), Trips(np.array(0), np.array(0), np.array(0), 1)
    )


def test_cars_with_names_of_the_table_do_what_it_says_of_them_at_that_time(tmp_path):
    channel = load(tmp_path, NAMED)
    early, late = links([10, 20], ["a", "b", "c"], 5.2), links([10, 20], ["a", "b", "c"], 5.9)
    luck = draws(0.5, 2)
    heard = channel.latencies_s(early.where, luck, REQUEST)
    assert heard.tolist() == pytest.approx([0.002, 0.004])
    up, delay_s, loss, _ = channel.deliver(early, luck)
    assert up.tolist() == [True, False]
    assert delay_s.tolist() == pytest.approx([0.103, 0.1035])  # a lost reply takes the median
    assert loss.tolist() == [0, 0.5]
    up, delay_s, loss, _ = channel.deliver(late, luck)
    assert up.tolist() == [False, False]
    assert delay_s[0] == pytest.approx(0.105)
    assert loss[0] == 0.5


def test_names_may_be_of_a_scene_each(tmp_path):
    lines = NAMED.splitlines()
    rows = [f"{line},{scene}" for scene in "st" for line in lines[1:]]
    rows = [row.replace("5.0,a,b,2", "5.0,a,b,9") if row.endswith("t") else row for row in rows]
    channel = load(tmp_path, "\n".join([lines[0] + ",scene", *rows]) + "\n")
    here = links([10.0], ["a", "b"], 5.0)
    there = replace(here.where, names=np.array(["t/a", "t/b"]))
    for site, delay_s in ((here.where, 0.002), (there, 0.009)):
        assert channel.latencies_s(site, draws(0.5, 1), REQUEST) == pytest.approx(delay_s)


def test_names_of_several_scenes_need_the_scene(tmp_path):
    site = replace(links([10.0], ["a", "b"], 5.0).where, several_scenes=True)
    with pytest.raises(UserError, match=r"log\.csv: has no column scene, and the traffic has"):
        load(tmp_path, NAMED).latencies_s(site, draws(0.5, 1), REQUEST)
    lines = NAMED.splitlines()
    text = "\n".join([lines[0] + ",scene", *[f"{line},s" for line in lines[1:]]]) + "\n"
    channel = load(tmp_path, text)
    assert channel.latencies_s(site, draws(0.5, 1), REQUEST) == pytest.approx(0.002)
    here = site.take(None)
    for part in (here, here.select(slice(1)), here.of_helpers(np.zeros((1, 1), int))):
        assert part.several_scenes


def test_others_draw_among_those_whose_distance_fits(tmp_path):
    channel = load(tmp_path, FAR)
    received = channel.reception(np.array([0, 35, 60, 99.0, 200]))
    assert received.tolist() == pytest.approx([1, 1, 0.5, 0.2, 0])
    near = links([40.0, 60.0, 150.0], None, 0)
    rows = [channel.latencies_s(near.where, draws(u, 3), REPLY) * 1000 for u in (0, 0.5, 0.99)]
    assert all(15 <= row[0] < 65 for row in rows)
    assert len({row[0] for row in rows}) == 3
    assert channel.deliver(near, draws(0.5, 3)).up.tolist() == [True, False, False]
    unlike = links([40.0], ["x", "z"], 5.0)
    assert (
        channel.deliver(unlike, draws(0.0, 1)).delay_s[0]
        == channel.deliver(links([40.0], None, 5.0), draws(0.0, 1)).delay_s[0]
    )
    early = links([40.0], ["x", "y1"], 99.9)  # the pair's last is at 97 s
    assert channel._of_pairs(early.where, REQUEST).tolist() == [-2]


def test_what_the_table_says_nothing_of_is_refused_where_it_is_asked(tmp_path):
    channel = load(tmp_path, NAMED)
    stranger = links([10.0], ["a", "d"], 5.0)
    with pytest.raises(UserError, match=r"log\.csv: has no transmission of two cars .* add dist"):
        channel.deliver(stranger, draws(0.5, 1))
    unasked = replace(stranger, asked=np.array([False]))
    assert np.isinf(channel.deliver(unasked, draws(0.5, 1)).delay_s).all()


def test_it_is_a_channel_and_parquet_says_the_same(tmp_path):
    channel = load(tmp_path, FAR)
    check_channel(channel)
    pd.read_csv(tmp_path / "log.csv").to_parquet(tmp_path / "log.parquet")
    other = from_profile({"file": "log.parquet"}, tmp_path, "profile")
    for one, two in zip(
        channel.deliver(*links_and_draws((9, 3))),
        other.deliver(*links_and_draws((9, 3))),
        strict=True,
    ):
        assert np.array_equal(one, two, equal_nan=True)
    named = load(tmp_path, NAMED)
    where, _ = links_and_draws((4, 2))
    names = np.array([["s/a", "s/b", "s/c"], ["s/b", "s/a", ""], ["s/c", "", "s/a"], [""] * 3])
    site = replace(where.where, names=names, time_s=np.full(4, 5.0))
    picked = site.of_helpers(np.array([[1, 1], [0, 1], [1, 0], [0, 0]]))
    assert picked.names[0].tolist() == ["s/a", "s/c", "s/c"]
    assert site.select(slice(1, 2)).names[0].tolist() == ["s/a", "s/c"]
    assert named._of_pairs(site.take([0]), REQUEST).tolist() == [
        named._of_pairs(site, REQUEST)[0].tolist()
    ]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,delay_ms\n1,2\n", "has no column received; it has time_s, delay_ms"),
        ("time_s,tx,delay_ms,received\n1,a,2,1\n", "has neither tx and rx nor distance_m"),
        (NAMED.replace("5.0,a,b", "nan,a,b"), "row 1: time_s is nan; allowed: seconds"),
        (NAMED.replace("2,1\n", "-2,1\n"), "row 1: delay_ms is -2; allowed: 0 to 1e+06"),
        (NAMED.replace("3,1\n", ",1\n"), "row 2: delay_ms is nan; allowed: 0 to 1e+06"),
        (NAMED.replace("2,1\n", "2,7\n"), "row 1: received is 7; allowed: 1 or 0"),
        (NAMED.replace("5.0,a,b", "soon,a,b"), "cannot be read as a table (In CSV column"),
        (FAR.replace(",99\n", ",-9\n"), "row 100: distance_m is -9; allowed: metres"),
        (FAR.partition("\n")[0] + "\n", "has 0 rows; allowed: 1 to"),
        ("", "has no column time_s"),
        ("PAR1nothing", "cannot be read as a table"),
    ],
)  # fmt: skip
def test_a_bad_table_is_refused_in_one_line(tmp_path, text, says):
    with pytest.raises(UserError) as refused:
        load(tmp_path, text)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({}, "has no file; add it"),
        ({"file": "../log.csv"}, "lies elsewhere"),
        ({"file": "none.csv"}, "cannot be read as a table"),
        ({"file": "log.csv", "loss": 1}, "loss"),
    ],
)
def test_a_mistake_in_a_profile_is_one_line(tmp_path, parameters, says):
    (tmp_path / "log.csv").write_text(NAMED)
    with pytest.raises(UserError) as error:
        from_profile(parameters, tmp_path, "mine.toml [parameters]")
    assert says in str(error.value)
    assert "\n" not in str(error.value)
