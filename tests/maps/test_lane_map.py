"""LaneMap: against closed forms, the host network and brute force, in float32 unless said otherwise."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import fresnel

from limsim_jax.maps import lane_map as lm
from limsim_jax.maps import rasterise
from limsim_jax.maps.network import (
    Action,
    ImportReport,
    Junction,
    Lane,
    LaneSpot,
    LaneType,
    MapError,
    Network,
    Road,
    StopLine,
)
from limsim_jax.maps.rasterise import TOLERANCE, TURN_WINDOW, build_lane_map

GAUSS_X, GAUSS_W = np.polynomial.legendre.leggauss(8)


class Line:
    """A reference line of clothoids: segments (length, first curvature, last curvature, turn before it)."""

    def __init__(self, *segments, x=0.0, y=0.0, heading=0.0, step=0.5):
        s, theta, kappa, xy = [0.0], [heading], [segments[0][1]], [np.array([x, y])]
        for length, k0, k1, *turn in segments:
            if turn:
                s.append(s[-1] + 1e-3)
                xy.append(xy[-1] + 1e-3 * np.array([np.cos(theta[-1]), np.sin(theta[-1])]))
                theta.append(theta[-1] + turn[0])
                kappa.append(k0)
            count = max(1, int(np.ceil(length / step)))
            u = np.linspace(0, length, count + 1)
            angle = lambda v, t0=theta[-1], k0=k0, b=(k1 - k0) / (2 * length): t0 + k0 * v + b * v**2  # noqa: E731
            h = length / count
            inner = angle(u[:-1, None] + h * (GAUSS_X + 1) / 2)
            steps = h / 2 * np.stack([np.cos(inner) @ GAUSS_W, np.sin(inner) @ GAUSS_W], -1)
            xy.extend(xy[-1] + np.cumsum(steps, 0))
            s.extend(s[-1] + u[1:])
            kappa.extend(k0 + (k1 - k0) * u[1:] / length)
            theta.extend(angle(u[1:]))
        self.s, self.heading, self.curvature, self.xy = map(np.array, (s, theta, kappa, xy))

    def lane(self, name, offset=0.0, width: Any = 3.5, z: Any = 0.0, reverse=False, **fields):
        """The parallel at this offset (left > 0); `width` and `z`: numbers or functions of s."""
        normal = np.stack([-np.sin(self.heading), np.cos(self.heading)], -1)
        xy = self.xy + offset * normal
        z = 0 * self.s + (z(self.s) if callable(z) else z)
        width = 0 * self.s + (width(self.s) if callable(width) else width)
        s = self.s - offset * (self.heading - self.heading[0])
        xyz, heading = np.column_stack([xy, z]), self.heading
        curvature, road_s = self.curvature / (1 - offset * self.curvature), self.s
        if reverse:
            s, xyz, heading = s[-1] - s[::-1], xyz[::-1], heading[::-1] + np.pi
            curvature, road_s, width = -curvature[::-1], road_s[::-1], width[::-1]
        return Lane(
            id=name,
            road=fields.pop("road", "road"),
            number=fields.pop("number", -1),
            speed_limit=fields.pop("speed_limit", 13.9),
            s=s,
            xyz=xyz,
            heading=heading,
            curvature=curvature,
            width=width,
            road_s=road_s,
            **fields,
        )


def network(*lanes, **fields):
    return Network(
        name="test",
        source="test.xodr",
        file_hash="0",
        format="test",
        lanes={lane.id: lane for lane in lanes},
        roads={lane.road: Road(id=lane.road) for lane in lanes},
        **fields,
    )


WINDING = [
    (60.0, 0.0, 0.0),
    (40.0, 0.0, 1 / 30),
    (50.0, 1 / 30, 1 / 30),
    (40.0, 1 / 30, 0.0),
    (35.0, 0.0, -1 / 12),
    (20.0, -1 / 12, -1 / 12),
    (120.0, 0.0, 0.0),
]
KINKED = [(20.0, 0.0, 0.0), (8.0, 0.0, 0.0, 0.3), (8.0, 0.0, 0.0, -0.2), (20.0, 0.0, 0.0, -0.25)]


def swelling(s):
    return 3.5 + 0.6 * np.sin(s / 40)


def hill(s):
    return 2.0 * np.cos(s / 60)


def example():
    """Three lanes of unequal widths that bend both ways, an oncoming one, a kinked one, a connector."""
    line = Line(*WINDING, x=120.0, y=-40.0, heading=0.7)
    kinked = Line(*KINKED, x=-60.0, y=30.0, heading=-2.0)
    turn = Line((9.4, 1 / 6, 1 / 6), x=300.0, y=300.0, heading=3.0)
    return network(
        line.lane("inner", 0.0, swelling, hill, right="middle", may_change_right=True, opposite="oncoming"),
        line.lane("middle", -3.6, 3.2, hill, left="inner", right="outer", number=-2, may_change_left=True),
        line.lane("outer", -6.7, 3.0, hill, left="middle", number=-3, type=LaneType.EXIT),
        line.lane("path", -9.0, 1.5, number=-4, type=LaneType.BIKING),
        line.lane("oncoming", 3.6, 3.4, hill, reverse=True, number=1, access=frozenset({"bus", "car"})),
        kinked.lane("kinked", road="2", speed_limit=8.3),
        turn.lane("turn", road="3", junction="j", predecessors=("inner", "middle"), successors=("kinked",)),
        stop_lines=(StopLine(id="1", spot=LaneSpot(lane="middle", s=100.0)),),
        junctions={"i": Junction(id="i"), "j": Junction(id="j", connectors=("turn",))},
    )


@pytest.fixture(scope="module")
def host():
    return example()


@pytest.fixture(scope="module")
def device(host):
    return build_lane_map(host)


@pytest.fixture(scope="module")
def rows(host):
    return lm.lane_rows(host)


def double(lane_map):
    """The same map in float64 (x64 has to be on)."""
    return jax.tree.map(lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a, lane_map)


def places(lane, count, rng, margin=0.0):
    return rng.uniform(margin, lane.length - margin, count).astype(np.float32)


pose = jax.jit(lm.pose)
to_frenet = jax.jit(lm.to_frenet)
project = jax.jit(lm.project)


# --- against closed forms ---------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [6.0, -15.0, 200.0])
def test_arc(radius):
    length = min(1.5 * np.pi * abs(radius), 600.0)
    lane_map = build_lane_map(network(Line((length, 1 / radius, 1 / radius)).lane("a")))
    s = np.linspace(0, length, 3001)
    x, y, heading = (np.asarray(v, float) for v in pose(lane_map, 0, jnp.asarray(s, jnp.float32)))
    x, y = lm.absolute(lane_map, x, y)
    np.testing.assert_allclose(x, radius * np.sin(s / radius), atol=1.2e-3)
    np.testing.assert_allclose(y, radius * (1 - np.cos(s / radius)), atol=1.2e-3)
    assert np.abs(np.angle(np.exp(1j * (heading - s / radius)))).max() < np.deg2rad(0.11)
    np.testing.assert_allclose(lm.curvature(lane_map, 0, jnp.asarray(s, jnp.float32)), 1 / radius, rtol=1e-3)
    np.testing.assert_allclose(lane_map.curvature_max[0], 1 / abs(radius), rtol=1e-3)


def test_clothoid_against_fresnel_integrals():
    length, bend = 80.0, 1 / 20
    lane_map = build_lane_map(network(Line((length, 0.0, bend)).lane("a")))
    s = np.linspace(0, length, 2001)
    scale = np.sqrt(np.pi * length / bend)
    sin, cos = fresnel(s / scale)
    x, y, _ = pose(lane_map, 0, jnp.asarray(s, jnp.float32))
    x, y = lm.absolute(lane_map, x, y)
    np.testing.assert_allclose(x, scale * cos, atol=1.2e-3)
    np.testing.assert_allclose(y, scale * sin, atol=1.2e-3)
    curvature = lm.curvature(lane_map, 0, jnp.asarray(s, jnp.float32))
    np.testing.assert_allclose(curvature, bend * s / length, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("reverse", [False, True])
def test_curvature_jumps_at_a_sample_with_one_value(reverse):
    line = Line((40.0, 0.02, 0.02), (40.0, 0.0, 0.0), (40.0, -0.01, -0.01), step=8.0)
    lane = line.lane("a", reverse=reverse)
    lane_map = build_lane_map(network(lane))
    s = np.array([1.0, 20.0, 38.0, 42.0, 60.0, 78.0, 82.0, 100.0, 119.0])
    truth = np.repeat([0.02, 0.0, -0.01], 3)
    s, truth = (120 - s, -truth) if reverse else (s, truth)
    np.testing.assert_allclose(lm.curvature(lane_map, 0, jnp.asarray(s, jnp.float32)), truth, atol=1e-6)


def test_lateral_offset_is_to_the_left():
    lane_map = build_lane_map(network(Line((40.0, 0.0, 0.0), heading=np.pi / 2).lane("north")))
    x, y, heading = pose(lane_map, 0, jnp.float32(10), jnp.float32(2))
    np.testing.assert_allclose(lm.absolute(lane_map, x, y), [-2, 10], atol=1e-5)
    np.testing.assert_allclose(heading, np.pi / 2, rtol=1e-6)


def test_lanes_go_on_straight_beyond_their_ends(device, host, rows):
    lane = host.lanes["turn"]
    for s, end in ((-7.0, 0.0), (lane.length + 7.0, lane.length)):
        place, angle = lane.pose(end)
        expected = place[:2] + (s - end) * np.array([np.cos(angle), np.sin(angle)])
        x, y, heading = pose(device, rows["turn"], jnp.float32(s))
        np.testing.assert_allclose(lm.absolute(device, x, y), expected, atol=1e-3)
        np.testing.assert_allclose(np.exp(1j * float(heading)), np.exp(1j * angle), atol=1e-4)
        found = to_frenet(device, rows["turn"], jnp.float32(end), x, y)
        np.testing.assert_allclose(found[:2], [s, 0.0], atol=1e-3)


# --- against the host -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["inner", "middle", "outer", "oncoming", "turn"])
def test_device_lane_follows_host_lane(host, device, rows, name):
    lane, row = host.lanes[name], rows[name]
    s = places(lane, 5000, np.random.default_rng(0))
    place, angle = lane.pose(s)
    x, y, heading = pose(device, row, s)
    ours = np.stack(lm.absolute(device, x, y), -1)
    assert np.hypot(*(ours - place[:, :2]).T).max() < TOLERANCE["position"] + 1e-4
    assert np.abs(np.angle(np.exp(1j * (np.asarray(heading) - angle)))).max() < 1.1 * TOLERANCE["heading"]
    np.testing.assert_allclose(lm.width(device, row, s), lane.width_at(s), atol=1.1e-3)
    np.testing.assert_allclose(lm.elevation(device, row, s)[0], place[:, 2], atol=1e-2)


def test_elevation_and_grade(host, device, rows):
    s = places(host.lanes["inner"], 5000, np.random.default_rng(0))
    z, grade = lm.elevation(device, rows["inner"], s)
    np.testing.assert_allclose(z, hill(s), atol=1e-3)
    np.testing.assert_allclose(grade, -2 / 60 * np.sin(s / 60), atol=1e-3)


def test_spacing_is_a_power_of_two_and_coarse_where_the_lane_is_simple():
    bends = [(16.0, 0.0, 0.0), (16.0, 1 / 500, 1 / 500), (16.0, 1 / 20, 1 / 20), (16.0, 1 / 5, 1 / 5)]
    lanes = [Line(bend, x=50.0 * k).lane(str(k), road=str(k)) for k, bend in enumerate(bends)]
    ds = np.asarray(build_lane_map(network(*lanes)).ds)[:4]
    assert (np.diff(ds[1:]) < 0).all()
    assert ds[0] == 16.0
    assert (np.log2(ds) % 1 == 0).all()


def test_kinked_lane_is_followed_and_reported(host, device, rows):
    lane = host.lanes["kinked"]
    s = places(lane, 5000, np.random.default_rng(1))
    x, y, _ = pose(device, rows["kinked"], s)
    deviation = np.hypot(*(np.stack(lm.absolute(device, x, y), -1) - lane.pose(s)[0][:, :2]).T)
    assert deviation.max() < 0.01
    assert np.median(deviation) < 1e-4
    report = ImportReport()
    build_lane_map(host, report=report)
    assert [note.where for note in report.notes] == ["kinked"]
    assert report.total(Action.APPROXIMATED) == 1
    # A driver takes 0.3 rad over four metres, not the infinite curvature of the kink.
    np.testing.assert_allclose(device.curvature_max[rows["kinked"]], 0.3 / TURN_WINDOW, rtol=1e-3)


def test_a_step_in_width_stays_a_step():
    line = Line((50.0, 0.0, 0.0))
    lane = line.lane("a")
    s = np.sort(np.append(lane.s, 30.001))
    fields = {
        "s": s,
        "xyz": np.stack([s, 0 * s, 0 * s], -1),
        "road_s": s,
        "width": np.where(s > 30, 5.0, 3.0),
    }
    zeros = {"heading": 0 * s, "curvature": 0 * s}
    lane_map = build_lane_map(network(dataclasses.replace(lane, **fields, **zeros)))
    width = lm.width(lane_map, 0, jnp.array([20.0, 29.4, 30.6, 40.0]))
    np.testing.assert_allclose(width, [3.0, 3.0, 5.0, 5.0], atol=1e-3)


@pytest.mark.engine
def test_side_s_is_level_across_the_road(host, device, rows):
    rng = np.random.default_rng(2)
    for name, side, other in (("inner", -1, "middle"), ("middle", 1, "inner"), ("middle", -1, "outer")):
        lane = host.lanes[name]
        s = places(lane, 1000, rng)
        ours = np.asarray(lm.side_s(device, rows[name], s, side))
        truth = host.lanes[other].s_at_road(np.interp(s, lane.s, lane.road_s))
        error = np.abs(ours - truth)
        assert error.max() < 0.02  # where the curvature jumps within an interval
        assert np.quantile(error, 0.95) < 1e-3
        # Level means: the neighbour's pose lies on the normal, with the same heading.
        x, y, heading = pose(device, rows[name], s)
        x2, y2, _ = pose(device, rows[other], ours)
        along = (x2 - x) * np.cos(heading) + (y2 - y) * np.sin(heading)
        assert np.abs(along).max() < 0.03
        assert np.quantile(np.abs(along), 0.95) < 3e-3
    s = jnp.array([5.0, 6.0])
    np.testing.assert_array_equal(lm.side_s(device, rows["outer"], s, -1), s)


def test_lane_tables_say_what_the_network_says(host, device, rows):
    def table(name, lane):
        return np.asarray(getattr(device, name))[rows[lane]]

    assert list(rows) == ["inner", "middle", "outer", "oncoming", "kinked", "turn"]
    assert lm.lane_ids(host) == list(rows)
    assert (table("left", "middle"), table("right", "middle")) == (rows["inner"], rows["outer"])
    assert (table("left", "inner"), table("right", "outer")) == (lm.NO_LANE, lm.NO_LANE)
    assert table("opposite", "inner") == rows["oncoming"]
    assert (table("may_change_left", "middle"), table("may_change_right", "middle")) == (True, False)
    lane, allowed = lm.neighbor(device, jnp.array([rows["middle"], rows["inner"]]), jnp.array([1, -1]))
    assert lane.tolist() == [rows["inner"], rows["middle"]]
    assert allowed.tolist() == [True, True]
    assert table("successors", "turn").tolist() == [rows["kinked"], -1, -1, -1]
    assert table("predecessors", "turn").tolist() == [rows["inner"], rows["middle"], -1, -1]
    assert (table("is_connector", "turn"), table("is_connector", "inner")) == (True, False)
    assert (table("junction", "turn"), table("junction", "inner")) == (1, -1)
    np.testing.assert_allclose(table("stop_s", "middle"), 100.0)
    np.testing.assert_allclose(table("stop_s", "inner"), host.lanes["inner"].length)
    assert lm.LANE_TYPES[table("lane_type", "outer")] is LaneType.EXIT
    allowed = [c for i, c in enumerate(lm.VEHICLE_CLASSES) if table("access", "oncoming") >> i & 1]
    assert allowed == ["car", "bus"]
    np.testing.assert_allclose(table("speed_limit", "kinked"), 8.3)
    np.testing.assert_allclose(table("length", "inner"), host.lanes["inner"].length)


def test_turn_speed(device, rows):
    fast = lm.turn_speed(device, jnp.array([rows["turn"], rows["inner"]]), 3.0)
    np.testing.assert_allclose(fast, [np.sqrt(3.0 * 6.0), np.sqrt(3.0 * 12.0)], rtol=2e-3)
    straight = build_lane_map(network(Line((40.0, 0.0, 0.0)).lane("a")))
    np.testing.assert_allclose(lm.turn_speed(straight, 0, 3.0), 13.9)


def test_a_lane_may_have_many_successors():
    line = Line((20.0, 0.0, 0.0))
    many = [line.lane(f"b{k}", number=k) for k in range(7)]
    fork = line.lane("fork", road="2", successors=tuple(lane.id for lane in many))
    lane_map = build_lane_map(network(fork, *many))
    assert lane_map.successors[0].tolist() == [1, 2, 3, 4, 5, 6, 7, -1]


# --- Frenet -----------------------------------------------------------------------------------------


def long_network(single):
    """10 km with bends, as one lane or as 40; the lanes are 7 m wide."""
    bends = [(40.0, 0.0, 1 / 60), (40.0, 1 / 60, 0.0), (40.0, 0.0, -1 / 60), (40.0, -1 / 60, 0.0)]
    block = [(90.0, 0.0, 0.0), *bends]
    if single:
        return network(Line(*(block * 40), step=1.0).lane("a", width=7.0))
    starts = np.linspace(-5000, 4750, 40)
    return network(
        *(Line(*block, x=x, y=0.7 * x, heading=0.2 * k, step=1.0).lane(str(k), width=7.0)
          for k, x in enumerate(starts))
    )  # fmt: skip


@pytest.mark.engine
@pytest.mark.parametrize("single", [True, False])
def test_round_trip_on_ten_kilometres(single):
    host = long_network(single)
    lane_map = build_lane_map(host)
    rng = np.random.default_rng(3)
    lane = rng.integers(0, len(host.lanes), 100_000)
    s = (rng.uniform(0, 1, len(lane)) * np.asarray(lane_map.length)[lane]).astype(np.float32)
    d = rng.uniform(-3.5, 3.5, len(lane)).astype(np.float32)
    extent = np.ptp(host.bounds()[0::2]), np.ptp(host.bounds()[1::2])
    assert max(extent) > 8000
    x, y, heading = pose(lane_map, lane, s, d)
    guess = s + rng.uniform(-4, 4, len(lane)).astype(np.float32)
    s2, d2, heading2 = (np.asarray(v) for v in to_frenet(lane_map, lane, guess, x, y))
    assert np.abs(s2 - s).max() < 1e-3
    assert np.abs(d2 - d).max() < 1e-3
    np.testing.assert_allclose(heading2, heading, atol=1e-4)


@pytest.mark.parametrize("name", ["inner", "outer", "oncoming", "turn"])
def test_round_trip_in_bends(host, device, rows, name):
    """Also half way to the centre of curvature, and from guesses many intervals away."""
    lane, rng = host.lanes[name], np.random.default_rng(4)
    s = places(lane, 20_000, rng)
    bend = np.interp(s, lane.s, lane.curvature)
    d = rng.uniform(-4, 4, len(s)).astype(np.float32)
    inside = bend * d < 0.5
    s, d = s[inside], d[inside]
    x, y, _ = pose(device, rows[name], s, d)
    guess = s + rng.uniform(-3, 3, len(s)).astype(np.float32)
    s2, d2, _ = (np.asarray(v) for v in to_frenet(device, rows[name], guess, x, y))
    assert np.abs(s2 - s).max() < 1e-3
    assert np.abs(d2 - d).max() < 1e-3


def test_round_trip_survives_kinks_outside_their_bends(host, device, rows):
    """On the outer side of a kink the projection is unique; between its legs it cannot be continuous."""
    s = np.linspace(0.5, 55.5, 2001).astype(np.float32)
    for d in (0.0, 0.02):
        x, y, _ = pose(device, rows["kinked"], s, jnp.full(s.shape, d))
        guess = s + np.random.default_rng(5).uniform(-3, 3, len(s)).astype(np.float32)
        s2, d2, _ = to_frenet(device, rows["kinked"], guess, x, y)
        np.testing.assert_allclose(s2, s, atol=1e-3)
        np.testing.assert_allclose(d2, d, atol=1e-3)


@pytest.mark.engine
def test_project_finds_the_nearest_lane_as_brute_force_does(host, device, rows):
    rng = np.random.default_rng(6)
    lanes = list(host.drivable_lanes())
    samples = [np.linspace(0, lane.length, int(lane.length / 0.05)) for lane in lanes]
    curves = [lane.pose(s) for lane, s in zip(lanes, samples, strict=True)]
    lane = rng.integers(0, len(lanes), 400)
    at = np.array([lanes[k].pose(rng.uniform(0, lanes[k].length))[0][:2] for k in lane])
    points = at + rng.uniform(-12, 12, at.shape)
    headings = rng.uniform(-4, 4, len(points))
    x, y = lm.relative(device, *points.T)

    # Feet of perpendiculars and ends of lanes: where the distance along a lane has a minimum.
    nearest, undecided = np.full((2, len(points)), np.inf), np.zeros(len(points), bool)
    for place, heading in curves:
        gap = np.hypot(*(points[:, None] - place[None, :, :2]).T).T
        padded = np.pad(gap, ((0, 0), (1, 1)), constant_values=np.inf)
        foot = np.where((gap <= padded[:, :-2]) & (gap <= padded[:, 2:]), gap, np.inf)
        off = np.abs(np.angle(np.exp(1j * (headings[:, None] - heading))))
        nearest[0] = np.minimum(nearest[0], foot.min(1))
        nearest[1] = np.minimum(nearest[1], np.where(off < np.pi / 2, foot, np.inf).min(1))
        undecided |= ((foot < lm.REACH) & (np.abs(off - np.pi / 2) < 0.05)).any(1)
        beyond_centre = (gap >= padded[:, :-2]) & (gap >= padded[:, 2:]) & (gap < lm.REACH + 1)
        undecided |= beyond_centre[:, 1:-1].any(1)
    assert undecided.mean() < 0.2
    for given, least in zip((None, jnp.asarray(headings, jnp.float32)), nearest, strict=True):
        found, s, d, _ = map(np.asarray, project(device, x, y, given))
        clear = (np.abs(least - lm.REACH) > 0.01) & ~(undecided & (given is not None))
        np.testing.assert_array_equal((found != lm.NO_LANE)[clear], (least < lm.REACH)[clear])
        hit = clear & (found != lm.NO_LANE)
        assert 50 < hit.sum() < clear.sum() - 10
        place = np.stack([lanes[k].pose(v)[0][:2] for k, v in zip(found[hit], s[hit], strict=True)])
        np.testing.assert_allclose(np.hypot(*(points[hit] - place).T), least[hit], atol=0.026)
        # The projection itself: pose(s, d) is the point again.
        back = lm.absolute(device, *pose(device, found[hit], s[hit], d[hit])[:2])
        np.testing.assert_allclose(np.stack(back, -1), points[hit], atol=2e-3)


@pytest.mark.engine
def test_project_of_vehicles_on_lanes_finds_their_lane(host, device, rows):
    rng = np.random.default_rng(7)
    lane = rng.integers(0, 4, 2000)
    s = (rng.uniform(0, 1, 2000) * np.asarray(device.length)[lane]).astype(np.float32)
    d = rng.uniform(-1.2, 1.2, 2000).astype(np.float32)
    x, y, heading = pose(device, lane, s, d)
    found, s2, d2, _ = project(device, x, y, heading)
    np.testing.assert_array_equal(found, lane)
    np.testing.assert_allclose(s2, s, atol=1e-3)
    np.testing.assert_allclose(d2, d, atol=1e-3)


@pytest.mark.engine
def test_project_far_away_or_of_nan_is_no_lane(device):
    x = jnp.array([5e4, -5e4, jnp.nan, 3e9])
    found = project(device, x, jnp.zeros(4))[0]
    assert found.tolist() == [lm.NO_LANE] * 4


# --- gradients --------------------------------------------------------------------------------------


@pytest.mark.engine
@pytest.mark.parametrize("name", ["inner", "outer", "turn", "kinked"])
def test_gradients_equal_finite_differences(host, name):
    with jax.enable_x64(True):
        lane_map, row, lane = double(build_lane_map(host)), lm.lane_rows(host)[name], host.lanes[name]
        rng = np.random.default_rng(8)
        # Ends and beyond them, too; away from interval bounds, where the second derivative steps.
        s = np.concatenate([rng.uniform(0, lane.length, 40), [-3.0, lane.length + 3.0]])
        d = rng.uniform(-0.05, 0.05, len(s)) if name == "kinked" else rng.uniform(-1.5, 1.5, len(s))

        def frenet(x, y, guess):
            return jnp.stack(lm.to_frenet(lane_map, row, guess, x, y))

        def looked_up(s, d):
            z, grade = lm.elevation(lane_map, row, s)
            level = lm.side_s(lane_map, row, s, -1)
            more = [lm.curvature(lane_map, row, s), lm.width(lane_map, row, s), z, grade, level]
            return jnp.stack([*lm.pose(lane_map, row, s, d), *more])

        def check(function, *args):
            args = [jnp.asarray(arg) for arg in args]
            step = 1e-6
            forward = jax.jit(jax.vmap(jax.jacfwd(function, (0, 1))))(*args)
            reverse = jax.jit(jax.vmap(jax.jacrev(function, (0, 1))))(*args)
            value = jax.jit(jax.vmap(function))
            for k in range(2):
                up, down = ([*args[:k], args[k] + sign * step, *args[k + 1 :]] for sign in (1, -1))
                central = (value(*up) - value(*down)) / (2 * step)
                np.testing.assert_allclose(forward[k], central, atol=2e-5, rtol=2e-5)
                np.testing.assert_allclose(reverse[k], central, atol=2e-5, rtol=2e-5)

        check(looked_up, s, d)
        x, y, _ = lm.pose(lane_map, row, jnp.asarray(s), jnp.asarray(d))
        check(frenet, np.asarray(x), np.asarray(y), s + 0.3)


@pytest.mark.engine
def test_gradients_are_finite_everywhere(device, rows):
    """On interval bounds, ends, kinks, the null lane and at the centre of curvature, in float32."""

    tables = {name: getattr(device, name) for name in ("rows", "height", "side", "ds", "curvature_max")}

    def total(tables, s, d, row):
        lane_map = dataclasses.replace(device, **tables)
        x, y, heading = lm.pose(lane_map, row, s, d)
        back = lm.to_frenet(lane_map, row, s, x, y)
        z = lm.elevation(lane_map, row, s)
        others = lm.curvature(lane_map, row, s), lm.width(lane_map, row, s), lm.side_s(lane_map, row, s, 1)
        speed = lm.turn_speed(lane_map, row, jnp.abs(s))
        return sum(jnp.sum(v) for v in (x, y, heading, *back, *z, *others, speed))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    ends = np.asarray(device.length)
    for row in (*rows.values(), lm.NO_LANE):
        s = jnp.array([-5.0, 0.0, 1.0, 20.0, 20.0005, 28.0, ends[row], ends[row] + 5.0], jnp.float32)
        for d in (0.0, 6.0, -12.0, 1e4):
            for leaf in jax.tree.leaves(gradient(tables, s, jnp.full(s.shape, d), jnp.int32(row))):
                assert np.isfinite(leaf).all(), (row, d)


@pytest.mark.engine
def test_gradients_are_finite_where_a_lane_turns_on_the_spot(device):
    """The tangent vanishes there; rows of constant position imitate that."""
    still = dataclasses.replace(device, rows=device.rows.at[:, 1:4].set(0).at[:, 5:8].set(0))

    def total(rows, s, d):
        lane_map = dataclasses.replace(still, rows=rows)
        return sum(jnp.sum(v) for v in (*lm.pose(lane_map, 0, s, d), *lm.to_frenet(lane_map, 0, s, d, d)))

    for leaf in jax.jit(jax.grad(total, argnums=(0, 1, 2)))(still.rows, jnp.float32(5), jnp.float32(1)):
        assert np.isfinite(leaf).all()


@pytest.mark.engine
def test_gradients_on_interval_bounds_are_those_of_one_side():
    """A clip would halve them on its bounds."""
    radius = 50.0
    lane_map = build_lane_map(network(Line((40.0, 1 / radius, 1 / radius)).lane("a")))
    bounds = jnp.arange(0, 40, float(lane_map.ds[0]))
    turn = jax.vmap(jax.grad(lambda s: lm.pose(lane_map, 0, s)[2]))(bounds)
    np.testing.assert_allclose(turn, 1 / radius, rtol=0.02)


@pytest.mark.engine
def test_project_is_differentiable(device):
    x, y, _ = pose(device, 0, jnp.float32(50), jnp.float32(0.5))
    dx, dy = jax.grad(lambda x, y: project(device, x, y)[2], argnums=(0, 1))(x, y)
    heading = pose(device, 0, jnp.float32(50))[2]
    np.testing.assert_allclose([dx, dy], [-np.sin(heading), np.cos(heading)], atol=1e-4)


# --- shapes, buckets and programs -------------------------------------------------------------------


def test_bucket_sizes():
    assert [lm.bucket(n) for n in (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 13, 24, 25, 1000)] == [
        1, 1, 2, 3, 4, 6, 6, 8, 8, 12, 12, 16, 24, 32, 1024
    ]  # fmt: skip


@pytest.mark.engine
def test_maps_in_the_same_buckets_share_one_program():
    traces = []

    @jax.jit
    def drive(lane_map, s, x):
        traces.append(1)
        return lm.pose(lane_map, 0, s), lm.to_frenet(lane_map, 0, s, x, x), lm.project(lane_map, x, x)

    one = build_lane_map(network(Line((200.0, 0.0, 0.0)).lane("a")))
    other = build_lane_map(example())
    for lane_map in (one, other):
        drive(lane_map, jnp.float32(3), jnp.float32(1))
    assert len(traces) == 1
    assert not np.array_equal(one.rows, other.rows)


def test_maps_of_different_size_share_shapes_on_request():
    least = {"lanes": 128, "rows": 8192, "foes": 16, "goals": 24, "sight": 6}
    some = [build_lane_map(network(Line((200.0, 0.0, 0.0)).lane("a")), least=least)]
    some += [build_lane_map(network(*(Line((60.0, 0.0, 0.0), x=5.0 * k).lane(f"{k}") for k in range(100))))]
    some += [build_lane_map(example(), least=least)]
    one, plain, other = (jax.tree.map(np.shape, x) for x in some)
    assert one == other != plain
    assert len(some[0].length) == 128 and some[0].conflicts.foe.shape[1] == 16
    with pytest.raises(KeyError, match="no table 'lane'"):
        build_lane_map(example(), least={"lane": 1})


@pytest.mark.engine
def test_padding_does_not_matter(host, device, rows):
    """The same lanes in a map with many others, in larger buckets, give the same bits."""
    more = [Line((60.0, 0.0, 0.0), x=-500.0 + 5 * k).lane(f"+{k}", road=f"+{k}") for k in range(100)]
    lane_map = build_lane_map(network(*host.lanes.values(), *more))
    assert lane_map.first.shape > device.first.shape
    shift = np.asarray(lane_map.origin - device.origin, np.float32)
    lane_map = dataclasses.replace(lane_map, rows=lane_map.rows.at[:, 0].add(shift[0]).at[:, 4].add(shift[1]))
    s = jnp.linspace(-1.0, 60.0, 100)
    for row in rows.values():
        for a, b in zip(pose(device, row, s, s / 50), pose(lane_map, row, s, s / 50), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        assert np.array_equal(lm.width(device, row, s), lm.width(lane_map, row, s))
        assert np.array_equal(lm.curvature(device, row, s), lm.curvature(lane_map, row, s))


@pytest.mark.engine
def test_scalars_arrays_and_vmap_agree(device):
    lane, s, d = jnp.array([0, 1, 5, -1]), jnp.array([3.0, 70.0, 4.0, 0.5]), jnp.array([0.5, -1.0, 0.0, 2.0])
    x, y, heading = pose(device, lane, s, d)
    mapped = jax.vmap(pose, (None, 0, 0, 0))(device, lane, s, d)
    single = [pose(device, *one) for one in zip(lane, s, d, strict=True)]
    for ours in (mapped, zip(*single, strict=True)):
        np.testing.assert_allclose(np.stack([x, y, heading]), np.array(list(ours)), rtol=1e-6, atol=1e-5)
    grid = pose(
        device, jnp.broadcast_to(lane, (2, 4)), jnp.broadcast_to(s, (2, 4)), jnp.broadcast_to(d, (2, 4))
    )
    np.testing.assert_allclose(grid[0][1], x, rtol=1e-6)
    for function in (lm.to_frenet, lambda m, lane, s, x, y: lm.project(m, x, y)):
        batched = jax.jit(function)(device, lane, s, x, y)
        one_by_one = jax.jit(jax.vmap(function, (None, 0, 0, 0, 0)))(device, lane, s, x, y)
        for a, b in zip(batched, one_by_one, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)


@pytest.mark.engine
def test_null_lane_is_inert(device):
    s = jnp.array([-10.0, 0.0, 0.5, 100.0])
    for leaf in jax.tree.leaves(
        (lm.pose(device, -1, s, s), lm.elevation(device, -1, s), lm.curvature(device, -1, s))
    ):
        assert np.isfinite(leaf).all()
    assert (device.length[-1], device.speed_limit[-1], lm.width(device, -1, s)[0]) == (1, 1, 1)
    for name in ("left", "right", "opposite", "successors", "predecessors", "junction"):
        assert (np.asarray(getattr(device, name))[-1] == lm.NO_LANE).all()
    for name in ("valid", "may_change_left", "may_change_right", "is_connector", "access"):
        assert not np.asarray(getattr(device, name))[-1]
    assert np.asarray(device.valid).sum() == 6
    np.testing.assert_allclose(
        lm.to_frenet(device, -1, s, *lm.pose(device, -1, s, s)[:2])[:2], [s, s], atol=1e-5
    )


def test_leaves_are_arrays_of_device_types(device):
    for leaf in jax.tree.leaves(device):
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.bool_)
    num_lanes = {len(getattr(device, name)) for name in ("first", "length", "left", "successors", "valid")}
    assert num_lanes == {device.conflicts.connector.shape[0]} == {device.routes.distance.shape[0]} == {64}
    assert device.signals.lane_program.shape == (64,)


# --- origin and errors ------------------------------------------------------------------------------


def test_far_coordinates_lose_nothing():
    """UTM northings: float32 alone would round them to half a metre."""
    far = (691_000.25, 5_335_000.75)
    near_map = build_lane_map(network(Line(*WINDING, x=0.25, y=0.75).lane("a")))
    far_map = build_lane_map(network(Line(*WINDING, x=far[0], y=far[1]).lane("a")))
    s = jnp.linspace(0.0, 300.0, 500)
    near, away = (np.stack(lm.absolute(m, *pose(m, 0, s)[:2]), -1) for m in (near_map, far_map))
    np.testing.assert_allclose(away - near, [[691_000, 5_335_000]] * 500, atol=1e-4)
    x, y = lm.relative(far_map, *away.T)
    np.testing.assert_array_equal(np.stack([x, y]), np.stack(pose(far_map, 0, s)[:2]))


def test_bad_networks_are_refused_with_a_map_error():
    good = Line((20.0, 0.0, 0.0)).lane("a")
    with pytest.raises(MapError, match=r"test\.xodr.*no lane"):
        build_lane_map(network(dataclasses.replace(good, type=LaneType.SIDEWALK)))
    with pytest.raises(MapError, match=r"lane 'a'.*finite"):
        build_lane_map(network(dataclasses.replace(good, width=np.full_like(good.width, np.nan))))
    with pytest.raises(MapError, match=r"lane 'a'.*'gone'"):
        build_lane_map(network(dataclasses.replace(good, left="gone")))


def test_a_lane_that_cannot_be_followed_is_refused(host, monkeypatch):
    monkeypatch.setattr(rasterise, "WORST_DEVIATION", 0.003)
    with pytest.raises(MapError, match=r"lane 'kinked'.*leave the centre line by 0\.00"):
        build_lane_map(host)
