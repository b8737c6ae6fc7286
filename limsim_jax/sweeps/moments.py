"""Key moments: when an episode went wrong, or nearly did."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.metrics.blame import Responsibility
from limsim_jax.metrics.moments import ORDER
from limsim_jax.metrics.safety import FIRM_BRAKING, NEAR_MISS

LEAD_UP = 1.0
"""s around a contact within which near misses and hard braking belong to it."""

SCORE_DROP = 50.0
"""LimSim's score of a second below which it is a key moment."""

_COLUMNS: dict[str, Any] = {
    "seed": np.int64,
    "ego": np.int32,
    "rank": np.int32,
    "kind": object,
    "time": np.float64,
    "other": np.float64,
    "value": np.float64,
    "responsible": object,
    "reason": object,
}


NOT_FINITE = "a command that is not finite"
"""Reason of a policy that failed without an exception."""


def key_moments(
    seeds: NDArray[np.int64],
    egos: NDArray[np.int32],
    metrics: Mapping[str, NDArray[np.float64]],
    reasons: Mapping[int, str] = MappingProxyType({}),
) -> dict[str, NDArray[Any]]:
    """Key moments of rows of metrics, the worst of each row first.

    Args:
      seeds: of the rows, `[R]`.
      egos: of the rows, `[R]`.
      metrics: columns, `[R]` each; rows without an ego have no key moments.
      reasons: by seed, why a policy failed that raised an exception.
    """
    m = metrics
    if "contact_time" not in m:
        return {name: np.asarray([], kind) for name, kind in _COLUMNS.items()}
    ttc = m["near_miss_ttc"]
    nobody = np.full(len(seeds), np.nan)
    found = {
        "policy_failed": (m["policy_failed_time"], nobody, nobody, m["policy_failed"] > 0),
        "contact": (m["contact_time"], m["contact_delta_v"], m["contact_other"], m["contact_time"] >= 0),
        "off_road": (m["off_road_time"], m["off_road"], nobody, m["off_road_time"] >= 0),
        "red_light": (m["red_light_time"], m["red_lights"], nobody, m["red_light_time"] >= 0),
        "near_miss": (m["near_miss_time"], ttc, m["near_miss_other"], ttc < NEAR_MISS[0]),
        "hard_brake": (m["max_drac_time"], m["max_drac"], m["max_drac_other"], m["max_drac"] > FIRM_BRAKING),
        "unsafe": (m["rss_first_time"], nobody, nobody, m["rss_first_time"] >= 0),
        "score_drop": (m["worst_second_time"], m["worst_second"], nobody, m["worst_second"] < SCORE_DROP),
    }
    rows = []
    for i, (seed, ego) in enumerate(zip(seeds.tolist(), egos.tolist(), strict=True)):
        rank = 0
        for kind in ORDER:
            time, value, other, there = (column[i] for column in found[kind])
            lead_up = kind in ("near_miss", "hard_brake") and abs(time - m["contact_time"][i]) < LEAD_UP
            if there and not lead_up:
                rank += 1
                who = m["contact_responsibility"][i] if kind == "contact" else np.nan
                known = not np.isnan(who) and who != Responsibility.NONE
                responsible = Responsibility(int(who)).name.lower() if known else None
                reason = reasons.get(seed, NOT_FINITE) if kind == "policy_failed" else None
                rows.append((seed, ego, rank, kind, time, other, value, responsible, reason))
    columns = list(zip(*rows, strict=True)) or [[]] * len(_COLUMNS)
    return {
        name: np.asarray(column, kind) for (name, kind), column in zip(_COLUMNS.items(), columns, strict=True)
    }
