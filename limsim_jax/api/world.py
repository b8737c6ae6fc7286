"""`World`: one world, every step of it: to look at, to tabulate, to fork."""

from __future__ import annotations

import html
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from limsim_jax.maps.map import Map
from limsim_jax.simulation.table import trajectory_table, write_trace
from limsim_jax.simulation.trace import Trace

if TYPE_CHECKING:
    from limsim_jax.api.futures import Futures
    from limsim_jax.api.perception import Perception
    from limsim_jax.api.sensed import Film, Sensed
    from limsim_jax.policies.base import PolicyLike
    from limsim_jax.policies.language.store import Answer
    from limsim_jax.sensors.rig import Rig
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.types import State

SUFFIXES = (".html", ".gif", ".mp4", ".png", ".parquet", ".npz")
"""What `World.save` writes: a viewer, videos, a picture, tables."""


class Page:
    """A page that shows itself in a notebook.

    Args:
      text: the page, HTML.
      height: of the frame, pixels.
    """

    def __init__(self, text: str, height: int = 640) -> None:
        self.text, self.height = text, height

    def _repr_html_(self) -> str:
        framed = html.escape(self.text, quote=True)
        return (
            f'<iframe srcdoc="{framed}" style="width:100%;height:{self.height}px;border:0" '
            'sandbox="allow-scripts" title="replay"></iframe>'
        )


@dataclass(frozen=True, eq=False)
class World:
    """One world of an experiment with its trace.

    Attributes:
      scenario, policy: names, as in results.
      seed: of the world.
      ego: number and slot of the ego that metrics and moments belong to; -1: there is none.
      map: where it happened.
      trace: every step, NumPy, `[T, ...]`; lengths in m, times in s, positions from the map's origin.
      metrics: columns of the row of this world; NaN: not measured.
      moments: key moments, the worst first.
      episodes: that it is a world of; None: it cannot be forked.
      answers: of a language model that drives the ego.
    """

    scenario: str
    policy: str
    seed: int
    ego: int
    map: Map
    trace: Trace
    metrics: dict[str, float]
    moments: list[dict[str, Any]]
    episodes: Episodes | None = None
    answers: Sequence[Answer] = ()

    @classmethod
    def run(cls, episodes: Episodes, seed: int, ego: int = 0, *, explain: bool = True) -> World:
        """Run the world of a seed."""
        if not 0 <= seed < 2**31:
            raise ValueError(f"seed {seed}: seeds lie between 0 and 2^31 - 1")
        found = episodes.replay(seed, ego, explain=explain)
        return cls(
            episodes.scenario, episodes.policy, seed, found.ego, episodes.town, found.trace, found.metrics,
            found.moments, episodes, found.answers,
        )  # fmt: skip

    @property
    def title(self) -> str:
        """What it is, in a line."""
        return f"{self.scenario}, {self.policy}, seed {self.seed}"

    def trajectories(self) -> pa.Table:
        """A row per time and vehicle: see `simulation.table.trajectory_table`. Column `seed` comes first."""
        return trajectory_table(self.map.network, self.map.lanes, self.trace, seed=self.seed)

    def show(self, height: int = 640) -> Page:
        """The interactive viewer; a notebook shows it inline."""
        with tempfile.TemporaryDirectory() as folder:
            path = self.save(Path(folder) / "replay.html")
            return Page(path.read_text(encoding="utf-8"), height)

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write the world to a file.

        Args:
          path: .html (viewer), .mp4 or .gif (video), .png (picture), .parquet or .npz (every step).
          options: of `report.viewer.write_viewer`, `report.video.write_video` or `write_picture`. In all
            three `sensors` shows what the ego senses, too: a `Film`, a `Rig`, or a name as in `film`.

        Raises:
          ValueError: another suffix, or sensors that are not there.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in SUFFIXES:
            raise ValueError(f"cannot write '{path}': use {', '.join(SUFFIXES)}")
        path.parent.mkdir(parents=True, exist_ok=True)
        place = (path, self.map.network, self.map.lanes, self.trace)
        egos = [] if self.ego < 0 else [self.ego]
        if suffix in (".gif", ".mp4", ".png"):
            follow = self.ego if egos and options.get("bounds") is None else None
            options = {"follow": follow, "egos": egos, "moments": self.moments} | options
        if options.get("sensors") is not None and suffix not in (".parquet", ".npz"):
            options = options | {"sensors": self._watched(options["sensors"])}
        if suffix == ".html":
            from limsim_jax.report.viewer import write_viewer

            options = {"title": self.title, "moments": self.moments, "answers": self.answers} | options
            write_viewer(*place, ego=self.ego if egos else None, **options)
        elif suffix in (".gif", ".mp4"):
            from limsim_jax.report.video import write_video

            write_video(*place, **options)
        elif suffix == ".png":
            from limsim_jax.report.video import write_picture

            at = self.moments[0]["time"] if self.moments else None
            options = {"at": at} | options
            write_picture(*place, **options)
        else:
            write_trace(*place)
        return path

    def sense(self, at: float, rig: Rig | None = None, **options: Any) -> Sensed:
        """What the ego senses at a moment: pictures, point cloud, bird's-eye view, object list.

        Args:
          at: s.
          rig: its cameras and LiDAR; None: the six cameras of LimSim++ and a LiDAR of 16 layers.
          options: `slot` of another vehicle, `detector` and `raster` (see `sensors`).

        Raises:
          ValueError: a time outside the record, or no such vehicle at that time.
        """
        from limsim_jax.api.sensed import sense

        return sense(self, at, rig, **options)

    def film(self, rig: Rig | str = "six", **options: Any) -> Film:
        """What the ego senses over the episode, a frame per decision: arrays, and a video.

        Args:
          rig: its cameras and LiDAR; or `six`, `front` or `one` cameras with a LiDAR, or `own`: the rig that
            the policy declares.
          options: `every` (s between frames), `begin` and `end` (s), `slot` of another vehicle, `detector`,
            `raster` and `faults` (see `sensors`).

        Raises:
          ValueError: an unknown rig, a policy without sensors, or no frame with that vehicle.
        """
        from limsim_jax.api.sensed import film

        return film(self, rig, **options)

    def perception(self, **options: Any) -> Perception:
        """How well the ego perceives other vehicles: detection, tracking, prediction against the truth.

        Args:
          options: `detector` (how object lists come about), `faults`, `slot` of another vehicle, `every` (s
            between looks; a decision unless told), `reach` (m around the ego, 50).

        Raises:
          ValueError: no frame with that vehicle, or a number out of range.
        """
        from limsim_jax.api.perception import perception

        return perception(self, **options)

    def _watched(self, sensors: Film | Rig | str) -> Film:
        """A film of few frames, to be shown beside the traffic."""
        from limsim_jax.api.sensed import Film, watch

        return sensors if isinstance(sensors, Film) else watch(self, sensors)

    def fork(
        self,
        at: float | Sequence[float],
        *,
        policies: Sequence[PolicyLike | str | None] = (None,),
        count: int = 1,
        change: Callable[[State, Any], State] | None = None,
        seconds: float | None = None,
    ) -> Futures:
        """Run on from one moment of the world, or from several.

        Args:
          at: s, rounded to whole decisions.
          policies: what drives the egos from then on, each a future or `count` of them; None: as before.
          count: copies per policy.
          change: `change(state, k)` returns the state from which copy `k` goes on. It is traced by JAX.
          seconds: how long they run; None: as long as the horizon leaves to all of them.

        Returns:
          All futures, policy by policy, moment by moment, copy by copy: a sequence of `World`s whose
          metrics count from the fork on.
        """
        from limsim_jax.api.futures import run_futures

        if self.episodes is None:
            raise ValueError("this world has no experiment to run on with")
        return run_futures(self, at, policies, count, change, seconds)

    def __repr__(self) -> str:
        steps, last = len(self.trace.time), float(self.trace.time[-1])
        worst = f", {self.moments[0]['kind']} at {self.moments[0]['time']:.1f} s" if self.moments else ""
        return f"World {self.title}: {steps} steps, {last:g} s{worst}"
