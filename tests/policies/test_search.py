"""Decisions of groups: against enumeration and car following, and effects of social value orientation."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import search_quality as quality

from limsim_jax.policies.limsim_tm.group import Vehicles, group, interactions
from limsim_jax.policies.limsim_tm.search import Settings, no_plan, play, search, shifted
from limsim_jax.traffic.car_following import IDM, NO_GAP
from limsim_jax.traffic.ego import Meta

pytestmark = pytest.mark.engine

SHORT = Settings(decisions=3)
STEPS = SHORT.steps
DRIVE = jax.jit(partial(play, SHORT))


def default(count):
    return jnp.full((count, SHORT.decisions), -1)


# ---- the model of the road


@pytest.mark.parametrize("gap, v, v_lead", [(30.0, 10.0, 9.0), (60.0, 13.0, 8.0), (15.0, 8.0, 8.5)])
def test_default_policy_follows_by_idm(gap, v, v_lead):
    scene = quality.road([(0, v, 0), (200, v, 1)], [(gap + 4.8, v_lead, 0)], steps=STEPS)
    plan = DRIVE(scene, default(2))
    one = jax.tree.map(lambda x: x[0], scene.driver)
    a = IDM()(one, gap=jnp.asarray(gap), v=jnp.asarray(v), v_lead=jnp.asarray(v_lead), a_lead=jnp.zeros(()),
              v0=scene.v0[0])  # fmt: skip
    np.testing.assert_allclose((plan.v[0, 1] - v) / SHORT.dt, a, atol=1e-4)
    np.testing.assert_allclose(plan.s[0, 1], (v + plan.v[0, 1]) / 2 * SHORT.dt, rtol=1e-5)


def test_actions_have_their_effects():
    scene = quality.road([(0, 10, 1), (300, 10, 1)], steps=STEPS)
    end = {}
    for action in range(5):
        actions = default(2).at[0, 0].set(action)
        end[action] = DRIVE(scene, actions)
    after = SHORT.substeps
    assert end[Meta.KEEP].v[0, after] == 10
    assert end[Meta.ACCELERATE].v[0, after] > 10.5
    np.testing.assert_allclose(end[Meta.DECELERATE].v[0, after], 10 - 2 * 1.5, rtol=1e-5)
    for action, lane in ((Meta.LEFT, 2), (Meta.RIGHT, 0)):
        np.testing.assert_allclose(end[action].y[0, -1], lane * 3.5, atol=1e-4)
        np.testing.assert_allclose(abs(end[action].y[0, after] - 3.5), 1.17 * 1.5, rtol=1e-4)
    outer = DRIVE(quality.road([(0, 10, 2), (300, 10, 1)], steps=STEPS), default(2).at[0, 0].set(Meta.LEFT))
    np.testing.assert_allclose(outer.y[0], 7, atol=1e-4)  # there is no lane


def test_stops_before_an_obstacle_in_its_lane():
    stop = np.full((2, 3), NO_GAP)
    stop[0, 1] = 35
    scene = quality.road([(0, 10, 1), (300, 10, 1)], stop=stop, steps=STEPS)
    plan = DRIVE(scene, default(2))
    assert not plan.crashed.any()
    assert plan.s[0, -1] < 35 and plan.v[0, -1] < 4
    beside = DRIVE(scene, default(2).at[0, :2].set(Meta.LEFT))  # the next lane is free
    assert not beside.crashed.any() and beside.s[0, -1] > 35


def test_collisions_between_samples_and_their_loss():
    # 30 m/s faster: it is through the other one within a decision, and beside it at no end of a decision
    scene = quality.road([(0, 14, 0), (-26, 44, 0)], lanes=1, v0=44, steps=STEPS)
    scene = scene._replace(driver=replace(scene.driver, b_max=jnp.asarray([8.0, 1e-3]), b=jnp.full(2, 1e-3)))
    plan = DRIVE(scene, jnp.zeros((2, 3), jnp.int32))
    assert plan.crashed.all()
    assert plan.reward[1] < plan.reward[0] < 0


# ---- the search


def the_best(settings, scenes):
    """Greatest sum of utilities of any plan."""
    every = quality.sequences(settings.decisions, scenes.s.shape[1])

    def of(scene):
        return jax.vmap(lambda actions: play(settings, scene, actions))(every).value.sum(-1).max()

    return jax.jit(lambda b: jax.lax.map(of, b))(scenes)


def test_one_vehicle_finds_the_best_of_all_plans():
    scenes = quality.stacked([quality.crowded(k, 1, 3, steps=STEPS) for k in range(8)])
    settings = Settings(decisions=3, simulations=2000, exploration=2.0)
    plan = jax.jit(partial(quality.decide, settings))(scenes)
    np.testing.assert_allclose(plan.value[:, 0], the_best(SHORT, scenes), atol=1e-5)
    assert (plan.visits.sum(-1) == 2000).all()
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        found = jax.jit(partial(quality.by_mctx, "puct", Settings(decisions=3, simulations=200)))(scenes)
    assert (found.reward[:, 0] < plan.reward[:, 0] + 1e-5).all()
    assert np.mean(np.isclose(found.reward[:, 0], plan.reward[:, 0], atol=1e-2)) >= 0.5

    # a good plan from before is tried first: three simulations are enough then
    few = Settings(decisions=3, simulations=3)
    again = jax.jit(jax.vmap(lambda s, p: search(few, s, p, jax.random.key(2))))(scenes, plan.action)
    np.testing.assert_allclose(again.value, plan.value, atol=1e-5)
    np.testing.assert_array_equal(shifted(jnp.asarray([[2, 3, 4]])), [[3, 4, Meta.ACCELERATE]])


PAIR = Settings(decisions=2, simulations=1000, exploration=1.5)
DECIDE = jax.jit(partial(quality.decide, PAIR))


def pairs(**kwargs):
    return quality.stacked([quality.crowded(k, 2, 3, steps=PAIR.steps, **kwargs) for k in range(8)])


def test_two_vehicles_converge_to_the_best_joint_plan():
    scenes = pairs(svo=np.pi / 4)
    best = the_best(PAIR, scenes)
    few = jax.jit(partial(quality.decide, Settings(decisions=2, simulations=6)))(scenes)
    short = [float((best - plan.value.sum(-1)).mean()) for plan in (few, DECIDE(scenes))]
    assert -1e-5 < short[1] < 0.01, short
    assert short[0] > 2 * short[1], short


def test_plans_are_reproducible_and_do_not_depend_on_order_or_company():
    scenes = pairs()
    plan, again = DECIDE(scenes), DECIDE(scenes)
    jax.tree.map(np.testing.assert_array_equal, plan, again)

    single = jax.jit(partial(search, PAIR))
    keys = jax.random.split(jax.random.key(0), 8)
    first = single(jax.tree.map(lambda x: x[0], scenes), no_plan(2, 2), keys[0])
    np.testing.assert_array_equal(first.action, plan.action[0])
    np.testing.assert_allclose(first.s, plan.s[0], rtol=1e-6)

    # in another order: other random numbers, but plans as good
    own = {f: getattr(scenes, f) for f in scenes._fields if not f.startswith(("other", "conf", "lane_w"))}
    other = DECIDE(scenes._replace(**jax.tree.map(lambda x: x[:, ::-1], own)))
    change = other.value[:, ::-1].sum(-1) - plan.value.sum(-1)
    assert np.abs(change).max() < 0.15 and np.abs(change).mean() < 0.03, change

    # what is in an empty place does not matter
    lonely = scenes._replace(active=scenes.active.at[:, 1].set(False))
    moved = lonely._replace(s=lonely.s.at[:, 1].set(lonely.s[:, 0] + 1), lane=lonely.lane.at[:, 1].set(0))
    np.testing.assert_allclose(DECIDE(lonely).value[:, 0], DECIDE(moved).value[:, 0], atol=1e-6)
    assert (DECIDE(lonely).visits[:, 1, 1:] == 0).all()


def test_prosocial_vehicles_make_room_for_a_merging_one():
    settings = Settings(simulations=50)
    run = jax.jit(partial(quality.decide, settings))
    angles = (0.0, np.pi / 3, np.pi / 2)
    loss, merging = [], []
    for svo in angles:
        plan = run(quality.stacked([quality.merge(k, svo) for k in range(64)]))
        loss.append(float(14 - plan.v[:, 1].mean()))
        merging.append(float(plan.reward[:, 0].mean()))
        assert plan.crashed.mean() < 0.05
    assert np.all(np.diff(loss) > 0.1), loss
    assert merging[0] < merging[1] and merging[0] < merging[2], merging


# ---- groups


def candidates(rows):
    """`(lane, s, v, x, y, wish)`; lanes 0 and 1 side by side lead on to 2 and 3; lane 4 is in a junction."""
    lane, s, v, x, y, wish = (np.asarray(column) for column in zip(*rows, strict=True))
    successors = np.asarray([[2, -1], [3, 4], [-1, -1], [-1, -1], [-1, -1]])[lane]
    left, right = np.asarray([1, -1, 3, -1, -1])[lane], np.asarray([-1, 0, -1, 2, -1])[lane]
    return Vehicles(
        active=jnp.ones(len(rows), bool), lane=jnp.asarray(lane), s=jnp.asarray(s, float),
        v=jnp.asarray(v, float), length=jnp.full(len(rows), 5.0), x=jnp.asarray(x, float),
        y=jnp.asarray(y, float), wish=jnp.asarray(wish), lane_length=jnp.full(len(rows), 100.0),
        successors=jnp.asarray(successors), left=jnp.asarray(left), right=jnp.asarray(right),
        in_junction=jnp.asarray(lane == 4),
    )  # fmt: skip


@pytest.mark.parametrize(
    "one, other, yes",
    [
        ((0, 10, 10, 0, 0, 0), (0, 53, 1, 900, 0, 0), True),  # 38 m ahead, less than 3.5 * 10 + 5
        ((0, 10, 10, 0, 0, 0), (0, 56, 1, 900, 0, 0), False),
        ((0, 10, 1, 0, 0, 0), (0, 53, 10, 900, 0, 0), False),  # the rear one is slow
        ((0, 90, 10, 0, 0, 0), (2, 30, 1, 900, 0, 0), True),  # over the end of the lane
        ((0, 90, 10, 0, 0, 0), (3, 30, 1, 900, 0, 0), False),
        ((1, 90, 10, 0, 0, 0), (4, 30, 1, 900, 0, 0), True),  # second successor
        ((0, 50, 10, 0, 0, 1), (1, 58, 10, 900, 0, 0), True),  # side by side, one wants over
        ((0, 50, 10, 0, 0, -1), (1, 58, 10, 900, 0, 0), False),
        ((0, 50, 10, 0, 0, 0), (1, 58, 10, 900, 0, -1), True),
        ((0, 50, 10, 0, 0, 1), (1, 63, 10, 900, 0, 0), False),
        ((4, 0, 10, 0, 0, 0), (0, 0, 10, 12, 15, 0), True),  # 19.2 m from one in the junction
        ((4, 0, 10, 0, 0, 0), (0, 0, 10, 13, 16, 0), False),
    ],
)
def test_interactions(one, other, yes):
    found = np.asarray(interactions(candidates([one, other])))
    np.testing.assert_array_equal(found, [[False, yes], [yes, False]])
    off = candidates([one, other])._replace(active=jnp.asarray([True, False]))
    assert not interactions(off).any()


def by_loop(interacts, score, active, groups, size):
    free, rows = set(np.flatnonzero(active)), []
    for _ in range(groups):
        members, near = [], set()
        for _ in range(size):
            pool = free & near if members else free
            best = min(pool, key=lambda i: (score[i], i), default=-1)
            members.append(best)
            if best >= 0:
                free.discard(best)
                near |= set(np.flatnonzero(interacts[best]))
        rows.append(members)
    return rows


def test_groups_are_those_of_a_loop():
    random = np.random.default_rng(0)
    form = jax.jit(lambda i, s, a: group(i, s, a, 12))
    for _ in range(20):
        links = random.random((12, 12)) < 0.15
        links = (links | links.T) & ~np.eye(12, dtype=bool)
        score, active = random.integers(0, 9, 12).astype(np.float32), random.random(12) < 0.8
        found = np.asarray(form(links, score, active))
        assert found.tolist() == by_loop(links, score, active, 12, 3)
        members = found[found >= 0]
        assert sorted(members) == np.flatnonzero(active).tolist()
