"""Drawings: what is on the axes agrees with the network, and files are what their suffix says."""

import builtins
import math
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure

from limsim_jax.maps import draw
from limsim_jax.maps.draw import TRAFFIC_ZORDER, draw_map, draw_network
from limsim_jax.maps.network import (
    Control,
    Crosswalk,
    Junction,
    Lane,
    LaneSpot,
    LaneType,
    MapError,
    Movement,
    Network,
    Road,
    Sign,
    SignKind,
    StopLine,
    TrafficLight,
    Turn,
)

REACH, BOX = 60.0, 12.0  # m, ends of the arms and half side of the junction


def _line(id_: str, start: tuple[float, float], end: tuple[float, float], **fields) -> Lane:
    """A straight lane; the road runs from the junction outwards, so arriving lanes run against it."""
    start_, end_ = np.array(start), np.array(end)
    length = float(np.hypot(*(end_ - start_)))
    s = np.array([0.0, 0.5 * length, length])
    xy = start_ + s[:, None] / length * (end_ - start_)
    road_s = length - s if fields.get("number", -1) > 0 else s
    heading = math.atan2(*(end_ - start_)[::-1])
    return Lane(
        **{
            "id": id_,
            "road": id_.split("_")[0],
            "number": -1,
            "s": s,
            "xyz": np.column_stack([xy, np.zeros(3)]),
            "heading": np.full(3, heading),
            "curvature": np.zeros(3),
            "width": np.full(3, 3.5),
            "road_s": road_s,
            "speed_limit": 13.9,
            **fields,
        }
    )


def _bend(id_: str, incoming: Lane, outgoing: Lane, **fields) -> Lane:
    """A connector along a circular arc, or a straight line, between two lane ends."""
    p, a = incoming.xyz[-1, :2], float(incoming.heading[-1])
    q, b = outgoing.xyz[0, :2], float(outgoing.heading[0])
    turn = (b - a + math.pi) % (2 * math.pi) - math.pi
    chord = float(np.hypot(*(q - p)))
    length = chord if abs(turn) < 1e-6 else chord * turn / (2 * math.sin(turn / 2))
    s = np.linspace(0.0, length, 9)
    heading = a + turn * s / length
    mid = a + 0.5 * turn * s / length
    share = np.ones(9) if abs(turn) < 1e-6 else np.sinc(turn * s / length / (2 * math.pi))
    xy = p + (s * share)[:, None] * np.column_stack([np.cos(mid), np.sin(mid)])
    return Lane(
        id=id_,
        road=id_,
        number=-1,
        s=s,
        xyz=np.column_stack([xy, np.zeros(9)]),
        heading=heading,
        curvature=np.full(9, turn / length),
        width=np.full(9, 3.5),
        road_s=s,
        speed_limit=8.0,
        junction="J",
        **fields,
    )


@pytest.fixture(scope="module")
def crossing() -> Network:
    """Four arms with two lanes in, one out and a sidewalk; lights, signs, stop lines and a crosswalk."""
    lanes: dict[str, Lane] = {}
    for k, arm in enumerate("ENWS"):
        along = np.array([math.cos(k * math.pi / 2), math.sin(k * math.pi / 2)])
        side = np.array([-along[1], along[0]])

        def place(r, d, along=along, side=side):
            return tuple(r * along + d * side)

        near, far = f"{arm}_in1", f"{arm}_in2"
        # One mark is asymmetric: from in2 to in1 only.
        lanes[near] = _line(
            near, place(REACH, 1.75), place(BOX, 1.75), number=1, right=far, opposite=f"{arm}_out"
        )
        lanes[far] = _line(
            far, place(REACH, 5.25), place(BOX, 5.25), number=2, left=near, may_change_left=arm in "EN"
        )
        if arm == "N":
            lanes[near] = replace(lanes[near], may_change_right=True)
        lanes[f"{arm}_out"] = _line(f"{arm}_out", place(BOX, -1.75), place(REACH, -1.75), opposite=near)
        lanes[f"{arm}_walk"] = _line(
            f"{arm}_walk",
            place(BOX, -4.5),
            place(REACH, -4.5),
            number=-2,
            type=LaneType.SIDEWALK,
            width=np.full(3, 2.0),
        )
    movements = []
    turns = (Turn.RIGHT, Turn.STRAIGHT, Turn.LEFT)
    for k, arm in enumerate("ENWS"):
        for step, turn in zip((1, 2, 3), turns, strict=True):
            # Arriving from arm k, the arm to the right is the one counter-clockwise from it.
            incoming = lanes[f"{arm}_in2" if turn is Turn.RIGHT else f"{arm}_in1"]
            outgoing = lanes["ENWS"[(k + step) % 4] + "_out"]
            via = f"{arm}_{turn.value}"
            lanes[via] = _bend(via, incoming, outgoing)
            movements.append(
                Movement(
                    index=len(movements),
                    junction="J",
                    incoming=incoming.id,
                    outgoing=outgoing.id,
                    via=(via,),
                    turn=turn,
                    control=Control.SIGNAL,
                )
            )
    connectors = tuple(id_ for id_, lane in lanes.items() if lane.junction)
    return Network(
        name="crossing",
        source="crossing.xodr",
        file_hash="",
        format="OpenDRIVE 1.7",
        lanes=lanes,
        roads={lane.road: Road(id=lane.road, length=lane.length) for lane in lanes.values()},
        movements=tuple(movements),
        junctions={"J": Junction(id="J", movements=tuple(range(12)), connectors=connectors)},
        traffic_lights=(
            TrafficLight(
                id="L",
                position=(14.0, 9.0, 5.0),
                heading=math.pi,
                spots=(LaneSpot(lane="E_in1", s=47.0), LaneSpot(lane="E_in2", s=47.0)),
            ),
        ),
        signs=(
            Sign(id="a", kind=SignKind.STOP, position=(-9.0, 20.0, 0.0), heading=-1.57),
            Sign(id="b", kind=SignKind.YIELD, position=(9.0, -20.0, 0.0), heading=1.57),
            Sign(id="c", kind=SignKind.SPEED, value=50 / 3.6, position=(40.0, 9.0, 0.0), heading=3.14),
            Sign(id="d", kind=SignKind.PRIORITY, position=(-40.0, -9.0, 0.0), heading=0.0),
        ),
        stop_lines=(StopLine(id="s", spot=LaneSpot(lane="W_in1", s=47.0)),),
        crosswalks=(
            Crosswalk(
                id="z",
                outline=np.array([[14.0, -6.0], [18.0, -6.0], [18.0, 7.0], [14.0, 7.0]]),
                spans=(("E_in1", 42.0, 46.0),),
            ),
        ),
    )
