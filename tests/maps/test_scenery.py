"""The painted ground against polygons of shapely, and what stands on the roads."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from paths import SHARED, needs_shared
from traffic_worlds import bundled

from limsim_jax.maps import scenery as module
from limsim_jax.maps.map import load_map
from limsim_jax.maps.network import LaneType, MapError
from limsim_jax.maps.outline import marks, outlines
from limsim_jax.maps.scenery import DRIVABLE, TILE, Label, build_scenery, ground


def labels_at(scenery, origin, points):
    xy = np.asarray(points) - np.asarray(origin)
    return np.asarray(ground(scenery, jnp.asarray(xy[:, 0], jnp.float32), jnp.asarray(xy[:, 1], jnp.float32)))


@pytest.fixture(scope="module", params=["intersection", "roundabout"])
def painted(request):
    network, lane_map = bundled(request.param)
    return network, lane_map, build_scenery(network, lane_map)


def test_polygons_are_filled_as_shapely_says():
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*[(np.arange(-2 * TILE, 2 * TILE) + 0.5) * 0.25] * 2)
    blank = np.full((TILE, TILE), Label.TERRAIN)
    for _ in range(8):
        canvas = module._Canvas(0.25, np.zeros(2), "a map")
        angles = np.sort(rng.uniform(0, 2 * math.pi, 9))
        unit = np.stack([np.cos(angles), np.sin(angles)], -1)
        corners = rng.uniform(-12, 12, 2) + rng.uniform(3, 15, (9, 1)) * unit
        canvas.fill(corners[:: rng.choice((1, -1))], Label.ROAD)
        found = np.block([[canvas.painted.get((i, j), blank) for i in range(-2, 2)] for j in range(-2, 2)])
        shape = shapely.Polygon(corners)
        edge = shapely.distance(shape.exterior, shapely.points(x, y)) < 1e-9
        inside = shapely.contains_xy(shape, x, y)
        assert shape.is_valid and inside.any()
        np.testing.assert_array_equal((found == Label.ROAD)[~edge], inside[~edge])


def test_polygons_without_an_area_paint_nothing():
    canvas = module._Canvas(0.25, np.zeros(2), "a map")
    for corners in (
        np.zeros((0, 2)),
        np.zeros((2, 2)),
        np.ones((4, 2)),
        np.array([[0, 0.1], [9, 0.1], [4, 0.1]]),
    ):
        canvas.fill(corners, Label.ROAD)
    assert not canvas.painted


def test_lanes_are_road_and_the_rest_is_not(painted):
    """Places well within lanes are drivable, places well away from all of them are open country."""
    network, lane_map, scenery = painted
    shapes = outlines(network)
    lanes = [shapely.make_valid(shapely.Polygon(s.polygon)) for s in shapes.values() if s.lane.drivable]
    every = shapely.union_all([shapely.make_valid(shapely.Polygon(s.polygon)) for s in shapes.values()])
    rng = np.random.default_rng(1)
    x0, y0, x1, y1 = network.bounds()
    points = rng.uniform((x0 - 40, y0 - 40), (x1 + 40, y1 + 40), (20000, 2))
    found = labels_at(scenery, lane_map.origin, points)
    inside = np.zeros(len(points), bool)
    for lane in lanes:
        inside |= shapely.contains_xy(lane.buffer(-0.3), *points.T)
    assert inside.sum() > 500
    assert np.isin(found[inside], [int(label) for label in DRIVABLE]).all()
    away = ~shapely.contains_xy(every.buffer(2.5), *points.T)
    assert away.sum() > 5000 and (found[away] == Label.TERRAIN).all()


def test_marks_are_where_lanes_meet(painted):
    """Solid lines are painted throughout, half of each dashed line is, and the middle of a lane is not."""
    network, lane_map, scenery = painted
    shares: dict[str, list[float]] = {"solid": [], "edge": [], "dashed": [], "middle": []}
    for mark in marks(network, outlines(network).values()):
        shape = mark.outline
        if mark.shift or mark.kind not in shares or shape.lane.length < 30:
            continue
        s = np.linspace(2, shape.lane.length - 15, 300)
        for kind, line in ((mark.kind, mark.border), ("middle", shape.centre)):
            heading = np.interp(s, shape.s, shape.heading)
            across = scenery.pixel / 2 * np.stack([-np.sin(heading), np.cos(heading)], -1)
            # the pixel at a place of the line may have its middle beside it
            found = [labels_at(scenery, lane_map.origin, shape.at(s, line) + k * across) for k in (-1, 0, 1)]
            shares[kind].append((np.stack(found) == Label.MARK).any(0).mean())
    mean = {name: np.mean(values) for name, values in shares.items() if values}
    assert mean["edge"] > 0.93 and mean["middle"] < 0.05
    assert abs(mean["dashed"] - 0.5) < 0.1
    assert mean.get("solid", 1) > 0.93


def test_lights_stand_beyond_their_stop_lines():
    network, lane_map = bundled("intersection")
    scenery = build_scenery(network, lane_map)
    behind = np.asarray(scenery.light_lane)
    real = behind >= 0
    assert real.sum() >= 4
    program = np.asarray(lane_map.signals.lane_program)[behind[real]]
    assert (program >= 0).all()
    rows = {lane.id: row for row, lane in enumerate(network.drivable_lanes())}
    for (x, y, heading), lane in zip(np.asarray(scenery.light)[real], behind[real], strict=True):
        befores = [
            a for a in network.lanes.values() if a.drivable and lane in [rows.get(b) for b in a.successors]
        ]
        ahead = np.array([math.cos(heading), math.sin(heading)])
        ways = []
        for before in befores:
            xyz, _ = before.pose(float(lane_map.stop_s[rows[before.id]]))
            ways.append((np.array([x, y]) + np.asarray(lane_map.origin) - xyz[:2]) @ ahead)
        assert min(abs(np.array(ways) - module.LIGHT_AHEAD)) < 1e-2


def test_turns_bend_as_they_say():
    network, lane_map = bundled("intersection")
    turn = np.asarray(build_scenery(network, lane_map).turn)
    rows = {lane.id: row for row, lane in enumerate(network.drivable_lanes())}
    said = {m.turn.value: {int(turn[rows[v]]) for v in m.via} for m in network.movements}
    assert said["left"] == {1} and said["right"] == {-1} and said["straight"] == {0}


def test_small_maps_share_shapes():
    shapes = {
        name: [x.shape for x in (s.tile, s.light, s.turn)]
        for name in ("intersection", "roundabout")
        for s in [build_scenery(*bundled(name))]
    }
    assert len({str(x) for x in shapes.values()}) == 1


def test_a_map_that_needs_too_much_memory_is_refused(monkeypatch):
    monkeypatch.setattr(module, "MOST_TILES", 20)
    with pytest.raises(MapError, match=r"more than 20 tiles of ground; use a pixel above 0\.25 m"):
        build_scenery(*bundled("intersection"))
    with pytest.raises(ValueError, match=r"pixel: 0\.0 m"):
        build_scenery(*bundled("intersection"), pixel=0.0)


@pytest.mark.slow
@needs_shared
def test_maps_of_others_can_be_painted():
    """Most of their lanes' middles are drivable ground."""
    files = [*(SHARED / "opendrive").glob("*.xodr"), *(SHARED / "sumo").glob("*/*.net.xml")]
    assert len(files) > 20
    for file in files:
        try:
            town = load_map(file)
            arrays = town.lanes
        except MapError:
            continue
        shapes = outlines(town.network)
        middles = [shapes[x.id].at(x.length / 2, shapes[x.id].centre) for x in town.network.drivable_lanes()]
        found = labels_at(town.scenery, arrays.origin, np.array(middles))
        assert np.isin(found, [int(label) for label in DRIVABLE]).mean() > 0.95, file


def test_invisible_lanes_are_not_painted():
    network, lane_map = bundled("roundabout")
    lanes = {
        id_: replace(lane, type=LaneType.NONE) if lane.type is LaneType.SIDEWALK else lane
        for id_, lane in network.lanes.items()
    }
    bare = np.asarray(build_scenery(replace(network, lanes=lanes), lane_map).paint)
    assert not (bare == Label.SIDEWALK).any()
    assert (np.asarray(build_scenery(network, lane_map).paint) == Label.SIDEWALK).any()


def test_a_map_keeps_its_scenery():
    town = load_map("roundabout")
    assert town.scenery is town.scenery
