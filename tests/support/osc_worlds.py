"""Scenarios on a straight road, played without traffic."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xosc
from jax import lax

from limsim_jax.maps.map import load_map
from limsim_jax.scenarios.openscenario.build import as_device, build
from limsim_jax.scenarios.openscenario.padding import Sizes
from limsim_jax.scenarios.openscenario.player import Bodies, step
from limsim_jax.scenarios.openscenario.roads import Roads
from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.scenarios.openscenario.storyboard import Scenario

WIDTH = 3.5


def road(length: float = 2000.0) -> str:
    """OpenDRIVE of a straight road east with two lanes of 3.5 m in each direction."""
    lanes = "".join(
        f'<lane id="{k}" type="driving" level="false">'
        f'<width sOffset="0" a="{WIDTH}" b="0" c="0" d="0"/></lane>'
        for k in (2, 1, -1, -2)
    )
    cut = lanes.index('<lane id="-1"')
    left, right = lanes[:cut], lanes[cut:]
    return f"""<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/>
<road name="" length="{length}" id="1" junction="-1">
<planView><geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry></planView>
<lanes><laneSection s="0"><left>{left}</left><center><lane id="0" type="none" level="false"/></center>
<right>{right}</right></laneSection></lanes></road></OpenDRIVE>"""


@functools.cache
def straight(folder: Path) -> Roads:
    path = folder / "road.xodr"
    path.write_text(road())
    return Roads(load_map(path, cache=False))


SIZES = Sizes(corridors=4, places=4, vertices=128, actions=8, profile=4)
"""Of all scenarios of these tests, so that one program serves them."""

PIECE = 40
"""Steps that the program takes."""


@functools.cache
def _program(dt: float) -> Any:
    def run(board: Any, memory: Any, bodies: Any) -> Any:
        def one(memory: Any, bodies: Any) -> tuple[Any, Any]:
            after = step(dt, board, memory, bodies)
            return after, after

        return lax.scan(one, memory, bodies)

    return jax.jit(run)


def run(board: Any, memory: Any, steps: int, dt: float, bodies: Any = None) -> Any:
    """`steps` steps, `[steps, ...]`; `bodies`: of each step, where the entities are that are not held."""
    program, found = _program(dt), []
    while len(found) * PIECE < steps:
        k = len(found) * PIECE
        if bodies is None:
            count = memory.v.shape[0]
            flat = np.zeros((PIECE, count), np.float32)
            some = Bodies(*as_device((np.zeros((PIECE, count, 3), np.float32), flat, flat, flat > 0)))
        else:
            some = jax.tree.map(lambda x: x[k : k + PIECE], bodies)  # noqa: B023
        memory, after = program(board, memory, some)
        found.append(jax.device_get(after))
    return jax.tree.map(lambda *x: np.concatenate(x)[:steps], *found)


class Played:
    """What entities did: arrays with a row per step, the start first."""

    def __init__(self, names: list[str], origin: Any, start: Any, after: Any, dt: float) -> None:
        self.names, self.dt = names, dt
        both = jax.tree.map(lambda a, b: np.concatenate([np.asarray(a)[None], np.asarray(b)]), start, after)
        self.memory = both
        self.time = np.arange(len(both.step)) * dt
        self.origin = np.asarray(origin, float)

    def __getitem__(self, name: str) -> dict[str, Any]:
        k = self.names.index(name)
        m = self.memory
        pose = np.asarray(m.pose[:, k], float)
        return {
            "x": pose[:, 0] + self.origin[0],
            "y": pose[:, 1] + self.origin[1],
            "h": pose[:, 2],
            **{f: np.asarray(getattr(m, f))[:, k] for f in ("s", "t", "v", "a", "there", "held", "across")},
        }

    def at(self, time: float) -> int:
        return round(time / self.dt)


def play(
    folder: Path,
    text: str,
    seconds: float = 12.0,
    dt: float = 0.05,
    *,
    roads: Roads | None = None,
    **options: Any,
) -> Played:
    """Play a scenario without traffic or policy."""
    roads = straight(folder) if roads is None else roads
    scenario = openscenario(xosc.write(folder, text)).scenario()
    return played(scenario, roads, seconds, dt, SIZES, **options)


def played(
    scenario: Scenario, roads: Roads, seconds: float, dt: float, sizes: Sizes, **options: Any
) -> Played:
    """Play a resolved scenario without traffic or policy; its arrays have these sizes."""
    built = build(scenario, roads, dt, script=True, sizes=sizes, **options)
    assert built.sizes == sizes
    board, memory = as_device((built.board, built.memory))
    steps = round(seconds / dt)
    after = run(board, memory, steps, dt)
    return Played([x.name for x in built.starts], roads.town.lanes.origin, built.memory, after, dt)
