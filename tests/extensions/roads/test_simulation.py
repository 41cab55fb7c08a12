"""Traffic of SUMO: a run is a function of files, seed and commands, and opens no other file."""

import sys
from pathlib import Path

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.extensions.roads import simulation
from harness.extensions.roads.simulation import Command, Inputs, inputs_of, run

TRAFFIC = Path(__file__).parents[3] / "benchmarks/traffic"
NET, ROUTES = TRAFFIC / "crossing.net.xml", TRAFFIC / "crossing.rou.xml"


def of(name: str) -> Inputs:
    return inputs_of(TRAFFIC / f"{name}.net.xml", TRAFFIC / f"{name}.rou.xml")


@pytest.mark.parametrize(
    ("within", "says"),
    [
        ('<include href="/etc/passwd"/>', "include is no part of"),
        ('<vType id="t"><param key="device.ssm.file" value="o"/></vType>', "param is no part of"),
        ('<e1Detector id="d" lane="l" pos="1" file="o"/>', "e1Detector is no part of"),
        ('<vType id="t" imgFile="o"/>', "vType names a file by imgFile"),
        ('<timedEvent type="SaveTLSStates" dest="o"/>', "timedEvent is no part of"),
        ("<vType", "it is no XML"),
    ],
)
def test_routes_that_could_open_another_file_are_refused(tmp_path, within, says):
    routes = tmp_path / "my.rou.xml"
    routes.write_text(f"<routes>{within}</routes>")
    with pytest.raises(UserError) as refused:
        inputs_of(NET, routes)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("net", "says"),
    [
        ('<net><tlLogic id="t" type="actuated"/></net>', "a traffic light is not static"),
        (
            '<net><tlLogic id="t" type="static"><param key="file" value="o"/></tlLogic></net>',
            "or has a param",
        ),
        ('<!DOCTYPE net [<!ENTITY a "b">]><net/>', "has a document type"),
        ("<configuration/>", "its root is configuration, not net"),
    ],
)
def test_so_is_such_a_net(tmp_path, net, says):
    path = tmp_path / "my.net.xml"
    path.write_text(net)
    with pytest.raises(UserError, match=says):
        inputs_of(path, ROUTES)


def test_sumo_reads_what_was_checked_and_no_schema_of_elsewhere(tmp_path):
    crossing = of("crossing")
    assert b"noNamespaceSchemaLocation" not in crossing.net + crossing.routes
    assert b"<connection " in crossing.net
    again = tmp_path / "again.net.xml"
    again.write_bytes(crossing.net)
    assert inputs_of(again, ROUTES) == crossing


def test_without_the_package_one_line_says_how_to_install_it(monkeypatch):
    simulation._sumo.cache_clear()
    monkeypatch.setattr("harness.core.extras.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"run `pip install 'swarmdrive-harness\[sumo\]'`"):
        run(Inputs(b"", b""), 0, 0, 1)


def test_without_what_libsumo_imports_it_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "libsumo.py").write_text("from traci import connection\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "libsumo", raising=False)
    monkeypatch.setitem(sys.modules, "traci", None)
    simulation._sumo.cache_clear()
    with pytest.raises(UserError, match=r"libsumo cannot be .*; run `pip install traci sumolib`"):
        simulation.version()


@pytest.mark.exhaustive
def test_equal_commands_give_equal_drives_and_a_brake_changes_only_those_who_could_see_it():
    pytest.importorskip("libsumo")
    crossing = of("crossing")
    free = run(crossing, 6, 30, 40)
    ego = free["we.0"]
    speed_mps = float(ego.poses[0, 3])
    brake = (Command(30.0, 0.0, 0),)
    braked = run(crossing, 6, 30, 40, ego.id, brake)
    run.cache_clear()
    again = run(crossing, 6, 30, 40, ego.id, brake)
    assert list(braked) == list(again)
    assert all(np.array_equal(braked[key].poses, again[key].poses) for key in braked)
    assert braked["we.0"].poses[-1, 3] == 0
    assert np.diff(braked["we.0"].poses[:, 3]).min() >= -0.46  # SUMO's car brakes at 4.5 m/s2
    moved = {
        key: np.abs(track.poses[: len(braked[key].poses)] - braked[key].poses[: len(track.poses)])
        for key, track in free.items()
    }
    changed = {key for key, apart in moved.items() if apart.max() > 0}
    assert {"we.0", "we.1"} <= changed  # itself, and who drives behind it
    assert all(moved[key][:5].max() == 0 for key in free if key != "we.0")  # nobody at once
    # nobody who was ahead of it, and nobody who comes against it
    ahead = {key for key, track in free.items() if track.poses[0, 0] > ego.poses[0, 0] + 5}
    assert len(ahead) > 3
    assert not {key for key in changed & ahead if key[0] in "we"}
    assert speed_mps > 10


@pytest.mark.exhaustive
def test_the_ego_changes_lane_and_sumo_says_what_it_cannot_read(tmp_path):
    pytest.importorskip("libsumo")
    merge = of("merge")
    free = run(merge, 3, 25, 32)
    ego = free["t.4"]  # in the right of two lanes
    speed_mps = float(ego.poses[0, 3])
    told = run(merge, 3, 25, 32, ego.id, (Command(26.0, speed_mps, 1),))[ego.id]
    assert np.ptp(told.poses[:5, 1]) < 0.01
    assert told.poses[-1, 1] == pytest.approx(-1.75, abs=0.05)
    assert np.abs(np.diff(told.poses[:, 1])).max() < 0.3  # it takes 2 s
    with pytest.raises(UserError, match="SUMO cannot play these files"):
        run(merge._replace(routes=b"<routes><flow/></routes>"), 0, 0, 1)
