"""Where the time of a sweep goes: compiling by stage, running by part of the program.

    python experiments/sweep_profile.py [--experiments highway intersection roundabout] [--decisions 40]

One chunk of worlds runs on one core under JAX's profiler, after it has filled with traffic. Times are those
of XLA's kernels, without waiting; the profiler itself takes a part. Writes
experiments/results/sweep_profile.json and .md.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.profiler as profiler
import numpy as np
from readme_tables import sweep_profile

from limsim_jax.api.experiment import load_experiments
from limsim_jax.files import no_garbage_collection
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.xla import use_all_cores, without_compilation_cache

RESULTS = Path(__file__).parent / "results"

WORLDS, FILLING = 25, 60
"""Worlds of the chunk, and decisions before the first one that counts."""

PARTS = (
    ("metrics", ("ego_metrics", "course", "aside")),
    ("contacts of bodies", ("contacts",)),
    ("right of way", ("right_of_way", "lights")),
    ("neighbours", ("neighbors", "sort_vehicles", "beside_leaders", "look_ahead")),
    ("lane changes", ("choose_lane", "lane_change_motion")),
    ("car following", ("accelerations", "speeds")),
    ("motion", ("advance",)),
    ("departures", ("enter",)),
    ("other decisions", ("decide",)),
    ("records, other steps", ("",)),
)
"""Parts of a sweep and named scopes of them; the first that a kernel lies in counts."""

STAGES = (
    ("emission", ("ThunkEmitter::EmitEntryComputation", "ThunkEmitter::ConsumeKernels")),
    ("machine code", ("JitCompiler::Compile",)),
)
"""Stages of XLA and events of its profile; passes over the program are what these leave."""


def part_of(scopes: str) -> str:
    """The part of a kernel, from the name of its operation."""
    steps = set(re.sub(r"jit\([\w<>]*\)/", "", scopes).split("/"))
    return next(part for part, names in PARTS if steps & set(names) or names == ("",))


def profiled(run: Callable[[], Any]) -> tuple[Any, float, Counter[str], Counter[str]]:
    """A result, s, and ns and number of events by name.

    Events within an event do not count for it.
    """
    options = profiler.ProfileOptions()
    options.host_tracer_level, options.python_tracer_level = 2, 0
    with tempfile.TemporaryDirectory() as folder:
        profiler.start_trace(folder, profiler_options=options)
        begin = time.perf_counter()
        result = run()
        seconds = time.perf_counter() - begin
        profiler.stop_trace()
        (file,) = Path(folder).rglob("*.xplane.pb")
        data = profiler.ProfileData.from_file(str(file))
        spent, number = Counter(), Counter()
        for plane in data.planes:
            for line in plane.lines:
                open_: list[tuple[float, str]] = []
                events = [(x.start_ns, x.start_ns + x.duration_ns, x.name.split("#")[0]) for x in line.events]
                for start, end, name in sorted(events, key=lambda x: (x[0], -x[1])):
                    while open_ and open_[-1][0] <= start:
                        open_.pop()
                    if open_:
                        spent[open_[-1][1]] -= end - start
                    spent[name] += end - start
                    number[name] += 1
                    open_.append((end, name))
    return result, seconds, spent, number


def compiled(episodes: Episodes) -> tuple[list[str], dict[str, float]]:
    """Make the programs of a chunk, one after the other: their texts, and s of every stage."""
    worlds: Any = episodes.worlds
    stages: dict[str, Any] = defaultdict(float)
    none, lane_map = np.int32(0), worlds.lane_map

    def made(program: Any, *of: Any) -> Any:
        begin = time.perf_counter()
        traced = program.trace(*of)
        stages["trace"] += time.perf_counter() - begin
        begin = time.perf_counter()
        lowered = traced.lower()
        stages["lower"] += time.perf_counter() - begin
        found, seconds, spent, _ = profiled(lowered.compile)
        parts = {stage: sum(spent[name] for name in names) / 1e9 for stage, names in STAGES}
        parts["HLO passes"] = seconds - sum(parts.values())
        for stage, took in parts.items():
            stages[stage] += took
        return found

    with no_garbage_collection(), without_compilation_cache():
        begin = time.perf_counter()
        start = worlds._start_jit.lower(lane_map, worlds._inputs(np.zeros(worlds.chunk, np.int32)))
        before = {"trace and lower the start": time.perf_counter() - begin}
        worlds._start = start.compile()
        begun, first = start.out_info
        carry = begun.carry._replace(measured=None)
        worlds._drive = made(worlds._drive_jit, (lane_map, none), (begun.schedule, begun.key), carry)
        seen = worlds._drive.out_info[1].tree._replace(trace=None)
        shared = lane_map, none, np.bool_(False)
        worlds._look = made(worlds._look_jit, shared, (begun.schedule, first, seen), begun.carry.measured)
    return [worlds._drive.as_text(), worlds._look.as_text()], before | stages


def kernels(text: str) -> tuple[dict[str, str], Counter[str]]:
    """Of a compiled program: the operation of every kernel, and instructions by part."""
    sizes: Counter[str] = Counter()
    body = ""
    for line in text.split("\n"):
        if head := re.match(r"^(?:ENTRY )?%?([\w.\-]+) \(.*\{$", line):
            body = head[1]
        elif " = " in line:
            sizes[body] += 1
    named, instructions = {}, Counter()
    for name, rest in re.findall(r"\n\s+(?:ROOT )?%?([\w.\-]+) = ([^\n]*)", text):
        operation = re.search(r'op_name="([^"]*)"', rest)
        named[name] = operation[1] if operation else ""
        if called := re.search(r" fusion\(.*calls=%?([\w.\-]+)", rest):
            instructions[part_of(named[name])] += sizes[called[1]]
    return named, instructions


def measure(name: str, decisions: int) -> dict[str, Any]:
    """Stages of compiling, and ms per decision, kernels and instructions by part."""
    episodes = load_experiments(name)[0].episodes(chunk=WORLDS)
    texts, stages = compiled(episodes)
    worlds: Any = episodes.worlds
    state, _ = jax.block_until_ready(worlds.advance(worlds.start(range(WORLDS)), FILLING))
    begin = time.perf_counter()
    state, _ = jax.block_until_ready(worlds.advance(state, decisions))
    seconds = time.perf_counter() - begin
    parts: dict[str, Any] = {part: {"ms": 0.0, "kernels": 0.0, "instructions": 0} for part, _ in PARTS}
    schedule, key, carry = state
    some = min(decisions, worlds.rollout.kept(carry.state))
    shared, of = (worlds.lane_map, np.int32(some)), carry._replace(measured=None)

    def drive() -> Any:
        return jax.block_until_ready(worlds._drive(shared, (schedule, key), of))

    def look() -> Any:
        return jax.block_until_ready(
            worlds._look((*shared, np.bool_(False)), (schedule, worlds._nothing[0], seen), carry.measured)
        )

    (_, kept), _, *driven = profiled(drive)
    seen = kept.tree._replace(trace=None)
    _, _, *looked = profiled(look)
    for text, (spent, number) in zip(texts, (driven, looked), strict=True):
        named, instructions = kernels(text)
        for part, _ in PARTS:
            parts[part]["instructions"] += instructions[part]
        for kernel, operation in named.items():
            here = parts[part_of(operation)]
            here["ms"] += spent[kernel] / 1e6 / some
            here["kernels"] += number[kernel] / some
    slots, config = episodes.experiment.slots, episodes.rollout.config
    updates = WORLDS * slots * config.decision_every
    return {
        "experiment": name,
        "worlds": WORLDS,
        "slots": slots,
        "ms_per_decision": 1e3 * seconds / decisions,
        "slot_updates_per_s": updates * decisions / seconds,
        "stages_s": stages,
        "parts": parts,
    }


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--experiments", nargs="+", default=["highway", "intersection", "roundabout"])
    parser.add_argument("--decisions", type=int, default=40)
    options = parser.parse_args()
    use_all_cores(1, spare=False)
    found = {"experiments": [measure(name, options.decisions) for name in options.experiments]}
    (RESULTS / "sweep_profile.json").write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "sweep_profile.md").write_text(
        "Regenerate: `python experiments/sweep_profile.py`\n\n" + sweep_profile(found) + "\n"
    )


if __name__ == "__main__":
    main()
