"""A reader of CARLA's recorder logs from its table of packets alone: it shares nothing with ours."""

from __future__ import annotations

import struct
from typing import Any


def parse(data: bytes) -> dict[str, Any]:
    """Header and frames: `add`, `delete`, `positions`, `lights`, ... by name, ids first."""
    place = 0

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal place
        values = struct.unpack_from("<" + layout, data, place)
        place += struct.calcsize("<" + layout)
        return values

    def text() -> str:
        nonlocal place
        (count,) = take("H")
        place += count
        return data[place - count : place].decode()

    fixed = {
        3: ("delete", "I", 4), 4: ("parents", "II", 8), 5: ("collisions", "III??", 14),
        6: ("positions", "I6f", 28), 7: ("lights", "I?fB", 10), 8: ("animations", "Ifff?i", 21),
        9: ("walkers", "If", 8), 10: ("lamps", "II", 8), 12: ("kinematics", "I6f", 28),
        13: ("boxes", "I6f", 28), 16: ("times", "I3f", 16),
    }  # fmt: skip
    version, magic = take("H")[0], text()
    date, town = take("q")[0], text()
    frames: list[dict[str, Any]] = []
    while place < len(data):
        kind, size = take("BI")
        begin = place
        if kind == 0:
            number, duration, elapsed = take("Qdd")
            frames.append({"number": number, "duration": duration, "elapsed": elapsed})
        elif kind == 2:
            frames[-1]["add"] = []
            for _ in range(take("H")[0]):
                ident, sort, *pose, uid = take("IB6fI")
                blueprint, attributes = text(), {}
                for _ in range(take("H")[0]):
                    take("B")
                    name = text()
                    attributes[name] = text()
                frames[-1]["add"].append((ident, sort, pose, uid, blueprint, attributes))
        elif kind in fixed:
            name, layout, bytes_each = fixed[kind]
            assert struct.calcsize("<" + layout) == bytes_each
            frames[-1][name] = [take(layout) for _ in range(take("H")[0])]
        elif kind != 1:
            place += size
        assert place - begin == size, f"packet {kind}: {place - begin} of {size} bytes"
    return {"version": version, "magic": magic, "date": date, "map": town, "frames": frames}
