"""Our OpenDRIVE maps against CARLA's parser and the standard's formulas.

    python experiments/maps_against_carla.py [--maps DIR|FILE ...] [--json FILE] [--markdown FILE]

For every map: each driving waypoint that CARLA's parser generates (every 0.5 m) is looked for on the
lane of ours with the same road, number and road coordinate, on the host (`Network`) and on the device
(`LaneMap`). Movements across junctions, lane widths, permissions to change lanes, lights, signs and
crosswalks are compared as well. Every driving lane is also compared with OpenDRIVE's formulas evaluated
directly (`opendrive_formulas.py`), which decide where CARLA and we differ.

CARLA's parser (PyPI `carla`) runs in a process of its own, as it crashes on some maps.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from carla_parser import CarlaMap, ask_carla
from lane_misfit import (
    DEVICE_LATERAL,
    DEVICE_MEDIAN,
    HEADING,
    HOST_LATERAL,
    LENGTH,
    WIDTH,
    Misfit,
    OurMap,
)
from numpy.typing import NDArray
from opendrive_formulas import LaneEnd, LaneKey, OpenDriveFormulas, paths_across

from limsim_jax.maps.network import LaneType, Network, SignKind

REPO = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", REPO.parent / "shared" / "data"))
RESULTS = REPO / "experiments" / "results"

Array = NDArray[np.float64]


# --- Comparisons --------------------------------------------------------------------------------------------


def spread(values: Array) -> dict[str, float | None]:
    """Median, 99th percentile and maximum, in thousandths of the unit."""
    values = values[np.isfinite(values)]
    if not len(values):
        return {"median": None, "p99": None, "max": None}
    median, p99 = np.percentile(values, (50, 99))
    return {"median": 1e3 * float(median), "p99": 1e3 * float(p99), "max": 1e3 * float(values.max())}


def integer_ids(ids: Iterable[str]) -> dict[int, str] | None:
    """CARLA's integer -> id in the file; None where the cast loses ids."""
    ids = list(ids)
    if not all(re.fullmatch(r"\d{1,9}", i) for i in ids):
        return None
    cast = {int(i): i for i in ids}
    return cast if len(cast) == len(ids) else None


@dataclass
class Comparison:
    """One row of the table."""

    map: str
    failure: str | None = None  # why CARLA's parser gives no answer
    said: tuple[str, ...] = ()  # what it printed
    figures: dict[str, Any] = field(default_factory=dict)
    exceptions: list[str] = field(default_factory=list)  # differences in which the file is on our side
    misses: list[str] = field(default_factory=list)  # differences in which it is not

    @property
    def verdict(self) -> str:
        """One word."""
        return "MISS" if self.misses else "pass" if self.failure is None else "referee fails"


def compare_poses(ours: OurMap, carla_map: CarlaMap, truth: OpenDriveFormulas, row: Comparison) -> None:
    """Waypoints of CARLA's parser on our lanes."""
    waypoints = carla_map.waypoints
    names = integer_ids(truth.roads)
    if waypoints is None or names is None:
        return
    row.figures["waypoints"] = len(waypoints)
    sound = np.isfinite(waypoints).all(1)
    if not sound.all():
        row.exceptions.append(f"{(~sound).sum()} waypoints of CARLA are NaN")
    waypoints = waypoints[sound]
    where = [(names[int(w[0])], int(w[2])) for w in waypoints]
    s, pose, width = waypoints[:, 3], waypoints[:, 4:7], waypoints[:, 7]
    fit = ours.misfit(where, s, pose, width)

    nowhere = np.isnan(fit.lateral) | (fit.lateral > DEVICE_LATERAL)
    nowhere[nowhere] = ~ours.on_any_lane(pose[nowhere])
    reasons = settle(ours, truth, waypoints, where, fit)
    settled = reasons != ""
    for reason in sorted(set(reasons[settled])):
        row.exceptions.append(describe(reason, waypoints, names, truth, fit, reasons == reason))
    kept = ~settled
    figures = row.figures
    figures["host"], figures["device"] = spread(fit.lateral[kept]), spread(fit.device[kept])
    figures["along"], figures["width"] = spread(fit.along[kept]), spread(fit.width[kept])
    heading = np.degrees(fit.heading[kept])
    figures["heading_deg"] = float(np.nanmax(heading, initial=0.0))
    figures["settled"] = int(settled.sum())
    figures["outside"] = int((nowhere & kept).sum())

    for name, at in (
        ("no lane of ours there", np.isnan(fit.lateral)),
        ("host lane off across the track", fit.lateral >= HOST_LATERAL),
        ("device lane off across the track", fit.device >= DEVICE_LATERAL),
        ("heading off", fit.heading >= HEADING),
        ("width off", fit.width >= WIDTH),
    ):
        if (at & kept).any():
            i = np.flatnonzero(at & kept)
            row.misses.append(f"{len(i)} waypoints: {name}, e.g. {places(waypoints[i], names)}")
    if (figures["device"]["median"] or 0.0) >= 1e3 * DEVICE_MEDIAN:
        row.misses.append(f"device lanes off by {figures['device']['median']:.1f} mm in the median")
    compare_permissions(fit, waypoints, where, truth, row)


def places(waypoints: Array, names: dict[int, str], count: int = 3) -> str:
    """A few lanes and road coordinates in words."""
    lanes: dict[tuple[str, int], float] = {}
    for w in waypoints:
        lanes.setdefault((names[int(w[0])], int(w[2])), w[3])
    text = [f"road {road} lane {lane} s {s:.1f}" for (road, lane), s in list(lanes.items())[:count]]
    return ", ".join(text) + (f" (and {len(lanes) - count} lanes more)" if len(lanes) > count else "")


CARLA_ERRS = "CARLA misses the formulas, ours meets them"
NEGATIVE = "the file's width is negative: 0 in ours"
JUMPS = "the lane breaks in the file: a short bridge in ours"


def settle(
    ours: OurMap, truth: OpenDriveFormulas, waypoints: Array, where: Sequence[tuple[str, int]], fit: Misfit
) -> NDArray[np.str_]:
    """Why the file agrees with us where CARLA's waypoints miss our lanes.

    One per waypoint; "" where it does not.
    """
    reasons = np.full(len(waypoints), "", f"U{max(map(len, (CARLA_ERRS, NEGATIVE, JUMPS)))}")
    doubtful, poses, widths, valid = [], [], [], []
    for i in map(int, np.flatnonzero(fit.bad() | ~(fit.device < DEVICE_LATERAL))):
        road, number = where[i]
        formulas = truth.roads[road]
        # CARLA may attribute a place to a section that does not hold there.
        section = formulas.section_at(waypoints[i, 3])
        if (section, number) not in formulas.lane_elements:
            reasons[i] = CARLA_ERRS
            continue
        place = formulas.lane(section, number, waypoints[i, 3])
        doubtful.append(i)
        poses.append(place.pose[0])
        widths.append(place.width[0])
        valid.append(place.valid[0])
    if not doubtful:
        return reasons
    s = waypoints[doubtful, 3]
    exact = ours.misfit([where[i] for i in doubtful], s, np.array(poses), np.array(widths))
    good = ~exact.bad() & (exact.device < DEVICE_LATERAL)
    for k, i in enumerate(doubtful):
        road, number = where[i]
        if good[k]:
            reasons[i] = CARLA_ERRS
        elif not valid[k]:
            reasons[i] = NEGATIVE
        elif bridge(truth, road, number, s[k], exact, k):
            reasons[i] = JUMPS
    return reasons


def bridge(truth: OpenDriveFormulas, road: str, number: int, s: float, exact: Misfit, k: int) -> bool:
    """Whether our lane only bridges a break in the file.

    That is: off sideways by no more than the gap, and turned only where the file's own kink is (within
    a millimetre, where the cubic across gap and kink overshoots).
    """
    gap, _ = truth.roads[road].breaks(number, s, 2.0)
    _, kink = truth.roads[road].breaks(number, s, 2e-3)
    sideways = exact.lateral[k] <= max(gap, HOST_LATERAL)
    return bool(sideways and exact.heading[k] <= max(3 * kink, HEADING) and exact.width[k] < WIDTH)


def describe(
    reason: str,
    waypoints: Array,
    names: dict[int, str],
    truth: OpenDriveFormulas,
    fit: Misfit,
    which: NDArray[np.bool_],
) -> str:
    """Waypoints that miss our lanes for one reason, in words."""

    def worst(values: Array) -> float:
        return float(np.nanmax(values[which], initial=0.0))

    roads = {names[int(r)] for r in waypoints[which, 0]}
    kinds = sorted({g.shape.tag for road in roads for g in truth.roads[road].geometries})
    apart = f"up to {1e3 * worst(fit.lateral):.1f} mm across the track"
    return (
        f"{which.sum()} waypoints, {reason} ({apart}, {math.degrees(worst(fit.heading)):.2f} deg, "
        f"width {1e3 * worst(fit.width):.1f} mm): {places(waypoints[which], names)}; "
        f"geometry: {', '.join(kinds)}"
    )


def compare_permissions(
    fit: Misfit, waypoints: Array, where: Sequence[tuple[str, int]], truth: OpenDriveFormulas, row: Comparison
) -> None:
    """Permission to change to a neighbour that exists on our side."""
    total, differ = 0, Counter[str]()
    for ours, column, side in ((fit.may_left, 8, "left"), (fit.may_right, 9, "right")):
        known = np.isfinite(ours)
        total += int(known.sum())
        for i in map(int, np.flatnonzero(known & (ours != waypoints[:, column]))):
            road, number = where[i]
            mark = truth.roads[road].mark(int(waypoints[i, 1]), number, side == "left", waypoints[i, 3])
            differ[
                f"{'we' if ours[i] else 'CARLA'} alone allow{'' if ours[i] else 's'} it across {mark}"
            ] += 1
    row.figures["permission"] = {
        "agree": total - differ.total(),
        "of": total,
        "differ": dict(differ.most_common()),
    }


def compare_formulas(
    ours: OurMap, truth: OpenDriveFormulas, published: float | None, row: Comparison
) -> None:
    """Length and poses of our driving lanes, about every metre."""
    records, samples, poses, widths, excluded = [], [], [], [], 0
    for record in truth.driving_lanes():
        length = record.s1 - record.s0
        if length < 0.01:
            continue
        n = max(2, math.ceil(length))
        s = record.s0 + np.concatenate([[2e-3], (np.arange(n) + 0.5) / n * length, [length - 2e-3]])
        place = truth.roads[record.road].lane(record.section, record.number, s)
        excluded += int((~place.valid).sum())
        records += [record] * int(place.valid.sum())
        samples.append(s[place.valid])
        poses.append(place.pose[place.valid])
        widths.append(place.width[place.valid])
    s, pose = np.concatenate([np.zeros(0), *samples]), np.concatenate([np.zeros((0, 3)), *poses])
    fit = ours.misfit([(r.road, r.number) for r in records], s, pose, np.concatenate([np.zeros(0), *widths]))
    bad = fit.bad()
    bridged = 0
    for i in map(int, np.flatnonzero(bad)):
        bad[i] = not bridge(truth, records[i].road, records[i].number, s[i], fit, i)
        bridged += not bad[i]
    row.figures["formulas"] = {
        "samples": len(s),
        "host": spread(fit.lateral),
        "device": spread(fit.device),
        "heading_deg": float(np.degrees(np.nanmax(fit.heading, initial=0.0))),
        "width": spread(fit.width),
        "excluded": excluded,
    }
    if excluded:
        row.exceptions.append(f"{excluded} samples where the file's width is negative are left out")
    if bridged:
        row.exceptions.append(f"{bridged} samples of the formulas: {JUMPS}")
    if bad.any():
        worst = sorted(
            map(int, np.flatnonzero(bad)), key=lambda i: -np.nan_to_num(fit.lateral[i], nan=np.inf)
        )
        text = [
            f"road {records[i].road} section {records[i].section} lane {records[i].number} s {s[i]:.3f}"
            f" ({1e3 * fit.lateral[i]:.1f} mm, {math.degrees(fit.heading[i]):.2f} deg,"
            f" width {1e3 * fit.width[i]:.1f} mm)"
            for i in worst[:3]
        ]
        lanes = len({records[i] for i in worst})
        row.misses.append(f"formulas missed at {len(worst)} places of {lanes} lanes, e.g. {'; '.join(text)}")
    length = sum(lane.length for lanes in ours.lanes.values() for lane in lanes)
    exact = truth.driving_length()
    row.figures["driving_km"], row.figures["length_error"] = exact / 1e3, length / exact - 1 if exact else 0.0
    row.figures["published_km"] = published
    if abs(length - exact) > LENGTH * exact + 1e-3:
        row.misses.append(f"driving lanes are {length:.3f} m, by the formulas {exact:.3f} m")
    # The published figure has two decimals.
    if published is not None and abs(length - 1e3 * published) > LENGTH * 1e3 * published + 5.0:
        row.misses.append(f"driving lanes are {length / 1e3:.3f} km, published {published} km")


def published_lengths() -> dict[Path, float]:
    """Driving km of the shared maps, from the table beside them."""
    readme = SHARED / "opendrive" / "README.md"
    if not readme.is_file():
        return {}
    lines = [line.split("|") for line in readme.read_text(encoding="utf-8").splitlines()]
    table = [[cell.strip() for cell in line[1:-1]] for line in lines if len(line) > 9]
    heads = next((line for line in table if "driving km" in line), None)
    if heads is None:
        return {}
    column = heads.index("driving km")
    found = {}
    for line in table:
        if re.fullmatch(r"`\S+\.xodr`", line[0]) and re.fullmatch(r"[\d.]+", line[column]):
            found[readme.parent / line[0].strip("`")] = float(line[column])
    return found


def our_movements(network: Network) -> dict[str, set[tuple[LaneEnd, LaneEnd]]]:
    """Junction -> our movements over driving lanes."""
    found: dict[str, set[tuple[LaneEnd, LaneEnd]]] = {junction: set() for junction in network.junctions}
    for movement in network.movements:
        lanes = [network.lanes[i] for i in (movement.incoming, *movement.via, movement.outgoing)]
        if all(lane.type is LaneType.DRIVING for lane in lanes):
            ends = tuple((lane.road, lane.number) for lane in (lanes[0], lanes[-1]))
            found.setdefault(movement.junction, set()).add((ends[0], ends[1]))
    return found


def carla_movements(carla_map: CarlaMap, truth: OpenDriveFormulas) -> dict[str, set[tuple[LaneEnd, LaneEnd]]]:
    """Junction -> movements of CARLA's topology over driving lanes."""
    names = integer_ids(truth.roads)
    if carla_map.topology is None or names is None:
        return {}
    driving = {tuple(key) for key, (kind, _) in carla_map.topology["lanes"] if kind == "Driving"}
    successors: dict[LaneKey, set[LaneKey]] = {}
    for a, b in carla_map.topology["links"]:
        if a != b and tuple(a) in driving and tuple(b) in driving:
            (road, *lane), (after, *other) = a, b
            successors.setdefault((names[road], *lane), set()).add((names[after], *other))
    return {
        junction: paths_across(successors, truth.roads_inside(junction)) for junction in truth.junction_ids()
    }


def compare_movements(ours: OurMap, carla_map: CarlaMap, truth: OpenDriveFormulas, row: Comparison) -> None:
    """Compare our movements with CARLA's and with the links of the file."""
    mine, linked = our_movements(ours.network), truth.movements()
    row.figures["junctions"] = len(linked)
    row.figures["movements"] = sum(map(len, mine.values()))
    for junction in sorted(linked.keys() | mine.keys()):
        difference(row.misses, f"junction {junction}, by the links of the file", mine, linked, junction)
    if carla_map.topology is None:
        return
    theirs = carla_movements(carla_map, truth)
    if not theirs and linked:
        return
    equal = 0
    for junction in linked:
        if mine.get(junction, set()) == theirs.get(junction, set()):
            equal += 1
            continue
        settled = mine.get(junction, set()) == linked[junction]
        into = row.exceptions if settled else row.misses
        difference(into, f"junction {junction}, against CARLA", mine, theirs, junction)
    row.figures["junctions_equal"] = equal


def difference(
    into: list[str],
    title: str,
    mine: dict[str, set[tuple[LaneEnd, LaneEnd]]],
    theirs: dict[str, set[tuple[LaneEnd, LaneEnd]]],
    junction: str,
) -> None:
    """Add a line on what is missing and extra, if anything is."""
    a, b = mine.get(junction, set()), theirs.get(junction, set())
    parts = []
    for word, pairs in (("missing", b - a), ("extra", a - b)):
        if pairs:
            text = [f"{i[0]}/{i[1]} -> {o[0]}/{o[1]}" for i, o in sorted(pairs)]
            parts.append(f"{word} {len(pairs)}: {', '.join(text[:4])}" + (", ..." if len(text) > 4 else ""))
    if parts:
        into.append(f"{title}: {'; '.join(parts)}")


LIGHT = "1000001"
SIGNS = {"206": SignKind.STOP, "205": SignKind.YIELD}


def compare_marks(ours: OurMap, carla_map: CarlaMap, truth: OpenDriveFormulas, row: Comparison) -> None:
    """Lights and signs with the driving lanes they govern, and crosswalks."""
    network = ours.network
    names = integer_ids(truth.roads)

    def governed(marks: Iterable[Any]) -> set[tuple[str, str, int]]:
        lanes = [(mark.id, network.lanes[spot.lane]) for mark in marks for spot in mark.spots]
        return {(id_, lane.road, lane.number) for id_, lane in lanes if lane.type is LaneType.DRIVING}

    stated = truth.signal_lanes()
    light_ids = {light.id for light in network.traffic_lights}
    for name, code, marks in (
        ("lights", LIGHT, network.traffic_lights),
        *((f"{k}_signs", code, [g for g in network.signs if g.kind is k]) for code, k in SIGNS.items()),
    ):
        mine = governed(marks)

        def counts(kind: str, id_: str, code: str = code) -> bool:
            return kind == code or (code == LIGHT and id_ in light_ids)

        in_file = {(i, road, lane) for kind, i, road, lane in stated if counts(kind, i)}
        placed = {m for m in mine - in_file if m[0] not in {i for i, _, _ in in_file}}
        beside = ours.beside(mine - in_file - placed, in_file)
        title = name.replace("_", " ")
        if placed:
            count = len({m[0] for m in placed})
            row.exceptions.append(f"{title}: {count} name no driving lane in the file, placed by position")
        if beside:
            row.exceptions.append(
                f"{title}: {len(beside)} connectors that leave the same lane as those named: {listed(beside)}"
            )
        for word, lanes in (("missing", in_file - mine), ("extra", mine - in_file - placed - beside)):
            if lanes:
                row.misses.append(f"{title} on lanes, by the file, {word} {len(lanes)}: {listed(lanes)}")
        figures = row.figures[name] = {"ids": len({mark.id for mark in marks}), "lanes": len(mine)}
        if carla_map.landmarks is None or names is None:
            continue
        theirs = set[tuple[str, str, int]]()
        for mark in carla_map.landmarks:
            if counts(mark["type"], mark["id"]):
                road = truth.roads[names[mark["road"]]]
                section = road.section_at(mark["s"])
                for n in [n for i, n in road.lane_elements if i == section and road.type(i, n) == "driving"]:
                    if any(min(v) <= n <= max(v) for v in mark["lanes"]):
                        theirs.add((mark["id"], road.id, n))
        figures["as_carla"] = len(mine & theirs)
        for word, lanes in (("misses", mine - theirs), ("adds", theirs - mine)):
            if lanes:
                row.exceptions.append(
                    f"{title}: CARLA {word} {len(lanes)} lanes where ours are as in the file: {listed(lanes)}"
                )
    compare_crosswalks(ours, carla_map, truth, row)


def listed(lanes: Iterable[tuple[str, str, int]]) -> str:
    """A few (signal, road, lane) in words."""
    lanes = sorted(lanes)
    text = ", ".join(f"signal {i} on road {road} lane {lane}" for i, road, lane in lanes[:3])
    return text + (", ..." if len(lanes) > 3 else "")


def compare_crosswalks(ours: OurMap, carla_map: CarlaMap, truth: OpenDriveFormulas, row: Comparison) -> None:
    """Corners of the crosswalks."""

    def among(corners: Array, points: Array, within: float = 0.1) -> bool:
        """Whether every corner is one of these points; CARLA's turn with the slope of the road."""
        gaps = np.hypot(*(corners[:, None] - points[None]).transpose(2, 0, 1))
        return bool(len(points)) and bool((gaps.min(1) < within).all())

    mine = [walk.outline for walk in ours.network.crosswalks]
    exact = truth.crosswalks()
    lost = sum(not any(among(corners, walk, 1e-3) for walk in mine) for corners, _ in exact)
    if lost:
        row.misses.append(f"{lost} of {len(exact)} crosswalks are not where the file puts them")
    if len(mine) > len(exact):
        row.misses.append(f"{len(mine)} crosswalks, but {len(exact)} in the file")
    figures = row.figures["crosswalks"] = {"ours": len(mine), "file": len(exact)}
    if carla_map.crosswalks is None:
        return
    theirs = np.array(carla_map.crosswalks, float).reshape(-1, 2)
    same = [among(corners, theirs) for corners, _ in exact]
    shifted = [not ok and among(other, theirs) for ok, (_, other) in zip(same, exact, strict=True)]
    figures["as_carla"] = sum(same)
    if any(shifted):
        row.exceptions.append(f"{sum(shifted)} crosswalks that CARLA shifts by the lane offset of their road")
    if absent := len(exact) - sum(same) - sum(shifted):
        row.exceptions.append(f"{absent} crosswalks of the file that CARLA does not give")


def compare(source: Path, network: Network, carla_map: CarlaMap) -> Comparison:
    """All comparisons of one map."""
    truth = OpenDriveFormulas(source)
    row = Comparison(
        map=f"{source.resolve().parent.name}/{source.stem}", failure=carla_map.failure, said=carla_map.said
    )
    if carla_map.failure is None and integer_ids(truth.roads) is None:
        row.failure = "casts the ids of roads to integers"
    ours = OurMap(network)
    compare_formulas(ours, truth, published_lengths().get(source), row)
    compare_poses(ours, carla_map, truth, row)
    compare_movements(ours, carla_map, truth, row)
    compare_marks(ours, carla_map, truth, row)
    return row


# --- The table ----------------------------------------------------------------------------------------------


def markdown(rows: Sequence[Comparison], command: str) -> str:
    """The table and the exceptions."""

    def number(value: float | None, digits: int = 2) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    heads = [
        "map", "verdict", "waypoints", "host lateral mm (median / p99 / max)",
        "device lateral mm (median / p99 / max)", "heading deg (max)", "width mm (max)", "outside",
        "settled", "host to formulas mm (max)", "device to formulas mm (max)", "junctions equal",
        "movements", "driving km", "length error %", "lane change agrees", "lights on lanes",
        "stop / yield on lanes", "crosswalks",
    ]  # fmt: skip
    lines = [
        "# Maps against CARLA's parser and against the formulas of OpenDRIVE",
        "",
        f"Made by `{command}`.",
        "",
        "Lateral: distance of CARLA's driving waypoints (every 0.5 m) from the lane of ours with the same",
        "road, number and road coordinate, across the track. *Outside*: on no lane of ours within 5 cm.",
        "*Settled*: waypoints that miss our lanes where the formulas of the standard meet them, or where the",
        "file itself is broken; they are listed below the table and left out of the figures. *To formulas*:",
        "driving lanes of ours against direct evaluation, every metre, also where CARLA gives no answer and",
        "where the file leaves a gap that our lanes lead over. *Length error*: summed driving",
        "lanes against quadrature of the formulas. Thresholds: host 1 mm, device 50 mm (median 10 mm),",
        "heading 1 degree, width 10 mm, length 0.1 %, equal movements at every junction. Lane change (over",
        "waypoints), lights and signs (over lanes that they govern), crosswalks: as CARLA has it, of ours.",
        "",
        "| " + " | ".join(heads) + " |",
        "|" + "---|" * len(heads),
    ]
    for row in rows:
        f = row.figures
        empty = {"median": None, "p99": None, "max": None}

        def triple(name: str, f: dict[str, Any] = f, empty: dict[str, None] = empty) -> str:
            return " / ".join(number(v, 3) for v in f.get(name, empty).values())

        def marks(name: str, f: dict[str, Any] = f) -> str:
            m = f[name]
            return f"{m.get('as_carla', '-')} of {m['lanes']}" if m["lanes"] else "0"

        allowed, walks = f.get("permission"), f["crosswalks"]
        cells = [
            row.map,
            row.verdict,
            str(f.get("waypoints", "-")),
            triple("host"),
            triple("device"),
            number(f.get("heading_deg"), 3),
            number(f.get("width", empty)["max"], 3),
            str(f.get("outside", "-")),
            str(f.get("settled", "-")),
            number(f["formulas"]["host"]["max"], 4),
            number(f["formulas"]["device"]["max"], 3),
            f"{f.get('junctions_equal', '-')} of {f['junctions']}",
            str(f["movements"]),
            number(f["driving_km"], 3),
            number(100 * f["length_error"], 5),
            "-" if not allowed else f"{allowed['agree']} of {allowed['of']}",
            marks("lights"),
            f"{marks('stop_signs')} / {marks('yield_signs')}",
            f"{walks.get('as_carla', '-')} of {walks['ours']}" if walks["ours"] else "0",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## Differences, and what settles them", ""]
    for row in rows:
        notes = [f"referee fails: CARLA's parser {row.failure}"] if row.failure else []
        notes += [f"MISS: {text}" for text in row.misses] + list(row.exceptions)
        permission = row.figures.get("permission", {}).get("differ", {})
        notes += [f"lane change, {count} waypoints: {text}" for text, count in permission.items()]
        notes += [f"CARLA prints: {line}" for line in dict.fromkeys(row.said)]
        if notes:
            lines += [f"**{row.map}**", "", *(f"- {note}" for note in notes), ""]
    return "\n".join(lines).rstrip() + "\n"


def map_files(given: Sequence[Path]) -> list[Path]:
    """The .xodr files named, or in the folders named."""
    found = [f for path in given for f in (sorted(path.glob("*.xodr")) if path.is_dir() else [path])]
    return list(dict.fromkeys(found))


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare maps and write the table; 1 if a map misses a threshold."""
    from limsim_jax.maps.opendrive import read_opendrive

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--maps", nargs="+", type=Path, default=[SHARED / "opendrive", REPO / "maps"])
    parser.add_argument("--json", type=Path, default=RESULTS / "maps_against_carla.json")
    parser.add_argument("--markdown", type=Path, default=RESULTS / "maps_against_carla.md")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds for CARLA's parser per map")
    options = parser.parse_args(arguments)
    rows = []
    for source in map_files(options.maps):
        start = time.perf_counter()
        rows.append(compare(source, read_opendrive(source), ask_carla(source, options.timeout)))
        print(f"{rows[-1].verdict:14} {source.name} ({time.perf_counter() - start:.1f} s)", flush=True)
        for text in rows[-1].misses:
            print(f"    {text}", flush=True)
    given = sys.argv[1:] if arguments is None else list(arguments)
    command = " ".join(["python experiments/maps_against_carla.py", *given])
    options.markdown.parent.mkdir(parents=True, exist_ok=True)
    options.markdown.write_text(markdown(rows, command), encoding="utf-8")
    options.json.parent.mkdir(parents=True, exist_ok=True)
    table = [{**vars(row), "verdict": row.verdict} for row in rows]
    options.json.write_text(
        json.dumps({"command": command, "maps": table}, indent=1) + "\n", encoding="utf-8"
    )
    return int(any(row.misses for row in rows))


if __name__ == "__main__":
    sys.exit(main())
