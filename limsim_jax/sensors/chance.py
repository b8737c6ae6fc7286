"""Random numbers of sensors, and pictures of the past: counter-based keys, and a delay."""

from __future__ import annotations

import enum
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

Tree = TypeVar("Tree")


class Purpose(enum.IntEnum):
    """What a random number is for: streams never mix."""

    LIDAR = 0x5E1
    DETECTION = 0x5E2
    FALSE_TRACKS = 0x5E3
    CAMERA_FAULTS = 0x5E4
    DRIFT = 0x5E5


def key_of(key: Key[Array, ""], step: Int[Array, ""] | int, purpose: Purpose) -> Key[Array, ""]:
    """The key of a step and a purpose, from the world's."""
    return jax.random.fold_in(jax.random.fold_in(key, step), int(purpose))


def delay_line(example: Tree, steps: int) -> Tree:
    """A memory for `delayed`, full of copies of the example, `[steps, ...]`."""
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x), (steps, *jnp.shape(x))), example)


def delayed(line: Tree, now: Tree) -> tuple[Tree, Tree]:
    """What went in before, as many calls as the memory is long.

    Returns it and the memory.
    """
    steps = jax.tree.leaves(line)[0].shape[0]
    if steps == 0:
        return now, line
    then = jax.tree.map(lambda old: old[0], line)
    after = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], jnp.asarray(new)[None]]), line, now)
    return then, after


def whole_steps(seconds: float, dt: float, what: str) -> int:
    """Steps in a time.

    Raises:
      ValueError: a negative time, or one that is not a whole number of steps.
    """
    count = round(seconds / dt)
    if not seconds >= 0 or abs(count * dt - seconds) > 1e-6:
        raise ValueError(f"{what}: {seconds} s; expected a multiple of {dt:g} s")
    return count
