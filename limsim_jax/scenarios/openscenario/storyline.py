"""The storyboard on the device: which elements run, and which actions begin and end.

Within a step completions come first, then conditions are looked at, then acts and events start. A condition
on an element sees the states of that moment, and all transitions since the look before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from limsim_jax.scenarios.openscenario.arrays import (
    Board,
    Change,
    Edge,
    Elements,
    Level,
    Memory,
    Phase,
    Priority,
)

_STANDBY, _RUNNING, _COMPLETE = int(Phase.STANDBY), int(Phase.RUNNING), int(Phase.COMPLETE)


class Started(NamedTuple):
    """What a step of the storyboard has decided."""

    memory: Memory
    begins: Bool[Array, " A"]  # actions that begin now
    stops: Bool[Array, " A"]  # actions that are stopped


def _children(elements: Elements, which: Bool[Array, " S"]) -> Bool[Array, " S"]:
    """Elements with a child among `which`."""
    number = jnp.arange(which.shape[0])
    return ((elements.parent[None] == number[:, None]) & which[None]).any(1)


def _of_parent(elements: Elements, values: Array, none: bool = False) -> Array:
    """The value of the parent of each element."""
    return jnp.where(elements.parent >= 0, values[jnp.maximum(elements.parent, 0)], none)


def complete(board: Board, memory: Memory) -> Memory:
    """The storyboard after actions have ended, and all that ends with them."""
    e, phase, change, runs = board.elements, memory.phase, memory.change, memory.runs
    rows = board.actions.element
    busy_rows = jnp.isfinite(memory.at) & ~memory.done
    busy = ((rows[None] == jnp.arange(phase.shape[0])[:, None]) & busy_rows[None]).any(1)
    ends = (e.level == int(Level.ACTION)) & (phase == _RUNNING) & ~busy
    phase, change = jnp.where(ends, _COMPLETE, phase), change | jnp.where(ends, int(Change.END), 0)
    for level in (Level.EVENT, Level.MANEUVER, Level.GROUP, Level.ACT, Level.STORY):
        open_ = _children(e, (phase != _COMPLETE) & (e.level >= 0))
        ends = (e.level == int(level)) & (phase == _RUNNING) & ~open_
        again = ends & (runs < e.most) & (level in (Level.EVENT, Level.GROUP))
        over = _STANDBY if level == Level.EVENT else _RUNNING
        phase = jnp.where(ends, jnp.where(again, over, _COMPLETE), phase)
        change = change | jnp.where(ends, int(Change.END), 0)
        if level == Level.GROUP:
            below = _of_parent(e, again) & (e.level == int(Level.MANEUVER))
            events = _of_parent(e, below) & (e.level == int(Level.EVENT))
            runs = jnp.where(again, runs + 1, jnp.where(events, 0, runs))
            phase = jnp.where(below, _RUNNING, jnp.where(events, _STANDBY, phase))
            change = change | jnp.where(again | below, int(Change.START), 0)
    return replace(memory, phase=phase, change=change, runs=runs)


class Looked(NamedTuple):
    """What conditions remember."""

    before: Array
    looked: Array
    past: Array
    result: Array


def edges(
    board: Board, memory: Memory, truth: Bool[Array, " Q"], open_: Bool[Array, " Q"], mine: Bool[Array, " Q"]
) -> Looked:
    """Conditions after edges and delays.

    Args:
      board: the scenario.
      memory: before this look.
      truth: of the tests now.
      open_: conditions that are looked at; the others forget.
      mine: conditions that this call is about.
    """
    q = board.conditions
    first = ~memory.looked
    rising, falling = truth & ~memory.before & ~first, ~truth & memory.before & ~first
    result = jnp.select(
        [q.edge == int(Edge.RISING), q.edge == int(Edge.FALLING), q.edge == int(Edge.BOTH)],
        [rising, falling, rising | falling],
        truth,
    )
    result &= open_
    past = memory.past
    if board.ring:
        slot = memory.step % board.ring
        past = past.at[:, slot].set(jnp.where(mine, result, past[:, slot]))
        back = jnp.take_along_axis(past, ((memory.step - q.delay) % board.ring)[:, None], 1)[:, 0]
        result = jnp.where(q.delay > 0, back & (memory.step >= q.delay), result)
    return Looked(
        jnp.where(mine, truth & open_, memory.before), jnp.where(mine, open_, memory.looked), past, result
    )


def triggers(board: Board, result: Bool[Array, " Q"]) -> Bool[Array, " R"]:
    """Which triggers are true: all conditions of any group are."""
    group = board.conditions.group
    number = jnp.arange(board.group_trigger.shape[0])
    broken = ((group[None] == number[:, None]) & ~result[None]).any(1)
    holds = ~broken & (board.group_trigger >= 0)
    trigger = jnp.arange(board.trigger_elements.shape[0])
    return ((board.group_trigger[None] == trigger[:, None]) & holds[None]).any(1)


def _fires(trigger: Int[Array, " S"], fired: Bool[Array, " R"], none: bool) -> Bool[Array, " S"]:
    return jnp.where(trigger >= 0, fired[jnp.maximum(trigger, 0)], none)


def advance(board: Board, memory: Memory, truth: Bool[Array, " Q"], each: Bool[Array, "Q K"]) -> Started:
    """Acts and events start and stop by their triggers.

    Args:
      board: the scenario.
      memory: after `complete`.
      truth: of the tests now.
      each: for which entities.
    """
    e, q = board.elements, board.conditions
    phase, runs = memory.phase, memory.runs
    change = jnp.zeros_like(memory.change)

    def begin(which: Array, phase: Array, change: Array) -> tuple[Array, Array]:
        return jnp.where(which, _RUNNING, phase), change | jnp.where(which, int(Change.START), 0)

    stories = (e.level == int(Level.STORY)) & (phase == _STANDBY)
    phase, change = begin(stories, phase, change)

    # acts, and what ends the scenario
    owner = jnp.maximum(q.owner, 0)
    of_act = (q.owner < 0) | (e.level[owner] == int(Level.ACT))
    open_ = of_act & ((q.owner < 0) | (phase[owner] != _COMPLETE)) & (q.group >= 0)
    seen = edges(board, memory, truth, open_, of_act)
    memory = replace(memory, before=seen.before, looked=seen.looked, past=seen.past)
    fired = triggers(board, seen.result & of_act)
    over = memory.over | (fired[jnp.maximum(board.stop, 0)] & (board.stop >= 0))
    acts = (e.level == int(Level.ACT)) & (phase == _STANDBY) & _of_parent(e, phase == _RUNNING)
    starts = acts & _fires(e.start, fired, True)
    phase, change = begin(starts, phase, change)
    for level in (Level.GROUP, Level.MANEUVER):
        below = (e.level == int(level)) & (phase == _STANDBY) & _of_parent(e, phase == _RUNNING)
        phase, change = begin(below, phase, change)
        runs = jnp.where(below, 1, runs)
    stopped = (e.level == int(Level.ACT)) & (phase == _RUNNING) & _fires(e.stop, fired, False)
    for level in (Level.GROUP, Level.MANEUVER, Level.EVENT, Level.ACTION):
        stopped |= (e.level == int(level)) & _of_parent(e, stopped) & (phase != _COMPLETE)
    change = change | jnp.where(stopped, int(Change.STOP), 0)
    phase = jnp.where(stopped, _COMPLETE, phase)

    # events
    of_event = (q.owner >= 0) & (e.level[owner] == int(Level.EVENT))
    waits = (e.level == int(Level.EVENT)) & (phase == _STANDBY) & _of_parent(e, phase == _RUNNING)
    open_ = of_event & waits[owner]
    seen = edges(board, memory, truth, open_, of_event)
    memory = replace(memory, before=seen.before, looked=seen.looked, past=seen.past)
    fired = triggers(board, seen.result & of_event)
    due = waits & _fires(e.start, fired, True) & (runs < e.most)
    siblings = (e.parent[:, None] == e.parent[None]) & ~jnp.eye(e.parent.shape[0], dtype=bool)
    siblings &= (e.level[:, None] == int(Level.EVENT)) & (e.level[None] == int(Level.EVENT))
    running = (e.level == int(Level.EVENT)) & (phase == _RUNNING)
    skips = due & (e.priority == int(Priority.SKIP)) & (siblings & running[None]).any(1)
    starts = due & ~skips
    runs = jnp.where(due, runs + 1, runs)
    ruling = starts & (e.priority == int(Priority.OVERRIDE))
    ousted = running & (siblings & ruling[None]).any(1)
    change = change | jnp.where(skips, int(Change.SKIP), 0) | jnp.where(ousted, int(Change.STOP), 0)
    again = (ousted | skips) & (runs < e.most)
    phase = jnp.where(ousted | skips, jnp.where(again, _STANDBY, _COMPLETE), phase)
    ousted_actions = (e.level == int(Level.ACTION)) & _of_parent(e, ousted) & (phase == _RUNNING)
    phase = jnp.where(ousted_actions, _COMPLETE, phase)
    change = change | jnp.where(ousted_actions, int(Change.STOP), 0)
    phase, change = begin(starts, phase, change)
    acting = (e.level == int(Level.ACTION)) & _of_parent(e, starts)
    phase, change = begin(acting, phase, change)

    # rows of actions
    row = jnp.maximum(board.actions.element, 0)
    real = board.actions.element >= 0
    event = e.parent[row]
    met = ((q.owner[None] == event[:, None])[:, :, None] & each[None] & q.who[None]).any(1)  # [A, K]
    entity = jnp.maximum(board.actions.entity, 0)
    mine = jnp.take_along_axis(met, entity[:, None], 1)[:, 0] | ~board.actions.only_triggering
    begins = acting[row] & real & mine
    stops = (stopped | ousted_actions)[row] & real & jnp.isfinite(memory.at)
    return Started(replace(memory, phase=phase, change=change, runs=runs, over=over), begins, stops)
