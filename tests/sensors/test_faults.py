"""Faults: cameras, drift and delay, by their statistics."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sensed_worlds import pose_at

from limsim_jax.maps.scenery import Label
from limsim_jax.sensors.camera import FAR, Pictures
from limsim_jax.sensors.chance import delay_line, delayed, whole_steps
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.rig import front_cameras

RIG, DT, STEPS = front_cameras(4, 3), 0.1, 4000
KEY = jax.random.key(5)


def pictures(value):
    """Pictures whose every pixel tells the step."""
    shape, step = (3, 3, 4), jnp.asarray(value)
    return Pictures(
        jnp.full(shape, step % 200 + 1, jnp.uint8), jnp.full(shape, step, jnp.float32),
        jnp.full((*shape, 3), step % 200 + 1, jnp.uint8), jnp.full(shape, step, jnp.int32),
    )  # fmt: skip


def run(faults, steps=STEPS):
    def step(memory, k):
        given, pose, memory = faults.spoil(memory, pictures(k), pose_at(), DT, KEY, k)
        return memory, (given.depth[:, 0, 0], given.label[:, 0, 0], jnp.stack([pose.x, pose.y, pose.heading]))

    _, found = jax.jit(lambda: jax.lax.scan(step, faults.init(RIG, pictures(0)), jnp.arange(steps)))()
    return [np.asarray(x) for x in found]


def test_without_faults_nothing_changes():
    depth, _, pose = run(Faults(), 50)
    np.testing.assert_array_equal(depth, np.tile(np.arange(50.0)[:, None], (1, 3)))
    np.testing.assert_array_equal(pose, 0)


def test_cameras_can_be_dark_or_frozen_all_the_time():
    depth, label, _ = run(Faults(dropped=("front",), frozen=("front_right",)), 50)
    np.testing.assert_array_equal(depth[:, 0], np.arange(50.0))
    np.testing.assert_array_equal(depth[:, 1], FAR)
    np.testing.assert_array_equal(label[:, 1], Label.SKY)
    np.testing.assert_array_equal(depth[:, 2], 0)


def test_faults_begin_and_last_as_stated():
    """A share `r D / (1 + r D)` of the time for a rate r and a mean duration D."""
    faults = Faults(drop_rate=0.1, freeze_rate=0.3)
    depth, _, _ = run(faults)
    now = np.arange(STEPS, dtype=float)[:, None]
    dark, frozen = depth == FAR, (depth != FAR) & (depth != now)
    mean = (faults.shortest + faults.longest) / 2 * 0.4
    assert (dark | frozen).mean() == pytest.approx(mean / (1 + mean), abs=0.04)
    assert dark.sum() / (dark | frozen).sum() == pytest.approx(0.25, abs=0.06)
    # a frozen camera shows the picture before the fault, for its whole length
    for camera in range(3):
        steps = np.flatnonzero(frozen[:, camera])
        first = steps[np.diff(steps, prepend=-9) > 1]
        shows = depth[first, camera]
        assert ((shows == first - 1) | dark[first - 1, camera]).all()
        runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1)
        alone = [len(r) for r in runs if len(np.unique(depth[r, camera])) == 1 and r[-1] < STEPS - 1]
        assert min(alone) * DT >= faults.shortest - DT and np.quantile(alone, 0.9) * DT <= faults.longest + DT


def test_drift_is_a_random_walk():
    faults = Faults(position_drift=0.05, yaw_drift=math.radians(0.2))
    _, _, pose = run(faults)
    jumps = np.diff(pose, axis=0)
    for k, size in enumerate((0.05, 0.05, math.radians(0.2))):
        assert jumps[:, k].std() == pytest.approx(size * math.sqrt(DT), rel=0.05)
        halves = np.corrcoef(jumps[1:, k], jumps[:-1, k])[0, 1]
        assert abs(halves) < 0.06
    np.testing.assert_allclose(pose[-1], pose[0] + jumps.sum(0), atol=1e-4)


def test_commands_come_late():
    line = delay_line({"a": jnp.float32(-1)}, Faults(delay=0.3).delay_steps(DT))
    given = []
    for k in range(6):
        now, line = delayed(line, {"a": jnp.float32(k)})
        given.append(float(now["a"]))
    assert given == [-1, -1, -1, 0, 1, 2]
    now, _ = delayed(delay_line(jnp.float32(0), 0), jnp.float32(7))
    assert float(now) == 7


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Faults(drop_rate=-1.0), "drop_rate: -1.0"),
        (lambda: Faults(shortest=4.0), "shortest 4.0 s, longest 3.0 s"),
        (lambda: Faults(dropped=("roof",)).init(RIG, pictures(0)), "no camera 'roof'"),
        (lambda: whole_steps(0.25, 0.1, "faults: delay"), "delay: 0.25 s; expected a multiple of 0.1 s"),
    ],
)
def test_impossible_faults_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()
