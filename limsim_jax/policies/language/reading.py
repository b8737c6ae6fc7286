"""Back from the text of a description to its facts: proof that the text tells them all."""

from __future__ import annotations

import re

from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.host import FAR
from limsim_jax.policies.language.describe import MEANS
from limsim_jax.policies.language.scene import NONE, Facts, Neighbour
from limsim_jax.traffic.ego import Meta


def read_description(text: str) -> tuple[Facts, dict[Meta, str]]:
    """The facts and the offered actions that a description tells.

    Args:
      text: of `description`, in any style that lists the vehicles.

    Raises:
      ValueError: it is no description.
    """

    def numbers(pattern: str) -> list[float]:
        found = re.search(pattern, text)
        return [float(x) for x in found.groups()] if found else []

    def vehicle(name: str) -> Neighbour:
        gap, v = numbers(rf"(?m)^{name}: gap ([\d.]+) m, speed ([\d.]+)") or (NONE, 0.0)
        return Neighbour(gap, v)

    own = numbers(r"Ego: speed ([\d.]+) m/s, limit ([\d.]+)")
    if not own:
        raise ValueError("no description of a scene: it has no line 'Ego: speed ..., limit ...'")
    light, distance = int(SignalState.OFF), FAR
    if shown := re.search(r"Signal: ([a-z ]+), stop line in ([\d.]+) m", text):
        light, distance = int(SignalState[shown[1].replace(" ", "_").upper()]), float(shown[2])
    to_go, within = 0, 0.0
    if route := re.search(r"Route: (\d+) lanes? to the (left|right) within ([\d.]+)", text):
        to_go, within = int(route[1]) * (1 if route[2] == "left" else -1), float(route[3])
    offered = _offered(text)
    return Facts(
        own[0], own[1],
        vehicle("Ahead"), vehicle("Left ahead"), vehicle("Left behind"),
        vehicle("Right ahead"), vehicle("Right behind"),
        light, distance, to_go, within, Meta.LEFT in offered, Meta.RIGHT in offered,
    ), offered  # fmt: skip


def _offered(text: str) -> dict[Meta, str]:
    """The label of each action that is offered."""
    found: dict[Meta, str] = {}
    for action, means in MEANS.items():
        label = re.search(rf"(\S+) = {means}[;.]|(?m:^{means}: (\S+)$)", text)
        if label:
            found[action] = label[1] or label[2]
    return found
