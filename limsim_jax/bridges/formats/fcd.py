"""SUMO's floating car data: `--fcd-output` files, as SUMO and its tools read them."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from limsim_jax.bridges.formats.motion import Motion


def fcd(motion: Motion) -> str:
    """A file of `<timestep>`s with a `<vehicle>` each, as SUMO's `fcd_file.xsd` says.

    x and y (m) are those of the middle of the front bumper, in coordinates of the map file, with the
    netOffset of a SUMO network in it; angle (degrees) runs clockwise from north; pos (m) is that of the
    front bumper along the lane, posLat (m) is left of its centre.

    Args:
      motion: of the world.
    """
    rows: list[list[str]] = [[] for _ in motion.time]
    for body in motion.bodies:
        front_x = body.x + body.length / 2 * np.cos(body.heading)
        front_y = body.y + body.length / 2 * np.sin(body.heading)
        angle = np.round(np.degrees(np.pi / 2 - body.heading), 4) % 360.0
        name, kind = quoteattr(body.name), quoteattr(body.vehicle_class)
        columns = (
            front_x, front_y, angle, np.maximum(body.speed, 0), np.maximum(body.s, 0),
            body.acceleration, body.d,
        )  # fmt: skip
        for k, (x, y, at, v, s, a, d) in enumerate(np.stack(columns, -1).tolist()):
            lane = body.lane[k]
            place = "" if lane is None else f' pos="{s:.3f}" lane={quoteattr(lane)} posLat="{d:.3f}"'
            rows[body.first + k].append(
                f'        <vehicle id={name} x="{x:.4f}" y="{y:.4f}" angle="{at:.4f}" type={kind} '
                f'speed="{v:.4f}"{place} slope="0.00" acceleration="{a:.4f}"/>\n'
            )
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n']
    for time, vehicles in zip(motion.time.tolist(), rows, strict=True):
        lines += [f'    <timestep time="{time:.3f}">\n', *vehicles, "    </timestep>\n"]
    return "".join([*lines, "</fcd-export>\n"])


__all__ = ["fcd"]
