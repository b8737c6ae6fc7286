"""Metrics of one's own: columns besides the built-in ones, and one line where they do not fit."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ego_records import DT, as_steps, record
from observed_worlds import CONFIG, N, crossing, records_of, seen, stacked

from limsim_jax.metrics.catalog import catalog
from limsim_jax.metrics.ego import NAMES, EgoMetrics
from limsim_jax.metrics.measure import Metric, Own, check_names
from limsim_jax.metrics.observer import EvaluateEgo
from limsim_jax.metrics.reductions import measured, on_host
from limsim_jax.simulation.rollout import measured_start


@dataclasses.dataclass(frozen=True)
class SlowTime(Metric):
    below: float = 2.0

    name, unit, better = "slow_time", "s below a speed", "lower"

    def init(self, slots):
        return 0.0

    def update(self, carry, step):
        return carry + jnp.where(step.v < self.below, step.dt, 0)

    def result(self, carry):
        return carry


class LeastGap(Metric):
    name, unit, better = "least_gap", "m, least gap to a leader", "higher"

    def init(self, slots):
        return {"gap": jnp.float32(jnp.inf), "steps": jnp.int32(0)}

    def update(self, carry, step):
        gap = jnp.where(step.has_leader, step.gap, jnp.inf)
        return {"gap": jnp.minimum(carry["gap"], gap), "steps": carry["steps"] + 1}

    def result(self, carry):
        return carry["gap"]


class Neighbours(Metric):
    name, unit = "neighbours", "1 if another vehicle was ever within 10 m"

    def init(self, slots):
        return jnp.zeros(slots, bool)

    def update(self, carry, step):
        x, y = step.box[:, 0] - step.ego_box[0], step.box[:, 1] - step.ego_box[1]
        return carry | (step.others & (x * x + y * y < 100))

    def result(self, carry):
        return carry.any()


class LaneOffset(Metric):
    """Reads the state of the world and the map."""

    name, unit = "lane_offset", "m, greatest offset from the centre of a lane"

    def init(self, slots):
        return jnp.float32(0)

    def update(self, carry, step):
        wide = step.lane_map.length[step.lane] > 0
        return jnp.where(wide, jnp.maximum(carry, jnp.abs(step.d)), carry)

    def result(self, carry):
        return measured(carry, carry >= 0)


OWN = (SlowTime(), LeastGap(), Neighbours())


@functools.cache
def program(own: tuple[Metric, ...]) -> Any:
    metrics = EgoMetrics(DT, own=own)

    def all_of(steps):
        carry = metrics.init(steps.active.shape[1], steps.zones.id.shape[1])
        carry, _ = jax.lax.scan(lambda c, s: (metrics.update(c, s), None), carry, steps)
        return metrics.result(carry)

    return jax.jit(all_of)


def drive(v: Any = 10.0, other=(500.0, 0.0, 0.0, 10.0), **changes) -> dict[str, Any]:
    """31 steps of an ego and another vehicle, far away unless told: one program for all."""
    return record(31, (0, 0, 0, v), [other], **changes)


def run(r, own: tuple[Metric, ...] = OWN) -> dict[str, Any]:
    return on_host(jax.device_get(program(own)(as_steps(r))))


@pytest.mark.engine
def test_own_metrics_are_further_columns():
    v = np.where(np.arange(31) < 11, 1.0, 5.0)
    leader = {"lead": np.full(31, 1, np.int32), "lead_gap": np.arange(31.0) + 3}
    r = drive(v, (6.0, 3.0, 0.0, 20.0), **leader)
    found = run(r)
    assert set(found) == {*NAMES, "slow_time", "least_gap", "neighbours"}
    assert found["slow_time"] == pytest.approx(10 * DT)  # the start is no step
    assert found["least_gap"] == pytest.approx(4.0)
    assert found["neighbours"] == 1.0
    for name, value in run(r, ()).items():
        assert found[name] == (value if value is None else pytest.approx(value, rel=1e-5, abs=1e-5)), name


@pytest.mark.engine
def test_a_value_that_is_not_finite_is_missing():
    found = run(drive())
    assert found["least_gap"] is None and found["neighbours"] == 0.0


def test_nothing_is_measured_before_the_ego_is_there_or_after_it_left():
    r = drive(1.0)
    r["active"][:6, 0] = False
    r["active"][21:, 0] = False
    assert run(r)["slow_time"] == pytest.approx(14 * DT)
    r["active"][6:, 0] = np.arange(25) < 4  # for three steps
    assert run(r)["slow_time"] == pytest.approx(3 * DT)
    for steps in (1, 0):  # there at the start of a step, or never
        r["active"][:, 0] = np.arange(31) < steps
        assert run(r)["slow_time"] is None


def test_the_description_of_an_own_metric_is_among_all():
    found = catalog(OWN)[-3:]
    assert [column.name for column in found] == ["slow_time", "least_gap", "neighbours"]
    assert [column.sign for column in found] == [-1, 1, 0]
    assert [column.kind for column in found] == ["mean", "mean", "proportion"]
    assert {column.section for column in found} == {"Own metrics"}
    assert list(EvaluateEgo(metrics=OWN).units)[-3:] == ["slow_time", "least_gap", "neighbours"]


@pytest.mark.engine
def test_the_state_of_the_world_is_there_in_a_rollout():
    """Records of random worlds, as a rollout hands them over."""
    ticks = [tick for tick, _ in seen()[:6]]
    assert records_of(ticks)[0].ego.state is None  # nothing is kept for the built-in metrics alone
    measure = EvaluateEgo(metrics=(LaneOffset(),))

    @jax.jit
    def all_of(lane_map, start, ticks):
        carry = measured_start(measure, CONFIG, lane_map, start)
        records = jax.vmap(lambda tick: measure.record(CONFIG, lane_map, tick))(ticks)
        carry = measure.update(CONFIG, lane_map, carry, records)
        return measure.result(CONFIG, lane_map, carry)

    slot = ticks[0].state.egos.slot[0]
    same = [
        tick._replace(
            state=dataclasses.replace(
                tick.state,
                active=np.ones(N, bool),
                goal=ticks[0].state.goal,
                egos=dataclasses.replace(tick.state.egos, slot=ticks[0].state.egos.slot),
            )
        )
        for tick in ticks
    ]
    same = [tick._replace(left=np.zeros(N, bool)) for tick in same]
    found = on_host(jax.device_get(all_of(crossing(), same[0].state, stacked(same[1:]))))
    driven = found["duration"]
    assert driven is not None and driven > 0
    offsets = [abs(float(tick.state.d[slot])) for tick in same[1:]]
    steps = round(driven / CONFIG.dt)  # it may have arrived
    assert found["lane_offset"] in [pytest.approx(max(offsets[:k])) for k in (steps, len(offsets))] + [0.0]


# --- what does not fit


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (LeastGap, r"is no limsim_jax.Metric; pass an instance, as LeastGap\(\)"),
        ("headway", "'headway' is no limsim_jax.Metric"),
    ],
)
def test_what_is_no_metric_is_refused(other: Any, message):
    with pytest.raises(ValueError, match=message):
        check_names((SlowTime(), other), ())


def with_attributes(**attributes) -> Metric:
    return type("Changed", (LeastGap,), attributes)()


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        ((with_attributes(name="min_ttc"),), "metric 'min_ttc': another column has this name"),
        ((with_attributes(name="seed"),), "metric 'seed': another column has this name"),
        ((with_attributes(name="had_contact"),), "metric 'had_contact': another column has this name"),
        ((with_attributes(name="traffic_jam"),), "metric 'traffic_jam': another column has this name"),
        ((LeastGap(), LeastGap()), "metric 'least_gap': another column has this name"),
        ((with_attributes(name="least gap"),), "name is 'least gap'; an identifier is expected"),
        ((with_attributes(unit=""),), "metric 'least_gap': unit is ''; text is expected"),
        ((with_attributes(better="more"),), "better is 'more'; 'higher', 'lower' or 'neither' is expected"),
    ],
)
def test_names_and_descriptions_that_do_not_fit(metrics, message):
    with pytest.raises(ValueError, match=message) as error:
        EvaluateEgo(metrics=metrics)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"result": lambda self, carry: jnp.zeros(3)}, r"result is float32\[3\]; a scalar is expected"),
        ({"result": lambda self, carry: "far"}, "result is far; a scalar is expected"),
        (
            {"update": lambda self, carry, step: carry | {"gap": jnp.zeros(2)}},
            r"update returns \{gap: float32\[2\].*, but init \{gap: float32\[\]",
        ),
        (
            {"update": lambda self, carry, step: carry | {"steps": 1.0}},
            r"steps: float32\[\]\}, but init .*steps: int32\[\]",
        ),
        ({"update": lambda self, carry, step: carry["gap"]}, r"update returns float32\[\], but init \{"),
    ],
)
def test_memories_and_results_that_do_not_fit(attributes, message):
    measure = EvaluateEgo(metrics=(with_attributes(**attributes),))
    state = seen()[0][0].state
    with pytest.raises(ValueError, match=message) as error:
        jax.eval_shape(lambda state: measure.init(CONFIG, crossing(), state), state)
    assert "\n" not in str(error.value)


class Told(Metric):
    name, unit = "told", "what it is told"

    def __init__(self, found):
        self.found = found

    def result(self, carry):
        return self.found


@pytest.mark.parametrize(
    "found", [2, 2.0, np.float32(2), np.array(2.0), jnp.float32(2), measured(jnp.ones(()) * 2)]
)
def test_a_result_may_be_any_kind_of_number(found):
    own: Any = Own(Told(found))
    assert own._scalar(None) == ()
    drove = SimpleNamespace(duration=jnp.float32(1), driven=jnp.bool_(True))
    assert on_host(own.result(None, drove)) == {"told": 2.0}
    stood = SimpleNamespace(duration=jnp.float32(0), driven=jnp.bool_(False))
    assert on_host(own.result(None, stood)) == {"told": None}
    absent: Any = Own(Told(measured(jnp.float32(2), jnp.bool_(False))))
    assert on_host(absent.result(None, drove)) == {"told": None}


def test_a_step_without_a_map_says_how_to_get_one():
    with pytest.raises(ValueError, match="knows no map"):
        run(drive(), (LaneOffset(),))
