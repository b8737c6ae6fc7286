"""Pictures: class, depth and colour of every pixel of the cameras of a rig."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt8, UInt32

from limsim_jax.maps.scenery import Label, Scenery, ground
from limsim_jax.sensors.cast import NOTHING, Hits, Rays, cast
from limsim_jax.sensors.rig import Camera, Rig
from limsim_jax.sensors.scene import Bodies, Lamp, Pose
from limsim_jax.xla import computed_once

FAR = 1000.0
"""Beyond this depth a camera sees sky, m: about the horizon of flat ground in haze. Chosen."""

MOST_BODIES = 128
"""Bodies that pictures can show: an integer of 32 bits holds all about a pixel."""

COLORS: dict[Label, tuple[int, int, int]] = {
    Label.SKY: (168, 199, 228),
    Label.TERRAIN: (117, 138, 91),
    Label.ROAD: (82, 85, 90),
    Label.SHOULDER: (103, 105, 108),
    Label.SIDEWALK: (168, 163, 153),
    Label.CYCLE_LANE: (150, 92, 82),
    Label.PARKING: (92, 97, 112),
    Label.MEDIAN: (131, 150, 102),
    Label.RAIL: (122, 112, 112),
    Label.MARK: (236, 236, 232),
    Label.CENTRE_LINE: (236, 186, 62),
    Label.STOP_LINE: (244, 244, 240),
    Label.CROSSWALK: (240, 240, 236),
    Label.CAR: (192, 192, 196),
    Label.VAN: (214, 214, 208),
    Label.TRUCK: (196, 148, 84),
    Label.BUS: (216, 168, 40),
    Label.MOTORCYCLE: (70, 70, 78),
    Label.EMERGENCY: (226, 222, 214),
    Label.PEDESTRIAN: (184, 96, 128),
    Label.BRAKE_LIGHT: (255, 36, 24),
    Label.TURN_SIGNAL: (255, 150, 0),
    Label.LIGHT_RED: (255, 32, 32),
    Label.LIGHT_YELLOW: (255, 196, 0),
    Label.LIGHT_GREEN: (24, 230, 96),
    Label.LIGHT_OFF: (34, 36, 34),
}
"""Red, green, blue of each label in daylight."""

TINTS = (
    (222, 222, 222), (58, 62, 70), (150, 156, 164), (36, 78, 140), (168, 36, 40), (96, 104, 84),
    (196, 186, 168), (88, 130, 166),
)  # fmt: skip
"""Colours of cars, by their slots."""

GLASS = (46, 54, 62)
"""Colour of windows and wheels."""

_SHADES = (1.0, 0.86, 0.72, 0.8)  # top, front and back, left, right: light comes from above and the left
_WINDOWS = 0.52, 0.88  # of the height
_WHEELS = 0.24, 0.62, 0.14  # of the height; middle and half width, of half the length
_LAMP = 0.3, 0.62, 0.3  # lower and upper edge, of the height up to `_LAMP_TOP`; width, of half the width
_LAMP_TOP = 2.0  # m, lamps of higher bodies are as high as those of a body of this height


class Pictures(NamedTuple):
    """What the `C` cameras of a rig see.

    `H` rows from the top, and `W` columns from the left.
    """

    label: UInt8[Array, "C H W"]  # `Label`
    depth: Float[Array, "C H W"]  # m along the axis of the camera; FAR: sky
    color: UInt8[Array, "C H W 3"]  # red, green, blue
    slot: Int[Array, "C H W"]  # of the vehicle; -1: none


def rays_of(cameras: tuple[Camera, ...]) -> Rays:
    """One ray through the middle of each pixel; its length is the depth.

    Raises:
      ValueError: no camera.
    """
    if not cameras:
        raise ValueError("rig: no camera")
    width, height = cameras[0].width, cameras[0].height
    columns = (width / 2 - np.arange(width) - 0.5)[None, :, None]
    rows = (height / 2 - np.arange(height) - 0.5)[:, None, None]
    ways = []
    for camera in cameras:
        ahead, left, up = camera.axes
        ways.append(ahead + columns / camera.focal * left + rows / camera.focal * up)
    way = np.stack(ways)  # [C H W 3]
    if all(camera.level for camera in cameras):
        flat, upright = way[:, :1], way[:, :, :1]
    else:
        flat = upright = way
    origin = np.array([(camera.x, camera.y, camera.z) for camera in cameras])
    fields = (*origin.T, flat[..., 0], flat[..., 1], upright[..., 2])
    return Rays(*(jnp.asarray(field, jnp.float32) for field in fields))


@jax.named_scope("cameras")
def take_pictures(rig: Rig, scenery: Scenery, pose: Pose, bodies: Bodies) -> Pictures:
    """The pictures of all cameras of a rig.

    Args:
      rig: of the vehicle; static.
      scenery: of the map.
      pose: of the vehicle.
      bodies: around it.

    Raises:
      ValueError: a rig without a camera, or more than `MOST_BODIES`.
    """
    rays = rays_of(rig.cameras)
    if bodies.x.shape[0] > MOST_BODIES:
        raise ValueError(f"cameras: {bodies.x.shape[0]} bodies; expected at most {MOST_BODIES}")
    hits = cast(rays, bodies)
    flat_label, flat_depth = _ground(rays, scenery, pose)
    struck = (hits.length < flat_depth) & (hits.length < FAR)
    depth = jnp.minimum(jnp.minimum(hits.length, flat_depth), FAR)
    flat_label = jnp.where(flat_depth < FAR, flat_label, int(Label.SKY))
    paint, label, slot = _surface(rays, hits, bodies)
    palette = computed_once(_palette(bodies))
    paint = jnp.where(struck, paint, 4 * (flat_label + bodies.x.shape[0] + 1))
    packed = computed_once(palette.at[paint].get(mode="promise_in_bounds"))
    color = lax.bitcast_convert_type(packed, jnp.uint8)
    label = jnp.where(struck, label, flat_label)
    return Pictures(label.astype(jnp.uint8), depth, color[..., :3], jnp.where(struck, slot, -1))


def _ground(rays: Rays, scenery: Scenery, pose: Pose) -> tuple[Int[Array, "C H W"], Float[Array, "C H W"]]:
    """Label and depth of the ground; NOTHING above the horizon."""
    down = rays.dz < 0
    z = rays.z[:, None, None]
    depth = jnp.where(down, -z / jnp.where(down, rays.dz, -1), NOTHING)
    near = jnp.minimum(depth, FAR)
    x, y = rays.x[:, None, None] + near * rays.dx, rays.y[:, None, None] + near * rays.dy
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    label = computed_once(ground(scenery, pose.x + (cos * x - sin * y), pose.y + (sin * x + cos * y)))
    return label.astype(jnp.int32), jnp.broadcast_to(depth, label.shape)


class _Surface(NamedTuple):
    paint: Int[Array, "C H W"]  # index into the palette
    label: Int[Array, "C H W"]
    slot: Int[Array, "C H W"]  # -1: a light


def _surface(rays: Rays, hits: Hits, bodies: Bodies) -> _Surface:
    """What the points that rays meet look like: sides in their shade, windows, lamps."""
    body = jnp.maximum(hits.body, 0)

    def of(column: Array) -> Array:
        return column.at[body].get(mode="promise_in_bounds")

    # the point in half sizes of the box: the coefficients of a linear map, from the frame of the vehicle
    cos, sin = jnp.cos(bodies.heading), jnp.sin(bodies.heading)
    long, wide, high = 2 / bodies.length, 2 / bodies.width, 1 / bodies.height
    place = cos * bodies.x + sin * bodies.y, cos * bodies.y - sin * bodies.x
    x = rays.x[:, None, None] + hits.length * rays.dx
    y = rays.y[:, None, None] + hits.length * rays.dy
    z = rays.z[:, None, None] + hits.length * rays.dz
    known = (bodies.slot + 1) * 256 + bodies.label * 8 + bodies.lamps
    columns = (
        cos * long, sin * long, place[0] * long, cos * wide, sin * wide, place[1] * wide, high,
        bodies.z * high, known,
    )  # fmt: skip
    columns = computed_once(columns)  # per body, not per pixel
    c_long, s_long, p_long, c_wide, s_wide, p_wide, high, bottom, known = map(of, columns)
    ahead = c_long * x + s_long * y - p_long
    left = c_wide * y - s_wide * x - p_wide
    up = high * z - bottom
    ends, sides, lid = jnp.abs(ahead), jnp.abs(left), jnp.abs(2 * up - 1)
    top = (lid >= ends) & (lid >= sides)
    end = ~top & (ends >= sides)
    shade = jnp.where(top, 0, jnp.where(end, 1, jnp.where(left > 0, 2, 3)))

    lamps, label, slot = known & 7, (known >> 3) & 31, (known >> 8) - 1
    light = slot < 0
    dark = light & ~(end & (ahead < 0))  # a light shines towards the traffic that comes to it
    window = ~light & ~top & (up > _WINDOWS[0]) & (up < _WINDOWS[1]) & (jnp.where(end, sides, ends) < 0.88)
    window |= ~light & ~top & ~end & (up < _WHEELS[0]) & (jnp.abs(ends - _WHEELS[1]) < _WHEELS[2])
    level = up * jnp.maximum(1, 1 / (_LAMP_TOP * high))
    corner = ~light & end & (level > _LAMP[0]) & (level < _LAMP[1]) & (sides > 1 - _LAMP[2])
    brake = corner & (ahead < 0) & ((lamps & int(Lamp.BRAKE)) != 0)
    mine = jnp.where(left > 0, int(Lamp.LEFT), int(Lamp.RIGHT))
    signal = corner & ((lamps & mine) != 0)

    label = jnp.where(dark, int(Label.LIGHT_OFF), label)
    label = jnp.where(signal, int(Label.TURN_SIGNAL), jnp.where(brake, int(Label.BRAKE_LIGHT), label))
    shines = signal | brake | light
    count = bodies.x.shape[0]
    paint = jnp.where(shines, count + 1 + label, jnp.where(window, count, body))
    paint = 4 * paint + jnp.where(shines, 0, shade)
    packed = computed_once(((slot + 1) * 32 + label) * 1024 + paint)  # one loop, not one for each of three
    return _Surface(packed & 1023, (packed >> 10) & 31, (packed >> 15) - 1)


def _palette(bodies: Bodies) -> UInt32[Array, " Q"]:
    """Packed colours in each shade: of the bodies, of glass, of the labels."""
    tints = jnp.asarray(TINTS, jnp.float32)
    plain = jnp.asarray([COLORS[name] for name in Label], jnp.float32)
    car = bodies.label == int(Label.CAR)
    paint = jnp.where(car[:, None], tints[bodies.slot % len(TINTS)], plain[bodies.label])
    paint = jnp.concatenate([paint, jnp.asarray([GLASS], jnp.float32), plain])
    shaded = (paint[:, None] * jnp.asarray(_SHADES, jnp.float32)[None, :, None]).astype(jnp.uint32)
    red, green, blue = (shaded[..., k].reshape(-1) for k in range(3))
    return red | green << 8 | blue << 16
