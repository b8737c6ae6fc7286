"""Roads in the making: lanes, sections, ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from lxml import etree

from mapbuilder.curves import Curve, Pose, Profile

if TYPE_CHECKING:
    from mapbuilder.junctions import Junction

# mark on the outer border of a lane; "" chooses by the lane beyond it
Mark = str | tuple[tuple[float, str], ...]


class Lane(NamedTuple):
    """A lane of a section.

    At section borders and links it continues the lane of the same `key`.
    """

    key: str
    width: float | Profile
    kind: str = "driving"
    mark: Mark = ""
    speed: float | None = None  # where it differs from the road's

    def profile(self) -> Profile:
        """The width along the road."""
        return self.width if isinstance(self.width, Profile) else Profile((0, self.width))


class Section(NamedTuple):
    """A lane section from `s` on, lanes from the reference line outwards."""

    s: float
    right: Sequence[Lane]
    left: Sequence[Lane] = ()
    centre: str = "solid"


@dataclass(eq=False)
class Road:
    """A road; `ends` has its neighbours at both ends."""

    id: int
    name: str
    curve: Curve
    sections: list[Section]
    kind: str
    speed: float
    offset: Profile
    height: Profile
    junction: Junction | None = None
    ends: dict[str, Junction | Contact] = field(default_factory=dict)
    lane_ends: dict[tuple[str, int], int] = field(default_factory=dict)  # connecting roads
    objects: list[etree._Element] = field(default_factory=list)
    signals: list[etree._Element] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Split sections where a driving lane becomes too narrow."""
        split = []
        for i, section in enumerate(self.sections):
            end = self.sections[i + 1].s if i + 1 < len(self.sections) else self.curve.length
            cuts = {lane.profile().narrow_at() for lane in section.right if lane.kind == "driving"}
            split.append(section)
            split += [section._replace(s=s) for s in sorted(c for c in cuts if c) if section.s < s < end]
        self.sections = split

    @property
    def start(self) -> Contact:
        """The end of the road where s = 0."""
        return Contact(self, "start")

    @property
    def end(self) -> Contact:
        """The end of the road where s is its length."""
        return Contact(self, "end")


class Contact(NamedTuple):
    """The start or the end of a road."""

    road: Road
    at: str

    @property
    def s(self) -> float:
        """Where it is along the road."""
        return 0.0 if self.at == "start" else self.road.curve.length

    @property
    def section(self) -> Section:
        """The first or last lane section."""
        return self.road.sections[0 if self.at == "start" else -1]

    def leaving(self, keys: Sequence[str]) -> list[int]:
        """Lane numbers of the lanes whose traffic leaves the road here."""
        return self._numbers(keys, right=self.at == "end")

    def entering(self, keys: Sequence[str]) -> list[int]:
        """Lane numbers of the lanes whose traffic enters the road here."""
        return self._numbers(keys, right=self.at == "start")

    def keys(self, *, leaving: bool, kind: str = "driving") -> list[str]:
        """Lanes that leave or enter the road here, from the left."""
        right = leaving == (self.at == "end")
        lanes = self.section.right if right else self.section.left
        return [lane.key for lane in lanes if lane.kind == kind]

    def _numbers(self, keys: Sequence[str], *, right: bool) -> list[int]:
        lanes = [lane.key for lane in (self.section.right if right else self.section.left)]
        missing = [k for k in keys if k not in lanes]
        assert not missing, f"{self.road.name} has no lanes {missing} at its {self.at}"
        return [(-1 if right else 1) * (lanes.index(k) + 1) for k in keys]

    def lane(self, number: int) -> Lane:
        """The lane with this number."""
        side = self.section.right if number < 0 else self.section.left
        return side[abs(number) - 1]

    def width(self, number: int) -> float:
        """The width of a lane here."""
        return self.lane(number).profile()(self.s)

    def t(self, number: int, across: float = 0.0) -> float:
        """Lateral coordinate between the borders of a lane.

        `across` is 0 at the inner and 1 at the outer border.
        """
        inner = sum(self.width(int(math.copysign(i, number))) for i in range(1, abs(number)))
        t = inner + across * self.width(number)
        return self.road.offset(self.s) + math.copysign(t, number)

    def left_edge(self, number: int) -> Pose:
        """Pose on a lane's inner border, in its direction of travel."""
        pose = self.road.curve.pose(self.s).move(left=self.t(number))
        return pose if number < 0 else pose.move(turn=math.pi)


def mark_between(lane: Lane, beyond: Lane | None, between: str, outside: str = "solid") -> str:
    """The usual mark between two lanes."""
    kinds = (lane.kind, beyond.kind if beyond else "")
    if "sidewalk" in kinds:
        return "curb" if "driving" in kinds else "none"
    if kinds == ("driving", "driving"):
        return between
    return outside if "driving" in kinds else "none"


def text(value: float, digits: int = 6) -> str:
    """A number with `digits` decimals, without trailing zeros."""
    out = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if out in ("-0", "") else out
