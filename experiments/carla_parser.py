"""What CARLA's parser says about an OpenDRIVE map.

    python experiments/carla_parser.py MAP FOLDER     # writes the answers into the folder

CARLA's parser (PyPI `carla`) crashes on some maps, so that `ask_carla` runs it in a process of its own.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _answer(source: Path, out: Path) -> None:
    """Ask CARLA's parser about a map, and write each answer at once."""
    import carla

    town = carla.Map("map", source.read_text(encoding="utf-8", errors="replace"))
    waypoints = town.generate_waypoints(0.5)
    change = carla.LaneChange
    rows = [
        (
            w.road_id,
            w.section_id,
            w.lane_id,
            w.s,
            w.transform.location.x,
            -w.transform.location.y,
            -math.radians(w.transform.rotation.yaw),
            w.lane_width,
            bool(int(w.lane_change) & int(change.Left)),
            bool(int(w.lane_change) & int(change.Right)),
        )
        for w in waypoints
    ]
    np.save(out / "waypoints.npy", np.array(rows, float).reshape(-1, 10))

    def key(w: Any) -> tuple[int, int, int]:
        return w.road_id, w.section_id, w.lane_id

    topology = town.get_topology()
    kinds = {
        key(w): (str(w.lane_type), w.junction_id if w.is_junction else None) for e in topology for w in e
    }
    (out / "topology.json").write_text(
        json.dumps({"links": [(key(a), key(b)) for a, b in topology], "lanes": list(kinds.items())})
    )
    crosswalks = [(p.x, -p.y) for p in town.get_crosswalks()]
    (out / "crosswalks.json").write_text(json.dumps(crosswalks))
    landmarks = [
        {
            "id": mark.id,
            "type": mark.type,
            "road": mark.road_id,
            "s": mark.s,
            "orientation": str(mark.orientation),
            "lanes": mark.get_lane_validities(),
            "dynamic": mark.is_dynamic,
        }
        for mark in town.get_all_landmarks()
    ]
    (out / "landmarks.json").write_text(json.dumps(landmarks))


@dataclass(frozen=True)
class CarlaMap:
    """Answers of CARLA's parser; those that it crashed on are None."""

    waypoints: Array | None  # [K, 10]: road, section, lane, s, x, y, heading, width, may change left, right
    topology: dict[str, Any] | None
    crosswalks: list[tuple[float, float]] | None
    landmarks: list[dict[str, Any]] | None
    said: tuple[str, ...]  # what it printed
    failure: str | None


def ask_carla(source: Path, timeout: float = 120.0) -> CarlaMap:
    """CARLA's answers about a map, from a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        command = [sys.executable, str(Path(__file__).resolve()), str(source), str(out)]
        failure = None
        try:
            run = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
            said, code = (run.stdout + run.stderr).splitlines(), run.returncode
        except subprocess.TimeoutExpired:
            said, code, failure = [], 0, f"no answer within {timeout:g} s"
        if code < 0:
            failure = f"crashes (signal {-code})"
        elif code:
            failure = f"raises: {said[-1] if said else '?'}"
            said = [line for line in said if not line.startswith((" ", "Traceback"))][:-1]

        def load(name: str) -> Any:
            path = out / f"{name}.json"
            return json.loads(path.read_text()) if path.exists() else None

        waypoints = out / "waypoints.npy"
        return CarlaMap(
            waypoints=np.load(waypoints) if waypoints.exists() else None,
            topology=load("topology"),
            crosswalks=load("crosswalks"),
            landmarks=load("landmarks"),
            said=tuple(line.strip() for line in said if line.strip()),
            failure=failure,
        )


if __name__ == "__main__":
    _answer(Path(sys.argv[1]), Path(sys.argv[2]))
