"""The front door of log replay: a scene, its replays, their tables and pictures."""

import functools

import numpy as np
import pyarrow.parquet as pq
import pytest
from paths import SHARED, needs_shared

from limsim_jax.log_replay import Scene, load_scene
from limsim_jax.policies.base import LikeTraffic
from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.recordings import Lanelet, RecordingError, Tracks, lanelet_network

pytestmark = pytest.mark.engine

TRAJECTORIES = SHARED / "trajectories"
DT, STEPS, SPEED = 0.1, 81, 15.0


@functools.cache
def scene() -> Scene:
    """Three cars 25 m apart on one lane, from left to right; the last one comes 1 s later."""
    x = np.linspace(0, 400, 41)
    lane = Lanelet("lane", np.stack([x, 0 * x + 1.75], -1), np.stack([x, 0 * x - 1.75], -1))
    t = np.arange(STEPS)[:, None] * DT
    place = 90 - 25 * np.arange(3) + SPEED * t
    place[:10, 2] = np.nan
    there = np.where(np.isfinite(place), 0.0, np.nan)
    return Scene(
        Tracks(
            name="road",
            source="road",
            dt=DT,
            vehicles=("11", "12", "13"),
            x=place,
            y=there,
            heading=there,
            v=there + SPEED,
            length=np.array([4.0, 4.5, 5.0]),
            width=np.full(3, 1.8),
            network=lanelet_network([lane], "road", "road"),
        )
    )


@functools.cache
def braked():
    return scene().replay(ego=0, braking=[0.0, 6.0], start=2.0)


def test_an_ego_on_its_log_changes_nothing():
    run = scene().replay(ego="11")
    assert run.takeovers.num_rows == 0 and run.metrics["contacts"].to_pylist() == [0]
    rows = run.trajectories().to_pandas()
    assert len(rows) == int(scene().tracks.valid.sum()) and set(rows["mode"]) == {"log"}
    last = rows[rows.vehicle == "13"].iloc[-1]
    np.testing.assert_allclose(last[["x", "v", "s", "d"]].astype(float), [160, SPEED, 162.5, 0], atol=0.02)
    assert last["lane"] == "lane" and last["length"] == 5.0
    assert "0 takeovers of other vehicles, 0 handed back" in repr(run)


def test_variants_of_braking_have_a_row_each():
    run = braked()
    assert len(run) == 2 and run.metrics["braking"].to_pylist() == [0.0, 6.0]
    assert run.metrics["vehicles"].to_pylist()[1] == 2 and run.metrics["ego"].to_pylist() == ["11", "11"]
    row = run.takeovers.to_pandas()
    assert set(row[row.variant == 1]["vehicle"]) == {"12", "13"} and (row["ego"] == "11").all()
    assert (row[row.variant == 1]["controlled"] > 1).all()
    rows = run.trajectories(1).to_pandas()
    assert set(rows[rows.vehicle == "12"]["mode"]) == {"log", "controlled"}
    ego = rows[rows.ego]
    assert (
        set(ego["vehicle"]) == {"11"}
        and ego["v"].iloc[-1] == 0
        and ego["a"].min() == pytest.approx(-6, abs=0.1)
    )
    assert "2 variants" in run._repr_html_()
    with pytest.raises(ValueError, match="no variant 2; 0 to 1 are expected"):
        run.trajectories(2)


def test_a_policy_takes_the_wheel(tmp_path):
    run = scene().replay(ego=1, policy=ConstantSpeed(speed=8.0), start=2.0)
    ego = run.trajectories().to_pandas().query("ego")
    assert ego["v"].iloc[-1] == pytest.approx(8.0, abs=0.1)
    assert run.takeovers["vehicle"].to_pylist() == ["13"]
    driven = np.asarray(run.trace().driven)[:, 0]
    assert (driven[:20] == -1).all() and (driven[20:] == 1).all()
    page = run.save(tmp_path / "replay.html").read_text()
    assert "road, ego 12" in page
    assert "<iframe srcdoc" in run.show()._repr_html_()
    table = pq.read_table(run.save(tmp_path / "replay.parquet"))
    assert table.num_rows == run.trajectories().num_rows
    with pytest.raises(ValueError, match=r"cannot write .*replay\.txt"):
        run.save(tmp_path / "replay.txt")


def test_several_egos_are_variants():
    run = scene().replay(ego=["11", "12", "13"], braking=5.0)
    assert run.metrics["ego"].to_pylist() == ["11", "12", "13"]
    np.testing.assert_allclose(run.start, [1.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ego": 3}, "road: no vehicle 3; numbers from 0 to 2 are expected"),
        ({"ego": "3"}, "road: no vehicle '3'; known are 11, 12, 13"),
        ({"ego": 2, "start": 0.5}, "vehicle 13: start at 0.5 s; its record goes from 1 to 8 s"),
        ({"ego": 0, "policy": ConstantSpeed(), "braking": 3.0}, "policy and braking: one of them"),
        ({"ego": [0, 1], "braking": [1.0, 2.0, 3.0]}, "2 egos and 3 values of braking"),
        ({"ego": 0, "braking": [1.0, np.nan]}, "braking: one finite number or one axis"),
        ({"ego": 0, "policy": LikeTraffic()}, "keeps to lanes"),
    ],
)
def test_what_makes_no_replay_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        scene().replay(**options)


@needs_shared
def test_every_kind_of_scene_loads():
    name = "USA_US101-4_1_T-1"
    loaded = load_scene(TRAJECTORIES / "commonroad" / f"{name}.xml.gz")
    assert repr(loaded) == f"Scene '{name}': 22 vehicles, 10 s in steps of 0.1 s, 12 lanes"
    assert load_scene(TRAJECTORIES / "scenes_vehicles.csv.gz", name).vehicles == loaded.vehicles
    platoon = TRAJECTORIES / "openacc_zalazone_no_ACC_handling_part22.csv.gz"
    assert load_scene(platoon, span=(60.0, 80.0)).duration == pytest.approx(19.9)
    with pytest.raises(RecordingError, match=r"span: a stretch of s .* is expected of an OpenACC"):
        load_scene(platoon)
