"""Results of made-up worlds, for tests of tables and pages."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from limsim_jax.metrics import ego
from limsim_jax.metrics.blame import Responsibility
from limsim_jax.sweeps.store import MOMENTS, Results

UNITS = ego.NAMES | {"traffic_collided": "vehicles that touched another", "traffic_mean_speed": "m/s"}
NAN = float("nan")
ONE = ("highway", "like_traffic")


def made(
    worlds: Mapping[tuple[str, str], Mapping[str, Any]],
    moments: Sequence[Mapping[str, Any]] = (),
    *,
    provenance: Mapping[tuple[str, str], Mapping[str, Any]] | None = None,
    path: str = "results",
) -> Results:
    """Results from columns by (scenario, policy); a column `seed` if they do not count from 0."""
    parts = []
    for (scenario, policy), given in worlds.items():
        metrics = dict(given)
        n = len(next(iter(metrics.values())))
        seeds = np.asarray(metrics.pop("seed", range(n)), np.int64)
        digest = np.asarray(metrics.pop("digest", range(n)), np.uint64)
        egos = np.asarray(metrics.pop("ego", [0] * n), np.int32)
        keys = {"scenario": [scenario] * n, "policy": [policy] * n, "seed": seeds, "ego": egos}
        part = pa.table(keys | {"digest": digest})
        for name, values in metrics.items():
            part = part.append_column(name, pa.array(np.asarray(values, float), from_pandas=True))
        parts.append(part)
    rows = [{name: None for name in MOMENTS.names} | dict(row) for row in moments]
    return Results(
        path=Path(path),
        episodes=pa.concat_tables(parts, promote_options="default"),
        moments=pa.Table.from_pylist(rows, MOMENTS),
        units=dict(UNITS),
        provenance={group: dict((provenance or {}).get(group, {})) for group in worlds},
    )


def broken_policies() -> Results:
    """Of 40 episodes the policy fails in three, for two reasons; seed 5 is a contact at fault."""
    own: dict[str, Any] = dict(zip(("scenario", "policy"), ONE, strict=True), rank=1, kind="policy_failed")
    failed = np.isin(np.arange(40), (3, 17, 30)) * 1.0
    contacts = (np.arange(40) == 5) * 1.0
    times = np.where(failed > 0, 2.5, NAN)
    return made(
        {
            ONE: {
                "policy_failed": failed, "policy_failed_time": times,
                "success": 1 - np.maximum(failed, contacts), "arrived": 1 - np.maximum(failed, contacts),
                "contacts": contacts, "at_fault_contacts": contacts, "min_ttc": np.full(40, 9.0),
            }
        },
        [
            dict(own, seed=3, time=2.5, reason="mine.py:7 in plan: ValueError: no path"),
            dict(own, seed=17, time=2.5, reason="a command that is not finite"),
            dict(own, seed=30, time=2.5, reason="mine.py:7 in plan: ValueError: no path"),
        ],
    )  # fmt: skip


def crashes() -> Results:
    """Seed: 0 nothing; 1 near; 2 nearer; 3 off the road; 4, 5 not at fault; 6 at fault, light; 7 shared."""
    own: dict[str, Any] = dict(zip(("scenario", "policy"), ONE, strict=True))
    ego, other, shared = (int(Responsibility[x]) for x in ("EGO", "OTHER", "SHARED"))
    return made(
        {
            ONE: {
                "contacts": [0, 0, 0, 0, 1, 2, 1, 1],
                "at_fault_contacts": [0, 0, 0, 0, 0, 0, 1, 0],
                "contact_responsibility": [NAN] * 4 + [other, other, ego, shared],
                "max_delta_v": [NAN] * 4 + [4.0, 9.0, 1.0, 0.5],
                "contact_time": [NAN] * 4 + [10.0, 11.0, 12.0, 13.0],
                "min_ttc": [NAN, 1.2, 0.3, 5.0, 0.0, 0.0, 0.0, 0.0],
                "min_ttc_time": [NAN, 5.0, 6.0, 7.0, 9.0, 9.0, 9.0, 9.0],
                "off_road": [0, 0, 0, 0.1, 0.2, 0, 0, 0],
                "nuplan_score": [0.9, 0.8, 0.7, NAN, 0.5, 0.4, 0.0, 0.6],
            }
        },
        [
            dict(own, seed=6, rank=2, kind="near_miss", time=11.5, value=0.2),
            dict(own, seed=6, rank=1, kind="contact", time=12.0, other=3, value=1.0, responsible="ego",
                 module="planning", avoidable_by_ego=True, avoidable_by_other=False),
            dict(own, scenario="ramp", seed=7, rank=1, kind="contact", time=99.0, responsible="ego"),
            dict(own, seed=2, rank=1, kind="near_miss", time=6.0, other=4, value=0.3),
        ],
    )  # fmt: skip
