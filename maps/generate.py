"""Write the five bundled OpenDRIVE maps, and those of the scenario library.

    python maps/generate.py           write them
    python maps/generate.py --check   fail unless the files are what would be written

The maps are OpenDRIVE 1.7, right-hand traffic, European marking and signs (country DE). Roads are
lines, arcs and clothoids only, so that every importer measures the same lengths. Widths, lane
offsets and heights change along smoothsteps, whose ends are level: at every link the edges and
centre lines of lanes continue in position and heading.

Units: metres, radians, km/h. Files hold micrometres, so that they do not depend on the last bit of
a platform's `sin`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from mapbuilder.curves import Curve, Piece, Pose, Profile, arc
from mapbuilder.junctions import Map
from mapbuilder.motorway import (
    EDGE,
    GORE_ANGLE,
    HARD,
    LANES,
    NOSE,
    RAMP,
    at_speed,
    diverge,
    expressway,
    merge,
    opposite,
    to_ramp,
)
from mapbuilder.roads import Lane, Section
from mapbuilder.urban import (
    POCKET,
    RING_MOUTH,
    SHIFT,
    SOLID,
    SPLITTER,
    STOP_BACK,
    Arm,
    Moves,
    connect_all,
    furnish,
    inwards,
    main_arm,
    minor_arm,
    ring_arm,
    roundabout,
    signalised,
    street,
    walk,
)
from mapbuilder.writer import write

FOLDER = Path(__file__).parent
LIBRARY = FOLDER.parent / "limsim_jax/scenarios/library/scenarios/maps"


def highway() -> Map:
    """Three kilometres of motorway, four lanes each way, bends to both sides."""
    m = Map("highway")
    shape = [
        *[Piece(350), *arc(1100, 28, 180), Piece(250), *arc(900, -33, 180)],
        *[Piece(220), *arc(1500, 14, 150), Piece(300)],
    ]
    base = Curve(Pose(0, 0, 0), shape)
    half = round(base.length / 2, 6)
    driving = [Lane("l1", 3.5), Lane("l2", 3.5), Lane("l3", 3.6), Lane("l4", 3.75, speed=100)]
    lanes = [Lane("median", 1.5, "median"), EDGE, *driving, HARD]
    sections = [Section(0, lanes, lanes, centre="none")]
    west, east = (
        m.road(f"motorway {name}", base.cut(a, b), sections, kind="motorway", speed=120)
        for name, a, b in (("west", 0, half), ("east", half, base.length))
    )
    m.link(west.end, east.start)
    for contact in (west.end, east.start):
        m.speed_sign(contact, contact.road.curve.length - 60, ["l1", "l2", "l3"], 120)
    return m


def ramp() -> Map:
    """A three-lane motorway with an on-ramp and, further on, an off-ramp."""
    m = Map("ramp")
    shape = [Piece(200), *arc(1300, -12, 150), Piece(640), *arc(1200, 14, 150), Piece(520)]
    base = Curve(Pose(0, 0, math.radians(8)), shape)
    on, off = 480.0, 1420.0
    first = expressway(m, "motorway west", base.cut(0, on))
    middle = expressway(m, "motorway middle", base.cut(on + NOSE, off), accelerate=250, decelerate=200)
    last = expressway(m, "motorway east", base.cut(off + NOSE, base.length))
    opposite(m, "motorway opposite", base)
    up = inwards(
        base.pose(on).move(left=-to_ramp(), turn=GORE_ANGLE),
        [Piece(60), *arc(180, 62, 60), Piece(40), *arc(140, -40, 50), Piece(90)],
    )
    down = Curve(
        base.pose(off + NOSE).move(left=-to_ramp(), turn=-GORE_ANGLE),
        [Piece(60), *arc(150, -70, 60), Piece(50), *arc(110, 45, 45), Piece(80)],
    )
    fast = at_speed(RAMP, 80)
    sections = [Section(0, RAMP, centre="none"), Section(up.length - 150, fast, centre="none")]
    on_ramp = m.road("on-ramp", up, sections, kind="motorway", speed=60)
    sections = [Section(0, fast, centre="none"), Section(100, RAMP, centre="none")]
    off_ramp = m.road("off-ramp", down, sections, kind="motorway", speed=60)
    merge(m, "on-ramp nose", first, on_ramp, middle, base.cut(on, on + NOSE))
    diverge(m, "off-ramp nose", middle, off_ramp, last, base.cut(off, off + NOSE))
    m.speed_sign(first.end, first.curve.length - 40, LANES, 120)
    m.speed_sign(on_ramp.end, up.length - 30, ["ramp"], 60)
    m.speed_sign(on_ramp.end, 150, ["ramp"], 80)
    m.speed_sign(off_ramp.end, down.length - 100, ["ramp"], 60)
    return m


def intersection() -> Map:
    """A signalised intersection with turn lanes and a bent south arm."""
    m = Map("intersection")
    bent = [Piece(35), *arc(160, -30, 40), Piece(80)]
    arms = {
        "W": main_arm(m, "west", inwards(Pose(-18, SHIFT, 0), [Piece(200)]), right_turn=POCKET),
        "E": main_arm(m, "east", inwards(Pose(18, -SHIFT, math.pi), [Piece(200)])),
        "N": minor_arm(m, "north", inwards(Pose(1.5, 23, -math.pi / 2), [Piece(200)])),
        "S": minor_arm(m, "south", inwards(Pose(-3.0, -26, math.radians(84)), bent)),
    }
    signalised(m, "crossing", arms)
    return m


def roundabout_map() -> Map:
    """A two-lane roundabout with four arms, not quite at right angles."""
    m = Map("roundabout")
    centre = Pose(0, 0, 0)
    shapes = {
        "east": (0.0, [Piece(150)]),
        "north": (94.0, [Piece(70), *arc(150, 18, 30), Piece(33)]),
        "west": (180.0, [Piece(150)]),
        "south": (268.0, [Piece(70), *arc(180, -16, 30), Piece(30)]),
    }
    arms = []
    for name, (degrees, pieces) in shapes.items():
        angle = math.radians(degrees)
        mouth = centre.move(turn=angle).move(ahead=RING_MOUTH, turn=math.pi)
        arms.append((angle, ring_arm(m, name, inwards(mouth, pieces))))
    roundabout(m, "roundabout", centre, arms)
    return m


def long_route() -> Map:
    """A route from town over a motorway to a stop-controlled crossing."""
    m = Map("long_route")

    # 1. a signalised intersection; the route starts on its west arm and leaves on the avenue
    start = [Piece(140), *arc(250, 15, 50), Piece(60)]
    avenue = [Piece(190), *arc(180, -34, 60), Piece(60), *arc(160, 22, 50), Piece(70)]
    avenue = inwards(Pose(18, -SHIFT, math.pi), avenue)
    south = [Piece(50), *arc(150, 20, 30), Piece(50)]
    z_ring = 3.0
    slope = Profile((70, z_ring), (avenue.length - 70, 0))
    arms = {
        "W": main_arm(m, "start", inwards(Pose(-18, SHIFT, 0), start)),
        "E": main_arm(m, "avenue", avenue, far=SPLITTER, height=slope),
        "N": minor_arm(m, "first north", inwards(Pose(1.5, 23, -math.pi / 2), [Piece(150)])),
        "S": minor_arm(m, "first south", inwards(Pose(-1.5, -23, math.pi / 2), south)),
    }
    signalised(m, "first crossing", arms)

    # 2. a roundabout; its arm opposite the avenue is the on-ramp
    towards, away = arms["E"].leave, arms["E"].enter
    assert towards and away
    centre = avenue.start.move(ahead=-RING_MOUTH)
    mouths = [centre.move(turn=math.radians(d)).move(ahead=RING_MOUTH) for d in (0, 92, 180, 272)]
    south = inwards(mouths[1].move(turn=math.pi), [Piece(80), *arc(200, 12, 20), Piece(30)])
    north = inwards(mouths[3].move(turn=math.pi), [Piece(150)])
    ring_south = ring_arm(m, "ring south", south, z_ring)
    ring_north = ring_arm(m, "ring north", north, z_ring)
    z_road = 8.0
    shape = [Piece(150), *arc(150, 38, 60), Piece(60), *arc(220, -48, 70), Piece(60)]
    up = Curve(mouths[2].move(left=-SPLITTER), shape)
    ending = Profile((90, 3.75), (150, 0))
    two = [RAMP[0], Lane("ramp", 3.5), Lane("ends", ending), RAMP[2]]
    widening = Lane("ramp", Profile((150, 3.5), (210, 4.0)))
    one = [RAMP[0], widening, RAMP[2]]
    on_ramp = m.road(
        "on-ramp",
        up,
        [
            Section(0, two, centre="none"),
            Section(90, two, centre="none"),
            Section(150, one, centre="none"),
            Section(up.length - 150, at_speed(one, 80), centre="none"),
        ],
        speed=60,
        height=Profile((40, z_ring), (up.length - 40, z_road)),
    )
    ring = [
        (centre.heading, Arm(towards.road.end, away.road.start)),
        (mouths[1].heading, ring_south),
        (mouths[2].heading, Arm(None, on_ramp.start)),
        (mouths[3].heading, ring_north),
    ]
    roundabout(m, "roundabout", centre, ring, z_ring)

    # 3. motorway: acceleration lane, bends over a hill and through a dip, deceleration lane
    on = 300.0
    begin = up.end.move(turn=-GORE_ANGLE).move(left=to_ramp(), ahead=-on)
    shape = [
        *[Piece(on + NOSE + 380), *arc(1000, 30, 200), Piece(150), *arc(1200, -36, 220)],
        *[Piece(200), *arc(900, 20, 160), Piece(900)],
    ]
    base = Curve(begin, shape)
    off = base.length - 400.0
    between = base.cut(on + NOSE, off)
    z_exit = 6.0
    hill = Profile((330, z_road), (800, 16), (1350, 3), (between.length - 280, z_exit))
    first = expressway(m, "motorway west", base.cut(0, on), height=z_road)
    middle = expressway(m, "motorway", between, accelerate=250, decelerate=200, height=hill)
    last = expressway(m, "motorway east", base.cut(off + NOSE, base.length), height=z_exit)
    whole = Profile(*((s + on + NOSE, z) for s, z in hill.knots))
    opposite(m, "motorway opposite", base, whole)
    merge(m, "on-ramp nose", first, on_ramp, middle, base.cut(on, on + NOSE), z_road)

    # 4. off-ramp to a crossing where it has to stop; the route ends on the left arm
    z_end = 1.5
    shape = [Piece(80), *arc(160, -64, 60), Piece(60), *arc(140, 30, 50), Piece(130)]
    down = Curve(base.pose(off + NOSE).move(left=-to_ramp(), turn=-GORE_ANGLE), shape)
    s1, s2 = down.length - 100, down.length - 60
    slow = [*at_speed(RAMP[:2], 50), walk(2.0)]
    solid = ((0.0, "broken"), (down.length - SOLID, "solid"))
    opening = [
        slow[0],
        slow[1]._replace(mark=solid),
        Lane("right", Profile((s1, 0), (s2, 3.5)), speed=50),
        slow[2],
    ]
    off_ramp = m.road(
        "off-ramp",
        down,
        [
            Section(0, at_speed(RAMP, 80), centre="none"),
            Section(120, RAMP, centre="none"),
            Section(s1 - 60, slow, centre="none"),
            Section(s1, opening, centre="none"),
            Section(s2, opening, centre="none"),
        ],
        speed=60,
        height=Profile((40, z_exit), (down.length - 80, z_end)),
    )
    diverge(m, "off-ramp nose", middle, off_ramp, last, base.cut(off, off + NOSE), z_exit)
    middle_of_crossing = down.end.move(ahead=17)
    ends = {
        name: middle_of_crossing.move(turn=math.radians(turn)).move(ahead=ahead, left=left, turn=math.pi)
        for name, turn, ahead, left in (("left", 90, 16, 0), ("right", -90, 21, 0), ("across", 0, 17, -0.75))
    }
    shapes = {
        "left": ("finish", [Piece(120), *arc(220, -16, 40), Piece(90)], 3.5),
        "right": ("last right", [Piece(150)], 3.5),
        "across": ("last across", [Piece(60), *arc(140, 14, 20), Piece(60)], 3.25),
    }
    last_arms = {"ramp": Arm(off_ramp.end, None)}
    for key, (name, shape, width) in shapes.items():
        curve = inwards(ends[key], shape)
        last_arms[key] = street(m, name, curve, [Lane("t1", width)], [Lane("out1", width)], height=z_end)
    crossing = m.junction("last crossing", z_end)
    moves: Moves = [
        ("ramp", ["ramp"], "left", ["out1"]),
        ("ramp", ["ramp"], "across", ["out1"]),
        ("ramp", ["right", "walk"], "right", ["out1", "walk"]),
        ("left", ["t1"], "right", ["out1"]),
        ("left", ["t1"], "across", ["out1"]),
        ("right", ["t1"], "left", ["out1"]),
        ("right", ["t1", "walk"], "across", ["out1", "walk"]),
        ("across", ["t1"], "right", ["out1"]),
        ("across", ["t1", "walk"], "left", ["out1", "walk"]),
    ]
    made = connect_all(crossing, last_arms, moves)
    minor = [*made["ramp"], *made["across"]]
    crossing.priorities += [(high, low) for high in [*made["left"], *made["right"]] for low in minor]
    stop, priority = ("206", "stop"), ("306", "priority road")
    for key, (sign, name) in {"ramp": stop, "across": stop, "left": priority, "right": priority}.items():
        enter = last_arms[key].enter
        assert enter
        furnish(m, last_arms[key], stop=sign == "206")
        m.sign(enter, STOP_BACK, enter.keys(leaving=True), sign, name=name)
    return m


def motorway() -> Map:
    """A straight motorway, one way, with three lanes."""
    m = Map("motorway")
    lanes = [*(Lane(f"l{k}", 3.75) for k in (1, 2, 3)), HARD]
    m.road("motorway", Curve(Pose(0, 0, 0), [Piece(1500)]), [Section(0, lanes)], kind="motorway", speed=130)
    return m


def lane_end() -> Map:
    """A straight motorway, one way, whose third and right lane ends."""
    m = Map("lane_end")
    ends = Lane("ends", Profile((450, 3.75), (525, 0)))
    two = [Lane("l1", 3.75), Lane("l2", 3.75)]
    three = [*two, ends, HARD]
    sections = [Section(0, three), Section(450, three), Section(525, [*two, HARD])]
    m.road("motorway", Curve(Pose(0, 0, 0), [Piece(1500)]), sections, kind="motorway", speed=100)
    return m


def crossing() -> Map:
    """A town crossing with a priority road from west to east.

    Each lane has one way on, so that every vehicle drives as scenarios say, whatever its goal. From the east
    one lane turns left.
    """
    m = Map("crossing")
    mouth = 12.0
    arms = {}
    for name, x, y, heading, length in (
        ("west", -mouth, 0, 0, 250),
        ("east", mouth, 0, math.pi, 250),
        ("south", 0, -mouth, math.pi / 2, 150),
        ("north", 0, mouth, -math.pi / 2, 150),
    ):
        curve = inwards(Pose(x, y, heading), [Piece(length)])
        left = [Lane("left", 3.25)] if name == "east" else []
        arms[name] = street(m, name, curve, [*left, Lane("in", 3.25)], [Lane("out", 3.25)])
    junction = m.junction("crossing")
    moves: Moves = [
        (a, [lane], b, ["out"])
        for a, lane, b in (
            ("west", "in", "east"),
            ("east", "in", "west"),
            ("east", "left", "south"),
            ("south", "in", "north"),
            ("north", "in", "south"),
        )
    ]
    made = connect_all(junction, arms, moves)
    minor = [*made["south"], *made["north"]]
    junction.priorities += [(high, low) for high in [*made["west"], *made["east"]] for low in minor]
    for name, (sign, said) in {
        "west": ("306", "priority road"),
        "east": ("306", "priority road"),
        "south": ("205", "yield"),
        "north": ("205", "yield"),
    }.items():
        enter = arms[name].enter
        assert enter
        m.sign(enter, 0.5, enter.keys(leaving=True), sign, name=said)
    return m


MAPS = {
    "highway": highway,
    "ramp": ramp,
    "intersection": intersection,
    "roundabout": roundabout_map,
    "long_route": long_route,
}
OF_LIBRARY = {"motorway": motorway, "lane_end": lane_end, "crossing": crossing}


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the maps, or compare them with the files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a file differs")
    check = parser.parse_args(arguments).check
    stale = []
    every = [(FOLDER, MAPS), (LIBRARY, OF_LIBRARY)]
    for path, build in [(folder / f"{name}.xodr", x) for folder, maps in every for name, x in maps.items()]:
        data = write(build())
        if not check:
            path.write_bytes(data)
        elif not path.is_file() or path.read_bytes() != data:
            stale.append(path.name)
    if stale:
        print(f"not what generate.py writes: {', '.join(stale)}", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
