"""Safety metrics against time stepping, simulations and values worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.metrics.safety import (
    NO_GAP,
    NONE,
    Rss,
    Zones,
    contact_interval,
    delta_v,
    distance,
    drac,
    encounter,
    first_touch,
    mirrored,
    overlaps,
    pet_init,
    pet_update,
    rss_lateral,
    rss_longitudinal,
    time_headway,
    ttc_1d,
    ttc_2d,
)


def f(x):
    return jnp.asarray(x, jnp.float32)


def corners(box):
    x, y, heading, length, width = box
    ahead = np.array([np.cos(heading), np.sin(heading)]) * length / 2
    left = np.array([-np.sin(heading), np.cos(heading)]) * width / 2
    center = np.array([x, y])
    return np.array(
        [center + ahead + left, center - ahead + left, center - ahead - left, center + ahead - left]
    )


def gap_along_axes(a, b, shift):
    """Largest gap of the corners' shadows on the four axes, for each shift of b `[T, 2]`."""
    gaps = []
    for heading in (a[2], a[2] + np.pi / 2, b[2], b[2] + np.pi / 2):
        axis = np.array([np.cos(heading), np.sin(heading)])
        pa, pb = corners(a) @ axis, corners(b) @ axis
        move = shift @ axis
        gaps.append(np.maximum(pb.min() + move - pa.max(), pa.min() - pb.max() - move))
    return np.max(gaps, 0)


def segment_distance(p, a, b):
    """Distance of points p `[P, 2]` to the segment a-b."""
    u = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(p - a - u[:, None] * (b - a), axis=1)


def random_pairs(n, seed):
    rng = np.random.default_rng(seed)
    size = np.stack([rng.uniform(0.5, 12, 2 * n), rng.uniform(0.4, 2.6, 2 * n)], -1)
    place = rng.uniform(-15, 15, (2 * n, 2))
    boxes = np.concatenate([place, rng.uniform(-np.pi, np.pi, (2 * n, 1)), size], -1)
    velocity = rng.normal(size=(2 * n, 2)) * 6
    return boxes[:n], boxes[n:], velocity[:n], velocity[n:]


pairs = jax.jit(jax.vmap(encounter))


def test_ttc_2d_is_what_time_stepping_finds():
    n, dt = 300, 2e-3
    a, b, va, vb = random_pairs(n, 0)
    found = np.asarray(ttc_2d(pairs(*map(f, (a, va, b, vb)))))
    times = np.arange(0, 8, dt)
    hits = 0
    for k in range(n):
        gap = gap_along_axes(a[k], b[k], times[:, None] * (vb[k] - va[k]))
        touching = np.nonzero(gap <= 0)[0]
        if touching.size:
            assert found[k] == pytest.approx(times[touching[0]], abs=1.1 * dt)
            hits += 0 < touching[0]
        elif found[k] < times[-1]:
            assert gap.min() < 0.05  # a corner that passes through between two steps
    assert hits > 25


def test_each_side_alone_can_keep_boxes_apart():
    n, rng = 2000, np.random.default_rng(5)
    a, b = (
        np.concatenate([rng.uniform(-2, 2, (n, 3)) * [1, 1, np.pi / 2], rng.uniform(1, 4, (n, 2))], -1)
        for _ in "ab"
    )
    found = np.asarray(overlaps(pairs(*map(f, (a, np.zeros((n, 2)), b, np.zeros((n, 2)))))))
    apart = np.zeros((n, 4), bool)
    for k in range(n):
        for i, heading in enumerate((a[k, 2], a[k, 2] + np.pi / 2, b[k, 2], b[k, 2] + np.pi / 2)):
            mine, other = (corners(x) @ [np.cos(heading), np.sin(heading)] for x in (a[k], b[k]))
            apart[k, i] = mine.max() < other.min() or other.max() < mine.min()
    np.testing.assert_array_equal(found, ~apart.any(1))
    alone = apart & (apart.sum(1) == 1)[:, None]
    assert (alone.sum(0) > 20).all()


def test_distance_is_that_of_the_polygons():
    n = 300
    a, b, va, vb = random_pairs(n, 1)
    e = pairs(*map(f, (a, va, b, vb)))
    found, touching = np.asarray(distance(e)), np.asarray(overlaps(e))
    for k in range(n):
        ca, cb = corners(a[k]), corners(b[k])
        apart = gap_along_axes(a[k], b[k], np.zeros((1, 2)))[0] > 0
        assert touching[k] == (not apart)
        expected = min(
            min(segment_distance(ca, cb[i - 1], cb[i]).min(), segment_distance(cb, ca[i - 1], ca[i]).min())
            for i in range(4)
        )
        assert found[k] == pytest.approx(expected if apart else 0.0, abs=2e-4)
    assert 10 < touching.sum() < n - 100


def pair(ego, velocity, other, other_velocity):
    return encounter(f(ego), f(velocity), f(other), f(other_velocity))


EGO = (0.0, 0.0, 0.0, 5.0, 2.0)


@pytest.mark.parametrize(
    ("other", "velocity", "expected"),
    [
        ((50.0, 0.0, 0.0, 5.0, 2.0), (5.0, 0.0), 3.0),  # 45 m at 15 m/s
        ((50.0, 0.0, np.pi, 5.0, 2.0), (-10.0, 0.0), 1.5),  # head-on
        ((50.0, 2.1, 0.0, 5.0, 2.0), (5.0, 0.0), NONE),  # passes beside
        ((50.0, 1.9, 0.0, 5.0, 2.0), (5.0, 0.0), 3.0),  # does not
        ((50.0, 0.0, 0.0, 5.0, 2.0), (25.0, 0.0), NONE),  # drives away
        ((50.0, 0.0, 0.0, 5.0, 2.0), (20.0, 0.0), NONE),  # same speed
        ((4.0, 0.0, 0.0, 5.0, 2.0), (30.0, 0.0), 0.0),  # touches now
        ((-10.0, 0.0, 0.0, 5.0, 2.0), (30.0, 0.0), 0.5),  # from behind: 5 m at 10 m/s
        # crossing from the right at 10 m/s: its front is 14.5 m from the ego's side
        ((30.0, -18.0, np.pi / 2, 5.0, 2.0), (0.0, 10.0), 1.45),
        ((60.0, -18.0, np.pi / 2, 5.0, 2.0), (0.0, 10.0), NONE),  # too early: has passed at 2.15 s
        ((125.0, 0.0, 0.0, 5.0, 2.0), (19.9, 0.0), NONE),  # 1,200 s
    ],
)
def test_ttc_2d_by_hand(other, velocity, expected):
    e = pair(EGO, (20.0, 0.0), other, velocity)
    assert float(ttc_2d(e)) == pytest.approx(expected, rel=1e-5)
    assert float(ttc_2d(mirrored(e))) == pytest.approx(expected, rel=1e-5)  # the same for both
    turned = [(*np.array([[0.6, -0.8], [0.8, 0.6]]) @ box[:2], box[2] + np.arctan2(0.8, 0.6), *box[3:])
              for box in (EGO, other)]  # fmt: skip
    rotated = [np.array([[0.6, -0.8], [0.8, 0.6]]) @ np.array(v) for v in ((20.0, 0.0), velocity)]
    assert float(ttc_2d(pair(turned[0], rotated[0], turned[1], rotated[1]))) == pytest.approx(
        expected, rel=1e-3
    )


def test_a_contact_has_an_end():
    e = pair(EGO, (20.0, 0.0), (30.0, -18.0, np.pi / 2, 5.0, 2.0), (0.0, 10.0))
    begin, cease = contact_interval(e)
    # in the way from 1.45 s (its front) and the ego from 1.325 s; the ego has passed at 1.675 s
    assert float(begin) == pytest.approx(1.45, rel=1e-5)
    assert float(cease) == pytest.approx(1.675, rel=1e-5)


def test_contacts_of_now_and_of_the_past_have_a_beginning():
    for x, expected in ((3.0, (-0.1, 0.4)), (-10.0, (-0.75, -0.25))):  # 5 m long, 20 m/s
        e = pair(EGO, (20.0, 0.0), (x, 0.0, 0.0, 5.0, 2.0), (0.0, 0.0))
        assert [float(t) for t in contact_interval(e)] == pytest.approx(expected, rel=1e-5)


def test_rounding_of_a_speed_that_is_zero_changes_nothing():
    # Compilers compute a speed twice, with different errors: the begin may see one, the end the other.
    beside = (20.0, 6.0, 0.0, 5.0, 2.0), (10.0, 0.0)
    ahead = (20.0, 1.0, 0.0, 5.0, 2.0), (10.0, 0.0)
    for (other, velocity), meets in ((beside, False), (ahead, True)):
        e = pair(EGO, (20.0, 0.0), other, velocity)
        noisy = [e._replace(w=f(w)) for w in (-1e-5, -1e-9, 0.0, 1e-9, 1e-5)]
        times = [contact_interval(e) for e in noisy]
        found = {float(first_touch(begin, cease)) for begin, _ in times for _, cease in times}
        assert found == ({float(ttc_2d(e))} if meets else {NONE})


def test_mirrored_twice_is_the_same():
    a, b, va, vb = random_pairs(20, 2)
    e = pairs(*map(f, (a, va, b, vb)))
    swapped = pairs(*map(f, (b, vb, a, va)))
    for x, y in zip(mirrored(e), swapped, strict=True):
        np.testing.assert_allclose(x, y, atol=2e-5)


def test_distances_by_hand():
    away = pair(EGO, (0, 0), (8.0, 5.0, 0.0, 5.0, 2.0), (0, 0))  # 3 m ahead, 3 m to the side
    assert float(distance(away)) == pytest.approx(np.hypot(3, 3), rel=1e-5)
    cross = pair(EGO, (0, 0), (0.0, 0.0, np.pi / 2, 8.0, 1.0), (0, 0))  # no corner within the other
    assert float(distance(cross)) == 0.0
    diamond = pair(EGO, (0, 0), (6.0, 0.0, np.pi / 4, 2.0, 2.0), (0, 0))  # a corner points at the ego
    assert float(distance(diamond)) == pytest.approx(3.5 - np.sqrt(2), rel=1e-5)


@pytest.mark.engine
def test_gradients_are_finite():
    a, b, va, vb = random_pairs(60, 3)
    b[0], vb[0] = a[0], va[0]  # on top of each other, no relative motion
    b[1, :2], b[1, 2], vb[1] = a[1, :2] + 30, a[1, 2], va[1]

    def total(boxes, velocities):
        e = jax.vmap(encounter)(boxes, velocities, f(b), f(vb))
        begin, cease = contact_interval(e)
        near = jnp.where(ttc_2d(e) < NONE, ttc_2d(e), 0)
        return jnp.sum(distance(e)) + jnp.sum(near) + 1e-9 * jnp.sum(begin + cease)

    grads = jax.grad(total, argnums=(0, 1))(f(a), f(va))
    assert all(bool(jnp.isfinite(g).all()) for g in grads)


def test_ttc_1d_headway_and_drac_by_hand():
    gap, v, lead = (
        f([30.0, 30.0, 30.0, NO_GAP, -0.5, 10.0, 8.0]),
        f([20, 10, 15, 20, 20, 0, 0.5]),
        f([10, 10, 20, 0, 10, 0, 0.1]),
    )
    np.testing.assert_allclose(ttc_1d(gap, v, lead), [3.0, NONE, NONE, NONE, 0.0, NONE, 20.0], rtol=1e-6)
    np.testing.assert_allclose(time_headway(gap, v), [1.5, 3.0, 2.0, NONE, 0.0, NONE, 16.0], rtol=1e-6)
    np.testing.assert_allclose(drac(gap, v, lead), [10**2 / 60, 0, 0, 0, 10**2 / 0.02, 0, 0.01], rtol=1e-5)


def test_rss_with_its_usual_parameters_by_hand():
    # 0.5 s at 2 m/s^2, then 4 m/s^2, behind one that brakes with 8 m/s^2
    assert float(rss_longitudinal(f(10.0), f(5.0))) == pytest.approx(5 + 0.25 + 11**2 / 8 - 25 / 16)
    # each 0.5 s at 0.2 m/s^2 towards the other, then 0.8 m/s^2, and 0.1 m
    ways = (0.8 + 0.9) / 2 * 0.5 + 0.9**2 / 1.6, 0.1 / 2 * 0.5 + 0.1**2 / 1.6
    assert float(rss_lateral(f(0.8), f(0.0))) == pytest.approx(0.1 + sum(ways), rel=1e-5)


def test_drac_is_the_braking_that_just_avoids_the_leader():
    gap, v, lead = 23.0, 17.0, 6.0
    brake = float(drac(f(gap), f(v), f(lead)))
    t = np.linspace(0, (v - lead) / brake, 2001)
    left = gap + lead * t - (v * t - brake * t**2 / 2)
    assert left.min() == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(("v", "lead"), [(20.0, 15.0), (30.0, 30.0), (10.0, 0.0), (5.0, 20.0)])
def test_rss_longitudinal_is_the_least_distance_that_survives_the_worst_case(v, lead):
    """The leader brakes its hardest; the follower accelerates during its response, then brakes its least."""
    p = Rss(response=0.7, accelerate=2.5, brake=4.0, brake_hardest=8.0)
    t = np.linspace(0, 30, 300_001)
    dt = t[1]
    follower = np.where(t < p.response, p.accelerate, -p.brake)
    v_follower = v + np.cumsum(follower) * dt
    v_follower = np.where(t < p.response, v_follower, np.maximum(v_follower, 0))
    v_lead = np.maximum(lead - p.brake_hardest * t, 0)
    needed = max(np.max(np.cumsum(v_follower - v_lead) * dt), 0)
    assert float(rss_longitudinal(f(v), f(lead), p)) == pytest.approx(needed, abs=0.02)


def test_rss_longitudinal_by_hand():
    # 20 * 0.5 + 2 * 0.25 / 2 + 21^2 / 8 - 15^2 / 16
    assert float(rss_longitudinal(f(20.0), f(15.0))) == pytest.approx(51.3125, rel=1e-6)


@pytest.mark.parametrize(("w", "other"), [(0.0, 0.0), (0.6, 0.2), (0.5, -0.8), (-1.0, 1.4)])
def test_rss_lateral_is_the_least_distance_that_survives_the_worst_case(w, other):
    p = Rss(response=0.5, lateral_accelerate=0.2, lateral_brake=0.8, margin=0.1)
    t = np.linspace(0, 10, 200_001)
    dt = t[1]

    def way(w):
        after = w + p.response * p.lateral_accelerate
        braking = np.sign(after) * np.maximum(abs(after) - p.lateral_brake * (t - p.response), 0)
        return np.cumsum(np.where(t < p.response, w + p.lateral_accelerate * t, braking)) * dt

    at_the_end = way(w)[-1] + way(other)[-1]
    assert float(rss_lateral(f(w), f(other), p)) == pytest.approx(0.1 + max(at_the_end, 0), abs=1e-3)


def test_delta_v_by_hand():
    assert float(delta_v(f(10.0), f(0.0), f(1.0))) == pytest.approx(5.0)  # into a standing car
    assert float(delta_v(f(10.0), f(10.0), f(-1.0))) == pytest.approx(10.0)  # head-on
    assert float(delta_v(f(3.0), f(4.0), f(0.0))) == pytest.approx(2.5)  # at a right angle
    assert float(delta_v(f(10.0), f(10.0), f(1.0))) == 0.0
    assert float(delta_v(f(10.0), f(0.0), f(1.0), 0.8)) == pytest.approx(8.0)  # into a truck


# --- post-encroachment time --------------------------------------------------------------------------


def pet(steps, ids=None, dt=0.1):
    """`steps`: per step the zones' (ego inside, other inside); all zones in all steps unless `ids`."""
    ego = np.array([[z[0] for z in row] for row in steps], bool)
    other = np.array([[z[1] for z in row] for row in steps], bool)
    if ids is None:
        ids = np.broadcast_to(np.arange(ego.shape[1]), ego.shape)

    def step(carry, x):
        t, ids, ego, other = x
        return pet_update(carry, t, Zones(ids, ego, other)), None

    xs = (f(np.arange(len(steps)) * dt), jnp.asarray(ids, jnp.int32), jnp.asarray(ego), jnp.asarray(other))
    return jax.lax.scan(step, pet_init(ego.shape[1]), xs)[0].least


def one_zone(ego, other, n=40):
    return [[(ego[0] <= i < ego[1], other[0] <= i < other[1])] for i in range(n)]


@pytest.mark.parametrize(
    ("ego", "other", "expected", "when"),
    [
        ((5, 10), (22, 25), 1.2, 2.2),  # ego first: out at 1.0 s, other in at 2.2 s
        ((30, 33), (8, 12), 1.8, 3.0),  # other first
        ((5, 10), (10, 12), 0.0, 1.0),  # one out, other in
        ((5, 10), (8, 12), 0.0, 0.8),  # together
        ((8, 12), (5, 10), 0.0, 0.8),
        ((5, 10), (5, 12), 0.0, 0.5),  # in at the same step
        ((5, 10), (90, 91), None, None),  # no other vehicle
        ((90, 91), (5, 10), None, None),
    ],
)
def test_pet_by_hand(ego, other, expected, when):
    least = pet(one_zone(ego, other))
    assert bool(least.found) == (expected is not None)
    if expected is not None:
        assert float(least.value) == pytest.approx(expected, abs=1e-5)
        assert float(least.time) == pytest.approx(when, abs=1e-5)


def test_pet_counts_the_last_who_left_and_the_least_of_all_zones():
    first, second = one_zone((20, 25), (2, 6)), one_zone((30, 33), (5, 28))
    assert float(pet([[a[0], b[0]] for a, b in zip(first, second, strict=True)]).value) == pytest.approx(0.2)
    met, alone = one_zone((5, 10), (22, 25)), one_zone((15, 20), (90, 91))
    assert float(pet([[a[0], b[0]] for a, b in zip(met, alone, strict=True)]).value) == pytest.approx(1.2)
    twice = one_zone((20, 25), (2, 6))
    for i in (14, 15, 16):
        twice[i] = [(False, True)]
    assert float(pet(twice).value) == pytest.approx(0.3)  # 2.0 s - 1.7 s


def test_pet_follows_zones_that_change_their_place():
    """The same episode with the zones in another order in every step, among empty places."""
    steps = [a + b for a, b in zip(one_zone((20, 25), (2, 9)), one_zone((5, 8), (12, 14)), strict=True)]
    expected = pet(steps)
    rng = np.random.default_rng(0)
    ids, shuffled = [], []
    for row in steps:
        order = rng.permutation(4)
        ids.append(np.array([7, 3, -1, -1])[order])
        shuffled.append([[*row, (True, True), (True, True)][i] for i in order])  # empty places do not count
    found = pet(shuffled, np.array(ids))
    assert float(found.value) == pytest.approx(0.4) == pytest.approx(float(expected.value))
    gone = np.array(ids)
    gone[9:12] = -1  # a zone that was not seen in between is forgotten
    assert not bool(pet([[row[0]] for row in steps], np.where(np.arange(40) == 15, -1, 7)[:, None]).found)
