"""Our traffic against SUMO's: `experiments/traffic_against_sumo.py` on one lane, and how it reads queues."""

from __future__ import annotations

import importlib.util
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import platoon_against_sumo as platoons
import pytest
import traffic_against_sumo as referee
from paths import SHARED, needs_shared

from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.signals import phase_at
from limsim_jax.maps.sumo import read_demand
from limsim_jax.traffic.demand.sumo import sumo_scenario

pytestmark = pytest.mark.engine

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="no libsumo; install the dev extra to compare with SUMO",
)


@needs_sumo
def test_a_platoon_drives_as_in_sumo():
    # a process of its own: SUMO keeps its world in globals
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = platoons.one_lane(100.0, pool, vehicles=8)
    same = found["ballistic, as ours"]
    assert same["driven"] > 500  # across a lane end
    assert same["position_rms"] < 0.01
    assert same["position_max"] < 0.02
    assert same["speed_max"] < 0.005
    other = found["Euler, SUMO's default"]  # the comparison can tell
    assert other["position_max"] > 20 * same["position_max"]


def test_platoon_stands_without_overlap():
    cars = platoons.platoon(20)
    gaps = cars.s[:-1] - cars.length[:-1] - cars.s[1:]
    assert (gaps > cars.s0[1:]).all()
    assert all(len(np.unique(x)) > 10 for x in vars(cars).values())


def test_discharge_counts_from_the_fourth_of_the_queue():
    greens = [referee.Green("a", 10.0, 40.0, 5), referee.Green("b", 10.0, 40.0, 3)]
    passages = {
        "a": [9.0, 12.0, 14.5, 16.5, 18.4, 20.2, 25.0, 41.0],  # 9: in the green before; 25: came later
        "b": [11.0, 13.0, 15.0, 17.0],
    }
    headways, first = referee.discharge(greens, passages)
    assert headways == pytest.approx([1.9, 1.8])
    assert first == pytest.approx([2.0, 1.0])


def test_a_green_counts_if_it_is_for_all_and_none_has_to_yield():
    light = referee.Light("program", links=(0, 2), foes=(3,))
    assert referee.is_free(light, "Grgr")
    assert not referee.is_free(light, "GrgG")  # a foe goes, too
    assert not referee.is_free(light, "Gryr")
    assert referee.is_closed(light, "rGrG") and not referee.is_closed(light, "rGyG")
    watch = referee._Watch({"a": light})
    for now, state in enumerate(["GrGr", "yryr", "rrrr", "rrrr", "GrGr", "GrGr", "GryG"]):
        watch.look(float(now), {"program": state}, lambda lane: 7)
    assert watch.greens == [referee.Green("a", 4.0, 6.0, 7)]


@needs_shared
def test_the_same_vehicles_drive_in_both(tmp_path):
    net, network, made = referee.prepare("ingolstadt1", tmp_path, [0], 300.0)
    assert net.parent == SHARED / "sumo" / "ingolstadt1"
    case = referee.CASES["ingolstadt1"]
    (types, path) = referee.sumo_files(net.parent, case, made[0].vehicles, tmp_path, idm=True)
    assert 'carFollowModel="IDM"' in types.read_text()
    root = referee.ElementTree.parse(path).getroot()
    ids = [x.attrib["id"] for x in root if x.tag in ("vehicle", "trip")]
    assert sorted(ids) == sorted(made[0].vehicles)
    assert all(x.attrib["carFollowModel"] == "IDM" for x in root.iter("vType"))
    assert set(referee.lights(network)) <= set(network.lanes)


@needs_shared
def test_lights_are_where_they_are_in_sumo_when_the_scenario_begins():
    folder = SHARED / "sumo" / "ingolstadt1"
    network = read_network(folder / "ingolstadt1.net.xml")
    lane_map = build_lane_map(network)
    demand = read_demand(folder / "ingolstadt1.rou.xml", network)
    begin = 57600 + 40.0  # 57600 s are whole cycles of 90 s; at 40 s the second phase shows
    made = sumo_scenario(network, lane_map, demand, slots=8, begin=begin, end=begin + 60)
    program = next(iter(network.programs.values()))
    ends = np.cumsum([phase.duration for phase in program.phases])
    for t in (0.0, 0.5, 1.5, 30.0, 49.5, 50.5):
        now = (begin + t - program.offset) % ends[-1]
        expected = np.searchsorted(ends, now, side="right")
        assert int(phase_at(made.lane_map.signals, t)[0]) == expected, t
