"""Reductions that a scan carries instead of a trace: means, extremes, episodes.

Each starts empty, takes one sample a step and ends as a `Measured`: a finite number and its validity.
Samples that are masked out may be NaN.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.numerics import safe_divide


class Measured(NamedTuple):
    """A number and its validity; 0 where it is not valid."""

    value: Float[Array, "*b"]
    valid: Bool[Array, "*b"]


def measured(value: Float[Array, "*b"], valid: Bool[Array, "*b"] | bool = True) -> Measured:
    """`value` where `valid`, 0 elsewhere."""
    valid = jnp.broadcast_to(jnp.asarray(valid), value.shape)
    return Measured(jnp.where(valid, value, 0), valid)


def on_host(results: dict[str, Measured]) -> dict[str, Any]:
    """NumPy copies for a table: floats for one world, arrays for a batch; None or NaN where invalid."""
    row: dict[str, Any] = {}
    for name, (value, valid) in results.items():
        number = np.where(np.asarray(valid), np.asarray(value, np.float64), np.nan)
        row[name] = number if number.ndim else (float(number) if valid else None)
    return row


class Mean(NamedTuple):
    """Mean of the samples so far."""

    total: Float[Array, "*b"]
    weight: Float[Array, "*b"]  # how many

    @classmethod
    def empty(cls, *shape: int) -> Mean:
        """Of no samples."""
        return cls(jnp.zeros(shape), jnp.zeros(shape))

    def add(self, x: Float[Array, "*b"], where: Bool[Array, "*b"]) -> Mean:
        """One more sample, if `where`."""
        return Mean(self.total + jnp.where(where, x, 0), self.weight + where.astype(self.weight.dtype))

    def result(self) -> Measured:
        """The mean; invalid without samples."""
        return measured(safe_divide(self.total, self.weight), self.weight > 0)


class Least(NamedTuple):
    """The least sample so far and its first time; negate samples for the greatest."""

    value: Float[Array, "*b"]
    time: Float[Array, "*b"]  # s
    found: Bool[Array, "*b"]

    @classmethod
    def empty(cls, *shape: int) -> Least:
        """Of no samples."""
        return cls(jnp.zeros(shape), jnp.zeros(shape), jnp.zeros(shape, bool))

    def add(self, x: Float[Array, "*b"], t: Float[Array, "*b"], where: Bool[Array, "*b"]) -> Least:
        """One more sample at time `t`, if `where`."""
        better = where & (~self.found | (x < self.value))
        return Least(jnp.where(better, x, self.value), jnp.where(better, t, self.time), self.found | where)

    def result(self) -> Measured:
        """The least; invalid without samples."""
        return measured(self.value, self.found)

    def when(self) -> Measured:
        """The time of the least, s."""
        return measured(self.time, self.found)


class LeastWith(NamedTuple):
    """The least sample so far, and the vehicle that it is with."""

    least: Least
    slot: Int[Array, "*b"]  # of that vehicle, -1: none

    @classmethod
    def empty(cls) -> LeastWith:
        """Of no samples."""
        return cls(Least.empty(), jnp.int32(-1))

    def add(self, x: Float[Array, ""], t: Float[Array, ""], where: Bool[Array, ""], slot: Array) -> LeastWith:
        """One more sample at time `t` with a vehicle, if `where`."""
        better = where & (~self.least.found | (x < self.least.value))
        return LeastWith(self.least.add(x, t, where), jnp.where(better, slot, self.slot))

    def other(self) -> Measured:
        """The slot."""
        return measured(self.slot.astype(self.least.value.dtype), self.least.found)


class Episodes(NamedTuple):
    """Counts how often a condition began: between `ends` and the next `begins` it goes on.

    Two conditions instead of one give hysteresis: a quantity that oscillates about a threshold counts once.
    """

    number: Int[Array, "*b"]
    inside: Bool[Array, "*b"]

    @classmethod
    def empty(cls, *shape: int) -> Episodes:
        """Nothing has begun."""
        return cls(jnp.zeros(shape, jnp.int32), jnp.zeros(shape, bool))

    def add(self, begins: Bool[Array, "*b"], ends: Bool[Array, "*b"]) -> Episodes:
        """One more step. If both hold, it goes on."""
        return Episodes(
            self.number + (begins & ~self.inside).astype(jnp.int32), begins | (self.inside & ~ends)
        )
