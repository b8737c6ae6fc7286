"""Speed on this machine: maps, look-ups, traffic and policies.

Everything is timed in processes of its own: a cold start is then really cold, and on one core even the
threads of XLA have only that core.
"""

from __future__ import annotations

import json
import os
import platform
import random
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax import __version__
from limsim_jax.maps.network import MapError

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.network import Network
    from limsim_jax.traffic.demand import Demand

RATE = 400.0
"""veh/h per origin where nothing else is said."""

DT = 0.1
"""s, physics step of what is timed."""

PEER_TIME = 3.0
"""s of stepping after which a process of the peer has run long enough."""


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
    used = _cores() if all_cores else _cores()[:1]
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


def bench_traffic(
    path: str | Path,
    *,
    worlds: int = 256,
    vehicles: int = 64,
    seconds: float = 20.0,
    repeats: int = 3,
    rate: float = RATE,
    peer: bool = True,
    cold: bool = False,
) -> dict[str, Any]:
    """Time traffic in many worlds on all devices; next to it SUMO.

    Every world starts with about as many vehicles as it has slots, or as many as find room.

    Args:
        path: map file.
        worlds: run together.
        vehicles: slots per world.
        seconds: of traffic.
        repeats: runs of which the median counts.
        rate: veh/h per origin.
        peer: run SUMO on the same map with the same flows, one process per core.
        cold: compile with an empty cache, then load from it; otherwise the user's cache is used.

    Returns:
        Figures by name; `vehicle_updates_per_s` counts vehicles on the road, `slot_updates_per_s` slots.
        Times in s, memory in bytes. `load_s` is None unless `cold`; `peer` has a `reason` if it did not run.

    Raises:
        MapError: the map cannot be used, or not with these numbers.
    """
    options = {"worlds": worlds, "vehicles": vehicles, "seconds": seconds, "rate": rate, "repeats": repeats}
    with tempfile.TemporaryDirectory(prefix="limsim-jax-bench-") as folder:

        def run(repeats: int) -> dict[str, Any]:
            told = json.dumps(options | {"repeats": repeats})
            return _child("traffic", str(path), told, cores=_cores(), cache=folder if cold else None)

        result = run(repeats)
        result["load_s"] = run(0)["compile_s"] if cold else None
        result["peak_memory"] = result.pop("device_memory") or round(result["peak_memory_mb"] * 1e6)
        for name in ("process_s", "peak_memory_mb"):
            del result[name]
        result["peer"], result["ratio"] = None, None
        if peer:
            found = _peer(Path(path), Path(folder), rate, result["mean_vehicles"], seconds)
            result["peer"] = found
            if "reason" not in found:
                result["ratio"] = result["vehicle_updates_per_s"] / found["vehicle_updates_per_s"]
    return result


def bench_policy(
    experiment: str, policy: str | None = None, *, worlds: int = 64, repeats: int = 5, cold: bool = False
) -> dict[str, Any]:
    """Time the decisions of an experiment's policy alone: of one world on one core, and of many on all.

    Args:
      experiment: file, or one that comes along.
      policy: instead of the experiment's.
      worlds: of the batch.
      repeats: runs of which the median counts.
      cold: compile with an empty cache; otherwise the user's cache is used.

    Returns:
      `latency_s`: of a call for one world from the host, on one core or on the accelerator;
      `amortised_s`: per planned vehicle and decision in the batch, on all cores; both with `_compile_s`;
      `planned`: vehicles that the policy plans for in a world.
    """
    told = {"policy": policy, "repeats": repeats}
    with tempfile.TemporaryDirectory(prefix="limsim-jax-bench-") as folder:
        cache = folder if cold else None
        one, many = (
            _child("policy", experiment, json.dumps(told | {"worlds": count}), cores=cores, cache=cache)
            for count, cores in ((1, _cores()[:1]), (worlds, _cores()))
        )
    return {name: many[name] for name in ("scenario", "policy", "device", "platform", "cores", "planned")} | {
        "worlds": many["worlds"],
        "latency_s": one["call_s"],
        "latency_compile_s": one["compile_s"],
        "amortised_s": many["call_s"] / (many["worlds"] * max(many["planned"], 1)),
        "amortised_compile_s": many["compile_s"],
    }


def policy_lines(result: dict[str, Any]) -> list[tuple[str, str]]:
    """The result of `bench_policy` as names and values to print."""
    r = result
    return [
        ("policy", f"{r['policy']} in {r['scenario']}, {r['planned']} planned vehicles per world"),
        ("device", f"{r['device']}, {r['cores']} cores"),
        ("one decision", f"{1e3 * r['latency_s']:.2f} ms for one world, one core"),
        (
            "amortised",
            f"{1e3 * r['amortised_s']:.3f} ms per planned vehicle, {r['worlds']} worlds, all cores",
        ),
        (
            "compile",
            f"{r['latency_compile_s']:.1f} s for one world, {r['amortised_compile_s']:.1f} s for many",
        ),
    ]


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
        "read_s": "read the file: `read_network`",
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


def traffic_lines(result: dict[str, Any]) -> list[tuple[str, str]]:
    """The result of `bench_traffic` as names and values to print."""
    r, peer = result, result["peer"]
    compile_s = f"{r['compile_s']:.1f} s" + (" (from the cache)" if r["from_cache"] else " cold")
    if r["load_s"] is not None:
        compile_s += f", {r['load_s']:.1f} s from the cache"
    lines = [
        (
            "map",
            f"{r['map']}: {r['worlds']} worlds x {r['vehicles']} slots x {r['steps']} steps of {r['dt']:g} s",
        ),
        ("device", f"{r['device']}, {r['devices']} device{'s' * (r['devices'] > 1)}, {r['cores']} cores"),
        (
            "vehicle-updates/s",
            f"{r['vehicle_updates_per_s']:.3g}, {r['mean_vehicles']:.1f} vehicles per world",
        ),
        ("slot-updates/s", f"{r['slot_updates_per_s']:.3g}"),
        ("world-steps/s", f"{r['world_steps_per_s']:.3g}"),
        ("run", f"{r['run_s']:.2f} s, median of {r['repeats']}"),
        ("trace and compile", compile_s),
        ("peak memory", f"{r['peak_memory'] / 1e6:.0f} MB"),
    ]
    if peer is not None and "reason" in peer:
        lines.append(("SUMO", f"not run: {peer['reason']}"))
    elif peer is not None:
        lines += [
            (
                peer["name"],
                f"{peer['vehicle_updates_per_s']:.3g} vehicle-updates/s, {peer['processes']} processes, "
                f"{peer['mean_vehicles']:.1f} vehicles per world",
            ),
            ("ratio", f"{r['ratio']:.1f}"),
        ]
    return lines


def _cores() -> list[int]:
    """Cores that this process may use; empty where the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []  # Linux


def _child(stage: str, *arguments: str, cores: Sequence[int], cache: str | None) -> dict[str, Any]:
    """Run a stage in its own process and return its figures; `cache` None: that of the user."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "limsim_jax.bench", ",".join(map(str, cores)), stage, *arguments],
        capture_output=True,
        text=True,
        env=os.environ | ({} if cache is None else {"LIMSIM_JAX_CACHE": cache}),
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
    run: dict[str, Callable[..., dict[str, Any]]] = {
        "cold": _cold,
        "cached": _cached,
        "look_ups": _look_ups,
        "traffic": _traffic,
        "policy": _policy,
        "sumo": _sumo,
    }
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
    from limsim_jax.maps import rasterise as _rasterise  # noqa: F401  what build_lane_map needs

    jax.devices()
    imported = time.perf_counter()
    network = maps.read_network(path, cache=cache)
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


def _traffic(path: str, told: str) -> dict[str, Any]:
    """Time many worlds."""
    import jax
    import numpy as np

    from limsim_jax.maps import build_lane_map, read_network
    from limsim_jax.simulation.rollout import Rollout
    from limsim_jax.simulation.worlds import Worlds
    from limsim_jax.traffic.demand import sample_scenario
    from limsim_jax.traffic.engine import Traffic
    from limsim_jax.types import Config
    from limsim_jax.xla import use_all_cores

    options = json.loads(told)
    worlds, slots, seconds, repeats = (options[x] for x in ("worlds", "vehicles", "seconds", "repeats"))
    use_all_cores()
    hits = []
    jax.monitoring.register_event_listener(
        lambda event, **_: hits.append(event) if event == "/jax/compilation_cache/cache_hits" else None
    )
    network = read_network(path)
    lane_map = build_lane_map(network)
    demand = _full(network, lane_map, options["rate"], slots, seconds)
    run = Rollout(Config(dt=DT), Traffic(), seconds)
    before, start = len(hits), time.perf_counter()
    many = Worlds(run, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), chunk=worlds)
    many.compile()
    compile_s = time.perf_counter() - start
    steps = run.decisions * run.config.decision_every
    seconds_of, updates_of = [], []
    for i in range(repeats + 1 if repeats else 0):  # the first one does not count
        start = time.perf_counter()
        totals = many.run_totals(range(i * many.chunk, (i + 1) * many.chunk))
        seconds_of.append(time.perf_counter() - start)
        updates_of.append(float(np.sum(totals.time, dtype=np.float64)) / DT)
    device = jax.devices()[0]
    facts = {
        "map": Path(path).name,
        "worlds": many.chunk,
        "vehicles": slots,
        "steps": steps,
        "dt": DT,
        "seconds": seconds,
        "rate": options["rate"],
        "initial": demand.initial,
        "device": _processor() if device.platform == "cpu" else device.device_kind,
        "platform": device.platform,
        "devices": jax.local_device_count(),
        "cores": len(_cores()) or os.cpu_count(),
        "jax": jax.__version__,
        "limsim_jax": __version__,
        "compile_s": compile_s,
        "from_cache": len(hits) > before,
        "repeats": repeats,
        "device_memory": (device.memory_stats() or {}).get("peak_bytes_in_use"),
    }
    if not repeats:
        return facts
    run_s, updates = statistics.median(seconds_of[1:]), statistics.median(updates_of[1:])
    rates = [updates / s for updates, s in zip(updates_of[1:], seconds_of[1:], strict=True)]
    return facts | {
        "run_s": run_s,
        "mean_vehicles": updates / (many.chunk * steps),
        "vehicle_updates_per_s": statistics.median(rates),
        "slot_updates_per_s": many.chunk * slots * steps / run_s,
        "world_steps_per_s": many.chunk * steps / run_s,
    }


def _policy(experiment: str, told: str) -> dict[str, Any]:
    """Time decisions of a policy at the start of worlds."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    from limsim_jax.policies.base import sighted
    from limsim_jax.simulation.rollout import started
    from limsim_jax.simulation.worlds import over_worlds
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.sweeps.experiment import read_experiments
    from limsim_jax.xla import enable_compilation_cache, run_once, use_all_cores

    options = json.loads(told)
    use_all_cores()
    enable_compilation_cache()
    (read,) = read_experiments(experiment, policy=options["policy"])
    episodes = Episodes(read)
    run, lane_map = episodes.rollout, episodes.lane_map
    policy = sighted(run.policy)
    devices = jax.local_devices()[: options["worlds"]]
    worlds = -(-options["worlds"] // len(devices)) * len(devices)
    mesh = Mesh(np.array(devices), ("worlds",))
    lane_map = jax.device_put(lane_map, NamedSharding(mesh, PartitionSpec()))

    def begin(lane_map: Any, seed: Any) -> Any:
        world = started(run, lane_map, episodes.sample, seed)
        return world.carry.state, world.carry.memory, world.key

    def decide(lane_map: Any, world: Any) -> Any:
        return policy(run.config, lane_map, *world)

    begun = over_worlds(begin, mesh, run_once())(lane_map, jnp.arange(worlds, dtype=jnp.int32))
    jax.block_until_ready(begun)
    start = time.perf_counter()
    compiled = over_worlds(decide, mesh).lower(lane_map, begun).compile()
    compile_s = time.perf_counter() - start
    runs = []
    for _ in range(10 * options["repeats"] + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(lane_map, begun))
        runs.append(time.perf_counter() - start)
    device = jax.devices()[0]
    return {
        "scenario": read.name,
        "policy": read.policy,
        "device": _processor() if device.platform == "cpu" else device.device_kind,
        "platform": device.platform,
        "cores": len(_cores()) or os.cpu_count(),
        "planned": begun[0].egos.slot.shape[1],
        "worlds": worlds,
        "call_s": statistics.median(runs[1:]),
        "compile_s": compile_s,
    }


def _full(network: Network, lane_map: LaneMap, rate: float, slots: int, seconds: float) -> Demand:
    """Traffic that starts with full slots, or with full roads."""
    from limsim_jax.sweeps.build import plain_demand

    vehicles = slots
    while True:
        try:
            return plain_demand(network, lane_map, rate=rate, vehicles=vehicles, seconds=seconds)[0]
        except ValueError as error:
            if "places" not in str(error):
                raise MapError(str(error)) from error
            vehicles = int(0.8 * vehicles)


# --- the peer ----------------------------------------------------------------------------------------


def _peer(path: Path, folder: Path, rate: float, vehicles: float, seconds: float) -> dict[str, Any]:
    """SUMO on the same map with the same flows; `reason` if it cannot run."""
    name = "SUMO"
    try:
        import libsumo  # pyright: ignore[reportMissingImports]
        import sumolib

        name = f"SUMO {libsumo.getVersion()[1].removeprefix('SUMO ')}"
        net = _sumo_network(path, folder)
        routes = _sumo_demand(sumolib.net.readNet(str(net)), folder, rate, round(vehicles), seconds)
    except ModuleNotFoundError as error:
        return {"name": name, "reason": f"{error.name} is not installed"}
    except _NoPeer as error:
        return {"name": name, "reason": str(error)}
    cores = _cores() or list(range(os.cpu_count() or 1))
    with ThreadPoolExecutor(len(cores)) as pool:
        runs = list(
            pool.map(
                lambda core: _child("sumo", str(net), str(routes), str(seconds), cores=[core], cache=None),
                cores,
            )
        )
    return {
        "name": name,
        "processes": len(cores),
        "model": "IDM, LC2013",
        "vehicle_updates_per_s": sum(run["updates"] / run["step_s"] for run in runs),
        "mean_vehicles": sum(run["updates"] for run in runs) / sum(run["steps"] for run in runs),
        "episodes": sum(run["episodes"] for run in runs),
    }


class _NoPeer(Exception):
    """Why SUMO cannot be compared with."""


def _sumo_network(path: Path, folder: Path) -> Path:
    """The map as a SUMO network."""
    if path.name.removesuffix(".gz").endswith(".net.xml"):
        return path
    try:
        import sumo  # the wheel that brings the programs

        program = str(Path(sumo.SUMO_HOME) / "bin" / "netconvert")
    except ModuleNotFoundError:
        program = shutil.which("netconvert")
    if program is None or not Path(program).exists():
        raise _NoPeer("netconvert is not installed (eclipse-sumo)")
    net = folder / "map.net.xml"
    # turns at dead ends, which netconvert would add, make loops of ways out
    command = [program, "--opendrive-files", str(path), "--no-turnarounds", "true", "-o", str(net)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode or not net.exists():
        said = (done.stderr.strip() or "no message").splitlines()[-1]
        raise _NoPeer(f"netconvert cannot convert {path.name}: {said}")
    return net


def _sumo_demand(net: Any, folder: Path, rate: float, vehicles: int, seconds: float) -> Path:
    """Flows from every entry to every exit in equal shares; vehicles at the start."""
    edges = {edge.getID(): edge for edge in net.getEdges() if edge.allows("passenger")}
    after = {
        name: [x.getID() for x in edge.getOutgoing() if x.getID() in edges] for name, edge in edges.items()
    }
    entered = {x for names in after.values() for x in names}

    def exits(start: str) -> list[str]:
        seen, new = {start}, [start]
        while new:
            new = [x for name in new for x in after[name] if not (x in seen or seen.add(x))]
        return sorted(x for x in seen if not after[x])

    reach = {name: found for name in edges if (found := exits(name))}
    sources = [name for name in reach if name not in entered]
    if not reach or (rate > 0 and not sources):
        raise _NoPeer("the converted network has no way in and out")
    rng = random.Random(0)
    lines = ['<routes><vType id="car" carFollowModel="IDM"/>']
    weight = [edges[x].getLength() * edges[x].getLaneNumber() for x in reach]
    for i, name in enumerate(rng.choices(list(reach), weight, k=vehicles)):
        lines.append(
            f'<trip id="start{i}" type="car" depart="0" from="{name}" to="{rng.choice(reach[name])}" '
            'departPos="random_free" departLane="random" departSpeed="desired"/>'
        )
    for name in sources if rate > 0 else []:
        for goal in reach[name]:
            each = rate / 3600 / len(reach[name])
            lines.append(
                f'<flow id="{name}_{goal}" type="car" begin="0" end="{seconds}" from="{name}" to="{goal}" '
                f'period="exp({each})" departLane="best" departSpeed="max"/>'
            )
    path = folder / "traffic.rou.xml"
    path.write_text("\n".join([*lines, "</routes>"]))
    return path


def _sumo(net: str, routes: str, seconds: str) -> dict[str, Any]:
    """Step episodes one after the other; only the steps are timed."""
    import libsumo  # pyright: ignore[reportMissingImports]

    steps, updates, episodes, spent = 0, 0, 0, 0.0
    while spent < PEER_TIME:
        options = ["-n", net, "-r", routes, "--step-length", str(DT), "--seed", str(episodes)]
        quiet = ["--no-step-log", "--no-warnings", "--xml-validation", "never", "--duration-log.disable"]
        libsumo.start(["sumo", *options, *quiet])
        libsumo.simulationStep()  # vehicles of the start enter
        start = time.perf_counter()
        for _ in range(round(float(seconds) / DT)):
            libsumo.simulationStep()
            updates += libsumo.vehicle.getIDCount()
        spent += time.perf_counter() - start
        libsumo.close()
        steps += round(float(seconds) / DT)
        episodes += 1
    return {"steps": steps, "updates": updates, "episodes": episodes, "step_s": spent}


def _time(function: Callable[..., Any], repeats: int, *arguments: Any) -> dict[str, float]:
    """Compile time, and the median time of a compiled call."""
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
