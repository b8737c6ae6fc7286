"""Tracks of recorded scenes and their lanes, from CommonRoad, tables and platoons."""

import gzip

import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared

from limsim_jax.maps import build_lane_map
from limsim_jax.maps.lane_map import lane_rows, width
from limsim_jax.maps.network import MapError
from limsim_jax.recordings import Lanelet, RecordingError, lanelet_network, read_platoon, read_tracks

TRAJECTORIES = SHARED / "trajectories"


def strip(name: str, y: float, *, wide: float = 3.5, end: float = 1000.0, **links) -> Lanelet:
    x = np.linspace(0, end, 101)
    return Lanelet(
        name, np.stack([x, 0 * x + y + wide / 2], -1), np.stack([x, 0 * x + y - wide / 2], -1), **links
    )


def test_lanelets_make_a_network():
    lanelets = [
        strip("a", 0, left="b", end=80, successors=("c",)),
        strip("b", 3.5, wide=4.0, right="a", end=80),
        strip("c", 0, end=80, predecessors=("a", "gone")),
    ]
    shift = np.array([80.0, 0.0])
    left, right = lanelets[2].left_bound + shift, lanelets[2].right_bound[::2] + shift  # not as many points
    lanelets[2] = Lanelet("c", left, right, predecessors=("a", "gone"))
    network = lanelet_network(lanelets, "n", "file", speed_limit=20.0)
    lane = network.lanes["a"]
    assert lane.length == pytest.approx(80) and lane.speed_limit == 20 and lane.may_change_left
    assert lane.road == network.lanes["b"].road != network.lanes["c"].road
    assert (lane.number, network.lanes["b"].number) == (0, 1)
    assert [note.where for note in network.report.notes if note.element == "predecessor"] == ["lanelet c"]
    lane_map = build_lane_map(network)
    rows = lane_rows(network)
    assert float(width(lane_map, jnp.int32(rows["b"]), jnp.float32(30.0))) == pytest.approx(4.0, abs=1e-3)
    assert int(lane_map.successors[rows["a"], 0]) == rows["c"]
    assert int(lane_map.left[rows["a"]]) == rows["b"]


@pytest.mark.parametrize(
    ("lanelets", "message"),
    [
        ([], "no lanelet"),
        ([strip("a", 0), strip("a", 3)], "lanelet a: is there twice"),
        ([strip("a", 0, end=0.1)], r"lanelet a: is 0\.10 m long"),
        ([strip("a", 0, wide=0.2)], r"lanelet a: is 0\.20 m wide"),
        ([strip("a", 0, wide=-3.0)], "left bound on the right"),
        (
            [strip("a", 0, left="b"), strip("b", 3, right="c"), strip("c", 6)],
            "lanelet a: is beside lanelet b, whose right neighbour is c",
        ),
    ],
)
def test_broken_lanelets_are_named(lanelets, message):
    with pytest.raises(MapError, match=message):
        lanelet_network(lanelets, "n", "file")


HEADER = "scenario,vehicle_id,step,t,x,y,heading,v,a,length,width,type,lanelet_id"
ROWS = [f"s,7,{k},{k / 10:.1f},{5 + 1.5 * k:.1f},0.1,0.0,15.0,0.0,4.5,1.8,car,1" for k in range(4)]


def write(folder, rows, header=HEADER):
    tables = {
        "scenes_vehicles.csv.gz": [header, *rows],
        "scenes_lanelets.csv.gz": [
            "scenario,lanelet_id,left,left_direction,right,right_direction,predecessors,successors",
            "s,1,,,,,,",
        ],
        "scenes_lanelet_points.csv.gz": [
            "scenario,lanelet_id,side,index,x,y",
            *(f"s,1,{side},{k},{100 * k},{y}" for side, y in (("left", 2), ("right", -2)) for k in range(2)),
        ],
    }  # fmt: skip
    for name, lines in tables.items():
        (folder / name).write_bytes(gzip.compress("\n".join(lines).encode()))
    return folder / "scenes_vehicles.csv.gz"


def test_tables_are_read(tmp_path):
    recorded = read_tracks(write(tmp_path, ROWS))
    assert recorded.dt == 0.1 and recorded.vehicles == ("7",) and recorded.name == "s"
    np.testing.assert_allclose(recorded.x[:, 0], 5 + 1.5 * np.arange(4))
    assert recorded.network.lanes["1"].length == pytest.approx(100)


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ([], HEADER, "line 2: no rows"),
        (ROWS, HEADER.replace("heading", "yaw"), "line 1: column heading is missing"),
        ([ROWS[0], ROWS[1].replace("6.5", "nan")], HEADER, "line 3, column x: 'nan'; a finite number"),
        ([ROWS[0], ROWS[1].replace("6.5", "left")], HEADER, "line 3, column x: 'left'; a finite number"),
        ([ROWS[0], ROWS[1], ROWS[1]], HEADER, "line 4: vehicle 7: step 1 twice"),
        ([ROWS[0], ROWS[1], ROWS[3]], HEADER, "line 4: vehicle 7: step 3 follows step 1; no gap in time"),
        ([row.replace("4.5,1.8", "14.8,5.9") for row in ROWS], HEADER, "width 5.9 m; metres"),
        ([ROWS[0], ROWS[1].replace("15.0", "-1.0")], HEADER, "line 3: vehicle 7: v is -1 m/s"),
        ([ROWS[0], ROWS[1].replace("6.5", "16.5")], HEADER, r"line 3: vehicle 7: moves 11\.5 m in one step"),
        ([ROWS[0], ROWS[1].replace("0.1,0.0", "0.1,88.0")], HEADER, "heading 88; radians"),
        ([ROWS[0], ROWS[1] + ",1"], HEADER, "line 3: 14 values; 13 are expected, as in the header"),
        ([ROWS[0], ROWS[1], ROWS[2].replace("0.2", "0.5")], HEADER, "column t: 0.1 s at step 1"),
        ([*ROWS, ROWS[0].replace("s,", "z,", 1)], HEADER, "no scenario is named; it has s, z"),
    ],
)
def test_bad_tables_are_named_by_line_and_column(tmp_path, rows, header, message):
    path = write(tmp_path, rows, header)
    with pytest.raises(RecordingError, match=message) as error:
        read_tracks(path)
    assert "\n" not in str(error.value) and path.name in str(error.value)


def write_platoon(folder, rows):
    lines = ["Date,1,1,2020", "Vehicle_order,A,B", "Number_of_vehicles,2", "ACC,0", "Distance_setting"]
    lines += ["Time,Speed1,E1,N1,Speed2,E2,N2,IVS1", *rows]
    path = folder / "openacc_x.csv.gz"
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    return path


def test_a_platoon_gets_the_lane_that_it_drives_along(tmp_path):
    """Two cars on a circle of 100 m around (50, 50), 0.15 rad apart."""
    t = np.arange(100) * 0.1
    angle = 0.1 * t[:, None] + np.array([0.15, 0.0])
    x, y = 50 + 100 * np.cos(angle), 50 + 100 * np.sin(angle)
    rows = [f"{7 + t[k]:.1f},10.0,{x[k, 0]},{y[k, 0]},10.0,{x[k, 1]},{y[k, 1]},10.5" for k in range(100)]
    recorded = read_platoon(write_platoon(tmp_path, rows), 1.0, 5.0)
    assert recorded.x.shape == (50, 2) and recorded.dt == 0.1 and recorded.vehicles == ("1", "2")
    np.testing.assert_allclose(recorded.x[0], x[10])
    # the heading is that of the circle but for half a chord at the ends
    np.testing.assert_allclose(recorded.heading, angle[10:60] + np.pi / 2, atol=0.025)
    lane = recorded.network.lanes["lane"]
    inside = lane.xyz[lane.s < 60]
    np.testing.assert_allclose(np.hypot(*(inside[:, :2] - 50).T), 100, atol=0.05)
    np.testing.assert_allclose(lane.width, 3.5, atol=0.01)

    with pytest.raises(RecordingError, match=r"8 to 13 s has 20 rows; .* within 0 to 10 s"):
        read_platoon(write_platoon(tmp_path, rows), 8.0, 5.0)
    broken = [*rows[:20], rows[20].replace("10.0,", "fast,", 1), *rows[21:]]
    with pytest.raises(RecordingError, match="line 27, column Speed1: 'fast'; a finite number"):
        read_platoon(write_platoon(tmp_path, broken), 1.0, 5.0)


@needs_shared
def test_both_forms_of_a_scene_are_the_same():
    name = "USA_US101-4_1_T-1"
    from_xml = read_tracks(TRAJECTORIES / "commonroad" / f"{name}.xml.gz")
    from_table = read_tracks(TRAJECTORIES / "scenes_vehicles.csv.gz", name)
    assert from_xml.vehicles == from_table.vehicles and from_xml.dt == from_table.dt == 0.1
    np.testing.assert_allclose(from_xml.x, from_table.x)
    np.testing.assert_allclose(from_xml.heading, from_table.heading, atol=1e-4)
    assert set(from_xml.network.lanes) == set(from_table.network.lanes)
    for lane_id, lane in from_xml.network.lanes.items():
        np.testing.assert_allclose(lane.xyz, from_table.network.lanes[lane_id].xyz, atol=2e-3)
    with pytest.raises(RecordingError, match="no scenario 'x'; it has USA_US101-24_2_T-1"):
        read_tracks(TRAJECTORIES / "scenes_vehicles.csv.gz", "x")
