"""The link to a real SUMO: places, followers, ghosts, routes, ids, signals, collisions, ends.

Every simulation runs in a process of its own, so nothing here starts libsumo in the process of the tests.
"""

from __future__ import annotations

import math
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paths import SHARED, needs_shared

from limsim_jax.bridges.sumo import link as link_module
from limsim_jax.bridges.sumo.messages import Body, Move, Orders, Reading, Start, SumoError
from limsim_jax.bridges.sumo.process import SumoProcess
from limsim_jax.bridges.sumo.seats import Places, angle_of, heading_of
from limsim_jax.maps.cut import close, cut
from limsim_jax.maps.lane_map import NO_LANE
from limsim_jax.maps.map import load_map
from limsim_jax.maps.network import LaneType

sumo = pytest.importorskip("sumo", reason="needs eclipse-sumo")

DT = 0.1
LENGTH, WIDTH = 5.0, 1.8  # m, SUMO's default car


@pytest.fixture(scope="module")
def nets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`grid` has two lanes and priority junctions, `lights` one lane and signals; edges of 200 m."""
    folder = tmp_path_factory.mktemp("nets")
    program = Path(sumo.__file__).parent / "bin" / "netgenerate"
    common = [program, "--grid", "--grid.number", "3", "--grid.length", "200", "--no-turnarounds", "true"]
    for name, options in (("grid", ["-L", "2"]), ("lights", ["--default-junction-type", "traffic_light"])):
        command = [*common, *options, "-o", folder / f"{name}.net.xml"]
        subprocess.run(list(map(str, command)), check=True, capture_output=True)
    return folder


def demand(nets: Path, text: str, net: str = "grid") -> Start:
    """A simulation with these vehicles."""
    path = nets / f"{abs(hash(text))}.rou.xml"
    path.write_text(f"<routes>{text}</routes>")
    return Start(arguments=("-n", str(nets / f"{net}.net.xml"), "-r", str(path)), seed=1, dt=DT)


def at(reading: Reading, handle: int) -> int:
    """Row of a vehicle."""
    return reading.handle.tolist().index(handle)


def until(process: SumoProcess, name: str) -> tuple[int, Reading]:
    """Step until a vehicle is on the road."""
    for _ in range(1000):
        reading = process.step(Orders())
        for one in reading.new:
            if one.id == name:
                return one.handle, reading
    raise AssertionError(f"{name} never came")


def apart(dx: float, dy: float) -> float:
    """Gap (m) between two cars that both point east or west; negative where they overlap."""
    return max(abs(dx) - LENGTH, abs(dy) - WIDTH)


def lane_of(process: SumoProcess, reading: Reading, row: int) -> str:
    return "" if reading.lane[row] < 0 else process.there.lanes[reading.lane[row]]


CAR = '<vType id="car" speedFactor="1" sigma="0"/>'
EAST = '<route id="east" edges="A1B1 B1C1"/>'


# --- places


def recorded(start: Start, after: float, seconds: float) -> tuple[str, np.ndarray]:
    """A vehicle of SUMO, and x, y and angle of it in every step."""
    with SumoProcess(start) as process:
        names: dict[int, str] = {}
        rows: dict[int, list[tuple[float, float, float]]] = {}
        for _ in range(round((after + seconds) / DT)):
            reading = process.step(Orders())
            names |= {one.handle: one.id for one in reading.new}
            for k, handle in enumerate(reading.handle.tolist()):
                if reading.time - process.there.time >= after:
                    rows.setdefault(handle, []).append((reading.x[k], reading.y[k], reading.angle[k]))
    best = max(rows, key=lambda h: len(rows[h]))
    return names[best], np.array(rows[best])


@needs_shared
@pytest.mark.parametrize(
    "net",
    [
        "ingolstadt1",
        pytest.param("limsim_roundabout", marks=pytest.mark.slow),
        pytest.param("limsim_town05", marks=pytest.mark.slow),
        pytest.param("bologna_pasubio", marks=pytest.mark.slow),
    ],
)
def test_sumo_reports_our_vehicle_where_we_put_it(net: str) -> None:
    """A vehicle of SUMO is taken over and driven along the path that it had, 0.4 m to the left."""
    folder = SHARED / "sumo" / net
    network = next(folder.glob("*.net.xml"))
    types_first = sorted(folder.glob("*.rou.xml"), key=lambda x: "vtypes" not in x.name)
    config = next(iter([*folder.glob(f"{net}.sumocfg"), *folder.glob("run.sumocfg")]), None)
    files = ("-n", str(network), "-r", ",".join(map(str, types_first)))
    start = Start(arguments=files if config is None else ("-c", str(config)), seed=3, dt=DT)
    name, path = recorded(start, after=20.0, seconds=62.0)
    with SumoProcess(start) as process:
        handle, reading = until(process, name)
        while (
            np.hypot(*(path[0, :2] - (reading.x[at(reading, handle)], reading.y[at(reading, handle)]))) > 0.01
        ):
            reading = process.step(Orders())
        heading = heading_of(path[:, 2])
        x, y = path[:, 0] - 0.4 * np.sin(heading), path[:, 1] + 0.4 * np.cos(heading)
        errors, speeds = [], []
        take: tuple[int, ...] = (handle,)
        for k in range(1, len(path)):
            v = math.hypot(x[k] - x[k - 1], y[k] - y[k - 1]) / DT
            move = Move(float(x[k]), float(y[k]), float(path[k, 2]), v)
            reading = process.step(Orders(take=take, move={handle: move}))
            take, row = (), at(reading, handle)
            errors.append(math.hypot(reading.x[row] - x[k], reading.y[row] - y[k]))
            speeds.append(abs(reading.v[row] - v))
    assert len(errors) > 100
    assert max(errors) < 0.01
    assert max(speeds) < 0.01


def test_angles_are_clockwise_from_north() -> None:
    assert heading_of(np.array([0.0, 90.0, 180.0])) == pytest.approx([math.pi / 2, 0, -math.pi / 2])
    assert angle_of(heading_of(217.0)) == pytest.approx(217.0)


# --- other vehicles react


def straight(process: SumoProcess, handle: int, reading: Reading, v: float, left: float = 0.0) -> Move:
    """A step on to the east."""
    row = at(reading, handle)
    return Move(reading.x[row] + v * DT, reading.y[row] + left, 90.0)


def test_a_follower_keeps_its_distance(nets: Path) -> None:
    text = (
        CAR
        + EAST
        + "".join(
            f'<vehicle id="{name}" type="car" route="east" depart="{when}" departLane="0" departSpeed="max"/>'
            for name, when in (("ego", 0), ("follower", 3))
        )
    )
    with SumoProcess(demand(nets, text, "lights")) as process:  # one lane: it cannot overtake
        ego, reading = until(process, "ego")
        take: tuple[int, ...] = (ego,)
        gaps = []
        for _ in range(250):
            reading = process.step(Orders(take=take, move={ego: straight(process, ego, reading, 5.0)}))
            take = ()
            others = [k for k, h in enumerate(reading.handle.tolist()) if h != ego]
            if others:
                gaps.append(reading.x[at(reading, ego)] - LENGTH - reading.x[others[0]])
            assert not reading.collisions
    assert min(gaps) > 2.0  # m
    assert min(gaps) < 15.0, "it has closed up"


@pytest.mark.parametrize("with_ghost", [True, False])
def test_a_body_on_two_lanes_is_seen_on_both_with_a_ghost(nets: Path, with_ghost: bool) -> None:
    """It stands 1.5 m off the middle of the right lane, and reaches 0.8 m into the left one."""
    text = (
        CAR
        + EAST
        + "".join(
            f'<vehicle id="{name}" type="car" route="east" depart="{when}" departLane="{lane}" '
            f'departPos="{pos}" departSpeed="{speed}"/>'
            for name, when, lane, pos, speed in (("ego", 0, 0, 100, 0), ("other", 1, 1, 0, "max"))
        )
    )
    with SumoProcess(demand(nets, text)) as process:
        ego, reading = until(process, "ego")
        row = at(reading, ego)
        x, y = reading.x[row], reading.y[row]
        ghost = (x, y + 3.2, 90.0) if with_ghost else None
        take: tuple[int, ...] = (ego,)
        gaps = []
        for _ in range(150):
            reading = process.step(Orders(take=take, move={ego: Move(x, y + 1.5, 90.0, ghost=ghost)}))
            take = ()
            for k, handle in enumerate(reading.handle.tolist()):
                if handle != ego:
                    gaps.append(apart(x - reading.x[k], y + 1.5 - reading.y[k]))
    if with_ghost:
        assert min(gaps) > 1.0
    else:
        assert min(gaps) < 0, "without a ghost it is run into"


def test_a_ghost_comes_only_where_a_vehicle_of_sumo_is_near(nets: Path) -> None:
    text = CAR + EAST + '<vehicle id="ego" type="car" route="east" depart="0" departLane="0" departPos="50"/>'
    with SumoProcess(demand(nets, text)) as process:
        ego, reading = until(process, "ego")
        row = at(reading, ego)
        move = Move(
            reading.x[row], reading.y[row] + 1.3, 90.0, ghost=(reading.x[row], reading.y[row] + 3.2, 90.0)
        )
        for _ in range(20):
            reading = process.step(Orders(take=(ego,), move={ego: move}))
        assert reading.expected == 1


# --- routes and owners


def turning(process: SumoProcess, handle: int, edges: tuple[str, ...]) -> list[str]:
    """Drive a vehicle to the middle of B1, and left to the north; the lanes that SUMO says it is on."""
    reading = process.step(Orders())
    row = at(reading, handle)
    x, y = reading.x[row], reading.y[row]
    lanes, take = [], (handle,)
    radius = 8.0
    begin = 201.6 - radius  # the left lane to the north is 1.6 m right of the middle of the road
    arc = [(s, y, 90.0) for s in np.linspace(x, begin, max(round(begin - x), 2))]
    x0, y0 = arc[-1][0], arc[-1][1]
    for turn in np.linspace(0, math.pi / 2, 14)[1:]:
        arc.append(
            (x0 + radius * math.sin(turn), y0 + radius * (1 - math.cos(turn)), 90 - math.degrees(turn))
        )
    arc += [(arc[-1][0], arc[-1][1] + s, 0.0) for s in np.arange(1, 60.0)]
    for px, py, angle in arc:
        reading = process.step(Orders(take=take, move={handle: Move(px, py, angle, edges=edges)}))
        take = ()
        if handle not in reading.handle:
            lanes.append("gone")
            break
        lanes.append(lane_of(process, reading, at(reading, handle)))
    return list(dict.fromkeys(lanes))


@pytest.mark.parametrize("told", [True, False])
def test_a_turn_off_the_first_route_keeps_the_vehicle_and_its_lanes(nets: Path, told: bool) -> None:
    text = (
        CAR
        + EAST
        + (
            '<vehicle id="ego" type="car" route="east" depart="0" departLane="1" departPos="120" '
            'departSpeed="10"/>'
        )
    )
    with SumoProcess(demand(nets, text)) as process:
        ego, _ = until(process, "ego")
        lanes = turning(process, ego, ("A1B1", "B1B2") if told else ())
        inside = [lane for lane in lanes if lane.startswith(":B1")]
        assert "gone" not in lanes
        assert lanes[-1].startswith("B1B2")
        connections = (nets / "grid.net.xml").read_text().splitlines()
        left = [
            x.split('via="')[1].split('"')[0]
            for x in connections
            if 'from="A1B1" to="B1B2"' in x and "via=" in x
        ]
        # without our route SUMO reports the lanes of its own
        assert inside and (set(inside) <= set(left)) == told, (inside, left)


def test_a_route_that_sumo_refuses_leaves_the_vehicle_where_it_is_put(nets: Path) -> None:
    """Edges without a connection; SUMO also refuses some routes close to the end of an edge."""
    text = CAR + EAST + '<vehicle id="ego" type="car" route="east" depart="0" departPos="120"/>'
    with SumoProcess(demand(nets, text)) as process:
        ego, reading = until(process, "ego")
        k = at(reading, ego)
        x, y, angle = (float(v[k]) for v in (reading.x, reading.y, reading.angle))
        for step in range(1, 4):
            move = Move(x + step, y, angle, 10.0, edges=("A1B1", "C2C1"))
            reading = process.step(Orders(take=(ego,) if step == 1 else (), move={ego: move}))
            assert float(reading.x[at(reading, ego)]) == pytest.approx(x + step, abs=0.01)


def test_a_thousand_ids_come_go_and_come_again(nets: Path) -> None:
    with SumoProcess(demand(nets, CAR)) as process:
        seen, there = 0, []
        for k in range(250):
            names = [f"car{(4 * k + i) % 500}" for i in range(4)]
            bodies = tuple(
                Body(-1 - (4 * k + i), name, "passenger", LENGTH, WIDTH, "A1B1")
                for i, name in enumerate(names)
            )
            moves = {
                b.handle: Move(20.0 + 30 * i, 196.8 if i % 2 else 193.6, 90.0) for i, b in enumerate(bodies)
            }
            reading = process.step(Orders(add=bodies, remove=tuple(there), move=moves))
            there = [body.handle for body in bodies]
            assert sorted(reading.handle.tolist()) == sorted(there)
            assert reading.owned == frozenset(there)
            seen += len(there)
        reading = process.step(Orders(remove=tuple(there)))
        assert seen == 1000 and not len(reading.handle)


def test_owners_sum_to_all_vehicles_and_a_released_one_drives_on(nets: Path) -> None:
    """200 s: vehicles are taken over, driven for 5 s and given back."""
    text = (
        CAR + EAST + '<flow id="f" type="car" route="east" begin="0" end="180" period="4" departSpeed="10"/>'
    )
    with SumoProcess(demand(nets, text)) as process:
        ours, since, jumps, known = -1, 0.0, [], set()
        released: dict[int, float] = {}
        reading = process.step(Orders())
        for _ in range(2000):
            orders = Orders()
            known |= {one.handle for one in reading.new}
            known -= set(reading.gone)
            if ours >= 0 and ours not in reading.owned:
                ours = -1
            if ours < 0 and len(reading.handle):
                ours, since = int(reading.handle[-1]), reading.time
                orders = Orders(take=(ours,))
            elif ours >= 0 and reading.time - since > 5.0:
                orders, ours = Orders(release=(ours,)), -1
            elif ours >= 0:
                orders = Orders(move={ours: straight(process, ours, reading, 9.0)})
            before = dict(zip(reading.handle.tolist(), reading.v.tolist(), strict=True))
            reading = process.step(orders)
            for handle in orders.release:
                released[handle] = reading.time
                if handle in reading.handle:
                    jumps.append(abs(reading.v[at(reading, handle)] - before[handle]))
            natives = set(reading.handle.tolist()) - reading.owned
            fresh = {one.handle for one in reading.new}
            assert natives | reading.owned == (known | fresh) - set(reading.gone)
            assert len(reading.owned) <= 1
        assert len(jumps) > 20
        assert max(jumps) < 0.5  # m/s in a step: no vehicle freezes
        early = {handle for handle, when in released.items() if when < 120}
        assert early and not early & set(reading.handle.tolist()), "all of them have arrived"


# --- signals and collisions


def test_red_from_us_stops_sumos_vehicles_until_it_is_given_back(nets: Path) -> None:
    text = CAR + EAST + '<flow id="f" type="car" route="east" begin="0" end="60" period="5"/>'
    with SumoProcess(demand(nets, text, "lights")) as process:
        lights = process.there.lights
        reading = process.step(Orders())
        red = {name: "r" * len(state) for name, state in zip(lights, reading.lights, strict=True)}
        reading = process.step(Orders(lights=red))
        for _ in range(600):
            reading = process.step(Orders())
        beyond = [lane_of(process, reading, k) for k in range(len(reading.handle))]
        assert len(beyond) > 3 and all(lane.startswith("A1B1") for lane in beyond)
        assert set("".join(reading.lights)) == {"r"}
        reading = process.step(Orders(lights=dict.fromkeys(lights)))
        for _ in range(1200):
            reading = process.step(Orders())
        assert not any(lane_of(process, reading, k).startswith("A1B1") for k in range(len(reading.handle)))


def test_both_sides_see_a_collision_in_the_same_step(nets: Path) -> None:
    """Our vehicle drives at 8 m/s into one that waits at a red light."""
    text = (
        CAR
        + EAST
        + "".join(
            f'<vehicle id="{name}" type="car" route="east" depart="{when}" departPos="{pos}"/>'
            for name, when, pos in (("first", 0, 150), ("ego", 12, 20))
        )
    )
    with SumoProcess(demand(nets, text, "lights")) as process:
        reading = process.step(Orders())
        red = {x: "r" * len(s) for x, s in zip(process.there.lights, reading.lights, strict=True)}
        process.step(Orders(lights=red))
        ego, reading = until(process, "ego")
        ours = theirs = None
        take: tuple[int, ...] = (ego,)
        for step in range(300):
            reading = process.step(Orders(take=take, move={ego: straight(process, ego, reading, 8.0)}))
            take = ()
            row = next(k for k, h in enumerate(reading.handle.tolist()) if h != ego)
            mine = at(reading, ego)
            gap = apart(reading.x[mine] - reading.x[row], reading.y[mine] - reading.y[row])
            if ours is None and gap <= 0:
                ours = step
            if theirs is None and any(ego in pair for pair in reading.collisions):
                theirs = step
            if ours is not None and theirs is not None:
                break
        assert ours is not None and theirs is not None
        assert abs(ours - theirs) <= 1


# --- ends


def test_equal_seeds_are_equal_simulations(nets: Path) -> None:
    text = (
        '<vType id="car" sigma="0.5"/>'
        + EAST
        + '<flow id="f" type="car" route="east" begin="0" end="60" probability="0.3"/>'
    )
    found = []
    for seed in (1, 1, 2):
        with SumoProcess(replace(demand(nets, text), seed=seed)) as process:
            reading = process.step(Orders())
            for _ in range(400):
                reading = process.step(Orders())
            found.append((reading.x.tobytes(), reading.v.tobytes()))
    assert found[0] == found[1] != found[2]


def test_a_killed_process_is_one_plain_error(nets: Path) -> None:
    process = SumoProcess(demand(nets, CAR))
    process.step(Orders())
    process.child.kill()
    with pytest.raises(SumoError, match=r"^the process of SUMO has ended \(seed 1, 0.1 s, signal 9\)$"):
        for _ in range(2):  # the first order may still fit into the pipe
            process.step(Orders())
    process.close()
    assert process.child.poll() is not None


def test_a_child_ends_with_its_parent(nets: Path) -> None:
    process = SumoProcess(demand(nets, CAR))
    assert process.child.stdin is not None
    process.child.stdin.close()  # as when this process dies
    end = time.monotonic() + 10
    while process.child.poll() is None and time.monotonic() < end:
        time.sleep(0.05)
    assert process.child.poll() == 0
    process.close()


def test_files_that_sumo_refuses_are_one_line(nets: Path) -> None:
    with pytest.raises(SumoError, match=r"nothing\.sumocfg") as error:
        SumoProcess(Start(arguments=("-c", str(nets / "nothing.sumocfg")), seed=0, dt=DT))
    assert "\n" not in str(error.value)
    with (
        pytest.raises(SumoError, match="vehicle type 'none'"),
        SumoProcess(demand(nets, EAST + '<vehicle id="a" type="none" route="east" depart="0"/>')) as process,
    ):
        process.step(Orders())


def test_outputs_of_a_scenario_do_not_litter_its_folder(nets: Path, tmp_path: Path) -> None:
    start = demand(nets, CAR + EAST + '<vehicle id="a" type="car" route="east" depart="0"/>')
    config = tmp_path / "out.sumocfg"
    config.write_text(
        f'<configuration><net-file value="{start.arguments[1]}"/><route-files value="{start.arguments[3]}"/>'
        '<tripinfo-output value="trips.xml"/><log value="log.txt"/></configuration>'
    )
    for outputs, names in ((False, []), (True, ["log.txt", "trips.xml"])):
        with SumoProcess(Start(arguments=("-c", str(config)), seed=0, dt=DT, outputs=outputs)) as process:
            process.step(Orders())
        assert sorted(x.name for x in tmp_path.iterdir() if x != config) == names


def test_another_network_than_the_map_is_refused(nets: Path) -> None:
    grid, lights = (load_map(nets / f"{name}.net.xml") for name in ("grid", "lights"))
    with SumoProcess(demand(nets, CAR)) as process:
        Places(grid.network, grid.lanes, process.there)
        there = process.there._replace(lengths=process.there.lengths + 1.0)
        with pytest.raises(SumoError, match="runs another network"):
            Places(grid.network, grid.lanes, there)
    with SumoProcess(demand(nets, CAR, "lights")) as process:
        with pytest.raises(SumoError, match="runs another network"):
            Places(grid.network, grid.lanes, process.there)
    assert lights.network.programs


def test_a_lane_of_sumo_may_be_several_pieces_of_the_map(nets: Path) -> None:
    """Roads are cut where no car fits; one of the pieces is closed."""
    grid = load_map(nets / "grid.net.xml")
    road = grid.network.lanes["A1B1_0"].road
    pieces = cut(grid.network, {(road, 0): [60.0, 130.0]})
    pieces = close(pieces, ["A1B1_0/1"], LaneType.NONE)
    rows = {lane.id: k for k, lane in enumerate(pieces.drivable_lanes())}
    with SumoProcess(demand(nets, CAR)) as process:
        there = process.there
        places = Places(pieces, grid.lanes, there)
    names = ["A1B1_0", "A1B1_0", "A1B1_0", "A1B1_1", "B1C1_0"]
    s = np.array([10.0, 100.0, 150.0, 150.0, 100.0])
    row, along = places.on(np.array([there.lanes.index(x) for x in names]), s)
    expected = ["A1B1_0", None, "A1B1_0/2", "A1B1_1/2", "B1C1_0"]
    assert row.tolist() == [NO_LANE if x is None else rows[x] for x in expected]
    declared = {x: grid.network.lanes[x].declared_length for x in names}
    stretch = {x: grid.network.lanes[x].length / m for x, m in declared.items() if m is not None}
    begins = [0.0, None, pieces.lanes["A1B1_0"].length + pieces.lanes["A1B1_0/1"].length, None, 0.0]
    for k in (0, 2, 4):
        assert along[k] == pytest.approx(s[k] * stretch[names[k]] - begins[k], abs=1e-6)
    nobody = places.on(np.array([-1]), np.array([3.0]))
    assert nobody[0].tolist() == [NO_LANE]


@needs_shared
def test_lanes_of_a_town_with_stretches_that_are_closed_are_found_in_sumo() -> None:
    folder = SHARED / "sumo" / "limsim_town05"
    town = load_map(folder / "Town05.net.xml")
    with SumoProcess(Start(arguments=("-n", str(folder / "Town05.net.xml")), seed=1, dt=DT)) as process:
        there = process.there
    assert any(name not in there.lanes for name in town.network.lanes)  # pieces
    places = Places(town.network, town.lanes, there)
    rows = places.on(np.arange(len(there.lanes)), np.zeros(len(there.lanes)))[0]
    drivable = {lane.id for lane in town.network.drivable_lanes()}
    assert [x for x, row in zip(there.lanes, rows, strict=True) if row >= 0] == [
        x for x in there.lanes if x in drivable
    ]


def test_a_missing_or_old_sumo_is_one_line(nets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = demand(nets, CAR)

    def missing(name: str) -> None:
        raise ImportError(f"No module named '{name}'")

    class Old:
        closed = False

        def start(self, arguments: list[str]) -> None:
            pass

        def getVersion(self) -> tuple[int, str]:
            return 16, "SUMO 0.32.0"

        def close(self) -> None:
            self.closed = True

    monkeypatch.setattr(link_module.importlib, "import_module", missing)
    with pytest.raises(SumoError, match=r'SUMO needs libsumo: pip install "limsim-jax\[sumo\]"'):
        link_module.Link(start)
    old = Old()
    monkeypatch.setattr(link_module.importlib, "import_module", lambda name: old)
    with pytest.raises(SumoError, match=r"SUMO 0\.32\.0 is too old"):
        link_module.Link(start)
    assert old.closed
