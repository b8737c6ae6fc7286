"""A platoon on one lane, in our engine and in SUMO.

Part of `traffic_against_sumo.py`.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.traffic.car_following import IDM
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, Limits, from_lane
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Driver, Shape, State

DT = 0.1
"""s, step of our physics, and of SUMO where it drives with the IDM."""

LIMIT = 20.0  # m/s
PIECE = 500.0  # m, length of each edge of the road
PIECES = 10

STOP_AND_GO = (
    (8, 1.5), (20, 0), (4, -3), (10, 0), (5, 2), (15, 0), (10, -0.5), (10, 0.5), (25, 0), (2, -5), (6, 0),
    (12, 1.25), (20, 0), (3, -2), (3, 2), (3, -2), (3, 2), (10, 0), (2, -7), (5, 0), (1, -1), (30, 0),
    (10, 1.2), (15, 0), (15, -0.8), (20, 0), (6, 2), (30, 0),
)  # fmt: skip
"""What the leader does: durations (s) and accelerations (m/s^2)."""


@dataclass(frozen=True)
class Platoon:
    """Vehicles on one lane, the first one in front: NumPy arrays `[N]`."""

    length: NDArray[np.float64]
    T: NDArray[np.float64]
    s0: NDArray[np.float64]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    delta: NDArray[np.float64]
    b_max: NDArray[np.float64]
    speed_factor: NDArray[np.float64]
    s: NDArray[np.float64]  # m, front bumper at the start; all stand


def platoon(vehicles: int, seed: int = 0) -> Platoon:
    """Vehicles that differ in everything, standing a little apart."""
    rng = np.random.default_rng(seed)
    draw = lambda low, high: np.round(rng.uniform(low, high, vehicles), 2)  # noqa: E731
    length, s0 = draw(2.2, 14.0), draw(1.0, 4.0)
    gaps = s0 + draw(0.2, 4.0)  # in front of each
    behind = np.concatenate([[0.0], np.cumsum(length[:-1] + gaps[1:])])
    return Platoon(
        length=length, T=draw(0.8, 2.0), s0=s0, a=draw(0.8, 2.6), b=draw(1.2, 4.0), delta=draw(3.0, 5.0),
        b_max=draw(7.0, 9.0), speed_factor=draw(0.7, 1.2), s=np.round(behind[-1] - behind + 40.0, 2),
    )  # fmt: skip


def road_xml() -> str:
    """A straight road of one lane in pieces, as a SUMO network."""
    edges, nodes, links = [], [], []
    for i in range(PIECES):
        shape = f"{i * PIECE:.2f},0.00 {(i + 1) * PIECE:.2f},0.00"
        edges.append(
            f'<edge id="e{i}" from="n{i}" to="n{i + 1}" priority="1"><lane id="e{i}_0" index="0" '
            f'speed="{LIMIT}" length="{PIECE:.2f}" shape="{shape}"/></edge>'
        )
    for i in range(PIECES + 1):
        inner = f'type="priority" incLanes="e{i - 1}_0"' if 0 < i < PIECES else 'type="dead_end" incLanes=""'
        x = i * PIECE
        shape = f'shape="{x:.2f},2.00 {x:.2f},-2.00"'
        requests = '<request index="0" response="0" foes="0" cont="0"/>' if 0 < i < PIECES else ""
        nodes.append(
            f'<junction id="n{i}" {inner} intLanes="" x="{x:.2f}" y="0.00" {shape}>{requests}</junction>'
        )
    for i in range(PIECES - 1):
        links.append(f'<connection from="e{i}" to="e{i + 1}" fromLane="0" toLane="0" dir="s" state="M"/>')
    location = (
        '<location netOffset="0.00,0.00" convBoundary="0.00,0.00,5000.00,0.00" '
        'origBoundary="0.00,0.00,5000.00,0.00" projParameter="!"/>'
    )
    return "\n".join(['<net version="1.20">', location, *edges, *nodes, *links, "</net>"])


class Ride(NamedTuple):
    """Distance and speed of every vehicle after every step, `[T, N]`."""

    x: NDArray[np.float64]  # m, front bumper from the start of the road
    v: NDArray[np.float64]  # m/s


def drive_ours(net: Path, vehicles: Platoon, seconds: float) -> Ride:
    """The platoon in our engine: the leader is a free ego, all others are traffic."""
    config = Config(dt=DT)
    # decisions every 0.5 s, and actuators without delay
    limits = Limits(acceleration=20.0, deceleration=20.0, jerk=1e6, acceleration_lag=0.0)
    traffic = Traffic(model=IDM(), limits=limits)
    lane_map = build_lane_map(read_network(net, cache=False), cache=False)
    n = len(vehicles.s)
    given = {field.name: 0.0 for field in fields(Driver)} | {
        "v_max": 60.0,
        "lane_change_time": 4.0,
        "a_lat": 2.5,
    }
    given |= {name: x for name, x in vars(vehicles).items() if name in given}
    state = start_state(
        lane_map,
        Driver(**{name: jnp.broadcast_to(jnp.asarray(x, jnp.float32), n) for name, x in given.items()}),
        Shape(
            length=jnp.asarray(vehicles.length, jnp.float32),
            width=jnp.full(n, 1.8),
            wheelbase=jnp.asarray(0.6 * vehicles.length, jnp.float32),
            vehicle_class=jnp.zeros(n, jnp.int32),
        ),
        lane=jnp.zeros(n, jnp.int32),
        s=jnp.asarray(vehicles.s, jnp.float32),
        v=jnp.zeros(n),
        goal=jnp.argmax(lane_map.routes.is_goal[PIECES - 1]) + jnp.zeros(n, jnp.int32),
    )
    state = replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [0], True))
    told = np.concatenate([np.full(round(t / config.decision_time), a, np.float32) for t, a in STOP_AND_GO])

    def decide(state: State, a: jax.Array) -> tuple[State, Any]:
        command = Command(control=Control(acceleration=a[None], steering=jnp.zeros(1)))
        record = lambda tick: (tick.state.lane, tick.state.s, tick.state.v)  # noqa: E731
        return drive(config, traffic, lane_map, state, command=command, record=record)

    run = jax.jit(lambda state, told: jax.lax.scan(decide, state, told)[1])
    seen = run(state, jnp.asarray(told[: round(seconds / config.decision_time)]))
    lane, s, v = (np.asarray(x, np.float64).reshape(-1, n) for x in seen)
    return Ride(lane * PIECE + s, v)


def drive_theirs(net: Path, vehicles: Platoon, leader: NDArray[np.float64], *options: str) -> Ride:
    """The platoon in SUMO: IDM, and the leader's speed after every step told, `[T]`."""
    import libsumo  # pyright: ignore[reportMissingImports]

    edges = " ".join(f"e{i}" for i in range(PIECES))
    lines = [f'<routes><route id="road" edges="{edges}"/>']
    for i in range(len(vehicles.s)):
        p = {name: x[i] for name, x in vars(vehicles).items()}
        lines.append(
            f'<vType id="t{i}" carFollowModel="IDM" length="{p["length"]}" tau="{p["T"]}" minGap="{p["s0"]}" '
            f'accel="{p["a"]}" decel="{p["b"]}" emergencyDecel="{p["b_max"]}" delta="{p["delta"]}" '
            f'speedFactor="{p["speed_factor"]}" speedDev="0" sigma="0" maxSpeed="60" width="1.8"/>'
        )
    for i, s in enumerate(vehicles.s):
        lines.append(
            f'<vehicle id="{i}" type="t{i}" route="road" depart="0" departPos="{s}" departSpeed="0" '
            'insertionChecks="none"/>'
        )
    routes = net.with_name("platoon.rou.xml")
    routes.write_text("\n".join([*lines, "</routes>"]))
    command = ["sumo", "-n", str(net), "-r", str(routes), "--step-length", str(DT), *options]
    libsumo.start([*command, "--no-step-log", "--no-warnings", "--xml-validation", "never"])
    ids = [str(i) for i in range(len(vehicles.s))]
    x, v = [], []
    libsumo.simulationStep()  # they are put on the road
    libsumo.vehicle.setSpeedMode("0", 0)
    for speed in leader:
        libsumo.vehicle.setSpeed("0", speed)
        libsumo.simulationStep()
        x.append([libsumo.vehicle.getDistance(i) for i in ids])
        v.append([libsumo.vehicle.getSpeed(i) for i in ids])
    libsumo.close()
    return Ride(np.array(x) + vehicles.s, np.array(v))


def one_lane(seconds: float, pool: ProcessPoolExecutor, vehicles: int = 20) -> dict[str, dict[str, float]]:
    """Largest differences between the two platoons, by the step that SUMO takes."""
    cars = platoon(vehicles)
    found = {}
    with tempfile.TemporaryDirectory() as temporary:
        net = Path(temporary) / "road.net.xml"
        net.write_text(road_xml())
        ours = drive_ours(net, cars, seconds)
        steps = {"ballistic, as ours": ("--step-method.ballistic", "true"), "Euler, SUMO's default": ()}
        for name, options in steps.items():
            theirs = pool.submit(drive_theirs, net, cars, ours.v[:, 0], *options).result()
            x, v = np.abs(ours.x - theirs.x), np.abs(ours.v - theirs.v)
            found[name] = {
                "position_rms": float(np.sqrt(np.mean(x * x))),
                "position_max": float(x.max()),
                "speed_max": float(v.max()),
                "driven": float(np.ptp(ours.x[:, 0])),
            }
    return found
