"""The maps that a server knows, by scene id."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from pathlib import Path

from limsim_jax.api.map import Map
from limsim_jax.maps import bundled_map, bundled_maps, read_network
from limsim_jax.recordings import read_tracks

ENDINGS = (".xodr", ".net.xml", ".xml")
"""OpenDRIVE, SUMO, CommonRoad; also gzipped."""


class Scenes:
    """Maps by scene id: the name of the file without its endings. A map is read when it is asked for.

    Args:
      places: folders of map files, map files, CommonRoad recordings, and names of bundled maps.

    Raises:
      ValueError: a place without maps, or two maps of one name.
    """

    def __init__(self, places: Iterable[str | Path]) -> None:
        self._files: dict[str, Path] = {}
        self._maps: dict[str, Map] = {}
        self._locks: dict[str, threading.Lock] = {}
        for place in places:
            for file in _files(place):
                name = _scene_id(file) or file.name
                if name in self._files and self._files[name].resolve() != file.resolve():
                    raise ValueError(f"scene '{name}': both {self._files[name]} and {file}; one is expected")
                self._files[name] = file
                self._locks[name] = threading.Lock()
        if not self._files:
            raise ValueError("no maps; at least one folder or file of maps is expected")

    @property
    def ids(self) -> list[str]:
        """All scene ids, sorted."""
        return sorted(self._files)

    def map(self, scene_id: str) -> Map:
        """The map of a scene.

        Raises:
          KeyError: no such scene.
          MapError, RecordingError: the file cannot be used.
        """
        file = self._files[scene_id]
        with self._locks[scene_id]:
            if scene_id not in self._maps:
                name = file.name.lower().removesuffix(".gz")
                plain = name.endswith(".xml") and not name.endswith(".net.xml")
                network = read_tracks(file).network if plain else read_network(file)
                self._maps[scene_id] = Map(network)
                _ = self._maps[scene_id].lanes
            return self._maps[scene_id]


def _files(place: str | Path) -> list[Path]:
    path = Path(place)
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.is_file() and _scene_id(file))
        if not found:
            raise ValueError(f"{path}: no map in this folder; files {', '.join(ENDINGS)} are expected")
        return found
    if path.is_file():
        return [path]
    if str(place) in bundled_maps():
        return [bundled_map(str(place))]
    raise ValueError(
        f"{place}: no such folder, file or bundled map; bundled are {', '.join(sorted(bundled_maps()))}"
    )


def _scene_id(file: Path) -> str | None:
    name = file.name.removesuffix(".gz")
    ending = next((ending for ending in ENDINGS if name.lower().endswith(ending)), None)
    return None if ending is None else name[: -len(ending)]


__all__ = ["Scenes"]
