"""`limsim-jax run` and `limsim-jax bench traffic`: what they print and write agrees with what happened."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from limsim_jax import bench, cli
from limsim_jax.maps import build_lane_map, bundled_map, read_network
from limsim_jax.simulation import table as trace_file
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.types import Status

SECONDS, SLOTS, START = 3.0, 24, 9


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """One short run on a small map, with everything that it can write; and the first lines of a bench."""
    folder = tmp_path_factory.mktemp("run")
    options = {"seconds": SECONDS, "slots": SLOTS, "vehicles": START, "rate": 1200, "seed": 3}
    files = {"json": "run.json", "trace": "trace.npz"}
    try:
        import matplotlib  # noqa: F401

        files |= {"video": "run.gif", "picture": "run.png"}
    except ModuleNotFoundError:
        pass
    arguments = [f"--{name}={value}" for name, value in options.items()]
    arguments += [f"--{name}={folder / file}" for name, file in files.items()]
    with pytest.MonkeyPatch.context() as patch:
        written = []
        patch.setattr(trace_file, "write_trace", lambda *given: (written.append(given), write(*given)))
        code = cli.main(["run", "roundabout", *arguments])
    with np.load(folder / "trace.npz") as file:
        trace = {name: file[name] for name in file.files}
    summary = json.loads((folder / "run.json").read_text())
    return SimpleNamespace(
        code=code, folder=folder, files=files, summary=summary, trace=trace, written=written[0]
    )


write = trace_file.write_trace


@pytest.mark.engine
def test_it_runs_and_writes(ran):
    assert ran.code == 0
    for file in ran.files.values():
        assert (ran.folder / file).stat().st_size > 0
    assert ran.summary["initial"] == START and ran.summary["seconds"] == SECONDS
    assert ran.summary["file_hash"] == read_network(bundled_map("roundabout")).file_hash
    assert ran.trace["time"].shape == (30,)
    np.testing.assert_allclose(ran.trace["time"], 0.1 * np.arange(1, 31), atol=1e-5)


@pytest.mark.engine
def test_summary_agrees_with_trace(ran):
    trace, summary = ran.trace, ran.summary
    active = trace["active"]
    seen = set(trace["vehicle"][active].tolist())
    assert sum(vehicle < 0 for vehicle in seen) == START
    assert len(seen) == summary["entered"]
    gone = seen - set(trace["vehicle"][-1, active[-1]].tolist())
    assert len(gone) == summary["left"]
    driven = trace["v"][active].sum() * 0.1
    assert summary["vehicle_km"] * 1e3 == pytest.approx(driven, rel=0.03)
    assert summary["collided"] == len(
        {*trace["vehicle"][active & ((trace["status"] & int(Status.COLLIDED)) != 0)].tolist()}
    )
    assert summary["deceleration"] <= max(0, -trace["a"][active].min()) + 1e-4


def test_positions_are_those_of_the_map_file(ran):
    """The centre of a body lies half a length behind its front bumper, on its lane as the file has it.

    In a bend of curvature kappa it lies kappa w^2 / 8 further in: both axles, w apart, are on the lane.
    """
    network, trace = read_network(bundled_map("roundabout")), ran.trace
    checked = 0
    for k, slot in np.argwhere(trace["active"]):
        s = float(trace["s"][k, slot] - trace["length"][k, slot] / 2)
        if s < 0 or abs(trace["d"][k, slot]) > 1e-3:
            continue
        lane = network.lanes[str(trace["lane_ids"][trace["lane"][k, slot]])]
        place = np.asarray(lane.pose(s)[0]).reshape(-1)[:2]
        here = trace["x"][k, slot], trace["y"][k, slot]
        np.testing.assert_allclose(here, place, atol=0.15)
        checked += 1
    assert checked > 100


def test_parquet_has_a_row_per_step_and_vehicle(ran):
    parquet = pytest.importorskip("pyarrow.parquet")
    path = ran.folder / "trace.parquet"
    write(path, *ran.written[1:])
    rows = parquet.read_table(path).to_pydict()
    active = ran.trace["active"]
    assert len(rows["time"]) == active.sum()
    np.testing.assert_allclose(rows["x"], ran.trace["x"][active])
    assert rows["lane"] == ran.trace["lane_ids"][ran.trace["lane"][active]].tolist()
    assert set(rows) >= {"time", "vehicle", "slot", "lane", "s", "d", "v", "a", "x", "y", "heading", "status"}


def test_missing_pyarrow_is_told(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert cli.main(["run", "roundabout", "--trace", str(tmp_path / "x.parquet")]) == 2
    assert "pip install pyarrow" in capsys.readouterr().err


@pytest.mark.parametrize("vehicles", [0, 7, 30])
def test_traffic_starts_with_the_vehicles_asked_for(vehicles):
    network = read_network(bundled_map("roundabout"))
    demand, origins = plain_demand(
        network, build_lane_map(network), rate=100.0, vehicles=vehicles, seconds=5.0
    )
    assert (demand.initial, origins) == (vehicles, 4)


@pytest.mark.engine
def test_a_policy_is_timed():
    found = bench.bench_policy("roundabout", "constant_speed", worlds=3, repeats=1)
    assert found["worlds"] in (3, 4) and found["planned"] == 1 and found["policy"] == "constant_speed"
    assert 0 < found["latency_s"] < 1 and 0 < found["amortised_s"] < 1
    lines = dict(bench.policy_lines(found))
    assert lines["policy"] == "constant_speed in roundabout, 1 planned vehicles per world"
    assert f"{1e3 * found['latency_s']:.2f} ms" in lines["one decision"]


def test_bench_lines_say_why_there_is_no_peer():
    result = {
        "map": "a.xodr", "worlds": 2, "vehicles": 8, "steps": 10, "dt": 0.1, "device": "cpu", "devices": 1,
        "cores": 1, "vehicle_updates_per_s": 1e6, "mean_vehicles": 4.0, "slot_updates_per_s": 2e6,
        "world_steps_per_s": 1e5, "run_s": 1.0, "repeats": 3, "compile_s": 9.0, "from_cache": False,
        "load_s": 1.5, "peak_memory": 10**9, "peer": {"name": "SUMO", "reason": "libsumo is not installed"},
    }  # fmt: skip
    lines = dict(bench.traffic_lines(result))
    assert lines["SUMO"] == "not run: libsumo is not installed"
    assert "9.0 s cold, 1.5 s from the cache" in lines["trace and compile"]
    assert lines["peak memory"] == "1000 MB"
    peer = {"name": "SUMO 1", "vehicle_updates_per_s": 1e5, "processes": 2, "mean_vehicles": 3.0}
    lines = dict(bench.traffic_lines(result | {"peer": peer, "ratio": 10.0, "load_s": None}))
    assert lines["ratio"] == "10.0" and "1e+05" in lines["SUMO 1"]


@pytest.mark.slow
def test_bench_traffic(tmp_path, capsys):
    out = tmp_path / "bench.json"
    options = ["--worlds=2", "--vehicles=16", "--seconds=2", "--repeats=1", f"--json={out}"]
    assert cli.main(["bench", "traffic", "roundabout", *options]) == 0
    result = json.loads(out.read_text())
    keys = {
        "vehicle_updates_per_s", "slot_updates_per_s", "worlds", "vehicles", "steps", "dt", "device", "cores",
        "compile_s", "run_s", "peak_memory", "peer", "ratio",
    }  # fmt: skip
    assert keys <= set(result)
    assert 0 < result["vehicle_updates_per_s"] < result["slot_updates_per_s"]
    assert result["steps"] == 20 and result["peak_memory"] > 1e7
    if "reason" not in result["peer"]:
        peer = result["peer"]["vehicle_updates_per_s"]
        assert result["ratio"] == pytest.approx(result["vehicle_updates_per_s"] / peer)
    assert "vehicle-updates/s" in capsys.readouterr().out
