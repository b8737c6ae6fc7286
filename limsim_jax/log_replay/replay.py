"""What happened in a replay: tables of takeovers, trajectories, a viewer."""

from __future__ import annotations

import html
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from limsim_jax.api.world import Page, World
from limsim_jax.log_replay.takeover import Mode, Moment, Record
from limsim_jax.maps.lane_map import NO_LANE, absolute, project
from limsim_jax.simulation.trace import Trace

if TYPE_CHECKING:
    from limsim_jax.log_replay.scene import Scene

_MODES = ("log", "controlled", "return")  # by `Mode`


@dataclass(frozen=True, eq=False)
class Replay:
    """A replay of a scene: one variant, or `B` of them.

    Attributes:
      scene: what was recorded.
      ego: number of the ego in each variant.
      braking: m/s^2, of the ego in each variant; None: it did not brake.
      policy: at the wheel of the ego; None: none.
      start: s, when the ego left its log.
      told: [B, T], moments at which the ego does not follow its log.
      record: counts of every vehicle, `[B, N]`.
    """

    scene: Scene
    ego: NDArray[np.int64]
    braking: NDArray[np.float64] | None
    policy: Any
    start: NDArray[np.float64]
    told: NDArray[np.bool_]
    record: Record
    _run: Callable[[int], tuple[Record, Moment]]
    _kept: dict[int, Moment]

    def __len__(self) -> int:
        return len(self.ego)

    # --- tables

    @property
    def takeovers(self) -> pa.Table:
        """One row per variant and vehicle that left its log.

        Columns: variant; ego and vehicle (ids); takeovers; handed_back (of these); carried_on (its log ended
        in the middle of the road near the ego, which is no takeover); controlled (s off the log);
        displacement (m, largest distance from the place in the log); delayed (s outside, until there was
        room to enter); hardest_braking (m/s^2).
        """
        r = self.record
        variant, vehicle = np.nonzero(r.takeovers + r.ended)
        ids = np.array(self.scene.vehicles)
        at = (variant, vehicle)
        return pa.table(
            {
                "variant": variant,
                "ego": ids[self.ego[variant]],
                "vehicle": ids[vehicle],
                "takeovers": r.takeovers[at],
                "handed_back": r.handed_back[at],
                "carried_on": r.ended[at],
                "controlled": r.controlled[at],
                "displacement": r.displacement[at],
                "delayed": r.delayed[at],
                "hardest_braking": r.hardest[at],
            }
        )

    @property
    def metrics(self) -> pa.Table:
        """One row per variant.

        Columns: variant; ego (id); start (s); braking (m/s^2, if the ego brakes); vehicles (that were taken
        over); takeovers; handed_back; carried_on (logs that ended in the middle of the road); contacts (pairs
        of bodies that overlap and do not in the log) and ego_contacts (of these, with the ego);
        hardest_braking (m/s^2) and displacement (m) of the vehicles that left their logs.
        """
        r = self.record
        struck = np.asarray(r.struck)
        columns: dict[str, Any] = {
            "variant": np.arange(len(self)),
            "ego": [self.scene.vehicles[k] for k in self.ego],
            "start": self.start,
        }
        if self.braking is not None:
            columns["braking"] = self.braking
        columns |= {
            "vehicles": (r.takeovers > 0).sum(-1),
            "takeovers": r.takeovers.sum(-1),
            "handed_back": r.handed_back.sum(-1),
            "carried_on": r.ended.sum(-1),
            "contacts": struck.sum((1, 2)) // 2,
            "ego_contacts": struck[np.arange(len(self)), self.ego].sum(-1),
            "hardest_braking": r.hardest.max(-1),
            "displacement": r.displacement.max(-1),
        }
        return pa.table(columns)

    def trajectories(self, variant: int = 0) -> pa.Table:
        """All vehicles of a variant at all moments, one row each.

        Columns: time (s); vehicle (id) and slot (its number); ego (bool); mode (log, controlled or return);
        lane (id, null beside all lanes), s and d (m, of the front bumper); x, y (m, of the middle, as in the
        file); heading (rad); v (m/s), a (m/s^2); length, width (m).
        """
        trace, moments = self.trace(variant), self._moments(variant)
        active = np.asarray(trace.active)
        slot = np.broadcast_to(np.arange(active.shape[1]), active.shape)
        x, y = absolute(self.scene.map.lanes, trace.box[..., 0], trace.box[..., 1])
        lane = np.asarray(trace.lane)
        ids = np.array(self.scene.map.lane_ids)
        columns: dict[str, Any] = {
            "time": np.broadcast_to(np.asarray(trace.time)[:, None], active.shape),
            "vehicle": np.array(self.scene.vehicles)[slot],
            "slot": slot,
            "ego": slot == self.ego[variant],
            "mode": np.array(_MODES)[np.asarray(moments.mode)],
            "lane": np.where(lane == NO_LANE, np.array(None, object), ids[lane]),
            **{name: getattr(trace, name) for name in ("s", "d")},
            "x": x,
            "y": y,
            "heading": trace.box[..., 2],
            **{name: getattr(trace, name) for name in ("v", "a")},
            "length": trace.box[..., 3],
            "width": trace.box[..., 4],
        }
        return pa.table({name: np.asarray(column)[active] for name, column in columns.items()})

    def trace(self, variant: int = 0) -> Trace:
        """A variant as a record of steps, `[T, ...]`, for pictures."""
        moments, log = self._moments(variant), self.scene.arrays.log
        lanes = self.scene.map.lanes
        active = np.asarray(moments.active)
        count, number = active.shape
        place = [np.asarray(moments[k]) for k in range(3)]
        found = jax.jit(project)(lanes, *(jnp.asarray(p.ravel(), jnp.float32) for p in place))
        lane, s, d = (np.asarray(values).reshape(active.shape) for values in found[:3])
        v = np.asarray(moments.v)
        a = np.zeros_like(v)
        a[:-1] = np.where(active[1:] & active[:-1], np.diff(v, axis=0) / log.dt, 0)
        size = np.stack([np.asarray(log.length), np.asarray(log.width)], -1)
        box = np.concatenate([np.stack(place, -1), np.broadcast_to(size, (*active.shape, 2))], -1)
        ego = int(self.ego[variant])
        driven = np.where(self.told[variant] & active[:, ego], ego, -1)
        nothing = np.zeros(active.shape, np.int32)
        columns: dict[str, Any] = {
            "time": np.arange(count, dtype=np.float32) * np.float32(log.dt),
            "active": active,
            "vehicle": np.broadcast_to(np.arange(number, dtype=np.int32), active.shape),
            "lane": np.where(active, lane, NO_LANE),
            "s": s + size[:, 0] / 2,
            "d": d,
            "v": v,
            "a": a,
            "box": box,
            "status": nothing,
            "phase": np.zeros((count, lanes.signals.duration.shape[0]), np.int32),
            "driven": driven[:, None].astype(np.int32),
        }
        return Trace(**columns)

    def _moments(self, variant: int) -> Moment:
        if not 0 <= variant < len(self):
            raise ValueError(f"no variant {variant}; 0 to {len(self) - 1} are expected")
        if variant not in self._kept:
            self._kept[variant] = self._run(variant)[1]
        return self._kept[variant]

    # --- to look at

    def world(self, variant: int = 0) -> World:
        """A variant as a `World`, for its pictures and videos."""
        policy = "log" if self.braking is None else f"braking {self.braking[variant]:g} m/s^2"
        policy = policy if self.policy is None else getattr(self.policy, "name", type(self.policy).__name__)
        return World(
            self.scene.name,
            str(policy),
            0,
            int(self.ego[variant]),
            self.scene.map,
            self.trace(variant),
            {},
            [],
        )

    def save(self, path: str | Path, variant: int = 0, **options: Any) -> Path:
        """Write a variant to a file.

        Args:
          path: .html (viewer), .mp4 or .gif (video), .png (picture), .parquet (`trajectories`) or .npz.
          variant: which one.
          options: see `World.save`.

        Raises:
          ValueError: another suffix, or no such variant.
          OSError: the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() == ".parquet":
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(self.trajectories(variant), path)
            return path
        if path.suffix.lower() == ".html":
            title = f"{self.scene.name}, ego {self.scene.vehicles[self.ego[variant]]}"
            options = {"title": title} | options
        return self.world(variant).save(path, **options)

    def show(self, variant: int = 0, height: int = 640) -> Page:
        """The viewer of a variant, which a notebook shows inline; `height`: pixels."""
        with tempfile.TemporaryDirectory() as folder:
            page = self.save(Path(folder) / "replay.html", variant)
            return Page(page.read_text(encoding="utf-8"), height)

    # --- in words

    def __repr__(self) -> str:
        return "\n".join([self._title(), *self._lines()])

    def _repr_html_(self) -> str:
        lines = "".join(f"<li>{html.escape(line)}</li>" for line in self._lines())
        return f"<p><b>{html.escape(self._title())}</b></p><ul>{lines}</ul>"

    def _title(self) -> str:
        egos = sorted({self.scene.vehicles[k] for k in self.ego})
        names = ", ".join(egos[:5]) + (f" and {len(egos) - 5} more" if len(egos) > 5 else "")
        count = f"{len(self)} variants" if len(self) > 1 else "1 variant"
        return f"Replay of {self.scene.name}: ego {names}, {count}"

    def _lines(self) -> list[str]:
        r, struck = self.record, np.asarray(self.record.struck)
        pairs, met = int(struck.sum()) // 2, int(struck.any((1, 2)).sum())
        lines = [
            f"{int(r.takeovers.sum())} takeovers of other vehicles, {int(r.handed_back.sum())} handed back",
            *([f"{int(r.ended.sum())} logs that end on the road were carried on"] if r.ended.any() else []),
            f"{pairs} contacts" + (f", in {met} variants" if len(self) > 1 else ""),
        ]
        if (r.takeovers + r.ended > 0).any():
            lines.append(
                f"hardest braking off the log {float(r.hardest.max()):.1f} m/s^2, largest displacement "
                f"{float(r.displacement.max()):.1f} m"
            )
        return lines


assert len(_MODES) == len(Mode)

__all__ = ["Replay"]
