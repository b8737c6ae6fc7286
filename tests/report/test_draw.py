"""Drawings agree with the network, and files have the format of their suffix."""

import itertools
import math
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("matplotlib")
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import imread

from limsim_jax.maps.network import (
    Control,
    Crosswalk,
    Junction,
    Lane,
    LaneSpot,
    LaneType,
    MapError,
    Movement,
    Network,
    Road,
    Sign,
    SignKind,
    StopLine,
    TrafficLight,
    Turn,
)
from limsim_jax.report.draw import TRAFFIC_ZORDER, draw_map, draw_network
from limsim_jax.report.draw.painter import CENTRE, EDGE

REACH, BOX = 60.0, 12.0  # m, ends of the arms and half side of the junction


def _line(id_: str, start: tuple[float, float], end: tuple[float, float], **fields) -> Lane:
    """A straight lane; the road runs from the junction outwards, so arriving lanes run against it."""
    start_, end_ = np.array(start), np.array(end)
    length = float(np.hypot(*(end_ - start_)))
    s = np.array([0.0, 0.5 * length, length])
    xy = start_ + s[:, None] / length * (end_ - start_)
    road_s = length - s if fields.get("number", -1) > 0 else s
    heading = math.atan2(*(end_ - start_)[::-1])
    return Lane(
        **{
            "id": id_,
            "road": id_.split("_")[0],
            "number": -1,
            "s": s,
            "xyz": np.column_stack([xy, np.zeros(3)]),
            "heading": np.full(3, heading),
            "curvature": np.zeros(3),
            "width": np.full(3, 3.5),
            "road_s": road_s,
            "speed_limit": 13.9,
            **fields,
        }
    )


def _bend(id_: str, incoming: Lane, outgoing: Lane, **fields) -> Lane:
    """A connector along a circular arc, or a straight line, between two lane ends."""
    p, a = incoming.xyz[-1, :2], float(incoming.heading[-1])
    q, b = outgoing.xyz[0, :2], float(outgoing.heading[0])
    turn = (b - a + math.pi) % (2 * math.pi) - math.pi
    chord = float(np.hypot(*(q - p)))
    length = chord if abs(turn) < 1e-6 else chord * turn / (2 * math.sin(turn / 2))
    s = np.linspace(0.0, length, 9)
    heading = a + turn * s / length
    mid = a + 0.5 * turn * s / length
    share = np.ones(9) if abs(turn) < 1e-6 else np.sinc(turn * s / length / (2 * math.pi))
    xy = p + (s * share)[:, None] * np.column_stack([np.cos(mid), np.sin(mid)])
    return Lane(
        id=id_,
        road=id_,
        number=-1,
        s=s,
        xyz=np.column_stack([xy, np.zeros(9)]),
        heading=heading,
        curvature=np.full(9, turn / length),
        width=np.full(9, 3.5),
        road_s=s,
        speed_limit=8.0,
        junction="J",
        **fields,
    )


@pytest.fixture(scope="module")
def crossing() -> Network:
    """Four arms with two lanes in, one out and a sidewalk; lights, signs, stop lines and a crosswalk."""
    lanes: dict[str, Lane] = {}
    for k, arm in enumerate("ENWS"):
        along = np.array([math.cos(k * math.pi / 2), math.sin(k * math.pi / 2)])
        side = np.array([-along[1], along[0]])

        def place(r, d, along=along, side=side):
            return tuple(r * along + d * side)

        near, far = f"{arm}_in1", f"{arm}_in2"
        # One mark is asymmetric: from in2 to in1 only.
        lanes[near] = _line(
            near, place(REACH, 1.75), place(BOX, 1.75), number=1, right=far, opposite=f"{arm}_out"
        )
        lanes[far] = _line(
            far, place(REACH, 5.25), place(BOX, 5.25), number=2, left=near, may_change_left=arm in "EN"
        )
        if arm == "N":
            lanes[near] = replace(lanes[near], may_change_right=True)
        lanes[f"{arm}_out"] = _line(f"{arm}_out", place(BOX, -1.75), place(REACH, -1.75), opposite=near)
        lanes[f"{arm}_walk"] = _line(
            f"{arm}_walk",
            place(BOX, -4.5),
            place(REACH, -4.5),
            number=-2,
            type=LaneType.SIDEWALK,
            width=np.full(3, 2.0),
        )
    movements = []
    turns = (Turn.RIGHT, Turn.STRAIGHT, Turn.LEFT)
    for k, arm in enumerate("ENWS"):
        for step, turn in zip((1, 2, 3), turns, strict=True):
            # Arriving from arm k, the arm to the right is the one counter-clockwise from it.
            incoming = lanes[f"{arm}_in2" if turn is Turn.RIGHT else f"{arm}_in1"]
            outgoing = lanes["ENWS"[(k + step) % 4] + "_out"]
            via = f"{arm}_{turn.value}"
            lanes[via] = _bend(
                via, incoming, outgoing, predecessors=(incoming.id,), successors=(outgoing.id,)
            )
            for lane, field in ((incoming, "successors"), (outgoing, "predecessors")):
                linked = (*getattr(lanes[lane.id], field), via)
                lanes[lane.id] = replace(lanes[lane.id], **{field: linked})
            movements.append(
                Movement(
                    index=len(movements),
                    junction="J",
                    incoming=incoming.id,
                    outgoing=outgoing.id,
                    via=(via,),
                    turn=turn,
                    control=Control.SIGNAL,
                )
            )
    connectors = tuple(id_ for id_, lane in lanes.items() if lane.junction)
    return Network(
        name="crossing",
        source="crossing.xodr",
        file_hash="",
        format="OpenDRIVE 1.7",
        lanes=lanes,
        roads={lane.road: Road(id=lane.road, length=lane.length) for lane in lanes.values()},
        movements=tuple(movements),
        junctions={"J": Junction(id="J", movements=tuple(range(12)), connectors=connectors)},
        traffic_lights=(
            TrafficLight(
                id="L",
                position=(14.0, 9.0, 5.0),
                heading=math.pi,
                spots=(LaneSpot(lane="E_in1", s=47.0), LaneSpot(lane="E_in2", s=47.0)),
            ),
        ),
        signs=(
            Sign(id="a", kind=SignKind.STOP, position=(-9.0, 20.0, 0.0), heading=-1.57),
            Sign(id="b", kind=SignKind.YIELD, position=(9.0, -20.0, 0.0), heading=1.57),
            Sign(id="c", kind=SignKind.SPEED, value=50 / 3.6, position=(40.0, 9.0, 0.0), heading=3.14),
            Sign(id="d", kind=SignKind.PRIORITY, position=(-40.0, -9.0, 0.0), heading=0.0),
        ),
        stop_lines=(StopLine(id="s", spot=LaneSpot(lane="W_in1", s=47.0)),),
        crosswalks=(
            Crosswalk(
                id="z",
                outline=np.array([[14.0, -6.0], [18.0, -6.0], [18.0, 7.0], [14.0, 7.0]]),
                spans=(("E_right", 0.0, 12.0), ("E_in1", 42.0, 46.0), ("E_in2", 42.0, 46.0)),
            ),
        ),
    )


def _axes():
    return Figure(figsize=(8, 8)).add_axes((0, 0, 1, 1))


def _polygons(artists) -> list[np.ndarray]:
    return [path.vertices[:-1] for artist in artists for path in artist.get_paths()]


def _lines(artists) -> list[tuple[str, list[np.ndarray]]]:
    """Colour and polylines of every line collection."""
    return [
        (to_hex(np.asarray(a.get_colors())[0]), [np.asarray(s) for s in a.get_segments()])
        for a in artists
        if isinstance(a, LineCollection)
    ]


def _area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_every_lane_is_drawn_with_its_surface(crossing):
    surfaces = draw_network(_axes(), crossing)["surfaces"]
    polygons = _polygons(surfaces)
    assert len(polygons) == len(crossing.lanes)
    drawn = sorted(_area(p) for p in polygons)
    # A band of constant width around an arc or a line has the area length times width.
    exact = sorted(lane.length * lane.width[0] for lane in crossing.lanes.values())
    np.testing.assert_allclose(drawn, exact, rtol=2e-3)


@pytest.mark.engine
def test_arrows_point_along_their_lane(crossing):
    arrows = _polygons(draw_network(_axes(), crossing)["arrows"])
    seen = set()
    for arrow in arrows:
        tail = arrow[len(arrow) // 2] if len(arrow) == 4 else 0.5 * (arrow[3] + arrow[4])
        direction = arrow[0] - tail
        middle = 0.5 * (arrow[0] + tail)
        distance, lane, s = min(
            (float(np.hypot(*(lane.pose(s)[0][:2] - middle))), lane.id, s)
            for lane in crossing.drivable_lanes()
            if lane.junction is None
            for s in np.linspace(0, lane.length, 481)
        )
        assert distance < 0.1
        heading = float(crossing.lanes[lane].pose(s)[1])
        assert direction @ [math.cos(heading), math.sin(heading)] > 0.9999 * np.hypot(*direction)
        seen.add(lane)
    assert seen == {lane.id for lane in crossing.drivable_lanes() if lane.junction is None}


@pytest.mark.parametrize(
    ("arm", "painted"),
    [
        ("W", [(3.5, 1.0)]),  # no vehicle may cross
        ("N", [(3.5, 0.5)]),  # both lanes may
        ("E", [(3.5 - 0.12, 1.0), (3.5 + 0.12, 0.5)]),  # only from the outer lane: dashed on its side
    ],
)
def test_marks_between_lanes_follow_the_permissions(crossing, arm, painted):
    ax = _axes()
    layers = draw_network(ax, crossing, bounds=(-20, -20, 20, 20))
    along = {"E": np.array([1.0, 0.0]), "N": np.array([0.0, 1.0]), "W": np.array([-1.0, 0.0])}[arm]
    side = np.array([-along[1], along[0]])
    length: dict[float, float] = {}
    for line in (line for color, lines in _lines(layers["marks"]) if color == "#ffffff" for line in lines):
        for p, q in itertools.pairwise(line):
            if p @ along > BOX - 1e-6 and q @ along > BOX - 1e-6 and abs((q - p) @ side) < 1e-9:
                offset = round(float(p @ side), 2)
                length[offset] = length.get(offset, 0.0) + abs(float((q - p) @ along))
    assert sorted(length) == [d for d, _ in painted]
    for d, share in painted:
        assert length[d] / (REACH - BOX) == pytest.approx(share, abs=0.07)


def test_one_centre_line_separates_opposite_directions(crossing):
    marks = draw_network(_axes(), crossing)["marks"]
    assert sum(len(lines) for color, lines in _lines(marks) if color == CENTRE) == 4


def test_a_sidewalk_does_not_hide_the_edge_of_the_carriageway(crossing):
    walk, out = crossing.lanes["E_walk"], crossing.lanes["E_out"]
    beside = {"E_walk": replace(walk, left="E_out"), "E_out": replace(out, right="E_walk")}
    rest = {id_: lane for id_, lane in crossing.lanes.items() if id_ not in beside}
    marks = draw_network(_axes(), replace(crossing, lanes={**beside, **rest}))["marks"]
    shared = [
        color
        for color, lines in _lines(marks)
        for line in lines
        if np.allclose(line[:, 1], -3.5) and line[:, 0].min() >= BOX
    ]
    assert shared == [EDGE]


def test_connectors_have_the_colour_of_their_turn(crossing):
    artists = draw_network(_axes(), crossing)["connectors"]
    counts = {color: len(lines) for color, lines in _lines(artists)}
    assert counts == {"#0072b2": 4, "#d55e00": 4, "#007a57": 4}


def test_a_connector_that_no_movement_uses_stands_out(crossing):
    artists = draw_network(_axes(), replace(crossing, movements=crossing.movements[1:]))["connectors"]
    assert [len(lines) for color, lines in _lines(artists) if color == "#000000"] == [1]


def test_stop_bars_lie_across_their_lanes(crossing):
    layers = draw_network(_axes(), crossing)
    bars = [bar for _, lines in _lines(layers["stop_lines"]) for bar in lines]
    line = next(bar for bar in bars if np.allclose(bar.mean(0), [-13.0, -1.75]))
    np.testing.assert_allclose(sorted(line[:, 1]), [-3.5, 0.0], atol=1e-9)
    # Lanes with signals but neither head nor line in the file are barred at their end: 8 - 2 - 1.
    ends = [bar for bar in bars if np.isclose(np.abs(bar.mean(0)).max(), BOX)]
    assert len(ends) == 5


def test_a_light_is_linked_to_every_lane_it_governs(crossing):
    lights = draw_network(_axes(), crossing)["lights"]
    starts = [line for _, lines in _lines(lights) for line in lines]
    links = [seg for seg in starts if np.allclose(seg[0], [14.0, 9.0]) and np.hypot(*(seg[1] - seg[0])) > 3]
    np.testing.assert_allclose(sorted(seg[1][1] for seg in links), [1.75, 5.25], atol=1e-9)
    tick = next(seg for seg in starts if np.allclose(seg[0], [14.0, 9.0]) and abs(seg[1][1] - 9.0) < 1e-9)
    assert tick[1][0] < 14.0  # traffic that looks at it drives west


def test_crosswalk_bars_fill_half_of_the_outline_along_the_traffic(crossing):
    layer = draw_network(_axes(), crossing)["crosswalks"]
    outline, bars = _polygons(layer[:1])[0], _polygons(layer[1:])
    assert sum(map(_area, bars)) == pytest.approx(0.5 * _area(outline), rel=0.1)
    for bar in bars:
        assert np.ptp(bar[:, 0]) == pytest.approx(4.0)  # as long as the walk is deep
        assert np.ptp(bar[:, 1]) < 1.5


def test_conflict_bands_lie_where_paths_cross(crossing):
    layers = draw_network(_axes(), crossing, conflicts=True)
    bands = {
        to_hex(np.asarray(a.get_facecolor())[0], keep_alpha=False): a.get_paths()
        for a in layers["conflicts"]
        if isinstance(a, PolyCollection)
    }
    assert set(bands) == {"#56b4e9", "#e69f00", "#d55e00"}  # diverge, merge, cross

    def covered(color: str, x: float, y: float) -> int:
        return sum(path.contains_point((x, y)) for path in bands[color])

    for x in (-1.75, 1.75):
        for y in (-1.75, 1.75):
            assert covered("#d55e00", x, y) >= 2  # both paths that cross there
    for arm in "ENWS":
        x, y = crossing.lanes[f"{arm}_right"].pose(6.0)[0][:2]
        assert covered("#d55e00", x, y) == 0  # right turns cross nothing
        x, y = crossing.lanes[f"{arm}_left"].pose(0.3)[0][:2]
        assert covered("#56b4e9", x, y) >= 2  # left and straight leave the same lane
        x, y = crossing.lanes[f"{arm}_out"].pose(0.0)[0][:2] * 0.98
        assert covered("#e69f00", x, y) >= 2


def test_speed_signs_show_their_number(crossing):
    ax = _axes()
    draw_network(ax, crossing, bounds=(20, -10, 60, 20))
    assert "50" in [text.get_text() for text in ax.texts]


def test_labels_name_roads_and_junctions(crossing):
    ax = _axes()
    draw_network(ax, crossing, labels=True)
    assert {"J", "E", "N", "W", "S"} <= {text.get_text() for text in ax.texts}


def test_traffic_lies_above_the_base_layer(crossing):
    layers = draw_network(_axes(), crossing, labels=True)
    assert max(artist.get_zorder() for layer in layers.values() for artist in layer) < TRAFFIC_ZORDER


def test_only_lanes_within_the_bounds_are_drawn(crossing):
    surfaces = draw_network(_axes(), crossing, bounds=(30, -10, 70, 10))["surfaces"]
    assert len(_polygons(surfaces)) == 4  # the east arm


def test_a_bridge_hides_the_road_below(crossing):
    below = _line("low_1", (-50.0, 0.0), (50.0, 0.0))
    above = _line("high_1", (0.0, -50.0), (0.0, 50.0))
    above = replace(above, xyz=above.xyz + np.array([0.0, 0.0, 6.0]))
    network = _only(crossing, above, below)
    layers = draw_network(_axes(), network)
    top = max(layers["surfaces"], key=lambda a: a.get_zorder())
    low, high = _polygons([top])[0].min(0), _polygons([top])[0].max(0)
    assert high[1] - low[1] > 99
    lower_marks = [a for a in layers["marks"] if any(np.ptp(s[:, 0]) > 99 for s in _lines([a])[0][1])]
    assert lower_marks
    assert all(a.get_zorder() < top.get_zorder() for a in lower_marks)


def _only(crossing: Network, *lanes: Lane) -> Network:
    """A network of these lanes and nothing else."""
    return replace(
        crossing,
        lanes={lane.id: lane for lane in lanes},
        roads={},
        movements=(),
        junctions={},
        traffic_lights=(),
        signs=(),
        stop_lines=(),
        crosswalks=(),
    )


def _scale(ax: Axes) -> tuple[float, float]:
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    box = ax.get_window_extent()
    return box.width / (x1 - x0), box.height / (y1 - y0)


@pytest.mark.parametrize(("heading", "gain"), [(0.0, 5), (0.4, 1.5), (math.pi / 2, 5)])
def test_a_long_thin_map_is_cut_into_strips_of_one_scale(crossing, heading, gain):
    end = (10_000.0 * math.cos(heading), 10_000.0 * math.sin(heading))
    figure = draw_map(_only(crossing, _line("road_1", (0.0, 0.0), end)))
    strips = [ax for ax in figure.axes if not ax.get_title(loc="left")]
    assert len(strips) > 1
    scales = [_scale(ax) for ax in strips]
    np.testing.assert_allclose(scales, scales[0][0])
    # Every strip begins where the one before ended, and shows the road there.
    axis = 1 if heading > 1 else 0
    spans = [(ax.get_xlim(), ax.get_ylim()) for ax in strips]
    for before, after in itertools.pairwise(spans):
        assert after[axis][0] == pytest.approx(before[axis][1])
    assert spans[0][axis][0] <= 0.0
    assert spans[-1][axis][1] >= end[axis]
    for span in spans:
        along = 0.5 * (span[axis][0] + span[axis][1])
        beside = along / end[axis] * end[1 - axis]
        assert span[1 - axis][0] < beside < span[1 - axis][1]
    whole = figure.get_size_inches()[axis] * figure.dpi / end[axis]
    assert scales[0][0] > gain * whole  # what strips are for


def test_details_show_junctions_that_are_small_on_the_page(crossing):
    lanes = {
        id_: replace(lane, xyz=3 * lane.xyz, s=3 * lane.s, road_s=3 * lane.road_s)
        for id_, lane in crossing.lanes.items()
    }
    lanes["far_1"] = _line("far_1", (2000.0, 1500.0), (0.0, 1500.0))
    figure = draw_map(replace(crossing, lanes=lanes))
    (overview,) = (ax for ax in figure.axes if not ax.get_title(loc="left"))
    details = {ax.get_title(loc="left"): ax for ax in figure.axes if ax is not overview}
    assert _scale(details["A"])[0] > 3 * _scale(overview)[0]
    for reach in (-3 * BOX, 3 * BOX):  # the whole junction
        assert details["A"].get_xlim()[0] < reach < details["A"].get_xlim()[1]
        assert details["A"].get_ylim()[0] < reach < details["A"].get_ylim()[1]
    assert set(details) <= {text.get_text() for text in overview.texts}  # each is framed on the map
    assert all(_scale(ax)[0] == pytest.approx(_scale(ax)[1], rel=1e-6) for ax in figure.axes)


@pytest.mark.parametrize("size", [None, (6.0, 9.0), (12.0, 4.0)])
def test_axes_have_one_scale_for_x_and_y(crossing, size):
    figure = draw_map(crossing, size=size)
    (ax,) = figure.axes
    assert _scale(ax)[0] == pytest.approx(_scale(ax)[1], rel=1e-6)
    if size:
        assert tuple(figure.get_size_inches()) == size


def test_the_page_says_what_the_map_has(crossing):
    crossing.report.counts.clear()
    crossing.report.read("lane", 28)
    figure = draw_map(crossing)
    text = "\n".join(t.get_text() for t in figure.texts)
    km = sum(lane.length for lane in crossing.drivable_lanes()) / 1000
    for part in ("crossing", "OpenDRIVE 1.7", "28 lanes", f"{km:.2f} km", "1 junction ", "1 traffic light"):
        assert part in text
    assert "28 read, 0 approximated, 0 ignored, 0 repaired" in text
    legend = {t.get_text() for t in figure.legends[0].get_texts()}
    assert {"driving lane", "sidewalk", "left", "traffic light", "stop line", "crosswalk"} <= legend
    assert not legend & {"parking", "u-turn", "tram, rail", "conflict: cross"}


@pytest.mark.engine
def test_png_shows_the_lanes_where_they_are(crossing, tmp_path):
    figure = draw_map(crossing, tmp_path / "map.png", dpi=80)
    pixels = imread(tmp_path / "map.png")[..., :3]
    (ax,) = figure.axes
    box = ax.get_position()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()

    def pixel(x: float, y: float) -> np.ndarray:
        u = box.x0 + (x - x0) / (x1 - x0) * box.width
        v = box.y0 + (y - y0) / (y1 - y0) * box.height
        return pixels[int((1 - v) * pixels.shape[0]), int(u * pixels.shape[1])]

    np.testing.assert_allclose(pixel(55.0, 2.6), to_rgba("#b3bac4")[:3], atol=0.01)  # a driving lane
    np.testing.assert_allclose(pixel(50.0, -4.6), to_rgba("#ebe3d3")[:3], atol=0.01)  # the sidewalk
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_svg_is_xml_with_a_path_per_lane_and_the_same_every_time(crossing, tmp_path):
    draw_map(crossing, tmp_path / "a.svg")
    draw_map(crossing, tmp_path / "b.svg")
    root = ET.parse(tmp_path / "a.svg").getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    (group,) = [g for g in root.iter() if g.get("id") == "map0-surfaces-0"]
    drawn = [e for e in group.iter() if e.tag.endswith(("}use", "}path"))]
    clip_or_use = [e for e in drawn if e.tag.endswith("}use")] or drawn
    assert len(clip_or_use) == len(crossing.lanes)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_pdf_is_written(crossing, tmp_path):
    draw_map(crossing, tmp_path / "map.pdf")
    assert (tmp_path / "map.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", ["map.bmp", "map", "nowhere/map.png"])
def test_a_target_that_cannot_be_written_is_one_clear_line(crossing, tmp_path, name):
    with pytest.raises(MapError) as error:
        draw_map(crossing, tmp_path / name)
    assert "\n" not in str(error.value)
    assert ("nowhere" if "/" in name else ".png, .svg, .pdf") in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("bounds", [(10, 0, -10, 5), (0, 0, 0, 5), (math.nan, 0, 1, 1), (900, 900, 950, 950)])
def test_invalid_bounds_are_refused(crossing, bounds):
    with pytest.raises(MapError, match="bounds"):
        draw_map(crossing, bounds=bounds)


def test_a_map_without_lanes_is_refused(crossing):
    with pytest.raises(MapError, match="no lanes"):
        draw_map(replace(crossing, lanes={}))


def test_without_matplotlib_the_error_says_what_to_install(crossing, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'limsim-jax\[viz\]'") as error:
        draw_map(crossing)
    assert "\n" not in str(error.value)


def test_the_module_loads_without_matplotlib():
    code = "import sys, limsim_jax.report.draw; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
