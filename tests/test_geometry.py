"""Geometry: against NumPy, closed forms and linear programming."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from limsim_jax import geometry


def random_boxes(rng, count):
    return np.stack(
        [
            rng.uniform(-5, 5, count),
            rng.uniform(-5, 5, count),
            rng.uniform(-4, 4, count),
            rng.uniform(1, 8, count),
            rng.uniform(0.5, 3, count),
        ],
        -1,
    ).astype(np.float32)


def half_planes(box):
    """A, b with A p <= b exactly for the points p of the box."""
    x, y, heading, length, width = (float(v) for v in box)
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    normals = np.array([ahead, -ahead, left, -left])
    return normals, normals @ [x, y] + np.array([length, length, width, width]) / 2


def depth_by_linear_program(a, b):
    """By how much all sides of both boxes can be moved in (m, negative: out) before no point is shared."""
    (na, ba), (nb, bb) = half_planes(a), half_planes(b)
    rows = np.c_[np.r_[na, nb], np.ones(8)]
    return linprog([0, 0, -1], A_ub=rows, b_ub=np.r_[ba, bb], bounds=[(None, None)] * 3).x[2]


def test_wrap_angle_keeps_the_direction_and_has_unit_gradient():
    angle = np.linspace(-20, 20, 4001)
    wrapped = np.asarray(geometry.wrap_angle(jnp.asarray(angle, jnp.float32)))
    assert np.abs(wrapped).max() <= np.pi + 1e-6
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=5e-6)
    grad = jax.vmap(jax.grad(geometry.wrap_angle))(jnp.array([-np.pi, 0.0, np.pi, 9.0]))
    np.testing.assert_array_equal(grad, 1.0)


def test_direction_is_arctan2_and_safe_at_zero():
    dx, dy = np.random.default_rng(0).normal(size=(2, 100)).astype(np.float32)
    np.testing.assert_allclose(
        geometry.direction(jnp.array(dx), jnp.array(dy)), np.arctan2(dy, dx), rtol=1e-5
    )
    value, grad = jax.value_and_grad(geometry.direction, argnums=(0, 1))(0.0, 0.0)
    assert value == 0
    assert grad == (0, 0)
    along_y = jax.grad(geometry.direction, argnums=(0, 1))(0.0, 2.0)
    np.testing.assert_allclose(along_y, (-0.5, 0.0))


def test_polynomial_and_derivative_equal_numpy():
    coefficients = [2.0, -1.0, 0.5, 3.0]
    u = jnp.linspace(-2.0, 2.0, 9)
    np.testing.assert_allclose(
        geometry.polynomial([jnp.float32(c) for c in coefficients], u),
        np.polynomial.Polynomial(coefficients)(np.asarray(u)),
        rtol=1e-6,
    )
    assert geometry.derivative(coefficients) == list(np.polynomial.Polynomial(coefficients).deriv().coef)


def test_box_corners_run_counter_clockwise_from_the_front_left():
    corners = np.asarray(geometry.box_corners(jnp.array([10.0, 20.0, np.pi / 2, 4.0, 2.0])))
    np.testing.assert_allclose(corners, [[9, 22], [9, 18], [11, 18], [11, 22]], atol=1e-5)
    x, y = corners.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    np.testing.assert_allclose(area, 8.0, rtol=1e-5)


def test_boxes_overlap_exactly_when_a_common_point_exists():
    rng = np.random.default_rng(1)
    a, b = random_boxes(rng, 200), random_boxes(rng, 200)
    depth = np.array([depth_by_linear_program(p, q) for p, q in zip(a, b, strict=True)])
    clear = np.abs(depth) > 1e-4
    ours = np.asarray(jax.vmap(geometry.boxes_overlap)(jnp.array(a), jnp.array(b)))
    np.testing.assert_array_equal(ours[clear], depth[clear] >= 0)
    assert 30 < ours.sum() < 170  # both answers occur


def test_box_separation_of_aligned_boxes_is_the_gap():
    a = jnp.array([0.0, 0.0, 0.0, 4.0, 2.0])
    np.testing.assert_allclose(geometry.box_separation(a, jnp.array([7.0, 0.5, 0.0, 4.0, 2.0])), 3.0)
    np.testing.assert_allclose(geometry.box_separation(a, jnp.array([3.5, 0.5, 0.0, 4.0, 2.0])), -0.5)
    np.testing.assert_allclose(
        geometry.box_separation(a, jnp.array([0.0, 5.0, np.pi / 2, 4.0, 2.0])), 2.0, rtol=1e-6
    )


@pytest.mark.engine
def test_box_separation_parts_the_boxes_and_is_symmetric():
    """Moved apart by its depth along the best axis, no overlap is left; moved by less, some is."""
    rng = np.random.default_rng(2)
    for a, b in zip(random_boxes(rng, 60), random_boxes(rng, 60), strict=True):
        gap = float(geometry.box_separation(jnp.array(a), jnp.array(b)))
        np.testing.assert_allclose(gap, geometry.box_separation(jnp.array(b), jnp.array(a)), atol=1e-5)
        if gap >= 0:
            continue
        axes = np.concatenate([half_planes(a)[0], half_planes(b)[0]])
        depths = []
        for scale in (0.999, 1.001):
            moved = [np.r_[b[:2] - scale * gap * axis, b[2:]] for axis in axes]
            depths.append(min(depth_by_linear_program(a, box) for box in moved))
        assert depths[0] > 0 > depths[1]


@pytest.mark.engine
def test_box_separation_gradient_is_finite_and_right():
    a, b = random_boxes(np.random.default_rng(3), 2)
    with jax.enable_x64(True):
        a, b = jnp.asarray(a, jnp.float64), jnp.asarray(b, jnp.float64)
        grad = jax.grad(geometry.box_separation, argnums=1)(a, b)
        for i in range(5):
            step = np.zeros(5)
            step[i] = 1e-6
            central = (geometry.box_separation(a, b + step) - geometry.box_separation(a, b - step)) / 2e-6
            np.testing.assert_allclose(grad[i], central, atol=1e-7)
    same = jnp.array([1.0, 2.0, 0.3, 4.0, 2.0])
    assert np.isfinite(jax.grad(geometry.box_separation)(same, same)).all()
