"""Scores of perception against the truth: detection, tracking, prediction.

Pure functions of an episode's arrays, `T` looks with `D` entries and `K` bodies; `vmap` makes the batch. A
score is NaN where there is nothing to judge.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import Box, box_corners
from limsim_jax.sensors.objects import Objects
from limsim_jax.sensors.scene import Bodies

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Distances between centres within which a detection is right, m (nuScenes; Caesar et al. 2020)."""

MATCH = 2.0
"""Distance between centres within which a track is right, m (nuScenes tracking)."""

MISS = 2.0
"""A prediction whose end is further off is a miss, m (nuScenes, Argoverse)."""

_RECALLS = 101  # points of the precision curve (nuScenes)
_LEAST_RECALL, _LEAST_PRECISION = 0.1, 0.1  # parts of the curve below are noise (nuScenes)
_TOUCH = 1e-4  # m: borders this close count as one
_KEPT, _APART = -1e4, 1e4  # costs of pairs that stay together, and of those that may not match


class Boxes(NamedTuple):
    """Boxes of one look, or `[T, ...]` of many, in one frame."""

    there: Bool[Array, " D"]
    id: Int[Array, " D"]  # of the track or the vehicle
    x: Float[Array, " D"]  # m
    y: Float[Array, " D"]
    heading: Float[Array, " D"]  # rad
    length: Float[Array, " D"]  # m
    width: Float[Array, " D"]
    score: Float[Array, " D"]  # confidence; of the truth 1


class Tracking(NamedTuple):
    """CLEAR MOT of an episode (Bernardin, Stiefelhagen 2008)."""

    mota: Float[Array, ""]  # 1 - (misses + false + switches) / bodies
    motp: Float[Array, ""]  # m, mean distance of matches
    misses: Int[Array, ""]
    false: Int[Array, ""]
    switches: Int[Array, ""]
    bodies: Int[Array, ""]


class Prediction(NamedTuple):
    """How far predictions are from what happened."""

    ade: Float[Array, ""]  # m, mean distance of the best mode
    fde: Float[Array, ""]  # m, distance of the best end
    miss_rate: Float[Array, ""]  # share of vehicles whose best end is further off than the bound


def boxes_of(what: Objects | Bodies) -> Boxes:
    """The boxes of an object list, or of the vehicles among bodies."""
    columns = {name: getattr(what, name) for name in ("x", "y", "heading", "length", "width")}
    if isinstance(what, Bodies):
        there, score = what.there & (what.slot >= 0), jnp.ones_like(what.x)
        return Boxes(there=there, id=what.slot, score=score, **columns)
    return Boxes(there=what.there, id=what.id, score=what.score, **columns)


def within(boxes: Boxes, reach: float) -> Boxes:
    """The boxes whose centres are within a distance (m) of the origin."""
    return boxes._replace(there=boxes.there & (jnp.hypot(boxes.x, boxes.y) <= reach))


# --- detection ---------------------------------------------------------------------------------------


def average_precision(
    found: Boxes,
    truth: Boxes,
    *,
    distance: float | Float[Array, ""] | None = None,
    iou: float | Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """Average precision of an episode, by nuScenes' rules.

    In every look detections are matched by falling score, each to the nearest body that is free, or to that
    with the largest intersection over union. The precision at 101 recalls is averaged above a recall and
    a precision of 0.1.

    Args:
      found: detections `[T, D]`.
      truth: bodies `[T, K]`.
      distance: m between centres within which a match is right.
      iou: intersection over union from which a match is right.

    Raises:
      ValueError: both or none of `distance` and `iou`.
    """
    if (distance is None) == (iou is None):
        raise ValueError("average_precision: expected either a distance or an iou")

    def look(found: Boxes, truth: Boxes) -> Bool[Array, " D"]:
        if iou is None:
            assert distance is not None
            return right_detections(found, truth, distances(found, truth), distance)
        return right_detections(found, truth, -overlaps(found, truth), -iou)

    right = jax.vmap(look)(found, truth).reshape(-1)
    there, score = found.there.reshape(-1), found.score.reshape(-1)
    bodies = truth.there.sum(dtype=jnp.float32)
    order = jnp.argsort(jnp.where(there, -score, jnp.inf), stable=True)
    hits = jnp.cumsum(right[order].astype(jnp.float32))
    listed = jnp.cumsum(there[order].astype(jnp.float32))
    precision, recall = hits / jnp.maximum(listed, 1), hits / jnp.maximum(bodies, 1)
    grid = jnp.linspace(0, 1, _RECALLS, dtype=jnp.float32)
    curve = jnp.interp(grid, recall, precision, right=0.0)
    first = round(_LEAST_RECALL * (_RECALLS - 1)) + 1
    score = jnp.maximum(curve[first:] - _LEAST_PRECISION, 0).mean() / (1 - _LEAST_PRECISION)
    return jnp.where(bodies > 0, jnp.where(hits[-1] > 0, score, 0.0), jnp.nan)


def right_detections(
    found: Boxes, truth: Boxes, cost: Float[Array, "D K"], most: float | Array
) -> Bool[Array, " D"]:
    """Detections of a look that match a body, by falling score."""

    def match(free: Array, k: Array) -> tuple[Array, Array]:
        own = jnp.where(free, cost[k], jnp.inf)
        best = jnp.argmin(own)
        right = found.there[k] & (own[best] <= most)
        return free & ~(right & (jnp.arange(free.shape[0]) == best)), right

    order = jnp.argsort(jnp.where(found.there, -found.score, jnp.inf), stable=True)
    _, right = lax.scan(match, truth.there, order)
    return jnp.zeros_like(found.there).at[order].set(right)


def distances(found: Boxes, truth: Boxes) -> Float[Array, "D K"]:
    """Distances between centres, m."""
    return jnp.hypot(found.x[:, None] - truth.x[None], found.y[:, None] - truth.y[None])


def overlaps(found: Boxes, truth: Boxes) -> Float[Array, "D K"]:
    """Intersection over union of each detection with each body, from above."""

    def boxes(of: Boxes) -> Float[Array, "D 5"]:
        return jnp.stack([of.x, of.y, of.heading, of.length, of.width], -1)

    return jax.vmap(jax.vmap(intersection_over_union, (None, 0)), (0, None))(boxes(found), boxes(truth))


def intersection_over_union(a: Box, b: Box) -> Float[Array, ""]:
    """Intersection over union of two boxes.

    The area is an integral along its border (Green's theorem): the parts of the sides of each box that lie in
    the other one. Sides that coincide count once.
    """
    middle = a[:2]
    one = box_corners(jnp.concatenate([a[:2] - middle, a[2:]]))
    two = box_corners(jnp.concatenate([b[:2] - middle, b[2:]]))
    common = jnp.maximum(_border(one, two, _TOUCH) + _border(two, one, -_TOUCH), 0)
    return common / (a[3] * a[4] + b[3] * b[4] - common)


def _border(corners: Float[Array, "4 2"], other: Float[Array, "4 2"], beyond: float) -> Float[Array, ""]:
    """Area integral along the sides of a polygon within another.

    Both are counter-clockwise. Sides that are `beyond` m outside count as within.
    """
    way, sides = jnp.roll(corners, -1, 0) - corners, jnp.roll(other, -1, 0) - other
    unit = sides / jnp.hypot(sides[:, :1], sides[:, 1:])
    offset = corners[:, None] - other[None]
    # a point at share t of a side is within a half plane where depth + t slope >= -beyond
    depth = unit[None, :, 0] * offset[..., 1] - unit[None, :, 1] * offset[..., 0] + beyond
    slope = unit[None, :, 0] * way[:, None, 1] - unit[None, :, 1] * way[:, None, 0]
    level = jnp.abs(slope) < 1e-9
    at = -depth / jnp.where(level, 1, slope)
    first = jnp.where(level, jnp.where(depth >= 0, -jnp.inf, jnp.inf), jnp.where(slope > 0, at, -jnp.inf))
    last = jnp.where(level, jnp.inf, jnp.where(slope > 0, jnp.inf, at))
    start, end = jnp.maximum(first.max(-1), 0), jnp.minimum(last.min(-1), 1)
    length = jnp.maximum(end - start, 0)
    cross = corners[:, 0] * way[:, 1] - corners[:, 1] * way[:, 0]
    return (cross * length).sum() / 2


# --- tracking ----------------------------------------------------------------------------------------


def clear_mot(found: Boxes, truth: Boxes, vehicles: int, *, most: float = MATCH) -> Tracking:
    """Multiple object tracking accuracy and precision of an episode.

    A pair stays together while it is within the bound; the others are matched with the least sum of distances
    (Kuhn 1955). A switch is a body whose track is another than that of its last match.

    Args:
      found: tracks `[T, D]` by `id`.
      truth: bodies `[T, K]`; each `id` is within 0 and `vehicles - 1`.
      vehicles: how many there are.
      most: m between centres.
    """
    from optax.assignment import hungarian_algorithm

    nobody = jnp.iinfo(jnp.int32).min

    def look(last: Array, boxes: tuple[Boxes, Boxes]) -> tuple[Array, tuple[Array, ...]]:
        found, truth = boxes
        away = distances(found, truth)
        may = found.there[:, None] & truth.there[None] & (away <= most)
        before = last[jnp.where(truth.there, truth.id, 0)]
        kept = may & (before[None] == found.id[:, None])
        cost = jnp.where(may, away + jnp.where(kept, _KEPT, 0.0), _APART)
        i, j = hungarian_algorithm(cost)
        good = may[i, j]
        known = before[j] != nobody
        switch = good & known & (before[j] != found.id[i])
        slot = jnp.where(good, truth.id[j], vehicles)
        last = last.at[slot].set(found.id[i], mode="drop")
        matches = good.sum(dtype=jnp.int32)
        return last, (
            matches,
            jnp.where(good, away[i, j], 0.0).sum(),
            switch.sum(dtype=jnp.int32),
            found.there.sum(dtype=jnp.int32),
            truth.there.sum(dtype=jnp.int32),
        )

    last = jnp.full(vehicles, nobody, jnp.int32)
    _, counts = lax.scan(look, last, (found, truth))
    matches, away, switches, listed, bodies = (x.sum(dtype=x.dtype) for x in counts)
    misses, false = bodies - matches, listed - matches
    wrong = (misses + false + switches).astype(jnp.float32)
    return Tracking(
        mota=jnp.where(bodies > 0, 1 - wrong / jnp.maximum(bodies, 1).astype(jnp.float32), jnp.nan),
        motp=jnp.where(matches > 0, away / jnp.maximum(matches, 1).astype(jnp.float32), jnp.nan),
        misses=misses,
        false=false,
        switches=switches,
        bodies=bodies,
    )


# --- prediction --------------------------------------------------------------------------------------


def prediction_errors(
    predicted: Float[Array, "V M H 2"],
    truth: Float[Array, "V H 2"],
    valid: Bool[Array, "V H"],
    *,
    miss: float = MISS,
) -> Prediction:
    """Displacement errors of the best mode.

    Args:
      predicted: places of `V` vehicles in `M` modes at `H` samples, m.
      truth: where the vehicles were, m.
      valid: samples at which they were there; a vehicle without any does not count.
      miss: m from the last valid place, from which on a prediction is a miss.
    """
    offset = jnp.where(valid[:, None, :, None], predicted - truth[:, None], 0.0)
    away = jnp.hypot(offset[..., 0], offset[..., 1])  # [V M H]
    count = valid.sum(-1)
    ade = (away.sum(-1) / jnp.maximum(count, 1).astype(away.dtype)[:, None]).min(-1)
    steps = jnp.arange(valid.shape[-1])
    final = jnp.max(jnp.where(valid, steps[None], 0), -1)
    fde = jnp.take_along_axis(away, final[:, None, None], -1)[..., 0].min(-1)
    counts = count > 0
    vehicles = counts.sum(dtype=away.dtype)

    def mean(x: Array) -> Float[Array, ""]:
        return jnp.where(vehicles > 0, jnp.where(counts, x, 0.0).sum() / jnp.maximum(vehicles, 1), jnp.nan)

    return Prediction(mean(ade), mean(fde), mean((fde > miss).astype(away.dtype)))
