"""Contacts of every type, fault, and whether braking would have helped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.metrics.blame import (
    ContactStep,
    ContactType,
    Responsibility,
    ahead,
    at_fault,
    avoidable_by_braking,
    behind,
    contact_init,
    contact_result,
    contact_type,
    contact_update,
)
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import contact_interval, encounter

REAR_AXLE = 1.4
LENGTH, WIDTH = 5.0, 2.0


def f(x):
    return jnp.asarray(x, jnp.float32)


def vehicle(x, y, heading, v):
    """Box and velocity of a car."""
    return (x, y, heading, LENGTH, WIDTH), (v * np.cos(heading), v * np.sin(heading))


def kind(ego, other):
    """Type of a contact of two (x, y, heading, v)."""
    e = encounter(*map(f, vehicle(*ego)), *map(f, vehicle(*other)))
    return ContactType(int(contact_type(e, f(ego[3]), f(other[3]), f(REAR_AXLE))))


T = ContactType


@pytest.mark.parametrize(
    ("ego", "other", "expected"),
    [
        ((0, 0, 0, 0.04), (-4.9, 0, 0, 8.0), T.STOPPED_EGO),
        ((0, 0, 0, 0.04), (4.9, 0, 0, 0.0), T.STOPPED_EGO),  # before the speed of the other
        ((0, 0, 0, 0.06), (4.9, 0, 0, 0.04), T.STOPPED_OTHER),
        ((0, 0, 0, 5.0), (0, 1.9, 0, 0.0), T.STOPPED_OTHER),  # wherever it is touched
        ((0, 0, 0, 5.0), (-4.9, 0, 0, 8.0), T.REAR),
        ((0, 0, 0, 5.0), (-4.9, 1.5, 0, 8.0), T.REAR),  # 1.5 m aside, 3.5 m behind the axle: 157 degrees
        ((0, 0, 0, 5.0), (-3.9, 1.5, 0, 8.0), T.LATERAL),  # 2.5 m behind the axle: 149 degrees
        ((0, 0, 0, 5.0), (4.9, 0, 0, 2.0), T.FRONT),
        ((0, 0, 0, 5.0), (3.4, -2.5, np.pi / 2, 6.0), T.FRONT),  # drives in front of the ego's bumper
        ((0, 0, 0, 5.0), (0.0, -3.0, np.pi / 2, 6.0), T.LATERAL),  # into the ego's side
        ((0, 0, 0, 5.0), (-1.0, 1.9, 0, 7.0), T.LATERAL),
        ((0, 0, 0, 5.0), (4.9, 0.5, np.pi, 5.0), T.FRONT),  # head-on
    ],
)
def test_types_of_contact(ego, other, expected):
    assert kind(ego, other) == expected
    # turned and moved as a whole, it is the same contact
    c, s = np.cos(2.1), np.sin(2.1)
    turned = [(40 + c * x - s * y, -7 + s * x + c * y, heading + 2.1, v) for x, y, heading, v in (ego, other)]
    assert kind(*turned) == expected


@pytest.mark.parametrize("several", [False, True])
def test_fault_by_type(several):
    blamed = [k for k in ContactType if bool(at_fault(jnp.asarray(int(k), jnp.int32), jnp.asarray(several)))]
    assert blamed == [T.STOPPED_OTHER, T.FRONT, *([T.LATERAL] if several else [])]


def test_ahead_and_behind_are_cones_at_the_rear_axle():
    for degrees, is_ahead, is_behind in (
        (0, 1, 0),
        (29, 1, 0),
        (31, 0, 0),
        (149, 0, 0),
        (151, 0, 1),
        (-180, 0, 1),
    ):
        angle = np.radians(degrees)
        other = (-REAR_AXLE + 10 * np.cos(angle), 10 * np.sin(angle), 0.3, 1.0)
        e = encounter(*map(f, vehicle(0, 0, 0, 5.0)), *map(f, vehicle(*other)))
        assert (bool(ahead(e, f(REAR_AXLE))), bool(behind(e, f(REAR_AXLE)))) == (is_ahead, is_behind)


def test_avoidable_by_braking_by_hand():
    def avoidable(v, b, other):
        e = encounter(*map(f, vehicle(0, 0, 0, v)), *map(f, vehicle(*other)))
        return bool(avoidable_by_braking(e, f(v), f(b)))

    # a wall 25 m ahead: 20 m/s needs 8 m/s^2
    assert avoidable(20, 8.01, (30, 0, 0, 0.0))
    assert not avoidable(20, 7.99, (30, 0, 0, 0.0))
    # a slower leader: 10 m/s of difference and 6.25 m need 8 m/s^2
    assert avoidable(20, 8.01, (11.25, 0, 0, 10.0))
    assert not avoidable(20, 7.99, (11.25, 0, 0, 10.0))
    assert not avoidable(20, 8.0, (60, 0, np.pi, 20.0))  # oncoming: it comes though the ego stands
    assert avoidable(20, 8.0, (60, 2.1, np.pi, 20.0))  # beside
    # crossing from the right at 10 m/s, in the way from 1.0 s on; its near side is 19 m from the front
    crossing = (22.5, -13.5, np.pi / 2, 10.0)
    assert avoidable(20, 11.0, crossing)  # stands after 18.2 m
    assert not avoidable(20, 4.0, crossing)  # 18 m after 1 s: hits it
    assert avoidable(20, 0.5, (60.0, -13.5, np.pi / 2, 10.0))  # has passed long before
    assert not avoidable(20, 8.0, (12.0, 0, np.pi, 40.0))  # through the ego within a second
    # a leader that crawls: 19.5 m/s of difference and 25 m need 7.605 m/s^2
    assert avoidable(20, 7.61, (30, 0, 0, 0.5)) and not avoidable(20, 7.60, (30, 0, 0, 0.5))
    assert avoidable(0, 0.5, (4.0, -10.0, np.pi / 2, 5.0))  # half a metre in front of an ego that stands
    assert not avoidable(0.8, 0.5, (3.8, -10.0, np.pi / 2, 5.0))  # 0.3 m before one that rolls 0.6 m


def test_avoidable_by_braking_is_what_a_simulation_finds():
    rng = np.random.default_rng(0)
    n = 400
    v, brake = rng.uniform(2, 25, n), rng.uniform(3, 9, n)
    other = np.stack([rng.uniform(-20, 60, n), rng.uniform(-25, 25, n)], -1)
    heading = rng.choice([0, np.pi / 2, -np.pi / 2, np.pi], n)
    velocity = np.stack([rng.uniform(-20, 20, n), -np.sign(other[:, 1]) * rng.uniform(0, 12, n)], -1)
    velocity[: n // 4, 1] = 0
    other[: n // 4, 1] *= 0.1
    boxes = np.concatenate([other, heading[:, None], np.tile([LENGTH, WIDTH], (n, 1))], -1)
    t = np.arange(0, 30, 2e-3)
    expected, clear = [], []
    for k in range(n):
        moving = np.minimum(t, v[k] / brake[k])
        ego = v[k] * moving - brake[k] * moving**2 / 2
        along, across = (LENGTH, WIDTH) if heading[k] in (0, np.pi) else (WIDTH, LENGTH)
        x = np.abs(other[k, 0] + velocity[k, 0] * t - ego) - (LENGTH + along) / 2
        y = np.abs(other[k, 1] + velocity[k, 1] * t) - (WIDTH + across) / 2
        gap = np.maximum(x, y).min()
        expected.append(gap > 0)
        clear.append(abs(gap) > 0.05)
    e = jax.vmap(encounter)(f([vehicle(0, 0, 0, 0)[0]] * n), f([(a, 0) for a in v]), f(boxes), f(velocity))
    found = np.asarray(avoidable_by_braking(e, f(v), f(brake)))
    clear = np.array(clear)
    assert clear.sum() > 0.9 * n and 40 < np.sum(~np.array(expected)) < n - 40
    np.testing.assert_array_equal(found[clear], np.array(expected)[clear])


# --- episodes ----------------------------------------------------------------------------------------

DT = 0.05


def episode(ego, others, steps, **flags):
    """Straight motion at constant speed from (x, y, heading, v); `flags[name](i)` per step and vehicle."""
    n = len(others) + 1
    start = np.array([ego, *others], float)

    def column(name, i):
        values = flags.get(name, lambda i: [False] * n)(i)
        return np.array(values, bool)

    boxes, velocities, rows = [], [], {name: [] for name in ("changing", "violation", "absent")}
    for i in range(steps):
        x, y, heading, v = start.T
        way = v * i * DT
        moved = np.stack([x + way * np.cos(heading), y + way * np.sin(heading), heading], -1)
        boxes.append(np.concatenate([moved, np.tile([LENGTH, WIDTH], (n, 1))], -1))
        velocities.append(np.stack([v * np.cos(heading), v * np.sin(heading)], -1))
        for name in rows:
            rows[name].append(column(name, i))
    speeds = jnp.broadcast_to(f(start[:, 3]), (steps, n))
    slots = jnp.arange(n)

    def step(carry, x):
        t, box, velocity, speed, changing, violation, absent = x
        e = encounter(box[0], velocity[0], box, velocity)
        begin, cease = contact_interval(e)
        record = ContactStep(
            t=t,
            e=e,
            begin=begin,
            cease=cease,
            there=(slots > 0) & ~absent,
            v=speed[0],
            v_others=speed,
            changing=changing[0],
            others_changing=changing,
            violation=violation[0],
            other_violations=violation,
            rear_axle=f(REAR_AXLE),
            b_max=f(8.0),
            others_b_max=jnp.full(n, 8.0),
        )
        carry = contact_update(carry, record)
        return carry, carry.fault_now

    xs = (f(np.arange(steps) * DT), f(np.array(boxes)), f(np.array(velocities)), speeds)
    xs += tuple(jnp.asarray(np.array(row)) for row in rows.values())
    carry, fault_now = jax.jit(lambda xs: jax.lax.scan(step, contact_init(n), xs))(xs)
    return on_host(contact_result(carry)), np.asarray(fault_now)


def who(found):
    return (
        None
        if found["contact_responsibility"] is None
        else Responsibility(int(found["contact_responsibility"]))
    )


R = Responsibility
FAR = (0.0, 400.0, 0.0, 0.0)


def always(*flags):
    return lambda i: list(flags)


@pytest.mark.parametrize(
    ("ego", "other", "flags", "expected_type", "expected"),
    [
        # the ego runs into a slower car that it has seen in time
        ((0, 0, 0, 15.0), (40, 0, 0, 5.0), {}, T.FRONT, R.EGO),
        ((0, 0, 0, 10.0), (30, 0, 0, 0.0), {}, T.STOPPED_OTHER, R.EGO),
        # it is run into
        ((0, 0, 0, 5.0), (-40, 0, 0, 15.0), {}, T.REAR, R.OTHER),
        ((0, 0, 0, 0.0), (-30, 0, 0, 10.0), {}, T.STOPPED_EGO, R.OTHER),
        # a vehicle that changes lanes comes too near to brake: 6 m at 15 m/s
        ((0, 0, 0, 25.0), (11, 0, 0, 10.0), {"changing": always(0, 1, 0)}, T.FRONT, R.OTHER),
        # the same without a change of lanes: it just appears
        ((0, 0, 0, 25.0), (11, 0, 0, 10.0), {}, T.FRONT, R.UNAVOIDABLE),
        # a change of lanes that leaves room is no excuse
        ((0, 0, 0, 15.0), (45, 0, 0, 5.0), {"changing": always(0, 1, 0)}, T.FRONT, R.EGO),
        # the ego changes lanes right in front of another vehicle
        ((0, 0, 0, 10.0), (-11, 0, 0, 25.0), {"changing": always(1, 0, 0)}, T.REAR, R.EGO),
        # and in good time
        ((0, 0, 0, 5.0), (-45, 0, 0, 15.0), {"changing": always(1, 0, 0)}, T.REAR, R.OTHER),
        # crossing on red, seen too late: 0.75 s
        ((0, 0, 0, 15.0), (15, -8.0, np.pi / 2, 10.0), {"violation": always(0, 1, 0)}, T.FRONT, R.OTHER),
        # and with time to brake: both
        ((0, 0, 0, 15.0), (40, -24.0, np.pi / 2, 10.0), {"violation": always(0, 1, 0)}, T.FRONT, R.SHARED),
        ((0, 0, 0, 15.0), (15, -8.0, np.pi / 2, 10.0), {"violation": always(1, 0, 0)}, T.FRONT, R.EGO),
        ((0, 0, 0, 15.0), (15, -8.0, np.pi / 2, 10.0), {}, T.FRONT, R.UNAVOIDABLE),
        # oncoming on the wrong side
        ((0, 0, 0, 15.0), (90, 0, np.pi, 15.0), {"violation": always(0, 1, 0)}, T.FRONT, R.OTHER),
        # both change into the same gap
        ((0, 0, 0.05, 15.0), (-2, 3.5, -0.05, 15.0), {"changing": always(1, 1, 0)}, T.LATERAL, R.SHARED),
        # only one of them: the other one's front corner meets its side
        ((0, 0, 0.08, 15.0), (-2, 3.5, 0.0, 15.0), {"changing": always(1, 0, 0)}, T.LATERAL, R.EGO),
        ((0, 0, 0.0, 15.0), (-2, 3.5, -0.08, 15.0), {"changing": always(0, 1, 0)}, T.LATERAL, R.OTHER),
        # a vehicle that has changed lanes when the hazard began is not excused by being done at the contact
        ((0, 0, 0, 25.0), (11, 0, 0, 10.0), {"changing": lambda i: [0, i < 3, 0]}, T.FRONT, R.OTHER),
        ((0, 0, 0, 10.0), (-11, 0, 0, 25.0), {"changing": lambda i: [i < 3, 0, 0]}, T.REAR, R.EGO),
        # nor one that begins to change after that
        ((0, 0, 0.08, 15.0), (-2, 3.5, 0.0, 15.0), {"changing": lambda i: [i > 3, 0, 0]}, T.LATERAL, R.EGO),
        # but what was long before the hazard does not matter
        ((0, 0, 0, 15.0), (85, -54, np.pi / 2, 10.0), {"changing": lambda i: [0, i < 5, 0]}, T.FRONT, R.EGO),
        # two that change lanes do not excuse each other
        ((0, 0, 0, 15.0), (40, -24.0, np.pi / 2, 10.0), {"changing": always(1, 1, 0)}, T.FRONT, R.SHARED),
    ],
)  # fmt: skip
def test_responsibility(ego, other, flags, expected_type, expected):
    found, _ = episode(ego, [other, FAR], 120, **flags)
    assert ContactType(int(found["contact_type"])) == expected_type
    assert who(found) == expected
    assert found["contact_other"] == 1.0
    assert found["contacts"] == 1.0  # however long it lasts


def test_the_numbers_of_a_contact():
    found, fault_now = episode((0, 0, 0, 15.0), [FAR, (40, 0, 0, 5.0)], 120)
    assert found["contact_time"] == pytest.approx(3.5)  # 35 m at 10 m/s
    assert found["contact_delta_v"] == found["max_delta_v"] == pytest.approx(5.0)  # not the other one's 7.5
    assert found["contact_other"] == 2.0
    assert found["contact_at_fault"] == found["at_fault_contacts"] == 1.0
    assert np.nonzero(fault_now)[0].tolist() == [70]


def test_no_contact():
    found, fault_now = episode((0, 0, 0, 15.0), [(40, 4.0, 0, 5.0), FAR], 120)
    assert found["contacts"] == found["at_fault_contacts"] == 0.0
    assert found["contact_time"] is found["max_delta_v"] is found["contact_responsibility"] is None
    assert not fault_now.any()


def test_the_first_contact_is_described_and_all_are_counted():
    # 2 m/s slower after 1 s, a standing car after 2 s, hit from behind after 3 s
    others = [(17.0, 0, 0, 8.0), (25.0, 0, 0, 0.0), (-35.0, 0, 0, 20.0)]
    others[0] = (7.0, 0, 0, 8.0)
    found, _ = episode((0, 0, 0, 10.0), [*others], 80)
    assert found["contacts"] == 3.0
    assert found["at_fault_contacts"] == 2.0
    assert found["contact_time"] == pytest.approx(1.0)
    assert found["contact_delta_v"] == pytest.approx(1.0)
    assert found["max_delta_v"] == pytest.approx(5.0)
    assert ContactType(int(found["contact_type"])) == T.FRONT


def test_of_contacts_in_one_step_the_worst_is_described():
    rear, front = (-15.0, 0, 0, 20.0), (7.0, 0, 0, 8.0)  # both at 1 s; the first is the harder one
    for others in ([rear, front], [front, rear]):
        found, _ = episode((0, 0, 0, 10.0), others, 40)
        assert found["contacts"] == 2.0
        assert found["contact_other"] == 1.0 + others.index(front)
        assert found["contact_delta_v"] == pytest.approx(1.0)
        assert found["max_delta_v"] == pytest.approx(5.0)


def test_of_contacts_at_fault_in_one_step_the_hardest_is_described():
    soft, hard = (7.0, 0, 0, 8.0), (11.0, 0, 0, 4.0)  # both at 1 s
    for others in ([soft, hard], [hard, soft]):
        found, _ = episode((0, 0, 0, 10.0), others, 40)
        assert found["contact_other"] == 1.0 + others.index(hard)
        assert found["contact_delta_v"] == found["max_delta_v"] == pytest.approx(3.0)


def test_a_touch_is_as_soft_as_it_is():
    found, _ = episode((0, 0, 0, 10.0), [(6.0, 0, 0, 9.0), FAR], 40)
    assert found["max_delta_v"] == found["contact_delta_v"] == pytest.approx(0.5)


def test_a_contact_may_be_over_in_a_moment():
    found, _ = episode((0, 0, 0, 1.0), [(1.0, -20.0, np.pi / 2, 30.0), FAR], 40)  # 7 m at 30 m/s
    assert found["contacts"] == 1.0 and ContactType(int(found["contact_type"])) == T.LATERAL


def test_what_numbers_in_results_mean():
    kinds = ["NONE", "STOPPED_EGO", "STOPPED_OTHER", "FRONT", "REAR", "LATERAL"]
    assert [(k.name, int(k)) for k in ContactType] == [(name, k) for k, name in enumerate(kinds)]
    blame = ["NONE", "EGO", "OTHER", "SHARED", "UNAVOIDABLE"]
    assert [(k.name, int(k)) for k in Responsibility] == [(name, k) for k, name in enumerate(blame)]


def test_slots_have_a_limit():
    assert contact_init(4096).notes.shape == (4096,)
    with pytest.raises(ValueError, match="4097 slots"):
        contact_init(4097)


@pytest.mark.engine
def test_a_slot_that_was_empty_holds_a_new_vehicle():
    standing = (20.0, 0, 0, 0.0)
    seen = {"absent": lambda i: [0, i in (45, 46), 0]}
    found, _ = episode((0, 0, 0, 10.0), [standing, FAR], 60)
    assert found["contacts"] == 1.0
    found, _ = episode((0, 0, 0, 10.0), [standing, FAR], 60, **seen)
    assert found["contacts"] == 2.0


def test_only_the_last_unbroken_time_as_a_hazard_counts():
    """A hazard that was avoidable, vanished, and came back too near."""
    leader = (40.0, 0, 0, 0.0)
    found, _ = episode((0, 0, 0, 15.0), [leader, FAR], 60)
    assert who(found) == R.EGO
    for first in (0, 20):  # appears after 2 s, 5 m ahead; the second time it has been seen before
        found, _ = episode(
            (0, 0, 0, 15.0), [leader, FAR], 60, absent=lambda i, first=first: [0, first <= i < 40, 0]
        )
        assert who(found) == R.UNAVOIDABLE
