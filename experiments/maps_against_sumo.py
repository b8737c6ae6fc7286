"""Compare `read_sumo` with SUMO's own reader `sumolib` on many networks.

    python experiments/maps_against_sumo.py [FILE ...]

Without files: every network of the shared data, and networks that `netgenerate` makes. Writes
experiments/results/maps_against_sumo.md and .json. Exit code 1 if anything differs.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import sumolib

from limsim_jax.maps.network import Array, Control, Lane, Network, Turn
from limsim_jax.maps.sumo import VEHICLE_CLASSES, read_sumo

REPO = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", REPO.parent / "shared" / "data")) / "sumo"
COMMAND = "python experiments/maps_against_sumo.py"

GENERATED = {
    "grid with lights, crossings, bicycle lanes": (
        "--grid --grid.number 3 --grid.length 120 -L 2 --default-junction-type traffic_light"
        " --tls.default-type actuated --sidewalks.guess --crossings.guess --bikelanes.guess"
    ),
    "grid, all-way stop, left-hand": (
        "--grid --grid.number 3 -L 2 --default-junction-type allway_stop --lefthand"
    ),
    "grid, zipper": "--grid --grid.number 3 -L 3 --default-junction-type zipper",
    "grid without internal lanes": "--grid --grid.number 3 -L 2 --no-internal-links",
    "spider": "--spider --spider.omit-center",
    "spider, left-hand": "--spider --spider.omit-center -L 2 --lefthand",
    "random, right before left": (
        "--rand --rand.iterations 40 --seed 3 -L 2 --default-junction-type right_before_left"
    ),
    "random, 6 decimals": "--rand --rand.iterations 40 --seed 5 -L 3 --precision 6",
}
"""Options of netgenerate; nothing here is known to the reader."""

TURNS = dict(s=Turn.STRAIGHT, t=Turn.U_TURN, T=Turn.U_TURN, l=Turn.LEFT, r=Turn.RIGHT)
TURNS |= {"L": Turn.SLIGHT_LEFT, "R": Turn.SLIGHT_RIGHT}
CONTROLS = {
    "M": Control.PRIORITY,
    "O": Control.PRIORITY,
    "m": Control.YIELD,
    "o": Control.YIELD,
    "s": Control.STOP,
    "w": Control.ALL_WAY_STOP,
    "=": Control.NONE,
    "-": Control.NONE,
    "Z": Control.ZIPPER,
}


@dataclass
class Comparison:
    """What was compared on one network, and what differed."""

    name: str
    compared: Counter[str] = field(default_factory=Counter)
    mismatches: list[str] = field(default_factory=list)
    road: float = 0.0  # m, largest distance between our curve and SUMO's polyline, lanes outside junctions
    inside: float = 0.0  # m, the same inside junctions, where netconvert samples a curve coarsely

    def check(self, what: str, where: str, ours: Any, theirs: Any) -> None:
        """Count a comparison; note it if the two differ."""
        self.compared[what] += 1
        if ours != theirs:
            self.mismatches.append(f"{what} of {where}: ours {ours}, sumolib {theirs}")


def compare(path: Path, name: str | None = None) -> tuple[Comparison, Network]:
    """Read a network with both readers and compare all of sumolib's data."""
    theirs = sumolib.net.readNet(
        str(path), withInternal=True, withPrograms=True, withFoes=True, withPedestrianConnections=True
    )
    ours = read_sumo(path)
    result = Comparison(name or path.parent.name)
    stated = without_bridges(ours)
    _lanes(result, stated, theirs)
    _connections(result, stated, theirs)
    _junctions(result, stated, theirs)
    _programs(result, stated, theirs)
    return result, ours


def without_bridges(network: Network) -> Network:
    """The network as its file states it: without lanes across gaps, see `limsim_jax.maps.bridges`."""
    lanes = network.lanes
    bridges = {name for name in lanes if "~" in name}

    def beyond(names: tuple[str, ...], way: str) -> tuple[str, ...]:
        return tuple(x for name in names for x in (getattr(lanes[name], way) if name in bridges else (name,)))

    return replace(
        network,
        lanes={
            name: replace(
                lane,
                successors=beyond(lane.successors, "successors"),
                predecessors=beyond(lane.predecessors, "predecessors"),
            )
            for name, lane in lanes.items()
            if name not in bridges
        },
        roads={name: road for name, road in network.roads.items() if name not in bridges},
        movements=tuple(
            replace(m, via=tuple(x for x in m.via if x not in bridges)) for m in network.movements
        ),
        junctions={
            name: replace(j, connectors=tuple(x for x in j.connectors if x not in bridges))
            for name, j in network.junctions.items()
        },
    )


def _lanes(result: Comparison, ours: Network, theirs: Any) -> None:
    edges = theirs.getEdges()
    lanes = [lane for edge in edges for lane in edge.getLanes()]
    result.check("lane ids", "the net", sorted(ours.lanes), sorted(lane.getID() for lane in lanes))
    result.check("edge ids", "the net", sorted(ours.roads), sorted(edge.getID() for edge in edges))
    for edge in edges:
        road = ours.roads[edge.getID()]
        mine = (road.priority, road.type, road.name, road.length)
        result.check(
            "edge", road.id, mine, (edge.getPriority(), edge.getType(), edge.getName(), edge.getLength())
        )
    for lane in lanes:
        mine = ours.lanes[lane.getID()]
        result.check("lane length", mine.id, mine.declared_length, lane.getLength())
        result.check("lane speed", mine.id, mine.speed_limit, lane.getSpeed())
        result.check("lane width", mine.id, set(mine.width), {lane.getWidth()})
        result.check(
            "lane index", mine.id, (mine.road, mine.number), (lane.getEdge().getID(), lane.getIndex())
        )
        allowed = set(lane.getPermissions()) & VEHICLE_CLASSES
        if lane.getPermissions() == sumolib.net.lane.SUMO_VEHICLE_CLASSES:
            allowed = set(VEHICLE_CLASSES)  # sumolib's list lacks classes that SUMO has
        known = VEHICLE_CLASSES & sumolib.net.lane.SUMO_VEHICLE_CLASSES
        result.check("lane permissions", mine.id, set(mine.access & known), allowed & known)
        result.check("opposite lane", mine.id, mine.opposite, lane.getNeigh())
        function = lane.getEdge().getFunction()
        if function == "walkingarea":
            continue  # its shape is an outline
        shape = np.array(lane.getShape3D())
        deviation = max(
            polyline_distance(shape, _dense(mine)).max(), polyline_distance(_dense(mine), shape).max()
        )
        if function == "internal":
            result.inside = max(result.inside, float(deviation))
        else:
            result.road = max(result.road, float(deviation))


def _dense(lane: Lane) -> Array:
    """Points of the centre line (m), five per sample."""
    parts = np.linspace(lane.s[:-1], lane.s[1:], 5, endpoint=False, axis=1)
    return lane.pose(np.append(parts, lane.length))[0]


def polyline_distance(points: Array, line: Array) -> Array:
    """Horizontal distance (m) of each point from a polyline."""
    start, chord = line[:-1, :2], np.diff(line[:, :2], axis=0)
    square = np.maximum((chord**2).sum(1), 1e-300)
    best = []
    for block in np.array_split(points[:, :2], len(points) // 200 + 1):
        offset = block[:, None] - start
        u = np.clip(np.einsum("pij,ij->pi", offset, chord) / square, 0, 1)
        best.append(np.sqrt(((offset - u[..., None] * chord) ** 2).sum(-1)).min(1))
    return np.concatenate(best)


def _connections(result: Comparison, ours: Network, theirs: Any) -> None:
    pairs = set()
    for edge in theirs.getEdges():
        for lane in edge.getLanes():
            for connection in lane.getOutgoing():
                pairs.add((lane.getID(), connection.getViaLaneID() or connection.getToLane().getID()))
    mine = {(lane.id, target) for lane in ours.lanes.values() for target in lane.successors}
    result.compared["connection"] += len(pairs)
    result.mismatches += [f"connection {pair} is in one only" for pair in sorted(mine ^ pairs)]
    back = {(source, lane.id) for lane in ours.lanes.values() for source in lane.predecessors}
    result.check("predecessors", "the net", back == mine, True)


def _chain(theirs: Any, connection: Any) -> tuple[str, ...]:
    """Via lanes of a connection by following sumolib's."""
    chain = []
    via = connection.getViaLaneID()
    while via:
        chain.append(via)
        onward = [c for c in theirs.getLane(via).getOutgoing() if c.getToLane() == connection.getToLane()]
        via = onward[0].getViaLaneID()
    return tuple(chain)


def _junctions(result: Comparison, ours: Network, theirs: Any) -> None:
    nodes = theirs.getNodes()
    result.check("junction ids", "the net", sorted(ours.junctions), sorted(node.getID() for node in nodes))
    for node in nodes:
        junction = ours.junctions[node.getID()]
        result.check("junction type", junction.id, junction.type, node.getType())
        result.check("junction centre", junction.id, junction.center, node.getCoord())
        links: dict[int, Any] = {}
        for edge in node.getIncoming():
            for lane in edge.getLanes():
                for connection in lane.getOutgoing():
                    index = node.getLinkIndex(connection)
                    crossing = connection.getTo().getFunction() == "crossing"
                    internal = lane.getEdge().getFunction() in {"internal", "crossing"}
                    on_foot = connection.getTo().getFunction() == "walkingarea"
                    walks = lane.getEdge().getFunction() == "walkingarea"
                    if index >= 0 and not internal and not on_foot and (crossing or not walks):
                        links[index] = connection
        result.check("number of links", junction.id, len(junction.movements), len(links))
        if len(junction.movements) != len(links):
            continue
        for i, m in enumerate(junction.movements):
            movement, connection = ours.movements[m], links[i]
            where = f"link {i} of junction {junction.id}"
            crossing = connection.getTo().getFunction() == "crossing"
            result.check("link from", where, movement.incoming, connection.getFromLane().getID())
            if crossing:
                result.check("link via", where, movement.via, (connection.getToLane().getID(),))
            else:
                result.check("link to", where, movement.outgoing, connection.getToLane().getID())
                result.check("link via", where, movement.via, _chain(theirs, connection))
            result.check("link dir", where, movement.turn, TURNS[connection.getDirection()])
            light = connection.getTLSID() or None
            index = connection.getTLLinkIndex() if light else None
            result.check("link signal", where, (movement.program, movement.link), (light, index))
            control = Control.SIGNAL if light else CONTROLS[connection.getState()]
            result.check("link state", where, movement.control, control)
            if node._foes:
                foes = {j for j in range(len(links)) if node.areFoes(i, j)}
                result.check("link foes", where, {x - junction.movements[0] for x in movement.foes}, foes)
                yields = {j for j in range(len(links)) if node.forbids(links[j], connection)}
                result.check(
                    "link response", where, {x - junction.movements[0] for x in movement.yields_to}, yields
                )


def _programs(result: Comparison, ours: Network, theirs: Any) -> None:
    for light in theirs.getTrafficLights():
        name = light.getID()
        programs = {
            p.name: p for key, p in ours.programs.items() if key == name or key.startswith(f"{name}:")
        }
        result.check("programs", name, sorted(programs), sorted(light.getPrograms()))
        for program_id, program in light.getPrograms().items():
            mine, where = programs[program_id], f"program {program_id} of light {name}"
            result.check("program", where, (mine.type, mine.offset), (program.getType(), program.getOffset()))
            result.check("number of phases", where, len(mine.phases), len(program.getPhases()))
            for i, (a, b) in enumerate(zip(mine.phases, program.getPhases(), strict=True)):
                low = -1 if a.min_duration is None else a.min_duration
                high = -1 if a.max_duration is None else a.max_duration
                phase = (a.duration, a.state, low, high, a.name, a.next)
                same = (b.duration, b.state, b.minDur, b.maxDur, b.name, tuple(b.next or ()))
                result.check("phase", f"{where} [{i}]", phase, same)
        for link, connections in light.getLinks().items():
            controlled = {ours.movements[m].incoming for m in ours.programs[name].movements[link]}
            result.check("signal link", f"{name} {link}", controlled, {c[0].getID() for c in connections})


@dataclass
class Inside:
    """Distance (m) from the curves that netconvert samples inside junctions.

    Mean and maximum over lanes.
    """

    name: str
    lanes: int
    polyline: tuple[float, float]  # of SUMO's usual five points per lane
    ours: tuple[float, float]  # of our curves over them


def compare_inside(path: Path, name: str, folder: Path) -> Inside:
    """Compare nets with 5 and with 50 points per lane inside junctions."""
    made = {}
    for detail in (5, 50):
        made[detail] = folder / f"detail_{detail}.net.xml"
        run_sumo("netconvert", f"-s {path} --junctions.internal-link-detail {detail} -o {made[detail]}")
    coarse, fine = (sumolib.net.readNet(str(made[detail]), withInternal=True) for detail in (5, 50))
    ours = read_sumo(made[5])
    distances = []
    for edge in fine.getEdges():
        for lane in edge.getLanes():
            if edge.getFunction() == "internal" and len(lane.getShape()) > 2 and lane.getID() in ours.lanes:
                truth = np.array(lane.getShape3D())
                shape = np.array(coarse.getLane(lane.getID()).getShape3D())
                curve = _dense(ours.lanes[lane.getID()])
                distances.append([polyline_distance(truth, line)[1:-1].max() for line in (shape, curve)])
    mean, worst = np.mean(distances, axis=0), np.max(distances, axis=0)
    return Inside(name, len(distances), (float(mean[0]), float(worst[0])), (float(mean[1]), float(worst[1])))


def run_sumo(program: str, options: str) -> None:
    """Run one of the programs of Eclipse SUMO."""
    import sumo

    home = Path(sumo.SUMO_HOME)
    command = [str(home / "bin" / program), *options.split()]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"SUMO_HOME": str(home)})


def generate(folder: Path) -> dict[str, Path]:
    """Networks made by SUMO's netgenerate."""
    made = {}
    for i, (name, options) in enumerate(GENERATED.items()):
        made[name] = folder / f"generated_{i}.net.xml"
        run_sumo("netgenerate", f"{options} -o {made[name]}")
    return made


def main(files: list[str]) -> int:
    """Compare, write the tables, and return 1 if anything differs."""
    results = []
    inside = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        maps = {Path(f).name: Path(f) for f in files}
        if not files:
            maps = {path.parent.name: path for path in sorted(SHARED.glob("*/*.net.xml"))}
            maps |= {f"netgenerate: {name}": path for name, path in generate(folder).items()}
        for name, path in maps.items():
            result, network = compare(path, name)
            results.append((result, sum(lane.id.startswith(":") for lane in network.lanes.values())))
            print(f"{name}: {sum(result.compared.values())} compared, {len(result.mismatches)} differ")
            for line in result.mismatches[:10]:
                print("   ", line)
            if "without internal" not in name:
                inside.append(compare_inside(path, name, folder))
    lines = [
        "# SUMO networks: `read_sumo` against `sumolib`",
        "",
        f"Made by `{COMMAND}` with sumolib {version('sumolib')}.",
        "",
        "Compared one by one: ids, edge attributes, lane lengths, speeds, widths, permissions,",
        "connections with via lanes, link indices, directions, states, signal links, response and",
        "foes bits, programs phase by phase. The last two columns: largest distance (m) between our",
        "curve and SUMO's polyline, both ways, on lanes outside and inside junctions.",
        "",
        "| network | edges | lanes | of these internal | connections | links | phases | values compared |"
        " mismatches | outside | inside |",
        "|---|" + "---:|" * 10,
    ]
    for r, internal in results:
        c = r.compared
        counts = (c["edge"], c["lane length"], internal, c["connection"], c["link from"], c["phase"])
        cells = [*map(str, (*counts, sum(c.values()), len(r.mismatches))), f"{r.road:.3f}", f"{r.inside:.3f}"]
        lines.append(f"| {r.name} | {' | '.join(cells)} |")
    lines += [
        "",
        "## Inside junctions",
        "",
        "netconvert draws a smooth curve inside a junction and writes five points of it. Here the",
        "same nets were written with five and with fifty: mean and largest distance (m) of the fifty",
        "from the polyline through the five, on which SUMO drives, and from our curve over the five.",
        "",
        "| network | bent lanes | polyline, mean | polyline, max | ours, mean | ours, max |",
        "|---|" + "---:|" * 5,
    ]
    for x in inside:
        figures = " | ".join(f"{figure:.3f}" for figure in (*x.polyline, *x.ours))
        lines.append(f"| {x.name} | {x.lanes} | {figures} |")
    out = REPO / "experiments" / "results" / "maps_against_sumo"
    out.with_suffix(".md").write_text("\n".join(lines) + "\n")
    table = {
        "command": COMMAND,
        "sumolib": version("sumolib"),
        "networks": [vars(r) for r, _ in results],
        "inside": [vars(x) for x in inside],
    }
    out.with_suffix(".json").write_text(json.dumps(table, indent=1) + "\n")
    return int(any(r.mismatches for r, _ in results))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
