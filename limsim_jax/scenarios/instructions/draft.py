"""What has been understood of an instruction so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from re import Match
from typing import Any

from limsim_jax.scenarios.instructions.intent import ActKind, InstructionError, Intent, intent_of

SLOWER, BRISK = -8.0, 8.0
"""m/s that a "slow" or a "fast" vehicle drives more than the ego."""

UNITS = {"m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "g": 9.81}
"""m/s, or m/s^2, of units; others are SI units."""

SCENE, EGO = -2, -1
"""In place of the number of an actor: the scene or the ego is spoken of."""


def span(found: Match[str], name: str) -> tuple[float, float]:
    """Two numbers of a phrase in SI units, in ascending order."""
    scale = UNITS.get(found[f"{name}u"], 1.0)
    low = float(found[name]) * scale
    high = low if found[f"{name}2"] is None else float(found[f"{name}2"]) * scale
    return (low, high) if low <= high else (high, low)


@dataclass
class Draft:
    """An intent in the making.

    Attributes:
      scene: fields of the intent.
      actors: fields of actors, with their acts.
      subject: number of the actor that is spoken of, `EGO` or `SCENE`.
      waiting: what adjectives say of the next vehicle.
      notes: what has no effect.
    """

    scene: dict[str, Any] = field(default_factory=dict)
    actors: list[dict[str, Any]] = field(default_factory=list)
    subject: int = SCENE
    waiting: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def actor(self) -> dict[str, Any]:
        """The actor that is spoken of, or the last one.

        Raises:
          InstructionError: there is none yet.
        """
        if not self.actors:
            raise InstructionError("names what happens before any vehicle; begin with the vehicle")
        return self.actors[self.subject if self.subject >= 0 else -1]

    @property
    def acts(self) -> list[dict[str, Any]]:
        """Acts of that actor."""
        return self.actor()["acts"]

    @property
    def last(self) -> str:
        """Kind of its last act."""
        return self.acts[-1]["kind"] if self.acts else "drive"

    def act(self) -> dict[str, Any]:
        """The last act of that actor."""
        return self.acts[-1] if self.acts else self.do("drive")

    def do(self, kind: ActKind, **more: Any) -> dict[str, Any]:
        """A further act of that actor; a second word for the same act adds to it."""
        if self.acts and self.last in (kind, "drive"):
            self.acts[-1] |= {"kind": kind} | more
        else:
            self.acts.append({"kind": kind} | more)
        return self.acts[-1]

    def meet(self, kind: str, *, new: bool) -> None:
        """A vehicle is named: an earlier one, unless words say that it is another one."""
        known = [k for k, actor in enumerate(self.actors) if kind == actor["kind"]]
        if known and not new and not self.waiting:
            self.subject = known[-1]
            return
        acts = [dict(x) for x in self.waiting.get("acts", ())]
        self.actors.append({"kind": kind} | self.waiting | {"acts": acts})
        self.waiting = {}
        self.subject = len(self.actors) - 1

    def intent(self) -> Intent:
        """The whole of it.

        Raises:
          InstructionError: values that make no sense, or nothing happens.
        """
        return intent_of(self.scene | {"actors": [_whole(x) for x in self.actors], "notes": self.notes})


def _whole(actor: dict[str, Any]) -> dict[str, Any]:
    """An actor with what follows from its acts."""
    kinds = {act["kind"] for act in actor["acts"]}
    said = {"speed", "faster"} & set(actor)
    if "slow" in kinds and not said:
        actor["faster"] = (SLOWER, SLOWER)
    if "overtake" in kinds:
        actor.setdefault("place", "behind")
        if not said:
            actor["faster"] = (BRISK, BRISK)
    if kinds & {"stand", "slow", "brake", "stop", "cut_out"} and "cut_in" not in kinds:
        actor.setdefault("place", "ahead")
    return actor
