"""Recorded traffic as chains of followers, and their simulation behind one another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import Segment, segments
from limsim_jax.calibration.fit import driver
from limsim_jax.recordings import RecordingError, Source, as_recording
from limsim_jax.traffic.car_following import CarFollowing, ballistic

PERIOD = 60.0
"""s, after which all vehicles are put where they were recorded."""

SETTLE = 5.0
"""s after the start or entry of a vehicle that do not count: it is where it was recorded."""

SLICE = 15.0
"""s of a chain of vehicles that make one point of the fundamental diagram."""

_SHORT = 1.0  # s, shorter segments are left out
_EVERY = 1.0  # s between the samples of a vehicle that are compared

Floats = NDArray[np.float64]


class Chains(NamedTuple):
    """Followers behind one another: `W` periods, `T` steps, `V` vehicles; or `[T, V]`.

    Where a row does not follow, all its numbers are harmless.
    """

    gap: Float[Array, "*W T V"]  # m, bumper to bumper
    v: Float[Array, "*W T V"]  # m/s
    v_lead: Float[Array, "*W T V"]  # m/s
    a_lead: Float[Array, "*W T V"]  # m/s^2, of the step before
    length_lead: Float[Array, "*W T V"]  # m
    leader: Int[Array, "*W T V"]  # row of the leader, -1 if it is not simulated in this period
    follows: Bool[Array, "*W T V"]
    fresh: Bool[Array, "*W T V"]  # begins to follow this leader


class Linked(NamedTuple):
    """Recorded traffic as chains."""

    chains: Chains  # [W T V]
    drivers: tuple[str, ...]  # [D]
    who: NDArray[np.int64]  # [W V], driver of the row
    periods: tuple[str, ...]  # names, [W]
    sources: tuple[str, ...]  # files, [W]
    spans: NDArray[np.float64]  # s, [W 2], begin and end in the time of the file
    dt: float  # s
    counts: NDArray[np.bool_]  # [W T V], what is compared
    slice: NDArray[np.int64]  # [W T V], which point of the fundamental diagram it belongs to

    def part(self, periods: Sequence[int]) -> Linked:
        """Some of the periods."""
        at = np.asarray(periods)
        return self._replace(
            chains=jax.tree.map(lambda x: x[at], self.chains),
            who=self.who[at],
            periods=tuple(self.periods[k] for k in periods),
            sources=tuple(self.sources[k] for k in periods),
            spans=self.spans[at],
            counts=self.counts[at],
            slice=self.slice[at],
        )


def link(found: Sequence[Segment], *, period: float = PERIOD, settle: float = SETTLE) -> Linked:
    """Chains of followers.

    Args:
      found: segments of one or more recordings, of `cleaning.segments(..., margins=False)`; a segment's
        leader is simulated where it is the driver of another segment of the same source.
      period: s, see `PERIOD`.
      settle: s, see `SETTLE`; at most a quarter of a period.

    Raises:
      ValueError: no segments, or their time steps differ.
    """
    steps = sorted({segment.dt for segment in found})
    if len(steps) != 1:
        raise ValueError(
            f"segments in steps of {', '.join(f'{dt:g}' for dt in steps)} s; one is needed"
            if found
            else "no segments; recorded followers are needed to build chains from"
        )
    dt = steps[0]
    length = round(period / dt)
    names = sorted({(segment.source, segment.driver) for segment in found})
    index = {name: i for i, name in enumerate(names)}
    begins = {s: min(x.time for x in found if x.source == s) for s in {x.source for x in found}}
    # Pieces of segments by source and period: piece, first step within the period.
    windows: dict[tuple[str, int], list[tuple[Segment, int]]] = {}
    for segment in sorted(found, key=lambda x: (x.source, x.driver, x.time)):
        first = round((segment.time - begins[segment.source]) / dt)
        at = 0
        while at < len(segment):
            window, offset = divmod(first + at, length)
            end = min(at + length - offset, len(segment))
            windows.setdefault((segment.source, window), []).append((segment.part(at, end), offset))
            at = end
    wide = max(len({piece.driver for piece, _ in pieces}) for pieces in windows.values())
    who = np.zeros((len(windows), wide), np.int64)
    parts, spans = [], []
    for k, ((source, window), pieces) in enumerate(sorted(windows.items())):
        rows = {name: i for i, name in enumerate(dict.fromkeys(piece.driver for piece, _ in pieces))}
        who[k, : len(rows)] = [index[source, name] for name in rows]
        parts.append(_window(pieces, rows, (length, wide), dt))
        spans.append((begins[source] + window * period, begins[source] + (window + 1) * period))
    chains = Chains(*(np.stack(leaves) for leaves in zip(*parts, strict=True)))  # pyright: ignore[reportArgumentType]
    counts, point = _samples(chains, dt, min(settle, period / 4))
    if not counts.any():
        raise ValueError(
            f"no vehicle follows for longer than {min(settle, period / 4):g} s; a shorter 'settle' is needed"
        )
    sources = tuple(source for source, _ in sorted(windows))
    periods = tuple(f"{Path(source).name.split('.')[0]} {k * period:g} s" for source, k in sorted(windows))
    linked = Linked(
        chains, tuple(name for _, name in names), who, periods, sources, np.array(spans), dt, counts, point
    )
    return linked.part(np.flatnonzero(counts.any(axis=(1, 2))).tolist())


def _window(
    pieces: list[tuple[Segment, int]], rows: Mapping[str, int], shape: tuple[int, int], dt: float
) -> Chains:
    """One period, `[T V]`; a follower without a segment is at rest 10 m behind a leader at rest."""
    values: dict[str, Any] = {name: np.zeros(shape, np.float32) for name in Chains._fields[:5]}
    values["gap"] += 10
    values["length_lead"] += 4.5
    leader = np.full(shape, -1, np.int32)
    follows, fresh = np.zeros(shape, bool), np.zeros(shape, bool)
    for piece, offset in pieces:
        i, there = rows[piece.driver], slice(offset, offset + len(piece))
        values["gap"][there, i], values["v"][there, i] = piece.gap, piece.v
        values["v_lead"][there, i] = piece.v_lead
        if len(piece) > 1:
            first = 2 * piece.v_lead[0] - piece.v_lead[1]
            values["a_lead"][there, i] = np.diff(piece.v_lead, prepend=first) / dt
        values["length_lead"][there, i] = piece.length_lead
        leader[there, i] = rows.get(piece.leader, -1)
        follows[there, i] = True
        fresh[offset, i] = True
    return Chains(**values, leader=leader, follows=follows, fresh=fresh)  # pyright: ignore[reportArgumentType]


def _samples(chains: Chains, dt: float, settle: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which samples are compared, and their points of the fundamental diagram."""
    follows = np.asarray(chains.follows)
    count, length, _ = follows.shape
    step = np.arange(length)[None, :, None]
    # steps since the vehicle was put where it was recorded
    begin = follows & ~np.concatenate([np.zeros_like(follows[:, :1]), follows[:, :-1]], axis=1)
    since = step - np.maximum.accumulate(np.where(begin, step, 0), axis=1)
    counts = follows & (since * dt >= settle - 1e-6) & (step % max(round(_EVERY / dt), 1) == 0)
    slices = math.ceil(length * dt / SLICE)
    point = np.arange(count)[:, None, None] * slices + (step * dt / SLICE).astype(int)
    return counts, np.broadcast_to(point, follows.shape)


def linked_recordings(
    sources: Sequence[Source], *, period: float = PERIOD, settle: float = SETTLE, dt: float = 0.1
) -> Linked:
    """Chains of all recordings but those that cannot be used.

    Raises:
      RecordingError: none can.
    """
    found: list[Segment] = []
    refused: list[RecordingError] = []
    for source in sources:
        try:
            found += segments(as_recording(source), dt=dt, shortest=_SHORT, margins=False)[0]
        except RecordingError as error:
            refused.append(error)
    if refused and not found:
        raise refused[0]
    return link(found, period=period, settle=settle)


def simulate(
    model: CarFollowing, parameters: Float[Array, "V P"], chains: Chains, dt: float
) -> tuple[Float[Array, "T V"], Float[Array, "T V"]]:
    """Gap, m, and speed, m/s, of followers behind one another.

    A vehicle starts at its recorded speed and place; from then on it is `u` metres ahead of its record.
    When it gets another leader, its gap is the recorded one and what both are ahead.

    Args:
      model: of car following.
      parameters: of the driver in each row, in the order of `PARAMETERS`.
      chains: of one period, `[T V]`.
      dt: s.
    """
    who, v0 = driver(parameters.T)

    def onward(x: Array) -> Array:
        return jnp.concatenate([x[1:], x[-1:]])

    class Carry(NamedTuple):
        gap: Array
        v: Array
        a: Array  # of the step before
        u: Array
        follows: Array

    @jax.checkpoint
    def step(carry: Carry, now: tuple[Chains, Array, Array, Array]) -> tuple[Carry, tuple[Array, Array]]:
        at, v_next, v_lead_next, stays = now
        lead = at.leader
        v = jnp.where(at.follows & carry.follows, carry.v, at.v)
        known = (lead >= 0) & at.follows[lead]
        ahead = jnp.where(lead >= 0, carry.u[lead], 0)
        gap = jnp.where(at.fresh, at.gap + ahead - carry.u, carry.gap)
        v_lead = jnp.where(known, v[lead], at.v_lead)
        a_lead = jnp.where(known & carry.follows[lead], carry.a[lead], at.a_lead)
        a = model(who, gap=gap, v=v, v_lead=v_lead, a_lead=a_lead, v0=v0)
        v_new, distance = ballistic(v, a, dt)
        of_leader = jnp.where(known, distance[lead], 0.5 * dt * (at.v_lead + v_lead_next))
        u = carry.u + jnp.where(stays, distance - 0.5 * dt * (at.v + v_next), 0)
        new = Carry(gap + of_leader - distance, v_new, (v_new - v) / dt, u, at.follows)
        return new, (gap, v)

    zero = jnp.zeros_like(v0)
    first = Carry(chains.gap[0] + zero, chains.v[0] + zero, zero, zero, jnp.zeros_like(chains.follows[0]))
    stays = chains.follows & onward(chains.follows)
    return jax.lax.scan(step, first, (chains, onward(chains.v), onward(chains.v_lead), stays))[1]


__all__ = ["PERIOD", "SETTLE", "SLICE", "Chains", "Linked", "link", "linked_recordings", "simulate"]
