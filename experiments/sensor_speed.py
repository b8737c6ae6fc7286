"""How fast sensors are on one core: cameras, LiDAR, bird's-eye view, object list.

    python experiments/sensor_speed.py [--worlds 16] [--repeats 20] [--boxes 16]

Every frame has `--boxes` boxes: bodies, and among them four lights. Time is that of the processor, so that
other programs on the machine do not count. Writes experiments/results/sensor_speed.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core, before JAX counts them

import jax
import jax.numpy as jnp
import numpy as np
from readme_tables import sensor_speed

from limsim_jax.files import write_whole
from limsim_jax.maps.map import load_map
from limsim_jax.maps.scenery import LIGHT_BOTTOM, LIGHT_SIZE, Label, Scenery
from limsim_jax.sensors.bev import Raster, birds_eye
from limsim_jax.sensors.camera import take_pictures
from limsim_jax.sensors.lidar import scan_around
from limsim_jax.sensors.objects import Detector, detect
from limsim_jax.sensors.rig import LAYERS_1, LAYERS_16, Rig, six_cameras
from limsim_jax.sensors.scene import LIGHTS, Bodies, Pose

RESULTS = Path(__file__).parent / "results"
MAP = "intersection"


def crowd(worlds: int, boxes: int) -> Bodies:
    """Vehicles and lights around every ego, at random."""
    rng = np.random.default_rng(0)
    shape = (worlds, boxes)
    light = np.broadcast_to(np.arange(boxes) >= boxes - LIGHTS, shape)

    def sized(low: float, high: float, of_light: float) -> Any:
        return jnp.asarray(np.where(light, of_light, rng.uniform(low, high, shape)), jnp.float32)

    def whole(low: int, high: int, of_light: int | None = None) -> Any:
        x = rng.integers(low, high, shape)
        return jnp.asarray(x if of_light is None else np.where(light, of_light, x), jnp.int32)

    away, around = rng.uniform(6, 60, shape), rng.uniform(-np.pi, np.pi, shape)
    return Bodies(
        x=jnp.asarray(away * np.cos(around), jnp.float32),
        y=jnp.asarray(away * np.sin(around), jnp.float32),
        z=jnp.asarray(np.where(light, LIGHT_BOTTOM, 0.0), jnp.float32),
        heading=jnp.asarray(rng.uniform(-np.pi, np.pi, shape), jnp.float32),
        length=sized(4, 12, LIGHT_SIZE[0]),
        width=sized(1.7, 2.5, LIGHT_SIZE[1]),
        height=sized(1.4, 3.4, LIGHT_SIZE[2]),
        vx=sized(0, 15, 0),
        vy=sized(-1, 1, 0),
        label=whole(Label.CAR, Label.PEDESTRIAN, Label.LIGHT_RED),
        lamps=whole(0, 8),
        slot=jnp.asarray(np.where(light, -1, np.arange(boxes)), jnp.int32),
        there=jnp.ones(shape, bool),
    )


def cases(key: Any) -> dict[str, tuple[int, Callable[[Scenery, Pose, Bodies], Any]]]:
    """Rays of a frame, and what makes it, by name."""

    def cameras(rig: Rig) -> tuple[int, Callable[[Scenery, Pose, Bodies], Any]]:
        rays = sum(c.width * c.height for c in rig.cameras)
        return rays, lambda scenery, pose, bodies: take_pictures(rig, scenery, pose, bodies)

    detector, raster, front = Detector(), Raster(), ("front_left", "front", "front_right")
    return {
        "six cameras 64 x 36": cameras(six_cameras()),
        "six cameras 112 x 63": cameras(six_cameras(112, 63)),
        "front three 64 x 36": cameras(six_cameras().only(*front)),
        "front three 112 x 63": cameras(six_cameras(112, 63).only(*front)),
        "front camera 64 x 36": cameras(six_cameras().only("front")),
        "LiDAR 16 x 360": (16 * 360, lambda s, p, b: scan_around(LAYERS_16, b, key, 0)),
        "LiDAR 1 x 360": (360, lambda s, p, b: scan_around(LAYERS_1, b, key, 0)),
        "object list by LiDAR 16 x 360": (16 * 360, lambda s, p, b: detect(detector, p, b, key, 0)),
        "bird's-eye view 80 x 64": (80 * 64, lambda s, p, b: birds_eye(raster, s, p, b)),
    }


def measure(
    make: Callable[[Scenery, Pose, Bodies], Any], scenery: Scenery, pose: Pose, bodies: Bodies, repeats: int
) -> tuple[float, float]:
    """Seconds to compile, and frames per second: the best of some runs."""
    batch = jax.jit(jax.vmap(make, (None, 0, 0)))
    begin = time.perf_counter()
    program = batch.lower(scenery, pose, bodies).compile()
    compiled = time.perf_counter() - begin
    jax.block_until_ready(program(scenery, pose, bodies))
    best = float("inf")
    for _ in range(repeats):
        begin = time.process_time()
        for _ in range(4):
            jax.block_until_ready(program(scenery, pose, bodies))
        best = min(best, (time.process_time() - begin) / 4)
    return compiled, bodies.x.shape[0] / best


def main() -> None:
    """Parse the command line, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--boxes", type=int, default=16)
    options = parser.parse_args()
    town = load_map(MAP)
    pose = Pose(
        x=jnp.linspace(-60, 60, options.worlds, dtype=jnp.float32),
        y=jnp.zeros(options.worlds, jnp.float32),
        heading=jnp.linspace(-3, 3, options.worlds, dtype=jnp.float32),
    )
    bodies, rows = crowd(options.worlds, options.boxes), []
    for name, (rays, make) in cases(jax.random.key(0)).items():
        compiled, frames = measure(make, town.scenery, pose, bodies, options.repeats)
        rows.append(
            {"sensor": name, "rays": rays, "frames_per_s": round(frames), "compile_s": round(compiled, 1)}
        )
        print(f"{name}: {frames:,.0f} frames/s, compiled in {compiled:.1f} s", flush=True)
    device = jax.devices()[0]
    result = {
        "map": MAP, "worlds": options.worlds, "boxes": options.boxes, "lights": LIGHTS,
        "device": device.device_kind, "jax": jax.__version__, "rows": rows,
    }  # fmt: skip
    write_whole(RESULTS / "sensor_speed.json", json.dumps(result, indent=1) + "\n")
    head = "# Speed of sensors\n\nRegenerate: `python experiments/sensor_speed.py`\n\n"
    write_whole(RESULTS / "sensor_speed.md", head + sensor_speed(result) + "\n")


if __name__ == "__main__":
    main()
