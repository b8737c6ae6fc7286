"""A straight road with as many lanes as an instruction asks for."""

from __future__ import annotations

from pathlib import Path

from limsim_jax.files import write_whole
from limsim_jax.scenarios.instructions.intent import RoadKind

LENGTH = 2500.0
"""m"""

WIDTH: dict[str, float] = {"motorway": 3.75, "rural": 3.5, "town": 3.25}
"""m of a lane (RAA 2008 RQ 36, RAL 2012 RQ 11, RASt 2006)."""

LIMIT: dict[str, float] = {"motorway": 36.1, "rural": 27.8, "town": 13.9}
"""m/s: 130, 100 and 50 km/h."""


def write_straight(folder: Path, kind: RoadKind, lanes: int) -> Path:
    """Write `KIND_LANES.xodr`: a road with lanes one way on a motorway, and both ways elsewhere.

    Args:
      folder: where to.
      kind: "motorway", "rural" or "town".
      lanes: per direction.
    """
    width, limit = WIDTH[kind], LIMIT[kind]
    marks = (
        '<roadMark sOffset="0" type="{}" weight="standard" color="standard" width="0.12" laneChange="{}"/>'
    )

    def lane(number: int) -> str:
        inner = abs(number) < lanes
        mark = marks.format("broken", "both") if inner else marks.format("solid", "none")
        return (
            f'<lane id="{number}" type="driving" level="false">'
            f'<width sOffset="0" a="{width}" b="0" c="0" d="0"/>'
            f'{mark}<speed sOffset="0" max="{limit}" unit="m/s"/></lane>'
        )

    right = "".join(lane(-k) for k in range(1, lanes + 1))
    left = "".join(lane(k) for k in range(lanes, 0, -1))
    left = "" if kind == "motorway" else f"<left>{left}</left>"
    middle = (
        marks.format("solid", "none") if kind == "motorway" or lanes > 1 else marks.format("broken", "none")
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<OpenDRIVE><header revMajor="1" revMinor="6" name="{kind}_{lanes}" version="1.0"/>'
        f'<road name="" length="{LENGTH}" id="1" junction="-1"><type s="0" type="{kind}"/><planView>'
        f'<geometry s="0" x="0" y="0" hdg="0" length="{LENGTH}"><line/></geometry></planView>'
        f'<elevationProfile/><lateralProfile/><lanes><laneSection s="0">{left}'
        f'<center><lane id="0" type="none" level="false">{middle}</lane></center><right>{right}</right>'
        "</laneSection></lanes></road></OpenDRIVE>\n"
    )
    path = folder / f"{kind}_{lanes}.xodr"
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, text)
    return path
