"""Sensors as observations of an environment."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import limsim_jax as lj
from limsim_jax.bridges.learning import seen_shape
from limsim_jax.policies.base import with_scenery
from limsim_jax.policies.sensed import ObserveScaled
from limsim_jax.policies.vector import SPEED
from limsim_jax.sensors.bev import CHANNELS, Raster
from limsim_jax.sensors.rig import Lidar, Rig

RASTER = Raster(ahead=40.0, behind=20.0, side=12.0, cell=1.0)
RIG = Rig(lidar=Lidar(z=0.6, elevations=(0.0,), columns=120, range=60.0))


def drive(**more: Any):
    """Two egos that a view of their own would not let see anything."""
    ego: Any = [
        {"start": "1-", "s": s, "goal": "3+", "policy": "constant_speed", "view": {"misses": 1.0}}
        for s in (60.0, 40.0)
    ]
    return lj.Experiment(name="short", map="roundabout", horizon=3.0, slots=8, vehicles=4, ego=ego, **more)


@pytest.mark.engine
def test_sensors_see_the_world_and_not_the_view():
    env = lj.Env(drive(), observe=ObserveScaled(("bev", "lidar"), rig=RIG, raster=RASTER))
    seen, state = jax.jit(env.reset)(jax.random.key(0))
    assert set(seen) == {"bev", "lidar"}
    assert seen["bev"].shape == (2, 6, 60, 24) and seen["lidar"].shape == (2, 1, 120)
    assert all(x.dtype == jnp.float32 and float(jnp.abs(x).max()) <= 1 for x in seen.values())
    world = state.world
    bev, lidar = np.asarray(seen["bev"]), np.asarray(seen["lidar"])
    layer = {name: bev[:, k] for k, name in enumerate(CHANNELS)}
    # the second ego drives 20 m behind the first one: it sees its rear in the middle ahead, and its speed
    first, second = (int(x) for x in world.egos.slot)
    assert RIG.lidar is not None
    gap = 20.0 - float(world.shape.length[first])
    bumper = float(world.shape.length[second]) / 2
    assert lidar[1, 0, 0] * 60.0 == pytest.approx(gap + bumper - RIG.lidar.x, abs=0.6)
    column = layer["occupied"][1, :, 11:13].max(-1)
    rows = 40.0 - 0.5 - np.flatnonzero(column)
    assert 20.0 - 2.6 < rows[rows < 30].min() and rows[(rows > 10) & (rows < 30)].size >= 4
    cell = int(40.0 - 20.0)
    assert layer["vx"][1, cell, 12] * SPEED == pytest.approx(float(world.v[first]), abs=0.05)
    assert layer["route"][1, 5:38, 11:13].max(-1).mean() > 0.9  # the route goes on ahead
    assert layer["drivable"].mean() > 0.1
    gone = world.replace(active=world.active.at[first].set(False))
    left: Any = env.observe(env.config, env.lanes, gone)
    assert float(jnp.abs(left["bev"][0]).max()) == 0 and float(left["lidar"][0].max()) == 0
    assert float(left["lidar"][1, 0, 0]) > lidar[1, 0, 0]  # the one ahead has gone


def test_one_name_makes_one_array_as_libraries_of_learning_want_it():
    env = lj.Env(drive(), observe=ObserveScaled("bev", raster=RASTER))
    assert seen_shape(env) == (6, 60, 24)
    several = lj.Env(drive(), observe=ObserveScaled(("bev", "depth"), raster=RASTER))
    with pytest.raises(ValueError, match="observe: makes dict; expected one array"):
        seen_shape(several)
    shapes = jax.eval_shape(several.reset, jax.random.key(0))[0]
    assert shapes["depth"].shape == (2, 3, 36, 64)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gives": "smell"}, "gives: 'smell'; known are bev, cameras, depth, lidar"),
        ({"gives": ()}, "gives: nothing"),
        ({"gives": "lidar"}, "rig: no lidar"),
        ({"gives": ("depth",), "rig": RIG}, "rig: no camera"),
    ],
)
def test_what_cannot_be_given_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        ObserveScaled(**options)


def test_a_map_without_scenery_is_named():
    env = lj.Env(drive())
    assert env.lanes.scenery is None
    with pytest.raises(ValueError, match="lane_map: no scenery"):
        ObserveScaled()(env.config, env.lanes, None)  # pyright: ignore[reportArgumentType]
    assert with_scenery(ObserveScaled(), env.map, env.lanes).scenery is not None
