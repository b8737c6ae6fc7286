"""The map cache: hits, misses, damage, competition, and a place that cannot be written."""

import gzip
import logging
import multiprocessing
import os
import pickle
import time
from collections import Counter

import numpy as np
import pytest

from limsim_jax import maps
from limsim_jax.files import cache_directory
from limsim_jax.maps import build_lane_map, bundled_map, cache, read_network
from limsim_jax.maps.network import ImportReport, Lane, Network


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty cache for every test; its folder does not exist yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("LIMSIM_JAX_CACHE", str(folder))
    cache._warn_once.cache_clear()
    return folder


@pytest.fixture
def reads(monkeypatch):
    """A list that grows by the path of every map that is really read, not taken from the cache."""
    seen = []
    read = maps._read

    def counted(path, root):
        seen.append(path)
        return read(path, root)

    monkeypatch.setattr(maps, "_read", counted)
    return seen


@pytest.fixture
def file(tmp_path):
    file = tmp_path / "town.xodr"
    file.write_bytes(bundled_map("intersection").read_bytes())
    return file


def entries(folder):
    return sorted(path.name for path in folder.iterdir())


def assert_same(a: Network, b: Network):
    assert pickle_free(a) == pickle_free(b)


def pickle_free(value):
    """Nested plain values with arrays as bytes, so that `==` compares everything."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, ImportReport | Network | Lane) or hasattr(value, "__dataclass_fields__"):
        return (type(value), [pickle_free(getattr(value, name)) for name in value.__dataclass_fields__])
    if isinstance(value, dict):
        return [(key, pickle_free(item)) for key, item in value.items()]
    if isinstance(value, tuple | list):
        return (type(value), [pickle_free(item) for item in value])
    return value


def test_second_load_is_a_hit_and_equal(file, reads, folder):
    first, second = read_network(file), read_network(file)
    assert reads == [file]
    assert first is not second
    assert_same(first, second)
    assert len(entries(folder)) == 1


def test_changed_byte_is_a_miss(file, reads):
    read_network(file)
    file.write_bytes(file.read_bytes() + b"\n")
    read_network(file)
    assert reads == [file, file]


def test_changed_source_code_is_a_miss(file, reads, monkeypatch):
    read_network(file)
    monkeypatch.setattr(cache, "_fingerprint", lambda: b"another version")
    read_network(file)
    assert reads == [file, file]


def test_moved_file_names_its_new_place(file, reads, tmp_path):
    read_network(file)
    (tmp_path / "elsewhere").mkdir()
    moved = file.rename(tmp_path / "elsewhere" / file.name)
    assert read_network(moved).source == str(moved)
    assert reads == [file]


NET = """<net version="1.16">
<location netOffset="0,0" convBoundary="0,0,100,0" origBoundary="0,0,100,0" projParameter="!"/>
<edge id="e" from="a" to="b" priority="1">
  <lane id="e_0" index="0" speed="13.9" length="100" shape="0,0 100,0"/>
</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,3"/>
<junction id="b" type="dead_end" x="100" y="0" incLanes="e_0" intLanes="" shape="100,0 100,3"/>
</net>"""


@pytest.mark.parametrize("form", ["OpenDRIVE", "SUMO"])
def test_gzipped_map_is_the_same_map(form, file, tmp_path, reads, folder):
    content = file.read_bytes() if form == "OpenDRIVE" else NET.encode()
    file.write_bytes(content)
    packed = tmp_path / "packed" / file.name
    packed.parent.mkdir()
    packed.write_bytes(gzip.compress(content))
    plain, unpacked = read_network(file), read_network(packed)
    assert reads == [file]
    assert plain.file_hash == unpacked.file_hash
    assert list(plain.lanes) == list(unpacked.lanes)
    assert len(entries(folder)) == 1


def test_without_cache_leaves_no_trace(file, reads, folder):
    build_lane_map(read_network(file, cache=False), cache=False)
    read_network(file, cache=False)
    assert reads == [file, file]
    assert not folder.exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[:10],
        lambda data: data[:-1],
        lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
        lambda data: data + b"x",
        lambda data: b"elephant" + data[8:],
    ],
    ids=["empty", "header cut", "end cut", "bit flipped", "longer", "other file"],
)
def test_damaged_entry_is_named_and_built_anew(damage, file, reads, folder, caplog):
    first = read_network(file)
    (entry,) = folder.iterdir()
    good = entry.read_bytes()
    entry.write_bytes(damage(good))
    with caplog.at_level(logging.WARNING, "limsim_jax"):
        second = read_network(file)
    assert str(entry) in caplog.text and "damaged" in caplog.text
    assert reads == [file, file]
    assert_same(first, second)
    assert entry.read_bytes() == good


class Trap:
    """A pickle that runs code when it is loaded."""

    def __init__(self, target):
        self.target = str(target)

    def __reduce__(self):
        return os.mkdir, (self.target,)


def test_entry_cannot_run_code(tmp_path, folder, caplog):
    folder.mkdir()
    (folder / "network-x").write_bytes(cache._encode(Trap(tmp_path / "sprung")))
    with caplog.at_level(logging.WARNING, "limsim_jax"):
        assert cache.load("network-x") is None
    assert "mkdir" in caplog.text
    assert not (tmp_path / "sprung").exists()
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung")))
    assert (tmp_path / "sprung").exists()  # the trap works where nothing guards against it


def test_values_come_back_as_they_are():
    value = {
        "arrays": [np.arange(3.0), np.zeros((0, 2), np.int32), np.float64(1.5), np.array([True, False])],
        "sets": frozenset({"a"}),
        "counter": Counter(a=2),
    }
    cache.store("thing", value)
    back = cache.load("thing")
    assert back is not None
    for a, b in zip(value["arrays"], back["arrays"], strict=True):
        np.testing.assert_array_equal(a, b, strict=True)
    assert back["sets"] == value["sets"] and back["counter"] == value["counter"]


def _compete(path, barrier, results):
    barrier.wait()
    network = read_network(path)
    results.put(len(network.lanes))


@pytest.mark.engine
def test_competing_writers(file, folder):
    """Many processes load the same new map; one whole entry remains."""
    lanes = len(read_network(file, cache=False).lanes)
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(4), context.Queue()
    workers = [context.Process(target=_compete, args=(file, barrier, results)) for _ in range(4)]
    for worker in workers:
        worker.start()
    found = [results.get(timeout=60) for _ in workers]
    for worker in workers:
        worker.join()
    assert found == [lanes] * 4
    (name,) = entries(folder)
    assert isinstance(cache.load(name), Network)


@pytest.mark.parametrize("obstacle", ["a file", "below a file"])
def test_unwritable_folder_is_said_once(obstacle, file, tmp_path, monkeypatch, caplog):
    """Permissions would not stop root, so a file is in the way."""
    (tmp_path / "taken").write_text("not a folder")
    place = tmp_path / "taken" if obstacle == "a file" else tmp_path / "taken" / "cache"
    monkeypatch.setenv("LIMSIM_JAX_CACHE", str(place))
    with caplog.at_level(logging.WARNING, "limsim_jax"):
        first, second = read_network(file), read_network(file)
    assert_same(first, second)
    assert len(caplog.records) == 1 and "not kept" in caplog.text


def test_file_that_changes_while_it_is_read_is_not_kept(file, folder, monkeypatch):
    read = maps._read

    def changed(path, root):
        file.write_bytes(file.read_bytes() + b"\n")
        return read(path, root)

    monkeypatch.setattr(maps, "_read", changed)
    read_network(file)
    assert not folder.exists()


def test_old_entries_and_remains_are_pruned(folder, monkeypatch):
    def age(name, seconds):
        os.utime(folder / name, (time.time() - seconds,) * 2)

    for name in ("ancient", "old", "fresh"):
        cache.store(name, np.zeros(1000))
    (folder / "died.tmp").write_bytes(b"half")
    age("ancient", cache.MAX_AGE + 1)
    age("old", 3600)
    age("died.tmp", 7200)
    cache.store("new", np.zeros(1000))
    assert entries(folder) == ["fresh", "new", "old"]

    cache.load("old")  # used: now "fresh" is the least recent
    age("fresh", 1800)
    monkeypatch.setattr(cache, "MAX_BYTES", 3 * (folder / "old").stat().st_size)
    cache.store("newer", np.zeros(1000))
    assert entries(folder) == ["new", "newer", "old"]


def test_place_of_the_cache(monkeypatch, tmp_path):
    monkeypatch.delenv("LIMSIM_JAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_directory() == tmp_path / "xdg" / "limsim_jax"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says the XDG specification
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_directory() == tmp_path / "home" / ".cache" / "limsim_jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_directory() == tmp_path / "home" / ".cache" / "limsim_jax"


def test_lane_map_is_kept_per_goals(file, folder, monkeypatch):
    import jax

    from limsim_jax.maps import rasterise
    from limsim_jax.maps.routing import default_goals

    calls = []
    build = rasterise.build_lane_map

    def counted(network, goals=None, routes=None, *, report=None, least=None):
        calls.append(goals)
        assert report is not None
        report.approximated("lane", "somewhere", "by 1 mm")
        return build(network, goals, routes, report=report)

    monkeypatch.setattr(rasterise, "build_lane_map", counted)
    network = read_network(file)
    goals = default_goals(network)
    assert len(goals) >= 2
    first, second = ImportReport(), ImportReport()
    built = build_lane_map(network, report=first)
    kept = build_lane_map(read_network(file), report=second)
    assert calls == [None]
    assert first == second and "somewhere" in str(second.notes)
    assert jax.tree.structure(built) == jax.tree.structure(kept)
    for a, b in zip(jax.tree.leaves(built), jax.tree.leaves(kept), strict=True):
        assert isinstance(b, jax.Array) and a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    groups = [list(group) for group in goals.values()]
    for same in (goals, groups, goals):
        build_lane_map(network, same)
    build_lane_map(network, groups[::-1])
    assert calls == [None, goals, groups[::-1]]
    name, (lane, *_) = next(iter(goals.items()))
    build_lane_map(network, goals, {name: [network.lanes[lane].road]})
    assert len(calls) == 4, "a route makes another table"


def test_network_that_was_changed_is_not_taken_from_the_cache(file, folder):
    """It has the hash of the file, but other lanes."""
    import dataclasses

    network = read_network(file)
    build_lane_map(network)
    slow = dataclasses.replace(
        network,
        lanes={name: dataclasses.replace(lane, speed_limit=1.0) for name, lane in network.lanes.items()},
    )
    before = entries(folder)
    assert float(build_lane_map(slow).speed_limit[0]) == 1.0
    assert float(build_lane_map(network).speed_limit[0]) != 1.0
    assert entries(folder) == before
