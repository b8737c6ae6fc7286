"""`export`: a recorded world as a file of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from limsim_jax.files import check_writable, write_whole

if TYPE_CHECKING:
    from limsim_jax.api.world import World

FORMATS: dict[str, str] = {
    "parquet": ".parquet",
    "fcd": ".fcd.xml",
    "commonroad": ".xml",
    "openscenario": ".xosc",
    "carla": ".log",
}
"""Formats and the suffixes of their files."""


def export(world: World, path: str | Path, to: str | None = None, *, every: float | None = None) -> Path:
    """Write a world in a format that other tools read: the whole file or nothing.

    Args:
      world: a replay, from `Results.replay` or `Replay.world`.
      path: of the file; what is there is replaced.
      to: parquet (a row per time and vehicle), fcd (SUMO), commonroad, openscenario or carla (a recorder
        log); None: by the suffix, .parquet, .fcd.xml, .xml, .xosc or .log.
      every: s between moments, a multiple of the time step; None: every step. Not for carla.

    Returns:
      The path.

    Raises:
      ValueError: an unknown format or suffix, no multiple of the step, or a world without vehicles.
      OSError: the file cannot be written.
    """
    path = Path(path)
    to = format_of(path, to)
    check_writable(path)
    if to == "carla":
        if every is not None:
            raise ValueError(f"every {every:g} s: a log of CARLA has every step; leave it out")
        from limsim_jax.bridges.carla.log import write_log

        return write_log(path, world)

    from limsim_jax.bridges.formats.motion import motion_of

    motion = motion_of(world, every)
    if to == "parquet":
        from limsim_jax.bridges.formats.table import parquet as encode
    elif to == "fcd":
        from limsim_jax.bridges.formats.fcd import fcd as encode
    elif to == "commonroad":
        from limsim_jax.bridges.formats.commonroad import commonroad as encode
    else:
        from limsim_jax.bridges.formats.openscenario import openscenario as encode
    write_whole(path, encode(motion))
    return path


def format_of(path: str | Path | None, to: str | None = None) -> str:
    """The format that is meant.

    Args:
      path: of the file, whose suffix tells where no name does.
      to: name; None: by the suffix.

    Raises:
      ValueError: it is unknown, or a suffix tells none.
    """
    if to is not None:
        if to not in FORMATS:
            raise ValueError(f"format '{to}': one of {', '.join(FORMATS)} is expected")
        return to
    for name, suffix in FORMATS.items():
        if path is not None and str(path).lower().endswith(suffix):
            return name
    raise ValueError(f"'{path}': {', '.join(FORMATS.values())}, or the name of a format, is expected")


__all__ = ["FORMATS", "export", "format_of"]
