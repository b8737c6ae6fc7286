"""Human drivers on a ring: stop-and-go from nothing, and growth of waves beside linear theory.

    python experiments/human_driver.py [--worlds 8] [--minutes 15]

The ring is that of Sugiyama et al., New Journal of Physics 10 (2008) 033001: 22 cars on 230 m, evenly spaced.
The theory is the linear stability of equal vehicles with delay, in steps as the engine drives. Writes
experiments/results/human_driver.json and .md, and the picture docs/results/human_ring.png.
"""

from __future__ import annotations

import argparse
import cmath
import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.maps.routing import default_goals
from limsim_jax.simulation.rollout import Rollout, world_key
from limsim_jax.traffic.car_following import IDM, NO_GAP, CarFollowing, equilibrium_gap
from limsim_jax.traffic.demand import build_demand, sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.human import HumanDriver
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import sample_vehicles, uniform_population
from limsim_jax.types import Config, Driver, Scenario, Status
from limsim_jax.xla import enable_compilation_cache

RESULTS = Path(__file__).parent / "results"
PICTURE = Path(__file__).parents[1] / "docs" / "results" / "human_ring.png"
RING, CARS, LIMIT = 230.0, 22, 30 / 3.6
"""Length (m), number of cars and speed limit (m/s) of Sugiyama et al."""
WIDTH = 3.5  # m, of the lane
DT = 0.1  # s
STANDS = 0.5  # m/s
SETTLED = 300.0  # s at the end, for which waves are described

DRIVERS: dict[str, HumanDriver | None] = {
    "default": None,
    "human": HumanDriver(),
    "human without errors": HumanDriver(gap_error=0.0, approach_error=0.0),
    "human without anticipation": HumanDriver(anticipates=False),
    "human that looks at 3 vehicles": HumanDriver(vehicles_ahead=3),
}

EXACT = HumanDriver(reaction=0.0, gap_error=0.0, approach_error=0.0)
WAVES: dict[str, HumanDriver | None] = {
    "default": None,
    "reaction time of 0.4 s": replace(EXACT, reaction=0.4, anticipates=False),
    "reaction time of 0.75 s": replace(EXACT, reaction=0.75, anticipates=False),
    "reaction time of 0.75 s, anticipates": replace(EXACT, reaction=0.75),
    "looks at 3 vehicles": replace(EXACT, vehicles_ahead=3),
    "reaction time of 0.75 s, looks at 3 vehicles": replace(EXACT, reaction=0.75, vehicles_ahead=3),
}
SPEEDS = 4.0, 10.0
"""m/s, at which waves are looked at."""


@cache
def ring(length: float, limit: float) -> tuple[Network, LaneMap]:
    """A lane that leads round, in two halves."""
    radius = length / math.tau - WIDTH / 2  # of the reference line, to the left of the lane
    roads = "".join(
        f"""<road name="" length="{math.pi * radius}" id="{i}" junction="-1"><link>
        <predecessor elementType="road" elementId="{1 - i}" contactPoint="end"/>
        <successor elementType="road" elementId="{1 - i}" contactPoint="start"/></link>
        <type s="0" type="rural"><speed max="{limit}" unit="m/s"/></type>
        <planView><geometry s="0" x="0" y="{2 * radius * i}" hdg="{math.pi * i}" length="{math.pi * radius}">
        <arc curvature="{1 / radius}"/></geometry></planView>
        <lanes><laneSection s="0"><center><lane id="0" type="none"/></center>
        <right><lane id="-1" type="driving"><link><predecessor id="-1"/><successor id="-1"/></link>
        <width sOffset="0" a="{WIDTH}" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road>"""
        for i in range(2)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring.xodr"
        path.write_text(f'<OpenDRIVE><header revMajor="1" revMinor="6" name="ring"/>{roads}</OpenDRIVE>')
        network = read_network(path, cache=False)
    return network, build_lane_map(network)


@dataclass(frozen=True)
class Run:
    """What equal cars on a ring did: `[T, N]`."""

    v: NDArray[np.float64]  # m/s
    x: NDArray[np.float64]  # m along the ring
    contacts: int


def drive_ring(
    around: tuple[Network, LaneMap],
    traffic: Traffic,
    driver: dict[str, float],
    x: NDArray[np.float64],
    v: NDArray[np.float64],
    seconds: float,
    seed: int = 0,
) -> Run:
    """Drive cars round a ring from places (m, ascending) and speeds (m/s)."""
    network, lane_map = around
    half, n = float(lane_map.length[0]), len(x)
    population = uniform_population("car", a_lat=50.0, **driver)
    drivers, shapes = sample_vehicles(population, world_key(seed), jnp.arange(n))
    nobody = build_demand(network, lane_map, default_goals(network), [], population, horizon=seconds)
    empty = sample_scenario(nobody, lane_map, world_key(seed), n)
    start = start_state(
        lane_map, drivers, shapes, lane=jnp.asarray((x >= half) * 1), s=jnp.asarray(x % half),
        v=jnp.asarray(v), goal=jnp.zeros(n, jnp.int32), origins=empty.start.queues.next.shape[0],
    )  # fmt: skip

    def kept(_: LaneMap) -> Callable[[Any], Any]:
        return lambda tick: (
            tick.state.v,
            tick.state.lane.astype(jnp.float32) * half + tick.state.s,
            tick.state.status,
        )

    run = Rollout(Config(dt=DT), traffic, seconds, record=kept)
    trace = jax.jit(
        lambda lanes, state, key: run(lanes, Scenario(start=state, schedule=empty.schedule), key).trace
    )
    speed, place, status = jax.device_get(trace(lane_map, start, jax.random.split(world_key(seed))[1]))
    contacts = int(((status[-1] & int(Status.COLLIDED)) != 0).sum())
    return Run(np.asarray(speed, float), np.asarray(place, float), contacts)


# --- stop-and-go -------------------------------------------------------------------------------------


def stop_and_go(human: HumanDriver | None, minutes: float, seed: int) -> tuple[dict[str, float], Run]:
    """How an even flow of default drivers goes on."""
    x = np.arange(CARS) * RING / CARS
    run = drive_ring(ring(RING, LIMIT), Traffic(human=human), {}, x, np.full(CARS, 3.5), 60 * minutes, seed)
    stood = (run.v < STANDS).any(1)
    last = slice(-round(SETTLED / DT), None)
    v, place = run.v[last], run.x[last]
    found = {
        "begins_s": DT * (1 + int(stood.argmax())) if stood.any() else math.nan,
        "speed": float(v.mean()), "deviation": float(v.std(1).mean()), "stands": float((v < STANDS).mean()),
        "contacts": run.contacts,
    }  # fmt: skip
    found["wave"] = wave_speed(v, place)
    return found, run


def wave_speed(v: NDArray[np.float64], place: NDArray[np.float64]) -> float:
    """Speed (m/s) of the fronts where cars move off, NaN without any.

    Of speeds (m/s) and places (m) `[T, N]`, each car behind the next.
    """
    moves = np.where(v < STANDS, -1, np.where(v > 2 * STANDS, 1, 0))
    starts = []  # of every car
    for k in range(v.shape[1]):
        known = np.flatnonzero(moves[:, k])
        starts.append(known[1:][np.diff(moves[known, k]) > 0])
    way, time = 0.0, 0.0
    for k, ahead in enumerate(np.roll(np.arange(v.shape[1]), -1)):
        for t in starts[ahead]:
            after = starts[k][starts[k] > t]
            if len(after) and after[0] - t < 5 / DT:
                way += float(place[after[0], k] - place[t, ahead]) % -RING
                time += float(after[0] - t) * DT
    return way / time if time else math.nan


# --- linear theory -----------------------------------------------------------------------------------


def slopes(driver: Driver, s: float, v: float, v0: float, human: HumanDriver | None) -> list[NDArray[Any]]:
    """Derivatives of the IDM by gap, own speed and leader's speed.

    For each vehicle ahead. Those by the own speed belong to all together and stand with the first.
    """
    n = 1 if human is None else human.vehicles_ahead
    root = math.sqrt(sum(1 / m**2 for m in range(1, n + 1)))
    close = replace(driver, T=driver.T / root, s0=driver.s0 / root)

    def total(gaps: Array, own: Array, leaders: Array) -> Array:
        def model(gap: Array, lead: Array) -> Array:
            return IDM()(close, gap=gap, v=own, v_lead=lead, a_lead=jnp.zeros_like(gap), v0=jnp.float32(v0))

        free = model(jnp.full_like(own, NO_GAP), own)
        return free + sum(model(gaps[m], leaders[m]) - free for m in range(n))

    gaps = s * jnp.arange(1.0, n + 1)
    return [np.asarray(x) for x in jax.grad(total, (0, 1, 2))(gaps, jnp.float32(v), jnp.full(n, v))]


def growth(derivatives: list[NDArray[Any]], human: HumanDriver | None, kappa: float) -> tuple[float, complex]:
    """Growth rate (1/s) of a wave, and speed over place.

    The phase is `kappa` (rad) from vehicle to vehicle.
    `derivatives` are those of `slopes`. With a delay there are many such waves; this is the fastest. Each
    vehicle accelerates evenly for a step: with z the growth of a step, V = A dt / (z - 1) and
    Y = dt (V + A dt / 2) / (z - 1). The acceleration is z^(-T'/dt) times what the driver wants.
    """
    f_s, f_v, f_l = derivatives
    late = 0.0 if human is None else human.reaction / DT
    whole = math.ceil(late - 1e-6)
    ahead = 0.0 if human is None or not human.anticipates else human.reaction

    def excess(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        speed = DT / (z - 1)
        place = DT * (speed + DT / 2) / (z - 1)
        change = ahead / z  # of speed, by the acceleration of the last step
        wish = f_v * (speed + change)
        for m, (by_gap, by_lead) in enumerate(zip(f_s, f_l, strict=True), 1):
            turn = cmath.exp(1j * kappa * m)
            wish += by_gap * (turn - 1) * (place + ahead * speed) + by_lead * (turn * speed + change)
        part = whole - late
        shift = z**-whole if whole == 0 else (1 - part) * z**-whole + part * z ** (1 - whole)
        return 1 - shift * wish

    real, imaginary = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-4, 4, 33))
    turn = np.exp(1j * kappa * np.arange(1, len(f_s) + 1))
    b, c = f_v + f_l @ turn, f_s @ (turn - 1)
    known = (b + np.array([1, -1]) * np.sqrt(b * b + 4 * c)) / 2  # without delay
    z: NDArray[np.complex128] = np.exp(np.append((real + 1j * imaginary).ravel(), known) * DT)
    change = np.zeros_like(z)
    with np.errstate(all="ignore"):
        for _ in range(60):  # Newton
            h = 1e-3 * (z - 1)
            change = excess(z) * 2 * h / (excess(z + h) - excess(z - h))
            z = z - change
        z = z[(np.abs(change) < 1e-8) & (np.abs(z - 1) > 1e-5)]
    fastest = complex(z[np.argmax(np.abs(z))])
    return math.log(abs(fastest)) / DT, (fastest - 1) / (DT * (0.5 + 0.5 * fastest))


def wave(human: HumanDriver | None, v: float, cars: int = 40, seconds: float = 60.0) -> dict[str, float]:
    """The wave that grows fastest: its length, and growth rate (1/s) by theory and driven.

    The drivers follow the IDM. The rate counts after 5 s, as long as the wave is small.
    """
    v0, values = 30.0, {"T": 1.0, "s0": 2.0, "a": 1.9, "b": 2.0, "delta": 4.0, "speed_factor": 1.0}
    driver = Driver(**{name: jnp.float32(values.get(name, 0.0)) for name in Driver.__dataclass_fields__})
    driver = replace(driver, b_max=jnp.float32(8.0))
    s, length = float(equilibrium_gap(IDM(), driver, jnp.float32(v), jnp.float32(v0))), 4.5
    way, derivatives = cars * (s + length), slopes(driver, s, v, v0, human)
    waves = [(*growth(derivatives, human, math.tau * k / cars), k) for k in range(1, cars // 2 + 1)]
    rate, speed_over_place, number = max(waves, key=lambda found: found[0])
    kappa = math.tau * number / cars
    pattern = (0.1 if rate < 0.02 else 0.002) * np.exp(1j * kappa * np.arange(cars))  # m
    x = np.arange(cars) * way / cars + 1.0 + pattern.real
    model: CarFollowing = IDM()
    run = drive_ring(
        ring(way, v0), Traffic(model=model, human=human), values | {"length": length}, x,
        np.asarray(v + (speed_over_place * pattern).real, np.float64), seconds,
    )  # fmt: skip
    size = np.abs((run.v * np.exp(-1j * kappa * np.arange(cars))).mean(1))
    t = DT * np.arange(1, len(size) + 1)
    use = (t > 5) & (np.maximum.accumulate(size) < 0.1 * v) & (np.minimum.accumulate(size) > 1e-5)
    return {
        "vehicles": cars / number,
        "theory": rate,
        "driven": float(np.polyfit(t[use], np.log(size[use]), 1)[0]),
    }


# --- all ---------------------------------------------------------------------------------------------


def draw(runs: dict[str, Run]) -> None:
    """The ring unrolled: a line per car, slow cars dark."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes, lines = figure.subplots(1, len(runs), sharey=True), None
    for ax, (name, run) in zip(np.atleast_1d(axes), runs.items(), strict=True):
        every = 5
        t = DT * every * np.arange(len(run.v[::every]))
        for k in range(run.v.shape[1]):
            y, v = run.x[::every, k] % RING, run.v[::every, k]
            points = np.stack([t, y], -1)
            parts = np.stack([points[:-1], points[1:]], 1)[np.abs(np.diff(y)) < RING / 2]
            lines = LineCollection(list(parts), cmap="viridis", linewidths=0.6)
            lines.set_array(v[:-1][np.abs(np.diff(y)) < RING / 2])
            lines.set_clim(0, 6)
            ax.add_collection(lines)
        ax.set(xlim=(0, 300), ylim=(0, RING), title=name, xlabel="time, s")
    np.atleast_1d(axes)[0].set_ylabel("place on the ring, m")
    assert lines is not None
    figure.colorbar(lines, ax=axes, label="speed, m/s")
    figure.savefig(PICTURE, dpi=110)


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return ["| " + " | ".join(row) + " |" for row in (header, rule, *rows)]


def _shown(value: float, digits: int) -> str:
    return "none" if math.isnan(value) else f"{value:.{digits}f}"


def report(rings: list[dict[str, Any]], waves: list[dict[str, Any]], worlds: int, minutes: float) -> str:
    """Both tables."""
    lines = ["Regenerate: `python experiments/human_driver.py`", ""]
    lines += [f"{CARS} cars on a ring of {RING:.0f} m, {minutes:g} minutes, {worlds} worlds:", ""]
    names = ["drivers", "worlds with stop-and-go", "after, s", "mean speed, m/s", "deviation, m/s"]
    names += ["vehicles that stand", "speed of the wave, km/h", "contacts"]
    lines += table(
        names,
        [
            [
                row["drivers"], f"{row['worlds_with']} of {worlds}", _shown(row["begins_s"], 0),
                f"{row['speed']:.2f}", f"{row['deviation']:.2f}", f"{row['stands']:.0%}".replace("%", " %"),
                _shown(3.6 * row["wave"], 1), str(row["contacts"]),
            ]
            for row in rings
        ],
    )  # fmt: skip
    lines += ["", "The wave that grows fastest, of 40 vehicles of the IDM on a ring. Growth in 1/min:", ""]
    lines += table(
        ["drivers", "speed, m/s", "length, vehicles", "theory", "driven"],
        [
            [
                row["drivers"],
                f"{row['v']:g}",
                f"{row['vehicles']:.1f}",
                f"{60 * row['theory']:+.2f}",
                f"{60 * row['driven']:+.2f}",
            ]
            for row in waves
        ],
    )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=15.0)
    args = parser.parse_args()
    enable_compilation_cache()
    rings, pictures = [], {}
    for name, human in DRIVERS.items():
        found = [stop_and_go(human, args.minutes, seed) for seed in range(args.worlds)]
        rows = [row for row, _ in found]
        begun = [row["begins_s"] for row in rows if not math.isnan(row["begins_s"])]
        mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        mean |= {"begins_s": float(np.median(begun)) if begun else math.nan, "worlds_with": len(begun)}
        mean |= {"contacts": sum(row["contacts"] for row in rows)}
        rings.append({"drivers": name} | mean)
        if name in ("default", "human"):
            pictures[name] = found[0][1]
        print(rings[-1], flush=True)
    waves = [{"drivers": name, "v": v} | wave(human, v) for name, human in WAVES.items() for v in SPEEDS]
    text = report(rings, waves, args.worlds, args.minutes)
    print(text)
    RESULTS.mkdir(exist_ok=True)
    found = {"worlds": args.worlds, "minutes": args.minutes, "ring": rings, "waves": waves}
    write_whole(RESULTS / "human_driver.json", json.dumps(found, indent=1) + "\n")
    write_whole(RESULTS / "human_driver.md", text)
    draw(pictures)


if __name__ == "__main__":
    main()
