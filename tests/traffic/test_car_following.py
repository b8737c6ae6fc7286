"""Car following against theory: closed forms, published behaviour, SciPy's integrator."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from limsim_jax.traffic import car_following as cf
from limsim_jax.types import Driver

MODELS = [cf.IDM(), cf.IIDM(), cf.ACC()]
each_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
HIGHWAY = 120 / 3.6  # m/s


def make_driver(shape=(), **parameters):
    values = dict.fromkeys(Driver.__dataclass_fields__, 1.0)
    values |= {"v_max": 60.0, "T": 1.5, "s0": 2.0, "a": 1.4, "b": 2.0, "delta": 4.0, "b_max": 9.0}
    values |= {"coolness": 0.99, "a_lat": 2.5} | parameters
    dtype = jnp.result_type(float)
    return Driver(**{k: jnp.broadcast_to(jnp.asarray(v, dtype), shape) for k, v in values.items()})


def accelerate(model, driver, gap, v, v_lead, a_lead, v0):
    arrays = (jnp.asarray(x, jnp.result_type(float)) for x in (gap, v, v_lead, a_lead, v0))
    names = ("gap", "v", "v_lead", "a_lead", "v0")
    return model(driver, **dict(zip(names, arrays, strict=True)))


# ---- the formulas


def plain_idm(p, s, v, v_l, v0):
    s_star = p["s0"] + max(0.0, v * p["T"] + v * (v - v_l) / (2 * math.sqrt(p["a"] * p["b"])))
    return p["a"] * (1 - (v / v0) ** p["delta"] - (s_star / s) ** 2)


def plain_iidm(p, s, v, v_l, v0):
    a, b = p["a"], p["b"]
    s_star = p["s0"] + max(0.0, v * p["T"] + v * (v - v_l) / (2 * math.sqrt(a * b)))
    z = s_star / s
    if v <= v0:
        free = a * (1 - (v / v0) ** p["delta"])
        return a * (1 - z**2) if z >= 1 else free * (1 - z ** (2 * a / free))
    free = -b * (1 - (v0 / v) ** (a * p["delta"] / b))
    return free + a * (1 - z**2) if z >= 1 else free


def plain_acc(p, s, v, v_l, a_l, v0):
    iidm = plain_iidm(p, s, v, v_l, v0)
    a_l = min(a_l, p["a"])
    if v_l * (v - v_l) <= -2 * s * a_l:
        cah = v**2 * a_l / (v_l**2 - 2 * s * a_l)
    else:
        cah = a_l - max(v - v_l, 0) ** 2 / (2 * s)
    if iidm >= cah:
        return iidm
    c, b = p["coolness"], p["b"]
    return (1 - c) * iidm + c * (cah + b * math.tanh((iidm - cah) / b))


@pytest.mark.parametrize(
    ("state", "idm", "iidm", "acc"),
    [
        ((100, 30, 30, 0), 0.17220, 0.47550, 0.47550),
        ((30, 20, 20, 0), -0.37433, -0.19289, -0.19230),
        ((20, 20, 15, 0), -12.18372, -12.00228, -2.71873),
        ((10, 30, 30, 0), -30.4445, -29.5260, -2.27526),
        ((10, 30, 30, -2), -30.4445, -29.5260, -4.17100),
        ((5, 10, 12, 0), -5.41676, -5.40542, -2.01634),
    ],
)
def test_accelerations_equal_the_table(state, idm, iidm, acc):
    """Table of accelerations at T = 1.5 s, s0 = 2 m, a = 1.4, b = 2, v0 = 120 km/h; in single precision."""
    driver = make_driver(b_max=100.0)
    gap, v, v_lead, a_lead = state
    found = [float(accelerate(model, driver, gap, v, v_lead, a_lead, HIGHWAY)) for model in MODELS]
    np.testing.assert_allclose(found, [idm, iidm, acc], rtol=2e-5, atol=2e-5)


@each_model
def test_accelerations_equal_the_plain_formulas(model):
    """On random states, parameters included, against the published case distinctions one by one."""
    rng = np.random.default_rng(5)
    n = 3000
    p = {
        "T": rng.uniform(0.5, 3, n),
        "s0": rng.uniform(0.5, 5, n),
        "a": rng.uniform(0.4, 3, n),
        "b": rng.uniform(0.5, 4, n),
        "delta": rng.uniform(1, 10, n),
        "coolness": rng.uniform(0, 1, n),
    }
    s, v, v_l = rng.uniform(0.5, 120, n), rng.uniform(0, 40, n), rng.uniform(0, 40, n)
    a_l, v0 = rng.uniform(-8, 3, n), rng.uniform(2, 45, n)
    want = []
    for i in range(n):
        q = {name: float(x[i]) for name, x in p.items()}
        if isinstance(model, cf.ACC):
            want.append(plain_acc(q, s[i], v[i], v_l[i], a_l[i], v0[i]))
        else:
            plain = {cf.IDM: plain_idm, cf.IIDM: plain_iidm}[type(model)]
            want.append(plain(q, s[i], v[i], v_l[i], v0[i]))
    with jax.enable_x64(True):
        found = np.asarray(accelerate(model, make_driver((n,), b_max=100.0, **p), s, v, v_l, a_l, v0))
    error = np.abs(found - np.maximum(want, -100))
    assert error.max() < 1e-3  # where v is so close to v0 that the exponent 2 a / free has a floor
    assert np.mean(error < 1e-9) > 0.99


@pytest.mark.engine
@each_model
def test_obstacles_are_independent(model):
    driver = make_driver((5,), T=jnp.linspace(1, 2, 5))
    rng = np.random.default_rng(1)
    gap, v_lead = rng.uniform(1, 60, (5, 3)), rng.uniform(0, 20, (5, 3))
    v, v0 = rng.uniform(0, 20, 5), np.full(5, 15.0)
    together = accelerate(model, cf.per_obstacle(driver), gap, v[:, None], v_lead, gap * 0, v0[:, None])
    for k in range(3):
        alone = accelerate(model, driver, gap[:, k], v, v_lead[:, k], v * 0, v0)
        np.testing.assert_allclose(together[:, k], alone, rtol=1e-6)


def test_equal_models_compile_once():
    traces = []

    def run(model, v):
        traces.append(model)
        return accelerate(model, make_driver(), 20.0, v, v, v, v + 1)

    jitted = jax.jit(run, static_argnums=0)
    for _ in range(2):
        for model in (cf.IDM(), cf.ACC()):
            jitted(model, jnp.float32(5.0))
    assert len(traces) == 2


# ---- limits


def states():
    """Ordinary and degenerate states, every combination."""
    gap = [-5.0, 0.0, 1e-30, 0.005, 0.01, 1.0, 2.0, 30.0, cf.NO_GAP]
    v = [0.0, 1e-30, 0.02, 10.0, 60.0]
    v_lead = [0.0, 1e-30, 0.02, 10.0, 60.0]
    a_lead = [-9.0, -1e-30, 0.0, 2.0]
    v0 = [0.0, 1e-30, 0.02, 10.0, 30.0]
    return np.array(list(itertools.product(gap, v, v_lead, a_lead, v0)), np.float32).T


@each_model
@pytest.mark.parametrize("empty", [False, True], ids=["driver", "zeros"])
def test_values_are_bounded_and_gradients_finite(model, empty):
    arguments = [jnp.asarray(x) for x in states()]
    driver = make_driver(arguments[0].shape)
    if empty:
        driver = jax.tree.map(jnp.zeros_like, driver)

    def acceleration(driver, arguments):
        return accelerate(model, driver, *arguments)

    @jax.jit
    def evaluate(*primals):
        value, pullback = jax.vjp(acceleration, *primals)
        ones = jax.tree.map(jnp.ones_like, primals)
        return value, pullback(jnp.ones_like(value)), jax.jvp(acceleration, primals, ones)[1]

    value, backward, forward = evaluate(driver, arguments)
    assert (value >= -driver.b_max).all() and (value <= driver.a + 1e-6).all()
    for gradient in jax.tree.leaves((backward, forward)):
        assert np.isfinite(gradient).all()


@each_model
def test_overlap_and_rest(model):
    """Where bodies overlap it brakes as hard as it can, and no vehicle starts too near a standing leader."""
    driver = make_driver()
    assert accelerate(model, driver, -1.0, 5.0, 5.0, 0.0, 10.0) == -9.0
    assert accelerate(model, make_driver(s0=0.0), 0.0, 0.0, 0.0, 0.0, 10.0) == -9.0
    assert accelerate(model, driver, 1.9, 0.0, 0.0, 0.0, 10.0) < 0
    assert accelerate(model, driver, 2.1, 0.0, 0.0, 0.0, 10.0) > 0


@each_model
def test_desired_speed_of_zero_stops_and_keeps(model):
    driver = make_driver()

    def step(v, _):
        a = accelerate(model, driver, cf.NO_GAP, v, v, 0.0, 0.0)
        return cf.ballistic(v, a, 0.1)

    _, distances = jax.lax.scan(step, jnp.float32(10.0), None, length=200)
    assert distances[100:].max() == 0 and distances.sum() < 100


def test_above_the_desired_speed_only_the_idm_brakes_hard():
    driver = make_driver(b_max=100.0)
    free = [float(accelerate(m, driver, cf.NO_GAP, 28.0, 28.0, 0.0, 14.0)) for m in MODELS]
    assert free[0] < -20 and -2.0 < free[1] < -1.5 and -2.0 < free[2] < -1.3


def test_desired_speed():
    driver = make_driver(speed_factor=1.1, v_max=25.0, a_lat=2.5)
    limit = jnp.array([10.0, 30.0, 20.0, 20.0])
    curvature = jnp.array([0.0, 0.0, 0.02, -0.1])
    driver = jax.tree.map(lambda x: jnp.broadcast_to(x, (4,)), driver)
    found = cf.desired_speed(driver, limit, curvature)
    np.testing.assert_allclose(found, [11.0, 25.0, math.sqrt(2.5 / 0.02), 5.0], rtol=1e-6)
    speed_gradient = jax.jit(jax.grad(lambda *x: cf.desired_speed(*x).sum(), argnums=(0, 1, 2)))
    for d in (driver, jax.tree.map(jnp.zeros_like, driver)):
        gradient = speed_gradient(d, limit, curvature)
        assert all(jnp.isfinite(g).all() for g in jax.tree.leaves(gradient))


# ---- equilibrium and stability

SETS = [  # v0, T, s0, a, b; largest flow (veh/h), its speed; unstable speeds; triangular bound (veh/h)
    ((HIGHWAY, 1.0, 2.0, 1.0, 1.5), 2519, 20.1, (0.0, 20.05), 2975),
    ((HIGHWAY, 1.5, 2.0, 1.0, 1.5), 1836, 18.8, (0.92, 18.6), 2105),
    ((15.0, 1.0, 2.0, 1.0, 1.5), 1957, 10.2, (0.0, 8.9), 2455),
    ((30.0, 1.5, 2.0, 2.0, 2.0), 1798, 17.2, None, 2077),
]


def driver_of(parameters, shape=()):
    return make_driver(shape, **dict(zip(("T", "s0", "a", "b"), parameters[1:], strict=True)))


@jax.jit
def criterion_and_flows(driver, length, v, v0):
    flows = [cf.equilibrium_flow(model, driver, length, v, v0) for model in MODELS]
    return cf.string_stability(driver, v, v0), flows


def closed_criterion(parameters, v):
    """f_v^2 - f_l^2 - 2 f_s of the IDM by hand, delta = 4."""
    v0, T, s0, a, b = parameters
    s_star, free = s0 + v * T, 1 - (v / v0) ** 4
    s = s_star / np.sqrt(free)
    f_s = 2 * a * free / s
    f_v = -a * (4 * v**3 / v0**4 + 2 * s_star * (T + v / (2 * math.sqrt(a * b))) / s**2)
    f_l = s_star * v * math.sqrt(a / b) / s**2
    return f_v**2 - f_l**2 - 2 * f_s


@pytest.mark.parametrize(("parameters", "flow", "speed", "unstable", "triangle"), SETS)
def test_fundamental_diagram_and_string_stability(parameters, flow, speed, unstable, triangle):
    v0 = parameters[0]
    v = np.linspace(1e-3, v0 - 1e-6, 4000)
    with jax.enable_x64(True):
        shape = v.shape
        arguments = np.full(shape, 5.0), v, np.full(shape, v0)
        criterion, flows = jax.tree.map(
            np.asarray, criterion_and_flows(driver_of(parameters, shape), *map(jnp.asarray, arguments))
        )
    np.testing.assert_allclose(criterion, closed_criterion(parameters, v), rtol=1e-9, atol=1e-12)
    inside = v[criterion < 0]
    if unstable is None:
        assert inside.size == 0
    else:  # the table has the ends on a grid
        np.testing.assert_allclose([inside[0], inside[-1]], unstable, atol=0.1)
        assert np.all(np.diff(inside) < 0.02)  # one interval
    idm, iidm, acc = (3600 * x for x in flows)
    np.testing.assert_allclose(idm.max(), flow, rtol=5e-4)
    np.testing.assert_allclose(v[idm.argmax()], speed, atol=0.06)
    np.testing.assert_allclose([iidm.max(), acc.max()], triangle, rtol=5e-4)


def test_equilibrium_gaps_and_string_stability_equal_the_table():
    v = jnp.array([5.0, 10.0, 20.0, 30.0])
    driver, v0 = driver_of(SETS[1][0], (4,)), jnp.full(4, HIGHWAY)
    gaps = cf.equilibrium_gap(cf.IDM(), driver, v, v0)
    np.testing.assert_allclose(gaps, [9.5024, 17.0693, 34.2997, 80.1460], rtol=1e-5)
    found = jax.jit(cf.string_stability)(driver, v, v0)
    np.testing.assert_allclose(found, [-0.04937, -0.03079, 0.00557, 0.03404], atol=1e-5)


def test_string_stability_at_rest():
    """At v -> 0 the IDM is string stable if a >= s0 / T^2."""
    s0, T = 2.0, 1.5
    with jax.enable_x64(True):
        a = jnp.array([0.95, 1.05]) * s0 / T**2
        driver = make_driver((2,), a=a, s0=s0, T=T)
        sign = jax.jit(cf.string_stability)(driver, jnp.full(2, 1e-6), jnp.full(2, 30.0))
        assert sign[0] < 0 < sign[1]


@each_model
def test_equilibrium_is_at_rest(model):
    v, v0 = jnp.linspace(0.0, 29.0, 50), jnp.full(50, 30.0)
    driver = make_driver((50,))
    gap = cf.equilibrium_gap(model, driver, v, v0)
    np.testing.assert_allclose(accelerate(model, driver, gap, v, v, v * 0, v0), 0, atol=1e-4)


def test_no_equilibrium_at_the_desired_speed():
    v, v0 = jnp.array([30.0, 35.0]), jnp.full(2, 30.0)
    np.testing.assert_array_equal(cf.equilibrium_gap(cf.IDM(), make_driver((2,)), v, v0), [cf.NO_GAP] * 2)


@pytest.mark.engine
def test_ring_road_amplifies_as_the_criterion_says():
    """100 vehicles on a ring, one of them 0.5 m/s off, 1500 s: the standard deviation of the speeds."""
    first, stable = SETS[0][0], (HIGHWAY, 1.5, 2.0, 2.0, 1.5)
    cases = [(p, spacing) for p in (first, stable) for spacing in (10.0, 20.0, 40.0)]
    n, dt = 100, 0.1

    def deviation(driver, spacing, v_e):
        def step(state, _):
            gap, v = state
            a = cf.IDM()(driver, gap=gap, v=v, v_lead=jnp.roll(v, -1), a_lead=v * 0, v0=v0)
            v, distance = cf.ballistic(v, a, dt)
            return (gap + jnp.roll(distance, -1) - distance, v), None

        v0 = jnp.full(n, HIGHWAY)
        start = jnp.full(n, spacing - 5), jnp.full(n, v_e).at[0].add(-0.5)
        (gap, v), _ = jax.lax.scan(step, start, None, length=15_000)
        return jnp.std(v), jnp.min(gap)

    v = jnp.linspace(0.0, HIGHWAY - 0.01, 20_000)
    drivers, speeds, signs = [], [], []
    for p, spacing in cases:
        driver = driver_of(p, v.shape)
        gaps = cf.equilibrium_gap(cf.IDM(), driver, v, jnp.full(v.shape, HIGHWAY))
        v_e = float(np.interp(spacing - 5, gaps, v))
        speeds.append(v_e)
        drivers.append(driver_of(p, (n,)))
        signs.append(float(closed_criterion(p, v_e)))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *drivers)
    spacings = jnp.array([spacing for _, spacing in cases])
    found, gap = jax.jit(jax.vmap(deviation))(stacked, spacings, jnp.array(speeds))
    assert (gap > 0).all()
    np.testing.assert_allclose(speeds[:3], [3.0, 12.8, 25.9], atol=0.05)
    np.testing.assert_allclose(found[:2], [4.0, 9.4], atol=0.3)
    start = 0.5 * math.sqrt(99) / 100
    for std, sign in zip(np.asarray(found), signs, strict=True):
        assert std > 10 * start if sign < 0 else std < 0.1 * start, (std, sign)
    assert [sign < 0 for sign in signs] == [True, True, False, False, False, False]


# ---- rollouts


def platoon(model, driver, start_gap, v, lead_v, lead_a, dt, v0):
    """Speeds and gaps `[T, N]` of vehicles in a row; the first follows a leader with given motion `[T]`.

    A leader of speed NaN is none.
    """

    first = jnp.arange(v.shape[0]) == 0

    def step(state: tuple[jax.Array, ...], lead: tuple[jax.Array, jax.Array]):
        gap, v, a = state
        speed, change = lead
        none = first & jnp.isnan(speed)
        v_lead = jnp.where(none, v, jnp.where(first, speed, jnp.roll(v, 1)))
        a_lead = jnp.where(none, 0.0, jnp.where(first, change, jnp.roll(a, 1)))
        seen = jnp.where(none, cf.NO_GAP, gap)
        wish = model(driver, gap=seen, v=v, v_lead=v_lead, a_lead=a_lead, v0=v0)
        v_new, distance = cf.ballistic(v, wish, dt)
        _, ahead = cf.ballistic(v_lead, a_lead, dt)
        gap = gap + jnp.where(first, ahead, jnp.roll(distance, 1)) - distance
        return (gap, v_new, (v_new - v) / dt), (v_new, gap, distance)

    return jax.lax.scan(step, (start_gap, v, jnp.zeros_like(v)), (lead_v, lead_a))[1]


@pytest.mark.parametrize(
    ("T", "a", "b", "flow"),
    [(1.0, 1.5, 1.5, 1845), (1.0, 2.0, 2.0, 1899), (1.2, 1.5, 2.0, 1655), (1.5, 1.0, 1.5, 1379)],
)
def test_queue_discharge(T, a, b, flow):
    """Vehicles 5 to 20 of a standing queue that is set free cross the stop line at the tabulated rate."""
    n, dt = 20, 0.1
    driver = make_driver((n,), T=T, a=a, b=b)
    free = jnp.full(1200, jnp.nan)
    gap, v = jnp.full(n, 2.0), jnp.zeros(n)
    _, _, distance = platoon(cf.IDM(), driver, gap, v, free, free, dt, jnp.full(n, 13.9))
    position = np.cumsum(np.asarray(distance), axis=0) - np.arange(n) * 7.0
    times = [np.interp(1e-6, position[:, i], dt * np.arange(1, 1201)) for i in range(n)]
    rate = 3600 * 15 / (times[19] - times[4])
    np.testing.assert_allclose(rate, flow, rtol=0.02)


@pytest.mark.parametrize(("v", "d"), [(10, 100), (20, 150), (20, 60), (20, 35), (30, 60)])
def test_approach_to_a_standing_obstacle(v, d):
    driver = make_driver((1,), a=1.0, b=1.5)
    lead = jnp.zeros(1200)
    start = jnp.full(1, float(d)), jnp.full(1, float(v))
    speed, gap, _ = platoon(cf.IDM(), driver, *start, lead, lead, 0.1, jnp.full(1, HIGHWAY))
    assert gap.min() > 0 and speed.min() >= 0
    np.testing.assert_allclose(gap[-1, 0], 1.97, atol=0.03)
    assert speed[-1, 0] < 0.01


@each_model
def test_no_collision_wherever_one_can_be_avoided(model):
    """From any state with d >= v^2 / (2 b_max) + 2 m behind a standing leader."""
    n = 4000
    rng = np.random.default_rng(11)
    p = {
        "T": rng.uniform(0.5, 3, n),
        "s0": rng.uniform(0.5, 5, n),
        "a": rng.uniform(0.4, 3, n),
        "b": rng.uniform(1, 4, n),
        "b_max": rng.uniform(4.5, 9, n),
    }
    v = rng.uniform(0, 50, n)
    d = v**2 / (2 * p["b_max"]) + 2 + np.where(rng.random(n) < 0.5, 0, rng.exponential(20, n))
    driver = make_driver((n,), **p)
    v0 = jnp.asarray(rng.uniform(5, 50, n), jnp.float32)

    def step(state, _):
        gap, v = state
        a = model(driver, gap=gap, v=v, v_lead=v * 0, a_lead=v * 0, v0=v0)
        v, distance = cf.ballistic(v, a, 0.1)
        return (gap - distance, v), (gap - distance, v, distance)

    start = jnp.asarray(d, jnp.float32), jnp.asarray(v, jnp.float32)
    _, (gap, v, distance) = jax.lax.scan(step, start, None, length=600)
    assert distance.min() >= 0 and v.min() >= 0
    assert gap.min() > 0
    assert v[-1].max() < 0.2


# ---- the step


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.37, 1.0])
def test_stopping_distance(dt):
    """v^2 / (2 b) for any step length, also where the stop falls within a step."""
    with jax.enable_x64(True):
        v = jnp.linspace(0.0, 40.0, 81)
        b = jnp.full(v.shape, 3.3)

        def step(v, _):
            return cf.ballistic(v, -b, dt)

        end, distances = jax.lax.scan(step, v, None, length=int(13 / dt) + 1)
        np.testing.assert_array_equal(end, 0)
        np.testing.assert_allclose(distances.sum(0), v**2 / (2 * b), rtol=1e-12)


def test_step_is_exact_for_constant_acceleration_and_safe_at_rest():
    v, x = cf.ballistic(jnp.array([5.0, 0.0, 1.0, 0.0]), jnp.array([2.0, 0.0, -4.0, -3.0]), 0.5)
    np.testing.assert_allclose(v, [6.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(x, [2.75, 0.0, 0.125, 0.0])
    gradients = jax.jit(
        jax.grad(lambda v, a, out: cf.ballistic(v, a, 0.1)[out].sum(), (0, 1)), static_argnums=2
    )
    rates = jnp.array([-9.0, -1e-3, -1e-30, 0.0, 1e-30, 2.0])
    for v in (0.0, 1e-30, 1e-6, 10.0):
        speeds = jnp.full(rates.shape, v)
        for out in (0, 1):
            gradient = gradients(speeds, rates, out)
            assert all(np.isfinite(g).all() for g in gradient)


def lead_motion(t):
    """Speed and acceleration of a leader on a wavy drive, m/s."""
    return 15 + 5 * np.sin(0.2 * t), np.cos(0.2 * t)


def test_step_converges_to_the_exact_solution():
    """Against SciPy's Runge-Kutta of order 8: first order in dt, as Treiber and Kanagaraj (2015) find."""
    p = {"T": 1.5, "s0": 2.0, "a": 1.4, "b": 2.0, "delta": 4.0}
    horizon, n = 40.0, 3

    def slope(t, y):
        gap, v = y[:n], y[n:]
        ahead = np.concatenate([[lead_motion(t)[0]], v[:-1]])
        a = [plain_idm(p, gap[i], v[i], ahead[i], 30.0) for i in range(n)]
        return np.concatenate([ahead - v, a])

    start = np.array([30.0, 25.0, 20.0, 12.0, 12.0, 12.0])
    exact = solve_ivp(slope, (0, horizon), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    errors = []
    with jax.enable_x64(True):
        for dt in (0.2, 0.1, 0.05, 0.025):
            t = np.arange(round(horizon / dt)) * dt
            distance = 15 * t - 25 * np.cos(0.2 * t)  # of the leader, exact
            ahead = np.diff(np.append(distance, 15 * horizon - 25 * np.cos(0.2 * horizon)))
            speed = lead_motion(t)[0]
            # the leader's step covers exactly its distance: a = 2 (dx / dt - v) / dt
            lead = jnp.asarray(speed), jnp.asarray(2 * (ahead / dt - speed) / dt)
            driver, v0 = make_driver((n,), **p, b_max=99.0), jnp.full(n, 30.0)
            start_gap, start_v = jnp.asarray(start[:n]), jnp.asarray(start[n:])
            v, gap, _ = platoon(cf.IDM(), driver, start_gap, start_v, *lead, dt, v0)
            errors.append(np.abs(np.concatenate([gap[-1], v[-1]]) - exact).max())
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(order[-1], 1.0, atol=0.1)
    assert errors[1] < 0.1  # m and m/s at 0.1 s


# ---- gradients


def stop_and_go(model, driver, v0, steps, dt=0.1):
    """Mean gap and mean speed of a platoon whose leader comes to rest for a while and drives on."""
    n = driver.T.shape[0]
    t = dt * jnp.arange(steps, dtype=jnp.result_type(float))
    change = jnp.where(t < 4, 0.0, jnp.where(t < 9, -2.0, jnp.where(t < 30, 0.0, 1.0)))
    speed = jnp.where(t < 4, 10.0, jnp.where(t < 9, 10 - 2 * (t - 4), jnp.where(t < 30, 0.0, t - 30)))
    v, gap, _ = platoon(model, driver, jnp.full(n, 15.0), jnp.full(n, 10.0), speed, change, dt, v0)
    return jnp.stack([gap.mean(), v.mean()]), v


@pytest.mark.engine
@each_model
def test_gradients_through_a_full_stop(model):
    """d(mean gap, mean speed)/d(parameters), forward and reverse, against central differences."""
    names = ("T", "s0", "a", "b", "delta", "v0")
    with jax.enable_x64(True):

        def outcome(theta):
            values = dict(zip(names, theta, strict=True))
            v0 = jnp.full(3, values.pop("v0"))
            return stop_and_go(model, make_driver((3,), **values), v0, 450)

        def result(theta):
            return outcome(theta)[0]

        theta = jnp.array([1.31, 2.2, 1.3, 1.9, 4.2, 14.0])
        _, v = jax.jit(outcome)(theta)
        assert (v.min(0) == 0).all()  # all come to rest
        assert (v[-1] > 5).all()
        forward = jax.jit(jax.jacfwd(result))(theta)
        backward = jax.jit(jax.jacrev(result))(theta)
        step = 1e-6
        shifts = step * jnp.eye(6)
        high, low = (jax.jit(jax.vmap(result))(theta[None] + sign * shifts) for sign in (1, -1))
        numeric = ((high - low) / (2 * step)).T
        np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(forward, numeric, rtol=1e-3, atol=1e-5)
        assert (jnp.abs(forward) > 1e-4).all(1).any()


@pytest.mark.engine
@each_model
def test_gradients_are_finite_in_a_standing_queue_with_empty_slots(model):
    """An empty slot holds zeros and overlaps its neighbours; the others stand at s0 or closer."""
    active = jnp.array([True, True, False, True])

    def mean_speed(driver):
        v, _, _ = platoon(
            model,
            driver,
            jnp.array([2.0, 1.5, 0.0, -1.0]),
            jnp.zeros(4),
            jnp.where(jnp.arange(300) < 100, 0.0, 5.0),
            jnp.zeros(300),
            0.1,
            jnp.where(active, 10.0, 0.0),
        )
        return jnp.where(active, v, 0).mean()

    driver = jax.tree.map(lambda x: jnp.where(active, x, 0), make_driver((4,)))
    value, gradient = jax.jit(jax.value_and_grad(mean_speed))(driver)
    assert value > 0
    assert all(jnp.isfinite(g).all() for g in jax.tree.leaves(gradient))
    assert any((g != 0).any() for g in jax.tree.leaves(gradient))
