"""Signal tables and generated programs, against SUMO, the formulas and each other."""

import dataclasses
import math
import re
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared
from synthetic import intersection, mirrored, network, rows, straight

from limsim_jax.maps import read_network
from limsim_jax.maps.conflicts import ConflictType, build_conflicts
from limsim_jax.maps.network import (
    Action,
    Control,
    LaneSpot,
    MapError,
    Phase,
    Program,
    TrafficLight,
    Turn,
)
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import (
    LONGEST_CYCLE,
    all_red_time,
    build_signals,
    generate_programs,
    lane_states,
    lane_states_on_host,
    movement_states,
    phase_at,
    yellow_time,
)


def with_program(net, program, links):
    """The network with a program whose link k controls the movement over connector links[k]."""
    movements = tuple(
        dataclasses.replace(m, program=program.id, link=links.index(m.via[0]), control=Control.SIGNAL)
        if m.via[0] in links
        else m
        for m in net.movements
    )
    return dataclasses.replace(net, movements=movements, programs={program.id: program})


def two_phases(**fields):
    phases = (
        Phase(duration=20.0, state="Gg"),
        Phase(duration=3.0, state="yy"),
        Phase(duration=10.0, state="ru", min_duration=5.0, max_duration=40.0, next=(1, 0)),
    )
    return Program(id="P", phases=phases, **fields)


LINKS = ["in0_0>out2_0", "in0_0>out3_0"]


def test_table_and_lookup():
    net = with_program(intersection(), two_phases(offset=5.0), LINKS)
    row = rows(net)
    table = build_signals(net, row)
    assert table.duration.tolist() == [[20, 3, 10], [1, 0, 0]]
    assert table.min_duration.tolist()[0] == [20, 3, 5]
    assert table.max_duration.tolist()[0] == [20, 3, 40]
    assert table.next_phase.tolist()[0] == [1, 2, 1]
    assert table.cycle.tolist() == [33, 1]
    assert table.lane_program[row[LINKS[1]]] == 0 and table.lane_link[row[LINKS[1]]] == 1
    assert table.lane_program[row["in0_0"]] == -1
    expected = {4.9: 2, 5.0: 0, 24.9: 0, 25.0: 1, 27.9: 1, 28.0: 2, 38.0: 0, 38.0 + 33 * 100: 0, -5.1: 1}
    for t, phase in expected.items():
        assert phase_at(table, t).tolist() == [phase, 0], t
    states = lane_states(table, phase_at(table, 30.0))
    assert states[row[LINKS[0]]] == SignalState.RED
    assert states[row[LINKS[1]]] == SignalState.RED_YELLOW
    assert states[row["in0_0"]] == states[-1] == SignalState.OFF
    by_movement = movement_states(table, phase_at(table, 5.0))
    shown = {m.via[0]: int(by_movement[m.index]) for m in net.movements}
    assert shown[LINKS[0]] == SignalState.GREEN_MAJOR
    assert shown[LINKS[1]] == SignalState.GREEN_MINOR
    assert shown["in1_0>out3_0"] == by_movement[-1] == SignalState.OFF


def test_lookup_under_jit_and_vmap_and_padding():
    net = with_program(intersection(), two_phases(offset=-7.0), LINKS)
    table = build_signals(net, rows(net))
    padded = table.pad(programs=5, phases=8, links=9, lanes=len(net.lanes) + 11, movements=40)
    device = jax.tree.map(jnp.asarray, padded)
    times = jnp.arange(0.0, 100.0, 0.5)
    phases = jax.jit(jax.vmap(phase_at, (None, 0)))(device, times)
    assert phases.dtype == jnp.int32
    for n, t in enumerate(times.tolist()):
        assert phases[n, 0] == phase_at(table, t)[0]
    assert (phases[:, 1:] == 0).all()
    one = np.asarray(lane_states(table, phase_at(table, 3.0)))
    phases = np.stack([phase_at(table, t) for t in (3.0, 30.0)])
    np.testing.assert_array_equal(lane_states_on_host(table, phases)[0], one)
    np.testing.assert_array_equal(lane_states_on_host(table, phases)[1], lane_states(table, phases[1]))
    many = np.asarray(lane_states(device, phase_at(device, 3.0)))
    np.testing.assert_array_equal(many[: len(one) - 1], one[:-1])
    assert (many[len(one) - 1 :] == SignalState.OFF).all()
    assert (np.asarray(padded.state)[1:, 0] == SignalState.OFF).all()
    assert (padded.cycle[1:] == 1).all() and (padded.num_phases[1:] == 1).all()
    for name, x in vars(table).items():
        inner = tuple(slice(n) for n in (x.shape[0] - 1, *x.shape[1:]))
        np.testing.assert_array_equal(getattr(padded, name)[inner], x[:-1])
        assert x.dtype in (np.float32, np.int32, bool)
    with pytest.raises(ValueError, match="does not fit"):
        table.pad(programs=1, phases=8, links=9, lanes=100, movements=40)


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (Program(id="P", phases=()), "has no phases"),
        (Program(id="P", phases=(Phase(duration=5, state="GX"),)), "phase 0 has the state 'X'"),
        (Program(id="P", phases=(Phase(duration=5, state="GG"), Phase(duration=5, state="G"))), "lengths"),
        (Program(id="P", phases=(Phase(duration=math.nan, state="GG"),)), "lasts nan s"),
        (Program(id="P", phases=(Phase(duration=0, state="GG"),)), "0 s together"),
        (Program(id="P", phases=(Phase(duration=5, state="GG", next=(3,)),)), "not there"),
        (Program(id="P", phases=(Phase(duration=5, state="G"),)), "no link 1"),
    ],
)
def test_broken_programs_are_refused(program, reason):
    net = with_program(intersection(), program, LINKS)
    with pytest.raises(MapError, match=reason):
        build_signals(net, rows(net))
    with pytest.raises(MapError, match="no signal program 'P'"):
        build_signals(dataclasses.replace(net, programs={}), rows(net))


def test_a_network_without_signals():
    net = intersection()
    table = build_signals(net, rows(net))
    assert (lane_states(table, phase_at(table, 12.0)) == SignalState.OFF).all()


# --- SUMO -------------------------------------------------------------------------------------

RUN_SUMO = textwrap.dedent(
    """
    import sys, libsumo
    libsumo.start(["sumo", "-n", sys.argv[1], "--no-step-log", "--no-warnings", *sys.argv[2:]])
    for step in range(240):
        libsumo.simulationStep()
        for name in libsumo.trafficlight.getIDList():
            print(step, name, libsumo.trafficlight.getRedYellowGreenState(name))
    libsumo.close()
    """
)


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """Four signalised crossings made by netgenerate, with offsets of both signs and beyond the cycle."""
    import sumo

    folder = tmp_path_factory.mktemp("grid")
    path = folder / "grid.net.xml"
    command = [f"{sumo.SUMO_HOME}/bin/netgenerate", "--grid", "--grid.number", "2", "-o", str(path)]
    command += ["--grid.attach-length", "80", "--default-junction-type", "traffic_light", "--no-turnarounds"]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    offsets = iter(["0", "13", "-7", "200"])
    text = re.sub(r'(<tlLogic [^>]*offset=")[^"]*', lambda m: m[1] + next(offsets), path.read_text())
    path.write_text(text)
    return path


def states_in_sumo(path, *options):
    command = [sys.executable, "-c", RUN_SUMO, str(path), *options]
    out = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    return [(int(step), name, state) for step, name, state in re.findall(r"^(\d+) (\S+) (\S+)$", out, re.M)]


@pytest.mark.engine
def test_phases_and_offsets_are_those_of_sumo(grid):
    net = read_network(grid)
    table = build_signals(net, rows(net))
    assert sorted(table.offset[:-1].tolist()) == [-7, 0, 13, 200]
    programs = list(net.programs)
    phases = np.asarray(jax.vmap(phase_at, (None, 0))(table, jnp.arange(240.0)))
    seen = states_in_sumo(grid)
    assert len(seen) == 4 * 240
    for step, name, state in seen:
        phase = phases[step, programs.index(name)]
        assert net.programs[name].phases[phase].state == state, (step, name)


@pytest.mark.engine
def test_letters_of_lights_that_are_off(grid):
    """SUMO switched off shows `o` to minor links and `O` to those with right of way."""
    net = read_network(grid)
    for _, name, state in states_in_sumo(grid, "--tls.all-off")[:4]:
        off = Program(id=name, phases=(Phase(duration=1.0, state=state),))
        table = build_signals(dataclasses.replace(net, programs={**net.programs, name: off}), rows(net))
        shown = np.asarray(movement_states(table, phase_at(table, 0.0)))
        links = [m for m in net.movements if m.program == name]
        yielding = {m.index for m in links if shown[m.index] == SignalState.OFF_BLINKING}
        assert {int(shown[m.index]) for m in links} == {SignalState.OFF, SignalState.OFF_BLINKING}
        assert all(net.movements[index].yields_to for index in yielding)


# --- generated programs -----------------------------------------------------------------------


def lit(net, controllers=None, over="incoming"):
    """The network with a light for every arm: over its incoming lanes, or over its connectors."""
    lights = []
    for lane in net.lanes.values():
        incoming, connector = lane.id.startswith("in") and lane.junction is None, lane.junction is not None
        if incoming if over == "incoming" else connector:
            spot = LaneSpot(lane=lane.id, s=lane.length if incoming else 0.0)
            controller = (controllers or {}).get(lane.id[:3])
            light = TrafficLight(
                id=f"L{lane.id}", position=(0, 0, 0), heading=0.0, spots=(spot,), controller=controller
            )
            lights.append(light)
    return dataclasses.replace(net, traffic_lights=tuple(lights))


def greens(net, program=None):
    """Sets of connectors that are green, stage by stage."""
    program = program or next(iter(net.programs.values()))
    via = [net.movements[link[0]].via[0] for link in program.movements]
    return [
        {v for v, letter in zip(via, phase.state, strict=True) if letter in "gG"}
        for phase in program.phases
        if phase.name.endswith("green")
    ]


def check_safe(net):
    """No crossing movements are green or yellow together.

    Turns across oncoming traffic are the exception.
    """
    row = rows(net)
    table, ids = build_conflicts(net, row), list(row)
    movement_of = {name: m for m in net.movements for name in m.via}
    checked = 0
    for k, c in np.argwhere((table.type == ConflictType.CROSS) | (table.type == ConflictType.MERGE)):
        one, two = (movement_of.get(ids[table.lane[x]]) for x in (k, table.foe[k, c]))
        if one is None or two is None or one.program is None or one.program != two.program:
            continue
        program = net.programs[one.program]
        for phase in program.phases:
            a, b = phase.state[one.link], phase.state[two.link]
            if a not in "gGy" or b not in "gGy":
                continue
            checked += 1
            incoming = net.lanes[one.incoming], net.lanes[two.incoming]
            turned = math.remainder(incoming[1].heading[-1] - incoming[0].heading[-1], math.tau)
            across = {Turn.LEFT, Turn.SLIGHT_LEFT}
            if net.roads[incoming[0].road].left_hand:
                across = {Turn.RIGHT, Turn.SLIGHT_RIGHT}
            permitted = abs(turned) > math.radians(120) and {one.turn, two.turn} & across
            assert permitted or incoming[0].road == incoming[1].road or Turn.U_TURN in (one.turn, two.turn), (
                one.via,
                two.via,
                phase.state,
            )
            if table.prio[k, c] < 0:
                assert a in "gy", (one.via, two.via, phase.state)
    return checked


@pytest.mark.parametrize("over", ["incoming", "connectors"])
def test_crossing_with_shared_lanes_has_two_stages(over):
    net = generate_programs(lit(intersection(), over=over))
    north_south, east_west = greens(net)
    assert {name[2] for name in north_south} == {"0", "2"} and {name[2] for name in east_west} == {"1", "3"}
    assert len(north_south) == len(east_west) == 6
    program = net.programs["J"]
    assert program.generated and program.type == "static"
    via = [net.movements[m].via[0] for (m,) in program.movements]
    state = dict(zip(via, program.phases[0].state, strict=True))
    assert state["in0_0>out3_0"] == "g"  # left turn, permitted
    assert state["in0_0>out2_0"] == state["in0_0>out1_0"] == "G"
    assert [phase.name.split()[2] for phase in program.phases] == ["green", "yellow", "all"] * 2
    assert all(m.control is Control.SIGNAL and m.program == "J" for m in net.movements)
    assert [m.link for m in net.movements] == list(range(12))
    assert check_safe(net)
    (note,) = [n for n in net.report.notes if n.action is Action.ADDED]
    assert "junction J" in note.where and "2 stages" in note.message
    table = build_signals(net, rows(net))
    assert table.state.shape == (2, 6, 12)


@pytest.mark.parametrize(("green", "least"), [(25.0, 25.0), (60.0, 40.0), (500.0, 40.0)])
def test_no_generated_cycle_is_longer_than_two_minutes(green, least):
    net = generate_programs(lit(intersection()), green=green)
    phases = net.programs["J"].phases
    assert sum(phase.duration for phase in phases) <= LONGEST_CYCLE
    assert min(phase.duration for phase in phases if phase.name.endswith("green")) >= least


def test_the_given_network_is_left_alone():
    net = lit(intersection())
    generate_programs(net)
    assert not net.programs and not net.report.notes
    assert all(m.program is None for m in net.movements)


def test_lanes_for_left_turns_are_protected():
    net = generate_programs(lit(intersection(lanes=2, separate_left=True)))
    lefts, rest, *_ = stages = greens(net)
    assert len(stages) == 4
    assert lefts == {"in0_1>out3_1", "in2_1>out1_1"}
    assert rest == {f"in{a}_0>out{b}_0" for a, b in ((0, 1), (0, 2), (2, 0), (2, 3))}
    for phase in net.programs["J"].phases:
        assert "g" not in phase.state
    assert net.programs["J"].phases[0].duration < net.programs["J"].phases[3].duration
    assert not check_safe(net)


def test_left_hand_traffic_is_the_mirror_image():
    net = lit(intersection(lanes=2, separate_left=True))
    one, other = generate_programs(net), generate_programs(mirrored(net))
    assert one.programs == other.programs


def test_a_tee_keeps_the_through_road_green_across_stages():
    """Movements stay green between two of their stages in a row."""
    net = generate_programs(lit(intersection(arms=(0, 90, 180), lanes=2, separate_left=True)))
    program = net.programs["J"]
    assert len(greens(net)) == 3
    letters = {
        net.movements[m].via[0]: "".join(phase.state[link] for phase in program.phases)
        for link, (m,) in enumerate(program.movements)
    }
    assert sum("in2_0>out0_0" in stage for stage in greens(net)) >= 2
    for shown in letters.values():
        twice = shown * 2
        assert not re.search("[gG]r", twice) and not re.search("y[gG]", twice)  # green, yellow, red
    check_safe(net)


def test_controllers_say_what_switches_together():
    one_each = generate_programs(lit(intersection(), {f"in{a}": f"C{a}" for a in range(4)}))
    assert len(greens(one_each)) == 2
    pairs = {"in0": "EW", "in2": "EW", "in1": "NS", "in3": "NS"}
    assert greens(generate_programs(lit(intersection(), pairs))) == greens(one_each)
    # One controller for everything cannot mean that everything is green: fall back on approaches.
    single = generate_programs(lit(intersection(), dict.fromkeys(pairs, "all")))
    assert greens(single) == greens(one_each)
    # A controller for one lane of lefts alone is an arrow: protected.
    arrow = lit(intersection(lanes=2, separate_left=True))
    lights = tuple(
        dataclasses.replace(light, controller="arrow" if light.id == "Lin0_1" else light.id[1:4])
        for light in arrow.traffic_lights
    )
    net = generate_programs(dataclasses.replace(arrow, traffic_lights=lights))
    (stage,) = [s for s in greens(net) if "in0_1>out3_1" in s]
    assert not {name for name in stage if name.startswith("in2")}
    check_safe(net)


def test_arrows_govern_their_turn_alone():
    """A left arrow over a shared lane governs the left turn only."""
    net = lit(intersection())
    (plain,) = [light for light in net.traffic_lights if light.id == "Lin0_0"]
    arrow = dataclasses.replace(plain, id="arrow", turns=(Turn.LEFT,))
    both = dataclasses.replace(net, traffic_lights=(*net.traffic_lights, arrow))
    made = generate_programs(both)
    (stage,) = [s for s in greens(made) if "in0_0>out3_0" in s]
    assert not {name for name in stage if name.startswith("in2") and not name.endswith("out3_0")}
    assert all(m.program == "J" for m in made.movements)
    check_safe(made)
    # Without the other lights, the arrow governs its turn alone, and no other movement is signalised.
    only = generate_programs(dataclasses.replace(net, traffic_lights=(arrow,)))
    assert [m.via[0] for m in only.movements if m.program] == ["in0_0>out3_0"]


def test_single_approach_and_lights_without_movement():
    net = intersection(arms=(0, 180))
    alone = straight("pedestrian", (500, 0), 0.0, 80.0)
    net = network([*net.lanes.values(), alone], net.movements)
    light = TrafficLight(
        id="S", position=(0, 0, 0), heading=0.0, spots=(LaneSpot(lane="pedestrian", s=40.0),)
    )
    net = dataclasses.replace(lit(net), traffic_lights=(*lit(net).traffic_lights, light))
    net = generate_programs(net)
    assert [phase.duration for phase in net.programs["J"].phases] == [25.0, yellow_time(13.9), 10.0]
    (note,) = [n for n in net.report.notes if n.action is Action.IGNORED]
    assert "S" in note.where


def test_programs_of_the_file_are_kept():
    net = lit(with_program(intersection(), two_phases(), LINKS))
    made = generate_programs(net)
    assert made.programs["P"] == net.programs["P"]
    kept = [m for m in made.movements if m.program == "P"]
    assert [m.via[0] for m in kept] == sorted(LINKS)
    taken = dataclasses.replace(net, programs={"J": two_phases()})
    assert set(generate_programs(taken).programs) == {"J", "J_1"}


def test_times_follow_the_formulas():
    assert yellow_time(50 / 3.6) == pytest.approx(3.4)  # 1 + 13.89 / 6 = 3.31, rounded up
    assert yellow_time(5.0) == 3.0 and yellow_time(60.0) == 6.0
    assert all_red_time(20.0, 10.0) == pytest.approx(2.5)
    assert all_red_time(0.0, 30.0) == 1.0 and all_red_time(100.0, 5.0) == 6.0
    net = generate_programs(lit(intersection()))
    table = build_conflicts(net, rows(net))
    turn = "in0_0>out3_0"
    k = table.connector[rows(net)[turn]]
    lane = net.lanes[turn]
    speed = math.sqrt(3.0 * lane.length / (math.pi / 2))
    expected = all_red_time(float(table.clear_s[k]), speed)
    assert net.programs["J"].phases[2].duration == pytest.approx(expected)


def signal_maps():
    return [path for path in sorted(SHARED.glob("opendrive/*.xodr")) if b"<signal " in path.read_bytes()]


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("path", signal_maps(), ids=lambda path: path.stem)
def test_lights_of_real_maps_get_safe_programs(path):
    net = read_network(path)
    if not net.traffic_lights:
        pytest.skip("no traffic lights")
    made = generate_programs(dataclasses.replace(net, programs={}, movements=_unsignalled(net)))
    check_safe(made)
    table = build_signals(made, rows(made))
    for program in made.programs.values():
        for link in range(len(program.movements)):
            shown = "".join(phase.state[link] for phase in program.phases)
            assert set("gG") & set(shown)
            assert not re.search("[gG]r", shown * 2)
    lights = np.asarray(lane_states(table, phase_at(table, 1.0)))
    governed = {m.via[0] for m in made.movements if m.program is not None}
    for lane, row in rows(made).items():
        assert (lights[row] == SignalState.OFF) == (lane not in governed)


def _unsignalled(net):
    return tuple(dataclasses.replace(m, program=None, link=None) for m in net.movements)
