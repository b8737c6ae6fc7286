"""How fast maps load and how fast lanes are looked up, on this machine.

Everything is timed in processes of its own: a cold start is then really cold, and on one core even the
threads of XLA have only that core.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from limsim_jax import __version__
from limsim_jax.maps.network import MapError


def bench_maps(
    path: str | Path, *, all_cores: bool = False, repeats: int = 5, batches: Sequence[int] = (1_000, 100_000)
) -> dict[str, Any]:
    """Time a map from file to look-ups.

    Args:
        path: map file.
        all_cores: use every core instead of one.
        repeats: runs of which the median counts.
        batches: how many look-ups per call.

    Returns:
        Figures by name; names end in their unit: `_s` seconds, `_per_s` per second, `_mb` 1e6 bytes.

    Raises:
        MapError: the map cannot be used.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []  # Linux
    used = cores if all_cores else cores[:1]
    with tempfile.TemporaryDirectory(prefix="limsim-jax-bench-") as cache:

        def run(stage: str, *options: str) -> dict[str, Any]:
            return _child(stage, str(path), *options, cores=used, cache=cache)

        cold = [run("cold") for _ in range(repeats)]
        run("cached")  # fills the cache
        cached = [run("cached") for _ in range(repeats)]
        look_ups = run("look_ups", str(repeats), *map(str, batches))
    facts = cold[0].pop("map")
    return {
        "map": facts,
        "machine": {
            "processor": _processor(),
            "cores": len(used) or os.cpu_count(),
            "python": platform.python_version(),
            "limsim_jax": __version__,
            **look_ups.pop("machine"),
        },
        "repeats": repeats,
        "cold": _medians(cold),
        "cached": _medians(cached),
        **look_ups,
    }


def markdown(result: dict[str, Any]) -> str:
    """The result of `bench_maps` as Markdown tables."""
    facts, machine, cold, cached = (result[name] for name in ("map", "machine", "cold", "cached"))
    on_cores = f"{machine['cores']} core{'s' if machine['cores'] > 1 else ''}"
    lines = [
        f"`{facts['file']}`: {facts['lanes']} lanes, {facts['kilometres']:.1f} km drivable, "
        f"{facts['connectors']} connectors.",
        f"{machine['processor']}, {on_cores} used; look-ups on {machine['device']} ({machine['platform']}); "
        f"JAX {machine['jax']}, Python {machine['python']}. Median of {result['repeats']} runs.",
        "",
        "| from file to device arrays | cold, s | from cache, s |",
        "|---|---:|---:|",
    ]
    stages = {
        "read_s": "read the file: `load_map`",
        "build_s": "rasterise, with all tables: `build_lane_map`",
        "total_s": "**both**",
        "import_s": "imports and start of JAX, before that",
        "process_s": "whole process",
    }
    lines += [f"| {text} | {cold[name]:.3f} | {cached[name]:.3f} |" for name, text in stages.items()]
    lines += [
        "",
        f"Conflict tables alone take {cold['conflicts_s']:.3f} s of the cold build. "
        f"Peak memory {cold['peak_memory_mb']:.0f} MB cold, {cached['peak_memory_mb']:.0f} MB from cache.",
        "",
        "| look-up, jitted | batch | per second | run, ms | compile, s |",
        "|---|---:|---:|---:|---:|",
    ]
    lines += [
        f"| `{row['function']}` | {row['batch']:,} | {row['look_ups_per_s']:.2e} | {1e3 * row['run_s']:.3f} "
        f"| {row['compile_s']:.2f} |"
        for row in result["look_ups"]
    ]
    return "\n".join(lines)


def _child(stage: str, *arguments: str, cores: Sequence[int], cache: str) -> dict[str, Any]:
    """Run a stage in a process of its own and return what it measured."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "limsim_jax.bench", ",".join(map(str, cores)), stage, *arguments],
        capture_output=True,
        text=True,
        env=os.environ | {"LIMSIM_JAX_CACHE": cache},
    )
    if done.returncode == 2:
        raise MapError(**json.loads(done.stderr.splitlines()[-1]), file=arguments[0])
    if done.returncode:
        raise RuntimeError(f"stage '{stage}' failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1]) | {"process_s": time.perf_counter() - start}


def _main(cores: str, stage: str, path: str, *options: str) -> int:
    """Be the child: only these cores, and one line of JSON for the parent."""
    if cores:
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    run: dict[str, Callable[..., dict[str, Any]]] = {"cold": _cold, "cached": _cached, "look_ups": _look_ups}
    try:
        result = run[stage](path, *options)
    except MapError as error:
        told = {"reason": error.reason, "line": error.line, "element": error.element}
        print(json.dumps(told), file=sys.stderr)
        return 2
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3  # kB on Linux
    print(json.dumps(result | {"peak_memory_mb": peak}))
    return 0


def _load(path: str, *, cache: bool) -> tuple[dict[str, Any], Any, Any]:
    """Time imports and the way from file to device arrays."""
    start = time.perf_counter()
    import jax

    from limsim_jax import maps
    from limsim_jax.maps import lane_map as _lane_map  # noqa: F401  what build_lane_map needs

    jax.devices()
    imported = time.perf_counter()
    network = maps.load_map(path, cache=cache)
    read = time.perf_counter()
    lanes = jax.block_until_ready(maps.build_lane_map(network, cache=cache))
    built = time.perf_counter()
    times = {
        "import_s": imported - start,
        "read_s": read - imported,
        "build_s": built - read,
        "total_s": built - imported,
    }
    return times, network, lanes


def _cold(path: str) -> dict[str, Any]:
    times, network, _ = _load(path, cache=False)
    from limsim_jax.maps.conflicts import build_conflicts
    from limsim_jax.maps.lane_map import lane_rows

    rows = lane_rows(network)
    start = time.perf_counter()
    build_conflicts(network, rows)
    times["conflicts_s"] = time.perf_counter() - start
    lanes = list(network.drivable_lanes())
    facts = {
        "file": Path(path).name,
        "file_hash": network.file_hash,
        "lanes": len(lanes),
        "connectors": sum(lane.junction is not None for lane in lanes),
        "kilometres": sum(lane.length for lane in lanes) / 1e3,
    }
    return times | {"map": facts}


def _cached(path: str) -> dict[str, Any]:
    return _load(path, cache=True)[0]


def _look_ups(path: str, repeats: str, *batches: str) -> dict[str, Any]:
    """Time look-ups at random places: everywhere on the map, as likely as a lane is long."""
    import jax
    import numpy as np

    from limsim_jax.maps.lane_map import pose, project, to_frenet

    _, network, lane_map = _load(path, cache=True)
    lengths = np.array([lane.length for lane in network.drivable_lanes()])
    rows = []
    for batch in map(int, batches):
        rng = np.random.default_rng(0)
        lane = rng.choice(len(lengths), size=batch, p=lengths / lengths.sum()).astype(np.int32)
        s = (rng.uniform(size=batch) * lengths[lane]).astype(np.float32)
        d = rng.uniform(-1.5, 1.5, size=batch).astype(np.float32)
        guess = s + rng.uniform(-2.0, 2.0, size=batch).astype(np.float32)  # 2 m: a step of 0.1 s at 20 m/s
        lane, s, d, guess = jax.device_put((lane, s, d, guess))
        x, y, heading = jax.jit(pose)(lane_map, lane, s, d)
        for function, arguments in (
            (pose, (lane, s, d)),
            (to_frenet, (lane, guess, x, y)),
            (project, (x, y, heading)),
        ):
            times = _time(function, int(repeats), lane_map, *arguments)
            rows.append(
                {
                    "function": function.__name__,
                    "batch": batch,
                    "look_ups_per_s": batch / times["run_s"],
                    **times,
                }
            )
    device = jax.devices()[0]
    machine = {"device": device.device_kind, "platform": device.platform, "jax": jax.__version__}
    return {"machine": machine, "look_ups": rows}


def _time(function: Callable[..., Any], repeats: int, *arguments: Any) -> dict[str, float]:
    """Compile time, and the median run time of a call once it is compiled."""
    import jax

    jax.clear_caches()
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - start
    jax.block_until_ready(compiled(*arguments))
    start = time.perf_counter()
    jax.block_until_ready(compiled(*arguments))
    calls = max(1, round(0.1 / (time.perf_counter() - start)))  # a run takes about 0.1 s
    runs = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready([compiled(*arguments) for _ in range(calls)])
        runs.append((time.perf_counter() - start) / calls)
    return {"compile_s": compile_s, "run_s": statistics.median(runs)}


def _medians(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(run[name] for run in runs) for name in runs[0]}


def _processor() -> str:
    """Model name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
