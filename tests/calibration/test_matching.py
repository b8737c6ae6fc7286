"""What statistics are matched with: the flow that is measured of worlds, and worlds by factors on medians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.calibration.matching import Engine, TrafficFlow
from limsim_jax.maps.routing import default_goals
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.traffic import TrafficStep
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.traffic.demand import build_demand
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import default_population
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)


def column(steps, *, v=10.0, spacing=20.0, vehicles=12, lane=3):
    """Vehicles that pass a place one after another, the first at once."""
    t = CONFIG.dt * np.arange(1, steps + 1)
    s = 100.0 + v * t[:, None] - spacing * np.arange(vehicles)[None]
    same = np.ones_like(s)
    return {
        "t": t, "active": same > 0, "lane": np.full(s.shape, lane), "s": s, "dx": v * CONFIG.dt * same,
        "v": v * same, "v_free": 15 * same, "inside": same > 0, "changed": same < 0, "left": same < 0,
        "entered": 0 * same,
    }  # fmt: skip


def measured(flow, looks):
    _, lane_map = bundled("intersection")
    steps = TrafficStep(
        **{k: jnp.asarray(x, {"f": jnp.float32, "i": jnp.int32}.get(x.dtype.kind)) for k, x in looks.items()}
    )

    @jax.jit
    def run(steps):
        carry, _ = flow.init(CONFIG, lane_map, _State(steps.lane[0]))
        half = len(looks["t"]) // 2
        for part in (slice(None, half), slice(half, None)):  # two decisions
            carry = flow.update(CONFIG, lane_map, carry, jax.tree.map(lambda x, part=part: x[part], steps))
        return flow.result(CONFIG, lane_map, carry)

    return on_host(run(steps))


class _State:
    """Only the number of slots is asked for."""

    def __init__(self, lane):
        self.lane = lane


def test_saturation_flow_is_over_all_detectors_from_the_time_on_that_counts():
    looks = column(240)
    found = measured(TrafficFlow(detectors=((3, 101.0),)), looks)
    assert found["saturation_flow_per_hour"] == pytest.approx(1800, rel=1e-3)  # every 2 s
    assert found["mean_speed"] == pytest.approx(10)
    assert "saturation_flow_per_hour" not in measured(TrafficFlow(), looks)
    # no vehicle passes on another lane; vehicles that passed before do not count
    assert measured(TrafficFlow(detectors=((4, 101.0),)), looks)["saturation_flow_per_hour"] is None
    late = measured(TrafficFlow(detectors=((3, 101.0),), begin=20.0), looks)
    assert late["saturation_flow_per_hour"] is None
    assert late["vehicle_km"] == pytest.approx(12 * 4 * 10 / 1000, rel=0.03)
    # two lanes with headways of 2 s and 3 s: the mean headway of all counts
    other = column(240, spacing=30.0, lane=5)
    per_slot = {name: np.concatenate([looks[name], other[name]], 1) for name in looks if name != "t"}
    both = measured(TrafficFlow(detectors=((3, 101.0), (5, 101.0))), {"t": looks["t"]} | per_slot)
    numbers = [np.sum((c["s"][0] < 101) & (c["s"][-1] >= 101)) for c in (looks, other)]
    counted = [n - 4 for n in numbers]  # headways from the fourth vehicle of a queue on
    mean = (2 * counted[0] + 3 * counted[1]) / sum(counted)
    assert both["saturation_flow_per_hour"] == pytest.approx(3600 / mean, rel=0.02)


def test_only_moves_to_the_lane_beside_are_lane_changes():
    looks = column(60, vehicles=3)
    looks["lane"][20:, 0] = 4  # to the side
    looks["lane"][30:, 1] = 6  # onto the next lane: it has just begun there
    looks["s"][30:, 1] = 0.4 + 10 * CONFIG.dt * np.arange(30)
    found = measured(TrafficFlow(), looks)
    assert found["lane_changes_per_km"] * found["vehicle_km"] == pytest.approx(1)
    late = measured(TrafficFlow(begin=4.0), looks)
    assert late["lane_changes_per_km"] == 0


def test_worlds_by_factors():
    network, lane_map = bundled("ramp")
    goals = default_goals(network)
    demand = build_demand(
        network, lane_map, goals, [], default_population({"car": 1.0}), horizon=3.0, vehicles=8
    )
    run = Rollout(CONFIG, Traffic(), 3.0, measure=TrafficFlow())
    engine = Engine(run, lane_map, demand, 8, ("speed_factor", "T"))
    factors, seeds = np.array([[1.0, 1.0], [0.5, 1.0], [1.0, 3.0]]), (4, 5)
    found = engine.measure(factors, seeds)
    assert found["mean_speed"].shape == (3, 2)
    assert (found["mean_speed"][1] < 0.8 * found["mean_speed"][0]).all()
    assert (found["density_per_km"] > 0).all()
    swapped = engine.measure(factors[[1, 2, 0]], seeds[::-1])
    for name, values in found.items():
        np.testing.assert_array_equal(swapped[name], values[[1, 2, 0]][:, ::-1], err_msg=name)
    means = engine.means(seeds)(factors)
    np.testing.assert_allclose(means["mean_speed"], found["mean_speed"].mean(1), rtol=1e-6)
