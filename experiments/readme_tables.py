"""Put the measured figures into docs and README.

python experiments/readme_tables.py           write them
python experiments/readme_tables.py --check   fail unless they are there already
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[1]
PAPER = {"highway": 76.3, "ramp": 64.6, "intersection": 86.3, "roundabout": 72.1, "long_route": 78.8}
"""Driving scores of LimSim-TM in the LimSim paper, and with that its five scenarios."""


INTERFUSER = {"highway": 51.0, "ramp": 54.2, "intersection": 65.2, "roundabout": 28.0, "long_route": 37.6}
"""Driving scores of InterFuser in the LimSim paper."""


def carla(result: dict[str, Any]) -> str:
    """The towns of CARLA one by one, other maps together."""
    rows = [
        "| map | waypoints | host lanes off, mm (max) | device lanes off, mm (median / max) "
        "| heading off (max) | junctions with equal movements |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for entry in result["maps"]:
        figures = entry["figures"]
        if "town" in entry["map"]:
            host, device = figures["host"], figures["device"]
            rows.append(
                f"| `{entry['map']}` | {figures['waypoints']:,} | {host['max']:.2f} "
                f"| {device['median']:.3f} / {device['max']:.2f} | {figures['heading_deg']:.3f}° "
                f"| {figures['junctions_equal']} of {figures['junctions']} |"
            )
    judged = [entry for entry in result["maps"] if entry["failure"] is None]
    waypoints = sum(entry["figures"]["waypoints"] for entry in judged)
    missed = [f"`{entry['map']}`" for entry in judged if entry["misses"]]
    missing = f"All thresholds are met but on {', '.join(missed)}." if missed else "All thresholds are met."
    rows += [
        "",
        f"{len(result['maps'])} maps in all; on {len(result['maps']) - len(judged)} CARLA's parser fails. "
        f"{waypoints:,} waypoints. {missing}",
    ]
    return "\n".join(rows)


def sumo(result: dict[str, Any]) -> str:
    """One sentence over all networks."""
    networks = result["networks"]
    compared = sum(sum(network["compared"].values()) for network in networks)
    mismatches = sum(len(network["mismatches"]) for network in networks)
    return f"{len(networks)} networks, {compared:,} values compared, {mismatches or 'no'} mismatches."


def speed(result: dict[str, Any]) -> str:
    """Times from file to arrays, and look-ups per second."""
    cold, cached, machine = result["cold"], result["cached"], result["machine"]
    largest = max(row["batch"] for row in result["look_ups"])
    rate = {
        row["function"]: row["look_ups_per_s"] / 1e6 for row in result["look_ups"] if row["batch"] == largest
    }
    rows = {
        "read, rasterised, with all tables": f"{cold['total_s']:.2f} s",
        "the same from the cache": f"{cached['total_s']:.3f} s",
        "`pose`: lane coordinates to position and heading": f"{rate['pose']:.1f} million per second",
        "`to_frenet`: back, from a guess": f"{rate['to_frenet']:.1f} million per second",
        "`project`: back, anywhere on the map": f"{rate['project']:.2f} million per second",
    }
    cores = f"{machine['cores']} core{'' if machine['cores'] == 1 else 's'}"
    head = [f"| `{result['map']['file']}`, {cores}, {machine['processor']} | |", "|---|---:|"]
    return "\n".join(head + [f"| {name} | {figure} |" for name, figure in rows.items()])


def soundness(result: dict[str, Any]) -> str:
    """What went wrong in many episodes."""
    rows = [
        "| map | episodes | vehicles | vehicle-km | collisions | two where lanes cross (against priority) "
        "| gridlock | off road | red light | have to change lanes | never did | hardest braking, m/s² |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in result["maps"]:
        rows.append(
            f"| {r['map']} | {r['episodes']} | {r['entered']:,} | {r['vehicle_km']:,.0f} "
            f"| {r['collided_episodes']} | {r['together']} ({r['against_priority']}) | {r['gridlock']} "
            f"| {r['off_road']} | {100 * r['ran_red'] / r['entered']:.2f} % | {r['must_change']:,} "
            f"| {r['missed_percent']:.2f} % | {r['deceleration']:.1f} |"
        )
    return "\n".join(rows)


def random_maps(result: dict[str, Any]) -> str:
    """Shares of maps and episodes with a fault, by kind of map."""
    head = [
        "kind", "maps", "not run", "episodes", "of these with a contact", "maps without a contact",
        "episodes with a crossing against priority", "with gridlock", "with a vehicle off the road",
        "hardest braking, m/s²", "vehicle-km",
    ]  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|---{'|---:' * (len(head) - 1)}|"]
    kinds = list(dict.fromkeys(row["kind"] for row in sorted(result["rows"], key=lambda row: row["map"])))
    for kind in [*kinds, "all"]:
        mine = [row for row in result["rows"] if kind in (row["kind"], "all")]
        run = [row for row in mine if "episodes" in row]
        bad = {name: [len(row[f"{name}_worlds"]) for row in run] for name in _FAULTS}
        clean = 100 * sum(not count for count in bad["contact"]) / max(len(run), 1)
        cells = [
            kind, str(len(mine)), str(len(mine) - len(run)), f"{sum(row['episodes'] for row in run):,}",
            str(sum(bad["contact"])), f"{clean:.1f} %",
            *(str(sum(bad[name])) for name in _FAULTS[1:]),
            f"{max((row['deceleration'] for row in run), default=0):.1f}",
            f"{sum(row['vehicle_km'] for row in run):,.0f}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


_FAULTS = "contact", "against", "gridlock", "off_road"


def merge(result: dict[str, Any]) -> str:
    """Ramps of 200 m, next to SUMO."""
    rows = [
        "| ramp | motorway, veh/h | ramp, veh/h | have to change lanes | stood before: ours, SUMO "
        "| never did: ours, SUMO | mean speed, m/s: ours, SUMO |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for r in result["rows"]:
        ours, sumo = r["ours"], r["SUMO"]
        stood, missed = (
            ", ".join(f"{100 * x[name] / max(x['must_change'], 1):.2f} %" for x in (ours, sumo))
            for name in ("stood", "missed")
        )
        rows.append(
            f"| {r['case']} | {r['motorway']:,.0f} | {r['ramp']:,.0f} | {ours['must_change']:,} "
            f"| {stood} | {missed} | {ours['speed']:.1f}, {sumo['speed']:.1f} |"
        )
    return "\n".join(rows)


def traffic_speed(result: dict[str, Any]) -> str:
    """Vehicle-updates per second, next to SUMO."""
    rows = [
        "| map | worlds x slots | vehicle-updates/s | slot-updates/s | SUMO on the same cores | ratio |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for r in result["cases"]:
        peer = r["peer"] or {}
        sumo = f"{peer['vehicle_updates_per_s']:,.0f}" if "vehicle_updates_per_s" in peer else "not run"
        ratio = f"{r['ratio']:.1f}" if r.get("ratio") else ""
        rows.append(
            f"| {r['map']} | {r['worlds']} x {r['vehicles']} | {r['vehicle_updates_per_s']:,.0f} "
            f"| {r['slot_updates_per_s']:,.0f} | {sumo} | {ratio} |"
        )
    first = result["cases"][0]
    rows += [
        "",
        f"{first['device']}, {first['cores']} cores, steps of {first['dt']:g} s. Compiling took "
        f"{first['compile_s']:.0f} s, loading the compiled program {first['load_s']:.0f} s.",
    ]
    return "\n".join(rows)


def sensor_speed(result: dict[str, Any]) -> str:
    """Frames per second of each sensor on one core."""
    rows = ["| sensor | rays | frames per second | compile, s |", "|---|---:|---:|---:|"]
    for r in result["rows"]:
        rows.append(f"| {r['sensor']} | {r['rays']:,} | {r['frames_per_s']:,} | {r['compile_s']:.1f} |")
    bodies = result["boxes"] - result["lights"]
    rows += [
        "",
        f"One CPU core, {result['worlds']} worlds at once, JAX {result['jax']}. Each frame "
        f"has {result['boxes']} boxes: {bodies} vehicles and {result['lights']} lights.",
    ]
    return "\n".join(rows)


def traffic_sumo(result: dict[str, Any]) -> str:
    """One lane in a sentence, networks side by side."""
    one = result["one_lane"]["ballistic, as ours"]

    def mean(runs: list[dict[str, Any]], name: str) -> float:
        values = [run[name] for run in runs if run[name] is not None]  # no vehicle may arrive in a jam
        return sum(values) / max(len(values), 1)

    rows = [
        "| network, SUMO (IDM) / ours (ACC-IDM) | arrived, veh/h | mean speed, m/s | travel time, s "
        "| jammed or teleported | in collisions |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, network in result["networks"].items():
        theirs, ours = (network["runs"][x] for x in ("SUMO, IDM", "ours, ACC-IDM"))
        pairs = [
            f"{mean(theirs, key):,.{digits}f} / {mean(ours, key):,.{digits}f}"
            for key, digits in (("arrived_per_hour", 0), ("mean_speed", 1), ("travel_time", 0))
        ]
        teleports = sum(run["teleports"] for run in theirs)
        jams = f"{teleports} vehicles / {sum(run['gridlock'] for run in ours)} of {len(ours)} runs"
        hit = (sum(run[key] for run in runs) for key, runs in (("collisions", theirs), ("collided", ours)))
        collisions = " / ".join(map(str, hit))
        rows.append(f"| `{name}` | {' | '.join(pairs)} | {jams} | {collisions} |")
    head = (
        f"One lane: 20 unequal vehicles in stop-and-go for 300 s, IDM, ballistic steps: positions agree to "
        f"{1000 * one['position_rms']:.0f} mm RMS and {1000 * one['position_max']:.0f} mm at most after "
        f"{one['driven'] / 1000:.1f} km."
    )
    return "\n".join([head, "", *rows])


def sweep_speed(result: dict[str, Any]) -> str:
    """How long sweeps take."""
    rows = ["| sweep | seeds | from command to table, s | peak memory, MB |", "|---|---:|---:|---:|"]
    for r in result["sweeps"]:
        rows.append(f"| {r['experiment']} | {r['seeds']:,} | {r['wall_s']:.0f} | {r['peak_memory_mb']:,} |")
    few, more = result["sweeps"][:2]
    seeds, seconds = more["seeds"] - few["seeds"], more["wall_s"] - few["wall_s"]
    rows += ["", f"Most of it is compiling: {seeds:,} worlds of 60 s more take {seconds:.0f} s more."]
    if result.get("waits"):
        rows += [
            "", "With table, report and six replays:", "",
            "| experiment | policy | seeds | cache | wall, s | CPU, s | memory, MB | compiled | loaded |",
            "|---|---|---:|---|---:|---:|---:|---:|---:|",
        ]  # fmt: skip
    for r in result.get("waits", []):
        rows.append(
            f"| {r['experiment']} | {r['policy']} | {r['seeds']} | {r['cache']} | {r['wall_s']:.1f} "
            f"| {r['cpu_s']:.1f} | {r['peak_memory_mb']:,} | {r['compiled']} | {r['loaded']} |"
        )
    return "\n".join(rows)


def scaling(result: dict[str, Any]) -> str:
    """What worlds, slots and workers cost."""
    rows = [
        "| map | worlds | slots | slot-updates/s | us of a core per slot and step | peak memory, MB |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for r in [*result["worlds"], *result["slots"]]:
        rows.append(
            f"| {r['map']} | {r['worlds']:,} | {r['slots']:,} | {r['slot_updates_per_s']:,.0f} "
            f"| {r['us_per_slot']:.2f} | {r['peak_memory_mb']:,} |"
        )
    one = result["workers"][0]
    rows += ["", "| Ray workers | worlds | s | times as fast |", "|---:|---:|---:|---:|"]
    for r in result["workers"]:
        rows.append(f"| {r['workers']} | {r['seeds']:,} | {r['s']:.1f} | {one['s'] / r['s']:.2f} |")
    return "\n".join(rows)


def sweep_profile(result: dict[str, list[dict[str, Any]]]) -> str:
    """Where the time of a sweep goes."""
    found = result["experiments"]
    one = found[0]

    def row(label: str, cell: Callable[[dict[str, Any]], str]) -> str:
        return f"| {label} | {' | '.join(map(cell, found))} |"

    def head(label: str) -> list[str]:
        return [row(label, lambda one: one["experiment"]), f"|---|{'---:|' * len(found)}"]

    def spent(part: str) -> Callable[[dict[str, Any]], str]:
        return lambda one: f"{one['parts'][part]['ms']:.2f} ({one['parts'][part]['kernels']:.0f})"

    def took(stage: str) -> Callable[[dict[str, Any]], str]:
        return lambda one: f"{one['stages_s'][stage]:.1f}"

    return "\n".join(
        [
            *head("part of a run, ms per decision"),
            *(row(part, spent(part)) for part in one["parts"]),
            row("all, without the profiler", lambda one: f"{one['ms_per_decision']:.2f}"),
            "", f"{one['worlds']} worlds on one core; in brackets, kernels that run.", "",
            *head("stage of compiling, s"),
            *(row(stage, took(stage)) for stage in one["stages_s"]),
        ]
    )  # fmt: skip


def calibration(result: dict[str, Any]) -> str:
    """How well drivers can be fitted."""
    rows = [
        "| recordings | model | drivers | hours | error, calibration | error, rest of the time |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for one in result.values():
        for model, found in one.get("models", {}).items():
            first, rest = (found["errors"][part]["mixed"]["median"] for part in ("calibration", "validation"))
            rows.append(
                f"| {one['title']} | {model} | {one['drivers']} | {one['seconds'] / 3600:.1f} "
                f"| {100 * first:.1f} % | {100 * rest:.1f} % |"
            )
    made = result["synthetic"]["parameters"]
    errors = (f"{name} {100 * made[name]['median_error']:.1f} %" for name in made)
    rows += ["", f"Median over drivers. Median error of parameters on made-up drivers: {', '.join(errors)}."]
    fits = [
        (model, one["drivers"], row)
        for one in result.values()
        for model, row in one.get("models", {}).items()
    ]
    beside = []
    for model in dict.fromkeys(model for model, *_ in fits):
        mine = [(drivers, row) for name, drivers, row in fits if name == model]
        lm, de = (sum(row[f"{method}_worse"] for _, row in mine) for method in ("lm", "de"))
        beside.append(
            f"{lm} of {sum(drivers for drivers, _ in mine)} with {model.upper()} (the other way {de})"
        )
    times = [row["lm_seconds"] / row["de_seconds"] for *_, row in fits]
    rows += [
        "",
        "Levenberg-Marquardt beside differential evolution, on the same data and objective: worse by more "
        f"than 1 % for {', '.join(beside)} drivers, in {min(times):.2f} to {max(times):.2f} of its time.",
    ]
    return "\n".join(rows)


def closed_loop(result: dict[str, Any]) -> str:
    """What is left of the default population's distances on held-out periods."""
    rows = [
        "| recordings | headway | speed | gap | flow |",
        "|---|---:|---:|---:|---:|",
    ]
    for one in result.values():
        if "left_of_default" not in one:
            continue
        before, after = one["held_out"]["default"], one["held_out"]["closed_loop"]
        halves, own = one["floor"], one["from_own"]
        cells = [
            f"{100 * one['left_of_default'][name]:.0f} %: {before[name]:.3g} to {after[name]:.3g} {unit} "
            f"({own[name]:.3g}, {halves[name]:.3g})"
            for name, unit in (("headway", "s"), ("speed", "m/s"), ("gap", "m"), ("flow", "veh/h"))
        ]
        rows.append(f"| {one['title']} | {' | '.join(cells)} |")
    return "\n".join(rows)


def policies(result: dict[str, Any], few: bool = False) -> str:
    """Scenarios and policies, with intervals; `few`: also of the first seeds, as many as the paper has."""
    titles = {"decision_ms": "decision, ms", "amortised_ms": "per vehicle in a batch, ms"}
    times = {name: title for name, title in titles.items() if any(name in r for r in result["rows"])}
    heads = ["scenario", "policy", "knows", "seeds", "success, %", "route completion, %",
             "LimSim driving score", "contact at fault, %", "near miss, %", "others in contact", "gridlocks",
             *times.values()]  # fmt: skip
    rows = [
        f"| {' | '.join(heads)} |",
        f"|---|---|---|---:|---|---:|---|---|---:|---:|---:|{'---:|' * len(times)}",
    ]
    parts = [[row, row | row["few"]] if few and "few" in row else [row] for row in result["rows"]]
    for r in itertools.chain.from_iterable(parts):
        fault, _, bound = (100 * x for x in r["at_fault_contacts"])
        theirs = f" ({PAPER[r['scenario']]})" if r["policy"].startswith("limsim_tm") else ""
        took = "".join(f" {r[name]:.2g} |" if name in r else " |" for name in times)
        rows.append(
            f"| {r['scenario']} | {r['policy']} | {r['knows']} | {r['seeds']:,} "
            f"| {bounded(r['success'], 100)} "
            f"| {100 * r['completion'][0]:.1f} | {bounded(r['score'])}{theirs} "
            f"| {fault:.1f} (at most {bound:.1f}) | {100 * r['near_misses'][0]:.1f} "
            f"| {r['others_collided']} | {r.get('gridlocks', '')} |{took}"
        )
    devices = dict.fromkeys(r["worlds_device"] for r in result["rows"])
    timed = dict.fromkeys(r["device"] for r in result["rows"] if "device" in r)
    told = f"; decisions were timed on {' and '.join(timed)}" if timed else ""
    rows += ["", f"Worlds ran on {' and '.join(devices)}{told}."]
    if "own" in result:
        told = (
            f"`{r['policy']}` {r['decision_ms']:.2g} ms, {r['amortised_ms']:.2g} ms in a batch, "
            f"compiled in {r['compile_s']:.1f} s"
            for r in result["own"]
        )
        rows += ["", f"Policies of 20 lines (`experiments/own_policies.py`): {'; '.join(told)}."]
    return "\n".join(rows)


NETWORKS = (
    "end-to-end", "without the filter", "with faults", "untrained", "the filter alone", "without LiDAR",
    "without cameras", "waypoints", "without DAgger",
)  # fmt: skip
"""Rows of a scenario, in their order."""


def end_to_end(result: dict[str, Any]) -> str:
    """Variants of the end-to-end driver by scenario, and its card."""
    rows = [
        "| scenario | driver | seeds | success, % | route completion, % | LimSim driving score "
        "| contact at fault, % | off the road, % | red light run, % |",
        "|---|---|---:|---|---:|---|---:|---:|---:|",
    ]
    order = {name: k for k, name in enumerate([*PAPER, *NETWORKS])}
    last = len(order)
    place = lambda r: (order.get(r["scenario"], last), r["scenario"], order.get(r["driver"], last))  # noqa: E731
    for r in sorted(result["rows"], key=place):
        where = f"{r['scenario']}, held out" if r["held_out"] else r["scenario"]
        theirs = INTERFUSER.get(r["scenario"]) if r["driver"] == "end-to-end" else None
        rows.append(
            f"| {where} | {r['driver']} | {r['seeds']} | {bounded(r['success'], 100)} "
            f"| {100 * r['completion'][0]:.1f} | {bounded(r['score'])}"
            f"{'' if theirs is None else f' ({theirs})'} "
            f"| {100 * r['at_fault_contacts'][0]:.1f} | {100 * r['off_road'][0]:.1f} "
            f"| {100 * r['red_lights'][0]:.1f} |"
        )
    about = result["about"]
    samples = ", ".join(f"{name} {count:,}" for name, count in about["samples"].items())
    last = about["curve"][-1] if about["curve"] else {}
    rows += [
        "",
        f"The network: {about['parameters']:,} parameters, trained in {about['seconds'] / 60:.1f} min on "
        f"{about['device']} with version {about['version']} and JAX {about['jax']}. Samples: {samples}; "
        f"seeds from {min(first for first, _ in about['seeds'].values()):,} on; {about['rounds']} rounds "
        f"of DAgger, {about['steps']:,} steps. Losses of held-out samples at the end: "
        f"{', '.join(f'{k} {v:g}' for k, v in last.items() if k not in ('s', 'phase', 'loss'))}.",
    ]
    if others := result.get("ablations"):
        said = (
            f"{name} {r['seconds'] / 60:.0f} min on {r['device']}, {r['steps']:,} steps"
            for name, r in others.items()
        )
        rows += ["", f"Networks that lack something: {'; '.join(said)}."]
    return "\n".join(rows)


TITLES = {
    "pdm_closed": "PDM-Closed",
    "limsim_tm": "LimSim-TM",
    "end_to_end": "end-to-end",
    "rules": "rules, by chat",
    "camera": "pictures, by chat",
}
"""Drivers of the table of the paper."""


def drivers(result: dict[str, Any]) -> str:
    """Five scenarios, all kinds of drivers; `result` has the times of decisions."""
    rows = [
        "| scenario | driver | seeds | success, % | route completion, % | LimSim driving score "
        "| answered by the model, % |",
        "|---|---|---:|---|---:|---|---:|",
    ]
    asked = [name for name in read("language") if name.startswith("model ")]
    models = {name: f"{name.removeprefix('model ')}, by chat" for name in asked}
    for scenario in PAPER:
        for name, title in (TITLES | models).items():
            r = _driver_row(name, scenario)
            if r is None:
                continue
            share = r.get("statuses")
            answered = "" if share is None else f"{100 * (share['ok'] + share['repaired']):.1f}"
            rows.append(
                f"| {scenario} | {title} | {r['seeds']:,} | {bounded(r['success'], 100)} "
                f"| {100 * r['completion'][0]:.1f} | {bounded(r['score'])} | {answered} |"
            )
    rows += [
        "",
        "| driver | a decision of one world, ms | per vehicle in a batch, ms | compiled in, s |",
        "|---|---:|---:|---:|",
    ]
    for name, r in result["decisions"].items():
        rows.append(
            f"| {TITLES[name]} | {r['decision_ms']:.2g} | {r['amortised_ms']:.2g} | {r['compile_s']:.0f} |"
        )
    for name, title in [(x, TITLES[x]) for x in ("rules", "camera")] + list(models.items()):
        waits = [r["seconds_per_call"] for x in PAPER if (r := _driver_row(name, x)) is not None]
        if waits:
            rows.append(f"| {title}, per question | {1e3 * sum(waits) / len(waits):.2g} | | |")
    devices = dict.fromkeys(r["device"] for r in result["decisions"].values())
    return "\n".join([*rows, "", f"Timed in the roundabout on {' and '.join(devices)}."])


def _driver_row(name: str, scenario: str) -> dict[str, Any] | None:
    """How a driver drove in a scenario."""
    if name == "rules":
        one = read("language").get("rules", {}).get(scenario)
        shared = ("seeds", "statuses", "seconds_per_call")
        return None if one is None else one["over_chat"] | {x: one[x] for x in shared}
    if name == "camera" or name not in TITLES:
        key = "camera network" if name == "camera" else name
        return read("language").get(key, {}).get("experiments", {}).get(scenario)
    end_to_end_ = name == "end_to_end"
    kind, said = ("driver", "end-to-end") if end_to_end_ else ("policy", name)
    found = read("end_to_end" if end_to_end_ else "policies")["rows"]
    return next((r for r in found if r["scenario"] == scenario and r[kind] == said), None)


OUTCOMES = {
    "mean_speed": "speed of the ego, m/s",
    "min_distance": "least distance, m",
    "limsim_corrected_drive": "driving score",
    "traffic_mean_speed": "speed of all, m/s",
}
"""Metrics by which areas of interest are compared."""


def area_of_interest(result: dict[str, Any]) -> str:
    """Cost and fidelity by vehicles planned for and radius."""
    rows = [
        "| planned for beside the ego | within, m | CPU ms per world and s "
        f"| {' | '.join(OUTCOMES.values())} | collided | gridlock |",
        f"|---:|---:|---:|{'---|' * len(OUTCOMES)}---:|---:|",
    ]
    for r in result["rows"]:
        values = " | ".join(f"{r['means'][name][0]:.3g} ({r['distance'][name]:.2g})" for name in OUTCOMES)
        many = "everybody" if r["radius"] is None else r["slots"]
        within = f"{r['radius']:g}" if r["radius"] else ""
        rows.append(
            f"| {many} | {within} | {1e3 * r['seconds_per_world_second']:.1f} | {values} "
            f"| {r['episodes_with_traffic_collided']} | {r['episodes_with_gridlock']} |"
        )
    cores = f"{result['devices']} core{'' if result['devices'] == 1 else 's'}"
    rows += ["", f"{result['scenario']}, {result['seeds']} seeds, {result['device']}, {cores}."]
    return "\n".join(rows)


TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "area_of_interest": area_of_interest,
    "calibration": calibration,
    "closed_loop": closed_loop,
    "drivers": drivers,
    "end_to_end": end_to_end,
    "maps_against_carla": carla,
    "maps_against_sumo": sumo,
    "maps_speed": speed,
    "merge": merge,
    "policies": policies,
    "random_maps": random_maps,
    "sensor_speed": sensor_speed,
    "soundness": soundness,
    "scaling": scaling,
    "sweep_speed": sweep_speed,
    "sweep_profile": sweep_profile,
    "traffic_against_sumo": traffic_sumo,
    "traffic_speed": traffic_speed,
}


def success(result: dict[str, Any]) -> str:
    """For the README: policies down, scenarios across, the share of successes with its interval."""
    rows = result["rows"]
    scenarios, policies = (list(dict.fromkeys(r[name] for r in rows)) for name in ("scenario", "policy"))
    lines = [f"| policy | {' | '.join(scenarios)} |", f"|---|{'---|' * len(scenarios)}"]
    for policy in policies:
        cells = []
        for scenario in scenarios:
            (found,) = (r["success"] for r in rows if (r["scenario"], r["policy"]) == (scenario, policy))
            cells.append(bounded(found, 100))
        lines.append(f"| `{policy}` | {' | '.join(cells)} |")
    return "\n".join(lines)


README: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {"success": ("policies", success)}
"""Tables of the README: the name of the place, the result, and what makes the table."""


def places() -> dict[Path, dict[str, str]]:
    """The tables of every page, by the name of their place."""
    found = {
        REPO / "docs" / "results" / f"{name}.md": {name: table(read(name))} for name, table in TABLES.items()
    }
    found[REPO / "README.md"] = {name: table(read(result)) for name, (result, table) in README.items()}
    return found


def bounded(found: Sequence[float], scale: float = 1) -> str:
    """An estimate with its interval."""
    middle, low, high = (scale * x for x in found)
    return f"{middle:.1f} [{low:.1f}, {high:.1f}]"


@cache
def read(name: str) -> dict[str, Any]:
    """A result."""
    return json.loads(_file(name).read_text(encoding="utf-8"))


def _file(name: str) -> Path:
    return REPO / "experiments" / "results" / f"{name}.json"


def with_tables(text: str, tables: dict[str, str]) -> str:
    """The text with tables between their comments."""
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, opened, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not (opened and closed):
            raise SystemExit(f"no place for the table {name}")
        text = f"{before}{begin}{table}\n{end}{after}"
    return text


def main() -> int:
    """Write the pages, or compare."""
    checking, same = "--check" in sys.argv[1:], True
    for page, tables in places().items():
        text = page.read_text(encoding="utf-8")
        made = with_tables(text, tables)
        if checking and made != text:
            print(f"{page.relative_to(REPO)}: not the figures of experiments/results/")
            same = False
        elif not checking:
            page.write_text(made, encoding="utf-8")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
