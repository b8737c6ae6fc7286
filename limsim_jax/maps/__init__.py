"""Maps: files to `Network` (host, exact) to `LaneMap` (device arrays)."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from limsim_jax.maps import cache as _cache
from limsim_jax.maps.network import ImportReport, MapError, Network

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import Goals, LaneMap

_PACKAGE = Path(__file__).resolve().parents[1]

# Networks that come straight from a file, with what identifies it: only these are cached.
_loaded: weakref.WeakKeyDictionary[Network, tuple[str, ...]] = weakref.WeakKeyDictionary()


def read_network(path: str | Path, *, cache: bool = True) -> Network:
    """Read a road network from an OpenDRIVE or SUMO file, also gzipped.

    The root element decides which of the two it is. With `cache` the result is kept on disk
    (`limsim_jax.maps.cache`), so that a second load of the same bytes is quick.

    Raises `MapError`, one line that names file, line, element and reason, for any file that cannot
    be used.
    """
    from limsim_jax.maps import xml

    path = Path(path)
    data = xml.read_bytes(path)
    file_hash = xml.file_hash(data)
    identity = (file_hash, path.name)  # a network without a name is named after its file
    name = _cache.key("network", *identity)
    network = _cache.load(name) if cache else None
    if isinstance(network, Network):
        network = dataclasses.replace(network, source=str(path))
    else:
        network = _read(path, xml.root_name(data, path))
        if network.file_hash != file_hash:  # the file changed between the two times that it was read
            return network
        if cache:
            _cache.store(name, network)
    _loaded[network] = identity
    return network


def build_lane_map(
    network: Network,
    goals: Goals | None = None,
    routes: Mapping[str, Sequence[str]] | None = None,
    *,
    report: ImportReport | None = None,
    least: Mapping[str, int] | None = None,
    cache: bool = True,
) -> LaneMap:
    """Turn a network into device arrays: see `limsim_jax.maps.rasterise.build_lane_map`.

    With `cache` the arrays of a network that comes straight from `read_network` are kept on disk.
    """
    import jax
    import numpy as np

    from limsim_jax.maps import rasterise

    notes = ImportReport()
    identity = _loaded.get(network) if cache else None
    name = _cache.key("lanes", *(identity or ()), _spell(goals), repr(routes or None), *_some(least))
    match _cache.load(name) if identity else None:
        case (rasterise.LaneMap() as arrays, ImportReport() as notes):
            built = jax.device_put(arrays)
        case _:
            built = rasterise.build_lane_map(network, goals, routes, report=notes, least=least)
            if identity:
                _cache.store(name, (jax.tree.map(np.asarray, built), notes))
    if report is not None:
        report.counts.update(notes.counts)
        report.notes.extend(notes.notes)
    return built


def _spell(goals: Goals | None) -> str:
    """Text that is equal for goals that make equal arrays."""
    from limsim_jax.maps.routing import Round

    groups = goals.values() if isinstance(goals, Mapping) else goals
    return repr(groups and [(isinstance(group, Round), *group) for group in groups])


def _some(least: Mapping[str, int] | None) -> list[str]:
    return [repr(sorted(least.items()))] if least else []


def bundled_maps() -> dict[str, Path]:
    """The maps that come with the package: name to path, sorted by name."""
    installed, checkout = _PACKAGE / "_bundled", _PACKAGE.parent / "maps"
    folder = installed if installed.is_dir() else checkout
    return {path.stem: path for path in sorted(folder.glob("*.xodr"))}


def bundled_map(name: str) -> Path:
    """The path of a bundled map. Raises `MapError` for an unknown name."""
    maps = bundled_maps()
    if name not in maps:
        raise MapError(f"no such file, and no bundled map either; bundled are {', '.join(maps)}", file=name)
    return maps[name]


def _read(path: Path, root: str) -> Network:
    from limsim_jax.maps.cut import without_gorges
    from limsim_jax.maps.widths import without_blind_changes

    return without_blind_changes(without_gorges(_read_file(path, root)))


def _read_file(path: Path, root: str) -> Network:
    if root == "OpenDRIVE":
        from limsim_jax.maps.opendrive import read_opendrive

        return read_opendrive(path)
    if root == "net":
        from limsim_jax.maps.sumo import read_sumo

        return read_sumo(path)
    raise MapError(
        f"the root element is <{root}>; maps have <OpenDRIVE> (OpenDRIVE) or <net> (SUMO)", file=path, line=1
    )
