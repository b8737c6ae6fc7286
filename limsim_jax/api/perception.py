"""`Perception`: how well a vehicle of a recorded world perceives the others, against the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from limsim_jax.metrics.perception import (
    DISTANCES,
    Boxes,
    Prediction,
    average_precision,
    boxes_of,
    clear_mot,
    prediction_errors,
    within,
)
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.objects import Detector
from limsim_jax.sensors.rig import Rig

if TYPE_CHECKING:
    from limsim_jax.api.sensed import Film
    from limsim_jax.api.world import World

REACH = 50.0
"""m around the ego within which vehicles count (nuScenes detects cars within 50 m)."""

OVERLAPS = (0.3, 0.5, 0.7)
"""Intersections over union from which a detection is right (Waymo and KITTI use 0.5 and 0.7)."""

_LOOKS = 64

AHEAD, SAMPLE = 3.0, 0.5
"""s that are predicted, and s between samples. nuScenes predicts 6 s; its planners score 3 s."""


@dataclass(frozen=True)
class Perception:
    """Scores of an episode. A score is NaN where there is nothing to judge.

    Vehicles count within `REACH` m, if a ray of the LiDAR without errors meets them.

    Attributes:
      map_distance: mean of the average precision at 0.5, 1, 2 and 4 m between centres (nuScenes' mAP).
      ap_distance: average precision by the distance within which a detection is right (m).
      ap_iou: average precision by the intersection over union from which it is right.
      recall: share of the vehicles that are found within 2 m, over all looks.
      precision: share of the entries within 2 m of a vehicle.
      mota, motp: tracking accuracy, and mean distance (m) of what is matched (CLEAR MOT, 2 m).
      misses, false, switches, bodies: counts behind them.
      ade, fde: m, mean and final distance of predicted places over 3 s from where the vehicles then are.
        Each is predicted from its entry in the list, at constant velocity.
      miss_rate: share of the predictions whose end is more than 2 m off.
      true_ade, true_fde, true_miss_rate: of the same predictions from true places and velocities. What
        `ade` has above `true_ade` is due to perception, the rest to prediction.
      looks: frames.
    """

    map_distance: float
    ap_distance: dict[float, float]
    ap_iou: dict[float, float]
    recall: float
    precision: float
    mota: float
    motp: float
    misses: int
    false: int
    switches: int
    bodies: int
    ade: float
    fde: float
    miss_rate: float
    true_ade: float
    true_fde: float
    true_miss_rate: float
    looks: int

    def columns(self) -> dict[str, float]:
        """Every score by its own name, such as `ap_0.5m` and `ap_iou_0.7`."""
        found: dict[str, float] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "ap_distance":
                found |= {f"ap_{distance:g}m": x for distance, x in value.items()}
            elif field.name == "ap_iou":
                found |= {f"ap_iou_{least:g}": x for least, x in value.items()}
            else:
                found[field.name] = value
        return found

    def table(self) -> pa.Table:
        """A row per score."""
        columns = self.columns()
        return pa.table({"score": list(columns), "value": pa.array(map(float, columns.values()))})

    def __repr__(self) -> str:
        rows = [f"{name:>16}  {value:.4g}" for name, value in self.columns().items()]
        return "\n".join(["Perception", *rows])


def perception(
    world: World,
    *,
    detector: Detector | None = None,
    faults: Faults | None = None,
    slot: int | None = None,
    every: float | None = None,
    reach: float = REACH,
) -> Perception:
    """How well a vehicle perceives the others, see `World.perception`."""
    if not reach > 0:
        raise ValueError(f"reach: {reach:g} m; expected more than 0")
    detector = detector or Detector()
    film = world.film(
        Rig(lidar=detector.lidar), detector=detector, faults=faults, slot=slot, every=every
    )  # fmt: skip
    found, truth = judged(film, reach)
    scores = jax.device_get(_scored(found, truth, world.trace.active.shape[1]))
    mot = scores["mot"]
    matched = int(mot.bodies - mot.misses)
    guess, true, place, valid = _predictions(world, film, np.asarray(found.there), np.asarray(truth.there))
    errors, true_errors = (_errors(x, place[i], valid[i]) for i, x in enumerate((guess, true)))
    ap_distance = {at: float(scores["distance"][k]) for k, at in enumerate(DISTANCES)}
    return Perception(
        map_distance=float(np.mean(list(ap_distance.values()))),
        ap_distance=ap_distance,
        ap_iou={at: float(scores["iou"][k]) for k, at in enumerate(OVERLAPS)},
        recall=matched / mot.bodies if mot.bodies else math.nan,
        precision=matched / (matched + mot.false) if matched + mot.false else math.nan,
        mota=float(mot.mota),
        motp=float(mot.motp),
        misses=int(mot.misses),
        false=int(mot.false),
        switches=int(mot.switches),
        bodies=int(mot.bodies),
        ade=float(errors.ade),
        fde=float(errors.fde),
        miss_rate=float(errors.miss_rate),
        true_ade=float(true_errors.ade),
        true_fde=float(true_errors.fde),
        true_miss_rate=float(true_errors.miss_rate),
        looks=len(film),
    )


def judged(film: Film, reach: float = REACH) -> tuple[Boxes, Boxes]:
    """Entries and bodies that count, `[F, D]` and `[F, K]`.

    Args:
      film: what a vehicle senses.
      reach: m around it.
    """
    found, truth = within(boxes_of(film.objects), reach), within(boxes_of(film.truth), reach)
    return found, truth._replace(there=truth.there & jnp.asarray(film.hits > 0))


@jax.jit
def _score(found: Boxes, truth: Boxes) -> dict[str, Any]:
    def by_distance(most: Any) -> Any:
        return average_precision(found, truth, distance=most)

    def by_overlap(least: Any) -> Any:
        return average_precision(found, truth, iou=least)

    return {
        "distance": jax.vmap(by_distance)(jnp.asarray(DISTANCES, jnp.float32)),
        "iou": jax.vmap(by_overlap)(jnp.asarray(OVERLAPS, jnp.float32)),
    }


def _scored(found: Boxes, truth: Boxes, vehicles: int) -> dict[str, Any]:
    """Scores of detection and tracking; looks are padded, so that episodes share programs."""
    spare = -len(found.there) % _LOOKS
    found, truth = (
        jax.tree.map(lambda x: jnp.pad(jnp.asarray(x), [(0, spare), (0, 0)]), boxes)
        for boxes in (found, truth)
    )
    return _score(found, truth) | {"mot": _mot(found, truth, vehicles)}


_mot = jax.jit(clear_mot, static_argnums=2)


def _errors(predicted: NDArray[Any], truth: NDArray[Any], valid: NDArray[np.bool_]) -> Prediction:
    """Errors of predictions, padded as looks are."""
    spare = -len(valid) % (8 * _LOOKS)
    padded = (np.pad(x, [(0, spare)] + [(0, 0)] * (x.ndim - 1)) for x in (predicted, truth, valid))
    return jax.device_get(_prediction_errors(*map(jnp.asarray, padded)))


_prediction_errors = jax.jit(prediction_errors)


def _predictions(
    world: World, film: Film, listed: NDArray[np.bool_], real: NDArray[np.bool_]
) -> tuple[Any, Any, Any, Any]:
    """Places predicted from lists and from the truth, `[V, 1, H, 2]`.

    Then, of both, where the vehicles are, and whether they are there.
    """
    trace, objects, truth = world.trace, film.objects, film.truth
    listed = listed & (np.asarray(objects.id) >= 0)
    time = np.asarray(trace.time, float)
    dt = float(time[1] - time[0]) if len(time) > 1 else SAMPLE
    ahead = np.arange(1, round(AHEAD / SAMPLE) + 1) * SAMPLE  # [H]
    then = film.step[:, None] + np.round(ahead / dt).astype(int)  # [F, H]
    known = then < len(time)
    then = np.minimum(then, len(time) - 1)

    def part(of: Any, slots: NDArray[Any], there: NDArray[Any], pose: Any) -> tuple[Any, Any, Any]:
        frame, row = np.nonzero(there)
        slot, now = slots[frame, row], film.step[frame]
        place = np.stack([np.asarray(of.x)[frame, row], np.asarray(of.y)[frame, row]], -1)
        way = np.stack([np.asarray(of.vx)[frame, row], np.asarray(of.vy)[frame, row]], -1)
        local = place[:, None] + ahead[:, None] * way[:, None]  # [V, H, 2]
        heading = np.asarray(pose.heading)[frame, None]
        cos, sin = np.cos(heading), np.sin(heading)
        origin = np.stack([np.asarray(pose.x), np.asarray(pose.y)], -1)[frame]
        x = origin[:, :1] + cos * local[..., 0] - sin * local[..., 1]
        y = origin[:, 1:] + sin * local[..., 0] + cos * local[..., 1]
        later = then[frame]
        same = trace.active[later, slot[:, None]] & known[frame]
        same &= trace.vehicle[later, slot[:, None]] == trace.vehicle[now, slot][:, None]
        same &= trace.active[now, slot][:, None]
        where = np.where(same[..., None], trace.box[later, slot[:, None], :2], 0.0)
        return np.stack([x, y], -1)[:, None].astype(np.float32), where.astype(np.float32), same

    guess, place, valid = part(objects, np.maximum(np.asarray(objects.id), 0), listed, objects.pose)
    true, true_place, true_valid = part(truth, np.maximum(np.asarray(truth.slot), 0), real, film.pose)
    return guess, true, (place, true_place), (valid, true_valid)
