"""The end-to-end driver in the traffic: it is trained for a few steps, and drives."""

import numpy as np
import pytest

import limsim_jax
from limsim_jax.policies.end_to_end.network import Design, load_weights
from limsim_jax.training import collect, end_to_end
from limsim_jax.training.end_to_end import FIRST_SEED, _Training
from limsim_jax.types import Status
from limsim_jax.xla import run_once

pytestmark = pytest.mark.engine

TINY = """
map = "roundabout"
horizon = 20.0
slots = 8

[ego]
start = "1-"
s = 70.0
goal = "3+"

[traffic]
vehicles = 6
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training of a few steps, its report and its lines."""
    folder = tmp_path_factory.mktemp("end_to_end")
    (folder / "tiny.toml").write_text(TINY)
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collect, "compile_soon", run_once)
        patch.setattr(collect, "SEGMENT", 8)
        patch.setattr(end_to_end, "BATCH", 16)
        patch.setattr(end_to_end, "_LOOK_EVERY", 2)
        run = _Training(
            folder / "w.npz", (str(folder / "tiny.toml"),), 1, 2, 1e-3, Design(hidden=16), 0, lines.append
        )
        report = run.run()
        yield run, report, lines


def test_training_writes_weights_that_say_how_they_came_about(trained):
    run, report, lines = trained
    found = load_weights(str(run.out))
    about = found.about
    assert found.design == Design(hidden=16) and about == report.trained.about
    assert about["version"] == limsim_jax.__version__ and about["rounds"] == 1
    assert about["seeds"]["tiny"][0] == FIRST_SEED and about["samples"]["tiny"] > 20
    assert about["steps"] >= 2 and np.isfinite(about["held_out"])
    assert {one["phase"] for one in about["curve"]} == {"cloning", "round 1 of 1"}
    assert "compiling" in lines[0] and not report.stopped and "finished" in str(report)


def test_labels_are_those_of_a_driver_on_its_route(trained):
    samples = trained[0].store.samples()
    labels, ego = samples.labels, samples.inputs.ego
    for x in (*samples.inputs, *labels):
        assert np.isfinite(np.asarray(x, float)).all()
    assert samples.good.all()
    assert np.abs(labels.path[labels.known]).max() < 3.5  # no further than the lane beside
    assert labels.known[ego[:, 0] * 20 > 8].mean() > 0.9  # at speed the plan reaches far
    assert (labels.change >= -8).all() and (labels.change <= 3).all()
    pictures = samples.inputs.cameras
    assert len(np.unique(pictures.reshape(-1, 3), axis=0)) > 10
    assert samples.inputs.raster[:, 0].any()  # the LiDAR meets vehicles
    there = labels.density[..., 0] > 0
    assert there.any() and np.abs(labels.density[there][:, 1:3]).max() <= 0.5 + 1e-5


def test_the_student_drives_without_a_fault(trained):
    run = trained[0]
    (field,) = run.fields
    field._running = None
    before = field.segment(run.learner.best[1], 0.0, np.random.default_rng(0))
    assert field._running is not None
    state = field._running.carry.state
    assert len(before.good) > 0
    slot = np.asarray(state.egos.slot)[:, 0]
    status = np.asarray(state.status)[np.arange(len(slot)), slot]
    assert (status & int(Status.NOT_FINITE) == 0).all()
    for x in (state.egos.x, state.egos.y, state.egos.heading, state.v):
        assert np.isfinite(np.asarray(x)).all()
    # it is not the expert that drives: with another network it ends elsewhere
    field._running, field.next_seed = None, field.next_seed - field.worlds
    other = end_to_end.fresh_weights(Design(hidden=16), 5)
    field.segment(other, 0.0, np.random.default_rng(0))
    assert field._running is not None
    moved = np.hypot(
        np.asarray(field._running.carry.state.egos.x) - np.asarray(state.egos.x),
        np.asarray(field._running.carry.state.egos.y) - np.asarray(state.egos.y),
    )
    assert moved.max() > 0.01


def test_an_interrupt_keeps_the_best_weights(trained, monkeypatch, tmp_path):
    run = trained[0]
    monkeypatch.setattr(run, "out", tmp_path / "kept.npz")
    monkeypatch.setattr(run, "_compile", lambda: None)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "_phase", interrupted)
    report = run.run()
    assert report.stopped and "stopped" in str(report)
    kept = load_weights(str(tmp_path / "kept.npz")).weights["path"]["kernel"]
    np.testing.assert_allclose(kept, run.learner.best[1]["path"]["kernel"], rtol=1e-3, atol=1e-4)
