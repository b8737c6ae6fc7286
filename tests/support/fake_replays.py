"""A trace with egos, plans and moments made by hand on the intersection, for tests of replays."""

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from traffic_worlds import bundled

from limsim_jax.maps.lane_map import lane_rows, pose
from limsim_jax.report.viewer import write_viewer
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

T, DT = 60, 0.1
SELF, LEAD, TURNS, AGAIN, HIT, NEVER = range(6)  # slots
N = NEVER + 1
LENGTH = np.array([4.0, 5.5, 4.4, 4.8, 12.0, 4.6])
WIDTH = np.array([1.7, 1.9, 1.8, 1.75, 2.5, 1.8])
SWAP = 31  # step at which another vehicle has the slot AGAIN, without a step between
TIME = np.float32(DT) * np.arange(1, T + 1, dtype=np.float32)
CLASSES = np.array([0, 1, 0, 4, 3, 5])
TAKEN, GIVEN = 10, 40  # steps from and until which TURNS is driven by the policy
EVERY, AHEAD = 5, 21  # steps per decision, moments of a plan


def driven(lane_map: Any, route: list[int], way: Any) -> tuple[Any, Any]:
    """Lane and s after a way (m) along a route that starts at s = 0 of its first lane."""
    ends = np.cumsum([float(lane_map.length[lane]) for lane in route])
    i = np.minimum(np.searchsorted(ends, way, side="right"), len(route) - 1)
    return np.array(route)[i], way - np.concatenate([[0.0], ends])[i]


def intersection_trace() -> Any:
    """The intersection: SELF drives straight on behind LEAD; TURNS leaves the same lane by another way."""
    network, lane_map = bundled("intersection")
    rows = lane_rows(network)
    ways: dict[str, list[list[int]]] = {}
    for movement in network.movements:
        route = [rows[lane] for lane in (movement.incoming, *movement.via, movement.outgoing)]
        ways.setdefault(movement.incoming, []).append(route)
    straight, turn = next(routes for routes in ways.values() if len(routes) > 1)[:2]
    other, far = (routes[0] for routes in list(ways.values())[-2:])
    end = float(lane_map.length[straight[0]])
    shape = (T, N)
    step = np.arange(T)
    v = np.zeros(shape, np.float32)
    v[:, SELF], v[:, LEAD], v[:, TURNS], v[:, AGAIN], v[:, HIT] = 11.0, 7.5 + 0.01 * step, 9.0, 13.0, 0.5
    lane, s = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    starts = {SELF: (straight, end - 34.0), LEAD: (straight, end - 6.0), TURNS: (turn, end - 17.0)}
    for slot, (route, at) in starts.items():
        way = at + DT * np.cumsum(v[:, slot])
        lane[:, slot], s[:, slot] = driven(lane_map, route, way)
    lane[:, HIT], s[:, HIT] = far[0], 60.0
    lane[:, AGAIN] = np.where(step < SWAP, other[0], far[0])
    s[:, AGAIN] = np.where(step < SWAP, 20.0 + 1.3 * step, 100.0 + 1.3 * (step - SWAP))
    centre = s - LENGTH / 2
    x, y, heading = pose(lane_map, lane, centre.astype(np.float32))
    size = [np.broadcast_to(size, shape) for size in (LENGTH, WIDTH)]
    a = np.zeros(shape, np.float32)
    a[:, SELF], a[:, HIT] = -0.75 - 0.01 * step, -3.0
    vehicle = np.where(np.arange(N) < AGAIN, -1, np.arange(N) + 40) + 0 * step[:, None]
    vehicle[SWAP:, AGAIN] = 77
    active = np.ones(shape, bool)
    active[:, NEVER] = False
    active[50:, LEAD] = False
    phase = np.zeros((T, lane_map.signals.duration.shape[0]), np.int32)
    phase[30:, 0] = 1
    status = np.where((np.arange(N) == HIT) & (step[:, None] >= 10), int(Status.COLLIDED), 0)
    fields: dict[str, Any] = dict(
        time=TIME, active=active, vehicle=vehicle.astype(np.int32), lane=lane, s=s, d=0.125 - 0 * s, v=v, a=a,
        box=np.stack([x, y, heading, *size], -1).astype(np.float32),
        status=status.astype(np.int32), phase=phase, **planned(x, y, heading, step),
        vehicle_class=np.broadcast_to(CLASSES, shape), to_go=np.where(step < 55, 312.5 - 1.1 * step, np.nan),
    )  # fmt: skip
    return network, lane_map, Trace(**fields)


def planned(x: Any, y: Any, heading: Any, step: Any) -> dict[str, Any]:
    """SELF is always driven by the policy, TURNS for a while; HIT, too, but there is no plan for it."""
    turns = np.where((step >= TAKEN) & (step < GIVEN), TURNS, -1)
    decided = step // EVERY * EVERY
    tau = DT * np.arange(AHEAD)
    plan = np.full((T, 3, AHEAD, 2), np.nan, np.float32)
    for row, (slot, v) in enumerate(((SELF, 12.0), (TURNS, 6.0))):
        along, left = v * tau, 4.0 * tau**2
        x0, y0, angle = (np.asarray(z)[decided, slot][:, None] for z in (x, y, heading))
        plan[:, row, :, 0] = x0 + along * np.cos(angle) - left * np.sin(angle)
        plan[:, row, :, 1] = y0 + along * np.sin(angle) + left * np.cos(angle)
    plan[turns < 0, 1] = np.nan
    return {
        "driven": np.stack([0 * step + SELF, turns, 0 * step + HIT], -1).astype(np.int32),
        "plan": plan,
        "plan_time": (DT * decided[:, None] + tau).astype(np.float32),
    }


MOMENTS = [
    {"kind": "contact", "time": 4.0, "value": 3.21, "other": HIT, "responsible": "other", "rank": 1,
     "module": None, "avoidable_by_ego": None},
    {"kind": "near_miss", "time": 1.5, "value": np.float64(0.92), "other": np.int32(LEAD),
     "responsible": "shared", "rank": 2, "module": "prediction"},
    {"kind": "hard_brake", "time": 2.5, "value": -4.5, "other": None, "responsible": None, "rank": 3},
]  # fmt: skip


def payload(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a page holds: its texts and its columns of numbers, unpacked without the code that packs."""
    found = re.search(r'<script type="application/octet-stream" id="data">([^<]*)</script>', path.read_text())
    assert found is not None
    block = zlib.decompress(base64.b64decode(found[1]))
    start = 4 + int.from_bytes(block[:4], "little")
    meta = json.loads(block[4:start])
    columns = {}
    for name, (offset, count, row, scale) in meta["columns"].items():
        planes = np.frombuffer(block, np.uint8, 4 * count, start + offset).reshape(4, count).astype(np.int64)
        bits = planes[0] + (planes[1] << 8) + (planes[2] << 16) + (planes[3] << 24)
        delta = np.where(bits % 2 == 1, -(bits + 1) // 2, bits // 2)
        columns[name] = np.cumsum(delta.reshape(-1, max(row, 1)), 1) / scale
    return meta, columns


def write_replay(world: Any, path: Path) -> Path:
    """A page of the trace, with its moments and an area of interest of all vehicles but one."""
    network, lane_map, trace = world
    interest = np.broadcast_to(np.arange(N) != AGAIN, (T, N))
    write_viewer(
        path, network, lane_map, trace, ego=SELF, moments=MOMENTS, interest=interest,
        title="a <b>bold</b> title",
    )  # fmt: skip
    return path
