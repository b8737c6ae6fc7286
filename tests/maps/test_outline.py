"""What drawings show: kinds of surface, marks, held ends of lanes, stripes of crosswalks."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import intersection, network, straight

from limsim_jax.maps.network import Control, Crosswalk, LaneType, MapError
from limsim_jax.maps.outline import (
    SURFACES,
    crosswalk_stripes,
    halfplane,
    held_ends,
    marks,
    outline,
    outlines,
    surface,
    union,
    view,
)


def pair(**fields):
    """Two lanes of 100 m side by side, `a` on the right, `b` on the left."""
    a = straight("a", (0.0, 0.0), 0.0, 100.0, left="b", **fields)
    b = straight("b", (0.0, 3.5), 0.0, 100.0, right="a")
    return network([a, b])


def found(net):
    return {
        (mark.outline.lane.id, "left right".split()[mark.side], mark.kind, mark.shift)
        for mark in marks(net, outlines(net).values())
    }


EDGES = {("a", "right", "edge", 0), ("b", "left", "edge", 0)}


@pytest.mark.parametrize("may", [False, True])
def test_a_border_with_one_rule_for_both_lanes_has_one_line(may):
    net = pair(may_change_left=may)
    net.lanes["b"] = replace(net.lanes["b"], may_change_right=may)
    assert found(net) == EDGES | {("a", "left", "dashed" if may else "solid", 0)}


def test_of_a_double_mark_each_lane_has_the_line_that_binds_it_on_its_side():
    net = pair(may_change_left=True)
    assert found(net) == EDGES | {("a", "left", "dashed", -1), ("a", "left", "solid", 1)}
    lines = [mark.line(0.1) for mark in marks(net, outlines(net).values()) if mark.shift]
    np.testing.assert_allclose([line[:, 1].mean() for line in lines], [1.65, 1.85])


def test_oncoming_lanes_share_a_centre_line_and_other_lanes_have_kerbs():
    a = straight("a", (0.0, 0.0), 0.0, 100.0, opposite="c", right="walk")
    c = straight("c", (100.0, 3.5), np.pi, 100.0, opposite="a")
    walk = straight("walk", (0.0, -3.5), 0.0, 100.0, left="a", type=LaneType.SIDEWALK)
    assert found(network([walk, a, c])) == {
        ("a", "left", "centre", 0),
        ("a", "right", "edge", 0),
        ("c", "right", "edge", 0),
        ("walk", "right", "kerb", 0),
    }


def test_lanes_inside_junctions_have_no_marks():
    net = intersection()
    assert all(mark.outline.lane.junction is None for mark in marks(net, outlines(net).values()))
    assert {surface(lane) for lane in net.lanes.values() if lane.junction} == {"junction"}


def test_every_lane_type_has_a_surface():
    lane = straight("a", (0.0, 0.0), 0.0, 10.0)
    for kind in LaneType:
        name = surface(replace(lane, type=kind))
        assert kind in SURFACES[name].types or name == "closed or other lane"


def test_ends_of_lanes_are_held_by_the_control_that_all_their_movements_share():
    net = intersection()
    first = net.movements[0].incoming

    def of(controls):
        """What holds the lane if its movements have these controls in turn."""
        own = [k for k, way in enumerate(net.movements) if way.incoming == first]
        given = {k: controls[n % len(controls)] for n, k in enumerate(own)}
        movements = tuple(
            replace(way, control=given.get(k, Control.NONE)) for k, way in enumerate(net.movements)
        )
        changed = replace(net, movements=movements)
        assert held_ends(changed, {first}) == []
        return dict(held_ends(changed, set())).get(first)

    assert of([Control.SIGNAL]) == "signal"
    assert of([Control.STOP, Control.ALL_WAY_STOP]) == "stop"
    assert of([Control.YIELD]) == "yield"
    assert of([Control.YIELD, Control.STOP]) is None
    assert of([Control.PRIORITY]) is None


def test_stripes_of_a_crosswalk_lie_along_the_traffic():
    lane = straight("a", (0.0, 0.0), 0.0, 100.0)
    corners = np.array([[50.0, -8.0], [54.0, -8.0], [54.0, 8.0], [50.0, 8.0]])
    walk = Crosswalk(id="w", outline=corners, spans=(("a", 50.0, 54.0),))
    stripes = crosswalk_stripes(network([lane]), walk)
    assert len(stripes) == 16
    for stripe in stripes:
        np.testing.assert_allclose(np.ptp(stripe, axis=0), [4.0, 0.5])
    # Without traffic they lie across the longer axis of the outline: the same here.
    alone = crosswalk_stripes(network([lane]), replace(walk, spans=()))
    assert sorted(map(np.ptp, alone)) == pytest.approx(sorted(map(np.ptp, stripes)))
    assert crosswalk_stripes(network([lane]), replace(walk, outline=corners[:2])) == []


def test_halfplane_keeps_the_part_of_a_polygon_behind_a_line():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    part = halfplane(square, np.array([1.0, 0.0]), 0.5)
    assert part[:, 0].max() == 0.5 and part[:, 0].min() == 0.0 and len(part) == 4
    assert len(halfplane(square, np.array([1.0, 0.0]), -1.0)) == 0


def test_spans_are_joined_where_they_overlap():
    assert union([(4.0, 5.0), (0.0, 2.0), (1.0, 3.0), (3.0, 3.5)]) == [(0.0, 3.5), (4.0, 5.0)]


def test_an_outline_has_the_width_of_its_lane():
    shape = outline(straight("a", (0.0, 0.0), 0.0, 100.0))
    np.testing.assert_allclose(shape.left - shape.right, np.tile([0.0, 3.5], (len(shape.s), 1)), atol=1e-12)
    np.testing.assert_allclose(shape.bar(30.0, 0.5), [[30.0, 0.875], [30.0, -0.875]], atol=1e-12)


def test_the_view_covers_the_map_and_refuses_bounds_without_lanes():
    net = pair()
    x0, y0, x1, y1 = view(net, outlines(net), None)
    assert x0 < 0 and x1 > 100 and y0 < -1.75 and y1 > 5.25
    with pytest.raises(MapError, match="show no lane"):
        view(net, outlines(net), (500.0, 500.0, 600.0, 600.0))
