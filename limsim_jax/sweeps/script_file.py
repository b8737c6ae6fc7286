"""The tables of an experiment file about single vehicles and places.

They are `[[vehicle]]` with `[[vehicle.action]]`, `[[obstacle]]` and `[[zone]]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def one_or_more(found: Any) -> Any:
    """`[vehicle]` is one of what `[[vehicle]]` is a list of."""
    return [found] if isinstance(found, Mapping | BaseModel) else found


class Table(BaseModel):
    """A table of a file: unknown fields and values of other types are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class PlacedTable(Table):
    """A vehicle at a place."""

    start: str
    """An entry of the map, a road or lane id."""
    lane: Annotated[int, Field(ge=0)] = 0
    """Which of the lanes there, from the right."""
    s: NotNegative = 10.0
    """m along the lane, front bumper."""
    v: NotNegative | None = None
    """m/s; absent: as fast as road and leader allow."""
    goal: str | None = None
    """Where it goes: a way out of the map or a lane id."""
    route: list[str] = Field(default_factory=list)
    """Instead of a goal: all roads on its way outside junctions, from where it starts."""
    vehicle: str = "car"
    """Its class."""
    driver: dict[str, float] = Field(default_factory=dict)
    """Fields of `types.Driver` that differ from those of a typical driver."""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.goal is not None and self.route:
            raise ValueError("goal or route, not both; a route ends at the end of its last road")
        return self


_KINDS = "brake", "stop", "speed", "change_lane", "leave"


class ActionTable(Table):
    """An order to a vehicle: one of `brake`, `stop`, `speed`, `change_lane` and `leave`.

    It begins when all its conditions hold and the action before it has begun. An order about the speed ends
    where the next one of that kind begins.
    """

    at: NotNegative = 0.0
    """s since the start, at least."""
    within: Positive | None = None
    """m to the nearest ego, from middle to middle, at most."""
    travelled: NotNegative = 0.0
    """m since the start, at least."""
    after: NotNegative = 0.0
    """s since the action before has begun, at least."""
    brake: Positive | None = None
    """m/s^2, down to standstill."""
    stop: bool = False
    """Brakes as its driver would, and stands."""
    speed: NotNegative | None = None
    """m/s, to be reached and held."""
    change_lane: Literal["left", "right"] | None = None
    """Now, whatever others do."""
    leave: bool = False
    """Leaves the road at once."""
    rate: Positive | None = None
    """m/s^2, how fast `speed` is reached; absent: as its driver would. A vehicle that is careful does not
    accelerate faster than its driver would."""
    duration: Positive | None = None
    """s, how long the order holds; of a lane change, how long it takes. Absent: to the next order, or as
    its driver changes lanes."""
    careful: bool = True
    """Minds leaders, bends and right of way all the same."""

    @model_validator(mode="after")
    def _one_order(self) -> ActionTable:
        given = [name for name in _KINDS if getattr(self, name) not in (None, False)]
        if len(given) != 1:
            found = " and ".join(given) if given else "none of them"
            raise ValueError(f"an action is one of {', '.join(_KINDS)}; here is {found}")
        if self.rate is not None and self.speed is None:
            raise ValueError("rate belongs to speed")
        if self.duration is not None and self.leave:
            raise ValueError("a vehicle that leaves does so at once; duration has no meaning")
        return self


class VehicleTable(PlacedTable):
    """A vehicle at a place of its own, with its actions."""

    goal: str | None = None
    """A way out of the map or a lane id; absent: the only one that it can reach."""
    keeps_lane: bool = False
    """Whether it changes lanes by order only."""
    action: Annotated[list[ActionTable], BeforeValidator(one_or_more)] = Field(default_factory=list)


class ObstacleTable(Table):
    """A body that stands on a lane."""

    start: str
    """An entry of the map, a road or lane id."""
    lane: Annotated[int, Field(ge=0)] = 0
    """Which of the lanes there, from the right."""
    s: NotNegative = 10.0
    """m along the lane, its end in the direction of travel."""
    length: Positive = 4.0
    """m"""
    width: Positive = 2.0
    """m"""
    until: Positive | None = None
    """s, when it is taken away; absent: never."""


class ZoneTable(Table):
    """A place with closed lanes, another speed limit or less friction."""

    where: str | list[str] = "*"
    """Road or lane ids; "*": the whole map."""
    s_from: NotNegative = 0.0
    """m along the lane, or along the road where that is named."""
    s_to: Positive | None = None
    """m; absent: to the end."""
    begin: NotNegative = 0.0
    """s"""
    end: Positive | None = None
    """s; absent: until the end of the episode."""
    closed: bool = False
    """No traffic at all, as in a work zone; for the whole episode."""
    speed_limit: Positive | None = None
    """m/s"""
    friction: Annotated[float, Field(gt=0, le=2, allow_inf_nan=False)] | None = None
    """Between tyres and road: about 0.5 wet, 0.3 snow, 0.1 ice; absent: dry."""

    @model_validator(mode="after")
    def _has_an_effect(self) -> ZoneTable:
        if not self.closed and self.speed_limit is None and self.friction is None:
            raise ValueError("a zone needs closed, speed_limit or friction")
        if self.closed and (self.begin or self.end is not None):
            raise ValueError("a closed lane is closed for the whole episode; leave begin and end out")
        if self.closed and self.where == "*":
            raise ValueError("closed needs the lanes or roads, as where")
        if self.end is not None and self.end <= self.begin:
            raise ValueError(f"ends at {self.end:g} s, but begins at {self.begin:g} s")
        if self.s_to is not None and self.s_to <= self.s_from:
            raise ValueError(f"s_to is {self.s_to:g} m, but s_from is {self.s_from:g} m")
        if self.where == "*" and (self.s_from or self.s_to is not None):
            raise ValueError("s_from and s_to need the lanes or roads, as where")
        return self
