"""Arithmetic with finite values and finite gradients at its singular points.

Each function masks the input as well as the output: a gradient through the untaken branch of a single
`where` is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Axis = int | Sequence[int] | None


def safe_divide(
    numerator: Float[Array, "*#b"], denominator: Float[Array, "*#b"], default: float = 0.0
) -> Float[Array, "*#b"]:
    """The quotient, and `default` with zero gradient where the denominator is 0."""
    zero = denominator == 0
    return jnp.where(zero, default, numerator / jnp.where(zero, 1, denominator))


def safe_sqrt(x: Float[Array, "*#b"]) -> Float[Array, "*#b"]:
    """Square root, and 0 with zero gradient where `x <= 0`."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_norm(x: Float[Array, ...], axis: Axis = -1) -> Float[Array, ...]:
    """Euclidean norm over `axis`; zero vectors have norm 0 and zero gradient."""
    return safe_sqrt(jnp.sum(x * x, axis=_axes(axis)))


def masked_sum(x: Float[Array, "*#b"], mask: Bool[Array, "*#b"], axis: Axis = None) -> Float[Array, ...]:
    """Sum of `x` where `mask`; masked entries may be NaN and get zero gradient."""
    return jnp.sum(jnp.where(mask, x, 0), axis=_axes(axis))


def masked_mean(
    x: Float[Array, "*#b"], mask: Bool[Array, "*#b"], axis: Axis = None, default: float = 0.0
) -> Float[Array, ...]:
    """Mean of `x` where `mask`, and `default` where nothing is; masked entries may be NaN."""
    count = jnp.sum(mask, axis=_axes(axis), dtype=x.dtype)
    return safe_divide(masked_sum(x, mask, axis), count, default)


def masked_max(
    x: Float[Array, "*#b"], mask: Bool[Array, "*#b"], axis: Axis = None, default: float = -jnp.inf
) -> Float[Array, ...]:
    """Maximum of `x` where `mask`, and `default` where nothing is; masked entries may be NaN."""
    found = jnp.max(jnp.where(mask, x, -jnp.inf), axis=_axes(axis))
    return jnp.where(jnp.any(mask, axis=_axes(axis)), found, default)


def masked_min(
    x: Float[Array, "*#b"], mask: Bool[Array, "*#b"], axis: Axis = None, default: float = jnp.inf
) -> Float[Array, ...]:
    """Minimum of `x` where `mask`, and `default` where nothing is; masked entries may be NaN."""
    return -masked_max(-x, mask, axis, -default)


def _axes(axis: Axis) -> int | tuple[int, ...] | None:
    return axis if axis is None or isinstance(axis, int) else tuple(axis)


__all__ = ["masked_max", "masked_mean", "masked_min", "masked_sum", "safe_divide", "safe_norm", "safe_sqrt"]
