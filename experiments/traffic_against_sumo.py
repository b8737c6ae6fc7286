"""Our traffic next to SUMO's: a platoon on one lane step by step, and flows on whole networks.

    python experiments/traffic_against_sumo.py [--network NAME ...] [--seeds 3] [--seconds 1800]

Needs `libsumo` and the shared data. Writes experiments/results/traffic_against_sumo.json and .md; what the
differences come from is explained in `EXPLAINED`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from numpy.typing import NDArray
from platoon_against_sumo import DT, one_lane

from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.lane_map import LaneMap, lane_rows
from limsim_jax.maps.network import Network
from limsim_jax.maps.sumo import read_demand
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.traffic.car_following import ACC, IDM
from limsim_jax.traffic.demand.sumo import SumoScenario, sumo_scenario
from limsim_jax.traffic.engine import Tick, Traffic
from limsim_jax.types import Config, Driver, Scenario, Schedule
from limsim_jax.xla import enable_compilation_cache, use_all_cores

REPO = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", REPO.parent / "shared" / "data")) / "sumo"
OUT = REPO / "experiments" / "results" / "traffic_against_sumo"
COMMAND = "python experiments/traffic_against_sumo.py"

# --- networks ----------------------------------------------------------------------------------------


class Case(NamedTuple):
    """A network of the shared data, its demand and number of slots."""

    files: tuple[str, ...]
    slots: int
    begin: float = 0.0  # s, time of the files
    every: int = 1  # one vehicle of this number drives
    programs: str | None = None  # file with signal programs that replace those of the network


CASES = {
    "ingolstadt1": Case(("ingolstadt1.rou.xml",), 128, 57600.0),
    "limsim_town05": Case(("carlavtypes.rou.xml", "Town05.rou.xml"), 256),
    "limsim_roundabout": Case(("roundabout.rou.xml",), 128),
    "limsim_bigInter": Case(("bigInter.rou.xml",), 128),
    "bologna_pasubio": Case(
        ("pasubio_vtypes.add.xml", "pasubio_bus_stops.add.xml", "pasubio.rou.xml", "pasubio_busses.rou.xml"),
        256,
        every=4,
        programs="pasubio_tls.add.xml",
    ),
}

WARM_UP = 600.0  # s that do not count
CHUNK = 60.0  # s of our traffic per call
QUEUED = 1.0  # m/s, below which a vehicle counts as queued when its light turns green
HARD = 4.5  # m/s^2, SUMO's default `decel`

SUMO = {
    "SUMO, files as they are": {"idm": False, "step": 1.0},
    "SUMO, IDM": {"idm": True, "step": DT},
}
OURS = {"ours, IDM": IDM(), "ours, ACC-IDM": ACC()}


class Light(NamedTuple):
    """The light at the end of a lane."""

    program: str
    links: tuple[int, ...]
    foes: tuple[int, ...]  # links that have right of way over these


def lights(network: Network) -> dict[str, Light]:
    """Lanes that end at a light."""
    found: dict[str, set[int]] = defaultdict(set)
    foes: dict[str, set[int]] = defaultdict(set)
    programs = {}
    for movement in network.movements:
        if movement.program is not None and movement.link is not None:
            found[movement.incoming].add(movement.link)
            programs[movement.incoming] = movement.program
            others = (network.movements[i] for i in movement.yields_to)
            foes[movement.incoming] |= {x.link for x in others if x.link is not None}
    return {
        lane: Light(programs[lane], tuple(sorted(links)), tuple(sorted(foes[lane] - links)))
        for lane, links in found.items()
    }


def is_free(light: Light, state: str) -> bool:
    """Whether all vehicles on the lane may go and need not yield."""
    return all(state[i] in "Gg" for i in light.links) and all(state[i] not in "Gg" for i in light.foes)


def is_closed(light: Light, state: str) -> bool:
    """Whether no vehicle on the lane may go."""
    return all(state[i] in "ru" for i in light.links)


class Green(NamedTuple):
    """A light turns from red to green for all on a lane."""

    lane: str
    start: float  # s
    end: float
    queue: int  # vehicles that stand on the lane at the start


def discharge(greens: Sequence[Green], passages: dict[str, list[float]]) -> tuple[list[float], list[float]]:
    """Discharge headways (s) from the fourth vehicle on, and first times."""
    headways, first = [], []
    for green in greens:
        times = [t for t in passages.get(green.lane, []) if green.start < t <= green.end][: green.queue]
        first += [times[0] - green.start] if times else []
        headways += [b - a for a, b in pairwise(times[2:])]
    return headways, first


def sumo_files(folder: Path, case: Case, keep: Sequence[str], out: Path, *, idm: bool) -> list[Path]:
    """SUMO's demand with only the vehicles that drive in ours, without stops."""
    kept, files = set(keep), []
    for name in case.files:
        tree = ElementTree.parse(folder / name)
        root = tree.getroot()
        for element in list(root):
            if element.tag == "busStop" or (
                element.tag in ("vehicle", "trip") and element.attrib["id"] not in kept
            ):
                root.remove(element)
            for stop in element.findall("stop"):
                element.remove(stop)
        for element in root.iter("vType") if idm else ():
            element.set("carFollowModel", "IDM")
        files.append(out / f"{'idm' if idm else 'own'}_{name}")
        tree.write(files[-1])
    if idm:
        files.insert(0, out / "idm_default.rou.xml")
        files[0].write_text('<routes><vType id="DEFAULT_VEHTYPE" carFollowModel="IDM"/></routes>')
    return files


def run_sumo(
    net: str,
    files: Sequence[str],
    lit: dict[str, Light],
    start: float,
    seconds: float,
    step: float,
    idm: bool,
    seed: int,
) -> dict[str, Any]:
    """One run of SUMO in this process."""
    import libsumo  # pyright: ignore[reportMissingImports]

    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        loops = [
            f'<instantInductionLoop id="{x}" lane="{x}" pos="-0.1" friendlyPos="true" file="loops.xml"/>'
            for x in lit
        ]
        (out / "loops.add.xml").write_text("<additional>" + "".join(loops) + "</additional>")
        options = {
            "-n": net, "-r": ",".join(files), "-a": out / "loops.add.xml", "-b": start, "--step-length": step,
            "--seed": seed, "--step-method.ballistic": str(idm).lower(),
            "--tripinfo-output": out / "trips.xml", "--summary-output": out / "summary.xml",
            "--statistic-output": out / "statistics.xml", "--lanechange-output": out / "changes.xml",
            "--xml-validation": "never",
        }  # fmt: skip
        libsumo.start(
            ["sumo", *(str(x) for pair in options.items() for x in pair), "--no-step-log", "--no-warnings"]
        )
        watch = _Watch(lit)
        for i in range(round(seconds / step)):
            libsumo.simulationStep()
            now = (i + 1) * step
            states = {name: libsumo.trafficlight.getRedYellowGreenState(name) for name in watch.programs}
            watch.look(
                now,
                states,
                lambda lane: sum(
                    libsumo.vehicle.getSpeed(x) < QUEUED for x in libsumo.lane.getLastStepVehicleIDs(lane)
                ),
            )
        libsumo.close()
        greens = watch.greens
        passages: dict[str, list[float]] = defaultdict(list)
        if lit:
            for event in _rows(out / "loops.xml"):
                if event["state"] == "enter":
                    passages[event["id"]].append(float(event["time"]) - start)
        trips, steps = _rows(out / "trips.xml"), _rows(out / "summary.xml")
        changes = [float(x["time"]) - start for x in _rows(out / "changes.xml")]
        totals = {x.tag: x.attrib for x in ElementTree.parse(out / "statistics.xml").getroot()}
    arrived = [x for x in trips if float(x["arrival"]) - start > WARM_UP]
    running = [x for x in steps if float(x["time"]) - start > WARM_UP]
    weight = np.array([float(x["running"]) for x in running])
    speed = np.array([float(x["meanSpeed"]) for x in running])
    headways, first = discharge(greens, passages)
    window = seconds - WARM_UP
    distance = float((weight * np.maximum(speed, 0)).sum() * step)
    return {
        "arrived_per_hour": 3600 * len(arrived) / window,
        "mean_speed": distance / float(weight.sum() * step),
        "travel_time": statistics.fmean(float(x["duration"]) for x in arrived),
        "depart_delay": statistics.fmean(float(x["departDelay"]) for x in arrived),
        "running": float(weight.mean()),
        "waiting_at_end": int(float(steps[-1]["waiting"])),
        "lane_changes_per_km": 1000 * sum(t > WARM_UP for t in changes) / distance,
        "teleports": int(totals["teleports"]["total"]),
        "collisions": int(totals["safety"]["collisions"]),
        "emergency_brakings": int(totals["safety"]["emergencyBraking"]),
        "headways": headways,
        "first": first,
    }


def _rows(path: Path) -> list[dict[str, str]]:
    """Attributes of the elements of one of SUMO's outputs."""
    return [x.attrib for x in ElementTree.parse(path).getroot()]


class _Watch:
    """Finds lights that turn green, and the queues before them."""

    def __init__(self, lit: dict[str, Light]) -> None:
        self.lit = lit
        self.programs = sorted({light.program for light in lit.values()})
        self.before: dict[str, str] = {}
        self.closed: set[str] = set()
        self.open: dict[str, tuple[float, int]] = {}
        self.greens: list[Green] = []
        self.by_program: dict[str, list[str]] = defaultdict(list)
        for lane, light in lit.items():
            self.by_program[light.program].append(lane)

    def look(self, now: float, states: dict[str, str], queue: Any) -> None:
        """Take the states of all programs at a time (s).

        `queue(lane)` counts vehicles that stand on a lane.
        """
        for program, state in states.items():
            if self.before.get(program) == state:
                continue
            self.before[program] = state
            for lane in self.by_program[program]:
                light = self.lit[lane]
                free = is_free(light, state)
                if lane in self.open and not free:
                    start, count = self.open.pop(lane)
                    self.greens.append(Green(lane, start, now, count))
                if free and lane in self.closed:
                    self.open[lane] = now, queue(lane)
                if is_closed(light, state):
                    self.closed.add(lane)
                else:
                    self.closed.discard(lane)


@dataclass(frozen=True)
class Either:
    """IDM for drivers without coolness, ACC-IDM for others: one program for both."""

    def __call__(self, driver: Driver, **seen: Any) -> Any:
        """Acceleration, m/s^2."""
        return jnp.where(driver.coolness > 0, ACC()(driver, **seen), IDM()(driver, **seen))


class Seen(NamedTuple):
    """What is kept of a step, `[N]` but for `phase`."""

    active: Any
    left: Any
    vehicle: Any
    entered: Any
    lane: Any
    s: Any
    v: Any
    a: Any
    dx: Any
    phase: Any


def _see(lane_map: LaneMap) -> Any:
    del lane_map

    def record(tick: Tick) -> Seen:
        x = tick.state
        return Seen(x.active, tick.left, x.vehicle, x.entered, x.lane, x.s, x.v, x.a, tick.dx, x.lights.phase)

    return record


def run_ours(
    network: Network, lane_map: LaneMap, scenarios: Sequence[Scenario], lit: dict[str, Light], seconds: float
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """All worlds together; the measurements of each one, and compile and run time (s)."""
    run = Rollout(Config(dt=DT), Traffic(model=Either(), after_collision="continue"), seconds, record=_see)
    scenario: Scenario = jax.tree.map(lambda *x: jnp.stack(x), *scenarios)
    start, schedule = scenario.start, scenario.schedule
    steps = round(CHUNK / DT)
    decisions = steps // run.config.decision_every

    def chunk(lane_map: LaneMap, schedule: Schedule, carry: Any) -> Any:
        go = lambda schedule, carry: run.advance(lane_map, schedule, jax.random.key(0), carry, decisions)  # noqa: E731
        result, carry = jax.vmap(go)(schedule, carry)
        return result.trace, carry

    worlds = PartitionSpec("worlds")
    cores = [x for x in range(1, len(jax.local_devices()) + 1) if len(scenarios) % x == 0][-1]
    mesh = Mesh(np.array(jax.local_devices()[:cores]), ("worlds",))
    program: Any = jax.jit(
        jax.shard_map(
            chunk, mesh=mesh, in_specs=(PartitionSpec(), worlds, worlds), out_specs=worlds, check_vma=False
        )
    )
    carry = jax.vmap(lambda state: run.init(lane_map, state))(start)
    clock = time.perf_counter()
    program = program.lower(lane_map, schedule, carry).compile()
    compiled = time.perf_counter()
    watchers = [
        _Observer(network, lane_map, lit, np.asarray(scenario.schedule.time)) for scenario in scenarios
    ]
    for _ in range(round(seconds / CHUNK)):
        seen, carry = program(lane_map, schedule, carry)
        seen = jax.device_get(seen)
        for i, watcher in enumerate(watchers):
            watcher.look(Seen(*(x[i] for x in seen)))
    times = {"compile_s": compiled - clock, "run_s": time.perf_counter() - compiled}
    totals = jax.device_get(carry.totals)
    found = []
    for i, watcher in enumerate(watchers):
        events = {
            name: int(getattr(totals, name)[i])
            for name in ("waiting", "full", "collided", "ran_red", "missed", "off_road", "broken", "gridlock")
        }
        found.append(watcher.result(seconds) | events)
    return found, times


class _Observer:
    """Measures one of our worlds with the definitions of `run_sumo`."""

    def __init__(self, network: Network, lane_map: LaneMap, lit: dict[str, Light], due: NDArray[Any]) -> None:
        rows = lane_rows(network)
        self.rows = rows
        self.names = {row: lane for lane, row in rows.items()}
        self.lit_row = np.zeros(lane_map.length.shape[0], bool)
        self.lit_row[[rows[lane] for lane in lit]] = True
        self.beside = np.stack([np.asarray(lane_map.left), np.asarray(lane_map.right)])
        self.programs = {
            p.id: (i, [x.state for x in p.phases]) for i, p in enumerate(network.programs.values())
        }
        self.due = due
        self.watch = _Watch(lit)
        self.step = 0
        self.last: Any = None
        self.passages: dict[str, list[float]] = defaultdict(list)
        self.trips: list[float] = []
        self.delays: list[float] = []
        self.distance = self.time = 0.0
        self.changes = self.hard = self.steps = 0

    def look(self, seen: Seen) -> None:
        """Steps `[T, N]` that follow those seen before."""
        for k in range(seen.active.shape[0]):
            self._step(Seen(*(x[k] for x in seen)))

    def _step(self, x: Seen) -> None:
        self.step += 1
        now = self.step * DT
        before, self.last = self.last, x
        if before is None:
            return
        # lights are set at the decision, a step before the first motion that follows it
        states = {p: self.programs[p][1][x.phase[self.programs[p][0]]] for p in self.watch.programs}
        self.watch.look(
            now - DT,
            states,
            lambda lane: int(((before.lane == self.rows[lane]) & before.active & (before.v < QUEUED)).sum()),
        )
        same = before.active & x.active & (before.vehicle == x.vehicle)
        over = np.nonzero(same & (before.lane != x.lane) & self.lit_row[before.lane] & (x.s <= x.dx))[0]
        for i in over[np.argsort(-x.s[over] / np.maximum(x.dx[over], 1e-6))]:
            self.passages[self.names[int(before.lane[i])]].append(
                now - DT * float(x.s[i] / max(x.dx[i], 1e-6))
            )
        if now <= WARM_UP:
            return
        self.steps += 1
        self.trips += (now - x.entered[x.left]).tolist()
        self.delays += (x.entered[x.left] - self.due[x.vehicle[x.left]]).tolist()
        self.distance += float(x.dx[x.active | x.left].sum())
        self.time += DT * float(x.active.sum())
        aside = same & (self.beside[:, before.lane] == x.lane).any(0) & (before.lane != x.lane)
        self.changes += int(aside.sum())
        self.hard += int((same & (x.a < -HARD) & (before.a >= -HARD)).sum())

    def result(self, seconds: float) -> dict[str, Any]:
        """All that `run_sumo` has, after `seconds`."""
        headways, first = discharge(self.watch.greens, self.passages)
        return {
            "arrived_per_hour": 3600 * len(self.trips) / (seconds - WARM_UP),
            "mean_speed": self.distance / self.time,
            "travel_time": statistics.fmean(self.trips) if self.trips else None,
            "depart_delay": statistics.fmean(self.delays) if self.delays else None,
            "running": self.time / (self.steps * DT),
            "lane_changes_per_km": 1000 * self.changes / self.distance,
            "hard_brakings_per_km": 1000 * self.hard / self.distance,
            "headways": headways,
            "first": first,
        }


def merged_net(net: Path, programs: Path | None, out: Path) -> Path:
    """The network with the signal programs of another file."""
    if programs is None:
        return net
    tree = ElementTree.parse(net)
    root = tree.getroot()
    new = {x.attrib["id"]: x for x in ElementTree.parse(programs).getroot().iter("tlLogic")}
    for i, element in enumerate(root):
        if element.tag == "tlLogic" and element.attrib["id"] in new:
            root[i] = new[element.attrib["id"]]
    path = out / net.name
    tree.write(path)
    return path


def prepare(
    name: str, out: Path, seeds: Sequence[int], seconds: float
) -> tuple[Path, Network, list[SumoScenario]]:
    """Network file, network and our scenarios, one per seed."""
    case, folder = CASES[name], SHARED / name
    net = merged_net(next(folder.glob("*.net.xml")), folder / case.programs if case.programs else None, out)
    network = read_network(net)
    demand = read_demand([folder / file for file in case.files], network)
    vehicles = list(demand.vehicles.items())
    demand = replace(demand, vehicles=dict(vehicles[:: case.every]))
    lane_map = build_lane_map(network)
    made = [
        sumo_scenario(
            network, lane_map, demand, slots=case.slots, begin=case.begin, end=case.begin + seconds, seed=seed
        )
        for seed in seeds
    ]
    for other in made[1:]:
        same = jax.tree.map(lambda a, b: bool((a == b).all()), made[0].lane_map.routes, other.lane_map.routes)
        assert all(jax.tree.leaves(same)), "the ways differ from seed to seed"
    return net, network, made


def compare_network(
    name: str, seeds: Sequence[int], seconds: float, pool: ProcessPoolExecutor
) -> dict[str, Any]:
    """All settings on one network: a list of measurements per setting, one per seed."""
    case, folder = CASES[name], SHARED / name
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        net, network, made = prepare(name, out, seeds, seconds)
        lit = lights(network)
        jobs = {}
        for setting, how in SUMO.items():
            files = [str(x) for x in sumo_files(folder, case, made[0].vehicles, out, idm=how["idm"])]
            arguments = (str(net), files, lit, case.begin, seconds, how["step"], how["idm"])
            jobs[setting] = [pool.submit(run_sumo, *arguments, seed) for seed in seeds]
        # one batch: the seeds with each model
        worlds = [
            _with_coolness(x.scenario, 0.0 if isinstance(model, IDM) else None)
            for model in OURS.values()
            for x in made
        ]
        found, times = run_ours(network, made[0].lane_map, worlds, lit, seconds)
        runs = {setting: [job.result() for job in of] for setting, of in jobs.items()}
    for i, setting in enumerate(OURS):
        runs[setting] = found[i * len(made) : (i + 1) * len(made)]
    return {
        "vehicles": len(made[0].vehicles),
        "slots": case.slots,
        "lights": len(lit),
        "notes": list(made[0].notes),
        "times": times,
        "runs": runs,
    }


def _with_coolness(scenario: Scenario, coolness: float | None) -> Scenario:
    if coolness is None:
        return scenario
    driver = scenario.schedule.driver
    driver = replace(driver, coolness=jnp.full_like(driver.coolness, coolness))
    return replace(scenario, schedule=replace(scenario.schedule, driver=driver))


# --- tables ------------------------------------------------------------------------------------------

ROWS = {
    "arrived_per_hour": ("arrived, veh/h", 0),
    "running": ("vehicles on the road, mean", 1),
    "mean_speed": ("mean speed, m/s", 2),
    "travel_time": ("mean travel time, s", 1),
    "depart_delay": ("mean delay of departure, s", 1),
    "lane_changes_per_km": ("lane changes per km", 2),
}
EVENTS = {
    "waiting": ("waiting outside at the end", "waiting_at_end"),
    "missed": ("teleported (SUMO), took another way (ours)", "teleports"),
    "collided": ("in collisions", "collisions"),
    "ran_red": ("crossed a line on red", None),
    "gridlock": ("runs with gridlock", None),
}

EXPLAINED = """
Vehicle types are those of the files in all settings: accel, decel, emergencyDecel, tau, minGap, maxSpeed,
speedFactor, length and width are a, b, b_max, T, s0, v_max, speed_factor and the body of ours. sigma (0.5)
exists in SUMO's Krauss model only. Files as they are: Krauss, 1 s steps. IDM: every type with
carFollowModel IDM, 0.1 s steps, ballistic. Stops of buses are made in none. Bologna has the programs of
pasubio_tls.add.xml and every fourth vehicle.

- One lane: SUMO's IDM is ours. The centimetre that is left is the leader's: a free ego adds up its x in
  float32, 2 km from the origin of the map, and its followers keep their distance to it.
- First vehicle after green: with steps of 1 s a driver starts a step later, and Krauss dawdles; IDM drivers
  of both simulators start at once.
- Turns: in SUMO the network gives the speed in junctions (5.5 m/s^2 across). Ours drive with what the driver
  accepts (2.5 m/s^2 on average). Turning queues discharge slower, and so do lanes that shift sideways within
  a few metres of a junction (104012170 of ingolstadt1).
- Lane changes take no time and no distance in SUMO. Ours take 3 to 7 s and at least 22 m, so shorter edges
  hardly serve for them. Below 10 m no vehicle counts on a change. A vehicle on the wrong lane there, or on a
  lane a little longer, takes another route (edge 164051413 of ingolstadt1, 8.9 m; edge -28 of limsim_town05,
  27 m). It then misses turns that SUMO's drivers make.
- Gaps: ours enter a crossing with a critical gap of about 6 s, as Siegloch's formula has it for turns from
  minor roads. SUMO's drivers go if they are clear a second before the other arrives. Minor arms discharge
  slower (391891458 of ingolstadt1: the queue behind it is what waits outside).
- SUMO's drivers choose the lane that leads on farthest, and so use all lanes of the roundabout. Ours stay on
  the lane of their exit, four fifths of them on the outermost, and wait for one another.
- limsim_bigInter jams in runs of SUMO: vehicles that have entered on a gap meet others inside, and SUMO
  teleports some of them. Ours enter no junction that they cannot leave.
- ingolstadt1 and limsim_town05 count as gridlocked as soon as one vehicle stands for 120 s, which happens
  in minor arms, behind long red phases and missed turns; traffic as a whole goes on.
- SUMO looks for collisions along lanes. Ours compares bodies, so it also finds vehicles that touch side by
  side where lanes come close: on the two lanes of 1200363973 in ingolstadt1, which shift 3 m sideways within
  8 m, and where vehicles of 12 m turn beside others (4_6 and 29_0 of bologna_pasubio). Where bodies have no
  room side by side, vehicles go one after the other: queues on 1200363973 discharge slower.
- SUMO teleports vehicles that stand for 300 s. Ours stay, and block the vehicles behind them.
"""


def _spread(of_runs: Sequence[float | None], digits: int) -> str:
    """Mean and standard deviation; runs without arrivals have no travel time."""
    values = [x for x in of_runs if x is not None]
    if not values:
        return "none arrived"
    mean = f"{statistics.fmean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.{digits}f}"


def network_table(name: str, result: dict[str, Any]) -> list[str]:
    """Markdown lines for one network: means over the seeds, and their standard deviation."""
    settings = [*SUMO, *OURS]
    runs = result["runs"]
    lines = [
        f"## {name}",
        "",
        f"{result['vehicles']} vehicles, {result['lights']} lanes with lights.",
        "",
        f"| | {' | '.join(settings)} |",
        "|---|" + "---:|" * len(settings),
    ]
    for key, (label, digits) in ROWS.items():
        cells = [_spread([run[key] for run in runs[x]], digits) for x in settings]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    for key, (label, theirs) in EVENTS.items():
        names = [theirs if x in SUMO else key for x in settings]
        cells = [
            "" if n is None else f"{sum(run[n] for run in runs[x])}"
            for n, x in zip(names, settings, strict=True)
        ]
        lines.append(f"| {label}, all seeds | {' | '.join(cells)} |")
    if result["lights"]:
        for label, key in (("discharge headway, s", "headways"), ("first vehicle after green, s", "first")):
            cells = []
            for x in settings:
                values = [v for run in runs[x] for v in run[key]]
                p = np.percentile(values, [10, 50, 90]) if values else []
                cells.append(
                    f"{p[1]:.2f} ({p[0]:.2f} to {p[2]:.2f}), n = {len(values)}" if values else "none"
                )
            lines.append(f"| {label} | {' | '.join(cells)} |")
    return [*lines, ""]


def main() -> None:
    """Compare and write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--network", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1800.0)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    use_all_cores()
    enable_compilation_cache()
    begun = time.perf_counter()
    table: dict[str, Any] = {
        "command": COMMAND,
        "sumo": version("libsumo"),
        "seeds": options.seeds,
        "seconds": options.seconds,
        "warm_up": WARM_UP,
    }
    with ProcessPoolExecutor(len(jax.local_devices()), mp_context=get_context("spawn")) as pool:
        table |= {"one_lane": one_lane(300.0, pool), "networks": {}}
        for name in options.network:
            table["networks"][name] = compare_network(name, range(options.seeds), options.seconds, pool)
            table["minutes"] = (time.perf_counter() - begun) / 60
            options.out.with_suffix(".json").write_text(json.dumps(_brief(table), indent=1) + "\n")
            options.out.with_suffix(".md").write_text("\n".join(_document(table)))
            print(f"{name} done after {table['minutes']:.1f} minutes", flush=True)


def _brief(table: Any) -> Any:
    """Replace lists of numbers by their count and 10th, 50th, 90th percentile."""
    if isinstance(table, dict):
        return {key: _brief(value) for key, value in table.items()}
    if isinstance(table, list) and table and all(isinstance(x, float) for x in table):
        return [len(table), *np.round(np.percentile(table, [10, 50, 90]), 3).tolist()]
    return [_brief(x) for x in table] if isinstance(table, list) else table


def _document(table: dict[str, Any]) -> list[str]:
    lines = [
        "# Our traffic against SUMO's",
        "",
        f"Made by `{COMMAND}` with SUMO {table['sumo']} in {table['minutes']:.0f} minutes.",
        "",
        "## One lane",
        "",
        "A platoon of 20 unequal vehicles (length, T, s0, a, b, delta, b_max, desired speed) on a road of",
        "ten edges behind a leader that stops and goes for 300 s: IDM in both, dt = 0.1 s, no randomness.",
        "Differences from ours, all vehicles and steps:",
        "",
        "| SUMO's step | position, RMS (m) | position, max (m) | speed, max (m/s) |",
        "|---|---:|---:|---:|",
    ]
    for name, row in table["one_lane"].items():
        figures = " | ".join(f"{row[k]:.4f}" for k in ("position_rms", "position_max", "speed_max"))
        lines.append(f"| {name} | {figures} |")
    lines += [
        "",
        "## Networks",
        "",
        "The same vehicles depart in all settings.",
        f"Of {table['seconds']:.0f} s the first {table['warm_up']:.0f} s do not count.",
        f"Means over {table['seeds']} seeds ± their standard deviation. Vehicles that collide drive on.",
        "",
        "Discharge headway: median (10th to 90th percentile) at the stop line from the fourth vehicle of a",
        f"queue on. The queue: vehicles below {QUEUED:.0f} m/s on a lane when its light turns green for all",
        "on it, where no vehicle has to yield.",
        "",
    ]
    for name, result in table["networks"].items():
        lines += network_table(name, result)
    return [*lines, "## Differences explained", EXPLAINED]


if __name__ == "__main__":
    main()
