"""A planner in another process: the same commands as in this one, and what happens when it breaks."""

import time
from typing import Any

import numpy as np
import pytest

import limsim_jax as lj
from limsim_jax.policies.host import Observation

pytest.importorskip("grpc")
from limsim_jax.bridges.traffic_service.driver import DriverServer, RemoteDriver, remote_driver

B, E, M, K = 3, 2, 5, 4


def seen() -> Observation:
    generator = np.random.default_rng(1)
    shapes = {name: (B, E) for name in Observation._fields} | {"time": (B,)}
    shapes |= {name: (B, E, M) for name in Observation._fields if name.startswith("way_")}
    shapes |= {name: (B, E, K) for name in Observation._fields if name.startswith(("other_", "there"))}
    made: dict[str, Any] = {name: generator.normal(size=s).astype(np.float32) for name, s in shapes.items()}
    made |= {"light": np.ones((B, E), int), "to_go": -np.ones((B, E), int), "there": made["other_x"] > 0}
    return Observation(**made)


def planner(asked):
    assert asked.there.dtype == bool and np.issubdtype(asked.light.dtype, np.integer)
    near = np.where(asked.there, asked.other_x, 9.0).min(-1)
    return {"acceleration": near + asked.to_go, "steering": asked.way_y[..., 2] * asked.time[:, None]}


def test_commands_are_those_of_the_planner_itself():
    with DriverServer(planner) as server:
        found = RemoteDriver(f"127.0.0.1:{server.port}")(seen())
    expected = planner(seen())
    assert set(found) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-6)


def test_planners_that_break_or_are_late_are_told_in_one_line():
    def breaks(asked):
        raise ValueError("no\nidea")

    with DriverServer(breaks) as server:
        with pytest.raises(RuntimeError, match=rf"^driver at 127.0.0.1:{server.port}: ValueError: no idea$"):
            RemoteDriver(f"127.0.0.1:{server.port}")(seen())
        with pytest.raises(ValueError, match=f"port {server.port} of 127.0.0.1 is in use"):
            DriverServer(breaks, port=server.port).start()
        port = server.port
    with pytest.raises(RuntimeError, match=f"^driver at 127.0.0.1:{port}: "):
        RemoteDriver(f"127.0.0.1:{port}", timeout=5.0)(seen())
    with (
        DriverServer(lambda asked: time.sleep(1.0) or {}) as server,
        pytest.raises(RuntimeError, match=r"no answer within 0.1 s$"),
    ):
        RemoteDriver(f"127.0.0.1:{server.port}", timeout=0.1)(seen())
    with pytest.raises(ValueError, match="timeout: 0 s; more than 0 is expected"):
        remote_driver("127.0.0.1:1", timeout=0)


@pytest.mark.slow
def test_a_planner_that_breaks_is_a_failed_episode():
    """It drives straight on for a second."""

    def straight(asked):
        if (asked.time > 1.0).any():
            raise ValueError("had enough")
        return {"acceleration": 0 * asked.v, "steering": 0 * asked.v}

    ego = lj.Ego(start="1-", s=20.0, goal="3+")
    drive = lj.Experiment(map="roundabout", horizon=3.0, slots=6, vehicles=2, ego=ego)
    with DriverServer(straight) as server:
        policy = lj.named("remote", remote_driver(f"127.0.0.1:{server.port}"))
        found = lj.sweep(drive, policies=[policy], seeds=2, chunk=2, progress=False)
    assert found.episodes["policy_failed"].to_pylist() == [1.0, 1.0]
    assert found.episodes["policy_failed_time"].to_pylist() == pytest.approx([1.5, 1.5], abs=0.51)
    reasons = [row["reason"] for row in found.moments.to_pylist() if row["kind"] == "policy_failed"]
    assert len(reasons) == 2
    assert all(f"driver at 127.0.0.1:{server.port}: ValueError: had enough" in text for text in reasons)
