"""Numerics: values against NumPy, gradients at the singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax import numerics

X = np.array([[-3.0, -1.0, np.nan], [0.5, 2.0, 7.0], [1.0, -4.0, 6.0]], np.float32)
MASK = np.array([[True, True, False], [False, False, False], [True, False, True]])


def test_safe_divide_divides_and_defaults():
    value = numerics.safe_divide(jnp.array([6.0, 6.0]), jnp.array([4.0, 0.0]), default=9.0)
    np.testing.assert_array_equal(value, [1.5, 9.0])


def test_safe_divide_gradient_is_right_and_zero_at_zero():
    grad = jax.vmap(jax.grad(numerics.safe_divide, argnums=(0, 1)))
    top, bottom = grad(jnp.array([6.0, 6.0, 0.0]), jnp.array([4.0, 0.0, 0.0]))
    np.testing.assert_allclose(top, [0.25, 0.0, 0.0])
    np.testing.assert_allclose(bottom, [-6 / 16, 0.0, 0.0])


def test_safe_norm_takes_rows_apart_and_has_zero_gradient_at_zero():
    x = jnp.array([[3.0, 4.0], [0.0, 0.0]])
    np.testing.assert_allclose(numerics.safe_norm(x), [5.0, 0.0])
    np.testing.assert_allclose(numerics.safe_norm(x, axis=0), [3.0, 4.0])
    np.testing.assert_allclose(numerics.safe_norm(x, axis=(0, 1)), 5.0)
    grad = jax.grad(lambda v: jnp.sum(numerics.safe_norm(v)))(x)
    np.testing.assert_allclose(grad, [[0.6, 0.8], [0.0, 0.0]], rtol=1e-6)


def test_safe_sqrt_is_zero_with_zero_gradient_where_not_positive():
    value, grad = jax.vmap(jax.value_and_grad(numerics.safe_sqrt))(jnp.array([-1.0, 0.0, 4.0]))
    np.testing.assert_allclose(value, [0.0, 0.0, 2.0])
    np.testing.assert_allclose(grad, [0.0, 0.0, 0.25])


@pytest.mark.parametrize(
    ("ours", "theirs", "empty"),
    [
        (numerics.masked_sum, np.sum, 0.0),
        (numerics.masked_mean, np.mean, 0.0),
        (numerics.masked_max, np.max, -np.inf),
        (numerics.masked_min, np.min, np.inf),
    ],
)
def test_masked_reductions_equal_numpy_on_what_is_left(ours, theirs, empty):
    rows = [float(theirs(row[mask])) if mask.any() else empty for row, mask in zip(X, MASK, strict=True)]
    np.testing.assert_allclose(ours(jnp.array(X), jnp.array(MASK), axis=1), rows, rtol=1e-6)
    np.testing.assert_allclose(ours(jnp.array(X), jnp.array(MASK)), theirs(X[MASK]), rtol=1e-6)


@pytest.mark.parametrize(
    "reduction", [numerics.masked_sum, numerics.masked_mean, numerics.masked_max, numerics.masked_min]
)
def test_masked_reductions_have_no_gradient_where_masked(reduction):
    def loss(x):
        rows = reduction(x, jnp.array(MASK), axis=1)
        return jnp.sum(rows, where=jnp.isfinite(rows))

    grad = np.asarray(jax.grad(loss)(jnp.array(X)))
    assert np.isfinite(grad).all()
    assert (grad[~MASK] == 0).all()
    assert (grad[[0, 2]] != 0).any(axis=1).all()


def test_masked_defaults_replace_only_empty_rows():
    value = numerics.masked_min(jnp.array(X), jnp.array(MASK), axis=1, default=42.0)
    np.testing.assert_allclose(value, [-3.0, 42.0, 1.0])
    value = numerics.masked_mean(jnp.array(X), jnp.array(MASK), axis=1, default=42.0)
    np.testing.assert_allclose(value, [-2.0, 42.0, 3.5])
