"""What an instruction asks for: a small typed value, from a sentence or from a language model."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

ActKind = Literal[
    "cut_in", "cut_out", "change_lane", "brake", "stop", "accelerate", "slow", "stand", "tailgate",
    "overtake", "merge", "cross", "turn_across", "run_red", "drive",
]  # fmt: skip

ActorKind = Literal["car", "van", "truck", "bus", "motorcycle", "emergency", "obstacle"]

RoadKind = Literal["motorway", "rural", "town", "ramp", "crossing", "roundabout"]

Traffic = Literal["none", "light", "moderate", "dense"]

Side = Literal["left", "right"]

AT_JUNCTIONS: tuple[ActKind, ...] = ("cross", "turn_across", "run_red")
"""Acts that need a junction."""

STREETS = 17.0
"""m/s below which a road is a street of a town, unless the instruction says what it is."""

MOST_ACTORS = 4
"""Vehicles that an instruction can name."""


class InstructionError(ValueError):
    """An instruction that cannot be turned into a scenario; one line that says why."""


def _range(found: Any) -> Any:
    """A number is a range of one value."""
    if isinstance(found, int | float) and not isinstance(found, bool):
        return (float(found), float(found))
    return tuple(map(float, found)) if isinstance(found, list) else found


Range = Annotated[tuple[float, float], BeforeValidator(_range)]
"""Least and greatest value; a number means both."""


def middle(span: Range | None, otherwise: float) -> float:
    """The middle of a range; `otherwise` where there is none."""
    return otherwise if span is None else (span[0] + span[1]) / 2


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in type(self).model_fields:
            span = getattr(self, name)
            if (
                isinstance(span, tuple)
                and len(span) == 2
                and isinstance(span[0], float)
                and span[0] > span[1]
            ):
                raise ValueError(f"{name}: {span[0]:g} is more than {span[1]:g}")
        return self


class Act(_Part):
    """What a vehicle does. Acts of a vehicle begin one after the other."""

    kind: ActKind
    side: Side | None = None
    """Where it comes from (cut_in, cross, run_red) or goes to (cut_out, change_lane)."""
    gap: Range | None = None
    """m to the ego when it begins."""
    rate: Annotated[float, Field(gt=0, le=12)] | None = None
    """m/s^2, how hard it brakes or accelerates."""
    speed: Annotated[float, Field(ge=0, le=70)] | None = None
    """m/s that it reaches."""
    at: Annotated[float, Field(ge=0, le=600)] | None = None
    """s since the start."""


class Actor(_Part):
    """A vehicle other than the ego, or an obstacle."""

    kind: ActorKind = "car"
    place: Literal["ahead", "behind", "beside", "oncoming"] | None = None
    lane: Side | Literal["same"] | None = None
    """Its lane beside that of the ego at the start."""
    gap: Range | None = None
    """m to the ego at the start, bumper to bumper."""
    speed: Range | None = None
    """m/s"""
    faster: Range | None = None
    """m/s more than the ego; negative: slower."""
    count: Annotated[int, Field(ge=1, le=MOST_ACTORS)] = 1
    """So many, one behind the other."""
    careless: bool = False
    """Does not give way."""
    acts: tuple[Act, ...] = ()


class Intent(_Part):
    """A scenario as it is asked for."""

    road: RoadKind | None = None
    lanes: Annotated[int, Field(ge=1, le=8)] | None = None
    """Per direction."""
    lights: bool | None = None
    """Whether the junction has traffic lights."""
    limit: Annotated[float, Field(gt=0, le=70)] | None = None
    """m/s"""
    friction: Annotated[float, Field(gt=0, le=2)] | None = None
    """As in a `[[zone]]`; absent: dry."""
    traffic: Traffic | None = None
    speed: Range | None = None
    """m/s of the ego at the start."""
    turn: Literal["left", "right", "straight"] | None = None
    """Of the ego at the junction."""
    merges: bool = False
    """The ego comes from the ramp."""
    actors: Annotated[tuple[Actor, ...], Field(max_length=MOST_ACTORS)] = ()
    notes: tuple[str, ...] = ()
    """What was asked for and has no effect."""

    @model_validator(mode="after")
    def _has_an_event(self) -> Self:
        if not (self.events or self.merges or (self.actors and self.turn)):
            raise ValueError("nothing happens; name a vehicle and what it does")
        return self

    @property
    def events(self) -> list[tuple[int, Act]]:
        """Everything that has to happen: number of the actor, and what it does."""
        return [(k, act) for k, actor in enumerate(self.actors) for act in actor.acts if act.kind != "drive"]

    @property
    def kind_of_road(self) -> RoadKind:
        """The kind of road; unless it is said, the one that acts need."""
        if self.road is not None:
            return self.road
        acts = {act.kind for _, act in self.events}
        if acts & set(AT_JUNCTIONS) or self.turn is not None:
            return "crossing"
        if "merge" in acts or self.merges:
            return "ramp"
        v = middle(self.speed, 25.0 if self.limit is None else self.limit)
        return "town" if v < STREETS else "motorway"


def intent_of(found: Any) -> Intent:
    """An intent from parsed JSON.

    Raises:
      InstructionError: unknown fields, or values that make no sense; one line.
    """
    try:
        return Intent.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "intent"
        raise InstructionError(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None
