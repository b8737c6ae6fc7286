"""Curves of the OpenDRIVE reader against closed forms."""

import math

import numpy as np
import pytest
from scipy.special import fresnel
from small_xodr import lane, notes, road, section

from limsim_jax.maps.network import Action
from limsim_jax.maps.opendrive.curves import Cubics, Geometry, Kind, ReferenceLine


@pytest.mark.parametrize(
    ("k0", "k1", "length"),
    [(0.0, 0.02, 100.0), (-0.01, 0.04, 80.0), (0.1, -0.1, 60.0), (0.0, -0.5, 12.0), (0.002, 0.0, 900.0)],
)
def test_clothoid_against_fresnel_integrals(k0, k1, length):
    c = (k1 - k0) / length
    g = Geometry(s=0, x=3, y=-4, heading=0.7, length=length, kind=Kind.CLOTHOID, curvature=k0, sharpness=c)
    s = np.linspace(0, length, 101)
    x, y, heading, curvature, _ = ReferenceLine([g]).frame(s, s)
    # standard form: shift the parameter to where the curvature is zero
    scale, sign, s0 = math.sqrt(math.pi / abs(c)), math.copysign(1, c), -k0 / c
    base = 0.7 - c * s0**2 / 2

    def point(s):
        sin, cos = fresnel((s - s0) / scale)
        return scale * (cos + 1j * sign * sin) * np.exp(1j * base)

    expected = 3 - 4j + point(s) - point(0.0)
    assert np.abs(x + 1j * y - expected).max() < 1e-6
    assert np.abs(x + 1j * y - expected).max() < 1e-9  # what it really is
    np.testing.assert_allclose(heading, 0.7 + k0 * s + c * s**2 / 2, atol=1e-12)
    np.testing.assert_allclose(curvature, k0 + c * s, atol=1e-12)


@pytest.mark.parametrize("difference", [0.0, 1e-15, 1e-9])
def test_spiral_with_equal_curvatures_is_an_arc(difference):
    k, length = 0.05, 40.0
    g = Geometry(
        s=0,
        x=0,
        y=0,
        heading=0,
        length=length,
        kind=Kind.CLOTHOID,
        curvature=k,
        sharpness=difference / length,
    )
    s = np.linspace(0, length, 9)
    x, y, *_ = ReferenceLine([g]).frame(s, s)
    np.testing.assert_allclose(x, np.sin(k * s) / k, atol=1e-6)
    np.testing.assert_allclose(y, (1 - np.cos(k * s)) / k, atol=1e-6)


def test_arc_of_no_curvature_is_a_line():
    g = Geometry(s=0, x=1, y=2, heading=0.3, length=50, kind=Kind.CLOTHOID, curvature=0.0)
    s = np.array([0.0, 20.0, 50.0])
    x, y, *_ = ReferenceLine([g]).frame(s, s)
    np.testing.assert_allclose(x, 1 + s * math.cos(0.3))
    np.testing.assert_allclose(y, 2 + s * math.sin(0.3))


def test_parametric_curve_is_measured_by_arc_length():
    # a parabola v = c u^2: arc length in closed form
    c, u_end = 0.01, 60.0
    arc = lambda u: u / 2 * np.sqrt(1 + (2 * c * u) ** 2) + np.arcsinh(2 * c * u) / (4 * c)  # noqa: E731
    length = float(arc(u_end))
    for p_end in (None, 1.0):  # poly3, and the same as normalized paramPoly3
        f = 1.0 if p_end is None else u_end
        g = Geometry(
            s=0,
            x=0,
            y=0,
            heading=0,
            length=length,
            kind=Kind.PARAMETRIC,
            u=(0, f, 0, 0),
            v=(0, 0, c * f**2, 0),
            p_end=p_end,
        )
        s = np.linspace(0, length, 37)
        x, y, heading, curvature, rate = ReferenceLine([g]).frame(s, s)
        np.testing.assert_allclose(arc(x), s, atol=1e-8)
        np.testing.assert_allclose(y, c * x**2, atol=1e-9)
        np.testing.assert_allclose(heading, np.arctan(2 * c * x), atol=1e-9)
        np.testing.assert_allclose(curvature, 2 * c / (1 + (2 * c * x) ** 2) ** 1.5, atol=1e-9)
        np.testing.assert_allclose(rate[1:-1], np.gradient(curvature, s)[1:-1], rtol=2e-2, atol=1e-6)


def test_cubics_take_the_later_of_two_records_at_one_place():
    f = Cubics([(0, 1, 0, 0, 0), (10, 2, 0.5, 0, 0), (10, 3, 0, 0.1, 0)])
    s = np.array([5.0, 10.0, 12.0])
    np.testing.assert_allclose(f(s, s), [1, 3, 3.4])
    np.testing.assert_allclose(f.jet(s, s)[1], [0, 0, 0.4])
    np.testing.assert_allclose(f(np.array([10.0]), np.array([9.0])), [1])  # left limit


def test_lane_on_an_arc_has_its_own_radius_and_length(read):
    k, length = 0.02, 60.0
    network = read(
        road(
            "1",
            [section(0, [lane(1, width=3.0)], [lane(-1), lane(-2, width=2.0)])],
            length=length,
            shape=f'<arc curvature="{k}"/>',
        )
    )
    for number, t in ((1, 1.5), (-1, -1.75), (-2, -4.5)):
        found = network.lane_at("1", number, 10.0)
        radius = 1 / k - t
        assert found.length == pytest.approx(length * radius * k, abs=1e-9)
        turn = 1 if number < 0 else -1  # the left lane runs the other way: it bends right
        np.testing.assert_allclose(found.curvature, turn / radius, rtol=1e-12)
        xyz, heading = found.pose(np.linspace(0, found.length, 50))
        np.testing.assert_allclose(np.hypot(xyz[:, 0], xyz[:, 1] - 1 / k), radius, atol=1e-4)
        away = np.arctan2(xyz[:, 1] - 1 / k, xyz[:, 0])
        np.testing.assert_allclose(np.cos(heading - away - turn * math.pi / 2), 1, atol=1e-8)


def test_lane_with_changing_width_measures_and_heads_along_its_centre(read):
    widths = '<width sOffset="0" a="2" b="0.1"/><width sOffset="40" a="6"/>'
    network = read(road("1", [section(0, [], [lane(-1, inner=widths)])], length=60.0))
    found = network.lane_at("1", -1, 0.0)
    assert found.length == pytest.approx(40 * math.hypot(1, 0.05) + 20, abs=2e-3)
    s = np.array([10.0, 50.0])
    np.testing.assert_allclose(found.pose(s)[1], [-math.atan(0.05), 0.0], atol=1e-9)
    np.testing.assert_allclose(
        found.width_at(found.s_at_road(np.array([0, 20, 40, 55]))), [2, 4, 6, 6], atol=1e-3
    )


def test_borders_define_lanes_and_lane_offset_moves_them(read):
    borders = [
        lane(-1, inner='<border sOffset="0" a="-3"/>'),
        lane(-2, inner='<border sOffset="0" a="-7" b="0.01"/>'),
    ]
    network = read(
        road("1", [section(0, [], borders)], offsets='<laneOffset s="0" a="0.5"/>'),
    )
    xyz, _ = network.lane_at("1", -1, 0).pose(0.0)
    np.testing.assert_allclose(xyz[:2], [0, 0.5 - 1.5], atol=1e-12)
    second = network.lane_at("1", -2, 0)
    np.testing.assert_allclose(second.width[[0, -1]], [4, 3], atol=1e-12)


def test_negative_width_is_zero_and_reported(read):
    network = read(road("1", [section(0, [], [lane(-1, inner='<width sOffset="0" a="1" b="-0.02"/>')])]))
    assert network.lane_at("1", -1, 0).width.min() == 0.0
    (note,) = notes(network, "lane width")
    assert note.action is Action.REPAIRED and "-1.000" in note.message


def test_elevation_is_kept_and_superelevation_reported(read):
    extra = (
        '<elevationProfile><elevation s="0" a="5" b="0.1"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.05"/></lateralProfile>'
    )
    network = read(road("1", [section(0, [], [lane(-1)])], extra=extra))
    np.testing.assert_allclose(network.lane_at("1", -1, 0).pose(50.0)[0][2], 10.0)
    (note,) = notes(network, "superelevation")
    assert "0.050 rad" in note.message and note.line is not None


def test_samples_keep_their_distance(read):
    """Records a hair apart must not leave samples between which headings are noise."""
    widths = "".join(f'<width sOffset="{s}" a="3.5"/>' for s in (0, 30, 30.0000000001, 30.0005, 60))
    network = read(road("1", [section(0, [], [lane(-1, inner=widths)])]))
    found = network.lane_at("1", -1, 0)
    assert np.diff(found.s).min() > 4e-4
    assert found.length == pytest.approx(100.0, abs=1e-12)
