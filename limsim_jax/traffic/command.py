"""What a policy asks of its vehicles until the next decision.

A command that is broken is found here, and its vehicle brakes.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Int

from limsim_jax.traffic.ego import Control, Limits, Meta, Trajectory, at_slots
from limsim_jax.types import State, Status


@struct.dataclass(frozen=True, kw_only=True)
class Command:
    """Commands for the egos until the next decision.

    An ego without a command is driven by the traffic model. A free ego follows a trajectory or holds a
    control; without either it rolls on with straight wheels. An ego that keeps to lanes takes meta-actions.
    Where some rows have a trajectory and others a control, `by_control` tells which.
    A row with a number that is not finite, or with an unknown meta-action, is broken: see `without_broken`.
    """

    trajectory: Trajectory | None = None
    control: Control | None = None
    by_control: Bool[Array, " E"] | None = None  # rows that hold the control, although others follow
    meta: Int[Array, " E"] | None = None  # `Meta`, or -1: decide like the traffic
    brake: Bool[Array, " N"] | None = None  # these vehicles, egos or others, brake as hard as they can
    slot: Int[Array, " E"] | None = None  # that each row of `Egos` drives from now on, -1: none
    signal: Int[Array, " E"] | None = None  # turn signal of free egos: +1 left, -1 right; others make way


def without_broken(state: State, command: Command) -> tuple[State, Command, Bool[Array, " E"]]:
    """Find rows that are broken, and clear them.

    Args:
      state: with the egos that the command is for.
      command: of the policy.

    Returns:
      The state, in which the vehicles of broken rows have `Status.NOT_FINITE`; the command with finite
      numbers only; and the broken rows, which the engine brakes with `hold_and_brake`.
    """
    egos = state.egos
    there = state.active[egos.slot] & (egos.slot >= 0)
    broken = jnp.zeros_like(egos.free)
    held = broken if command.by_control is None else command.by_control
    if command.trajectory is not None:
        found = command.trajectory
        samples = {name: getattr(found, name) for name in ("x", "y", "heading", "v")}
        finite = jnp.stack([jnp.isfinite(x).all(-1) for x in samples.values()]).all(0)
        bad = egos.free & ~(finite & jnp.isfinite(found.t0)) & ~held
        stand = {"x": egos.x, "y": egos.y, "heading": egos.heading, "v": jnp.zeros_like(egos.x)}
        samples = {name: jnp.where(bad[:, None], stand[name][:, None], x) for name, x in samples.items()}
        t0 = jnp.where(jnp.isfinite(found.t0), found.t0, 0)
        command = replace(command, trajectory=replace(found, t0=t0, **samples))
        broken |= bad
    if command.control is not None:
        a, steering = command.control.acceleration, command.control.steering
        bad = egos.free & ~(jnp.isfinite(a) & jnp.isfinite(steering))
        bad &= held | (command.trajectory is None)
        control = Control(acceleration=jnp.where(bad, 0, a), steering=jnp.where(bad, 0, steering))
        command = replace(command, control=control)
        broken |= bad
    if command.meta is not None:
        bad = ~egos.free & ((command.meta < -1) | (command.meta > max(Meta)))
        command = replace(command, meta=jnp.where(bad, int(Meta.STOP), command.meta))
        broken |= bad
    broken &= there
    return _marked(state, broken), command, broken


def hold_and_brake(
    limits: Limits, state: State, control: Control, broken: Bool[Array, " E"]
) -> tuple[State, Control]:
    """The control of free egos; those that are broken brake fully.

    Their steering is held. A control that is not finite, as from a trajectory of huge numbers, is broken
    as well.

    Returns:
      The state, in which these vehicles have `Status.NOT_FINITE`, and the control.
    """
    egos = state.egos
    finite = jnp.isfinite(control.acceleration) & jnp.isfinite(control.steering)
    broken = broken | (egos.free & state.active[egos.slot] & ~finite)
    held = Control(
        acceleration=jnp.where(broken | ~finite, -limits.deceleration, control.acceleration),
        steering=jnp.where(broken | ~finite, egos.steering, control.steering),
    )
    return _marked(state, broken), held


def _marked(state: State, broken: Bool[Array, " E"]) -> State:
    mark = jnp.where(broken, int(Status.NOT_FINITE), 0)
    bits = at_slots(state.egos, mark, jnp.zeros_like(state.status), broken)
    return replace(state, status=state.status | bits)
