"""All metrics of an ego together: episodes with known answers, and what must not matter."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ego_records import DT, FLAGS, LENGTH, PER_VEHICLE, WIDTH, as_steps, free, record

from limsim_jax.metrics.blame import ContactType, Responsibility
from limsim_jax.metrics.ego import NAMES, EgoMetrics
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import NONE
from limsim_jax.metrics.step import EgoStep

METRICS = EgoMetrics(DT)

TRACES = []


@jax.jit
def one(steps: EgoStep):
    """Results, and those with a reference progress of 40 m."""
    TRACES.append(1)
    carry = METRICS.init(steps.active.shape[1], steps.zones.id.shape[1])
    carry, _ = jax.lax.scan(lambda c, s: (METRICS.update(c, s), None), carry, steps)
    return METRICS.result(carry), METRICS.result(carry, jnp.float32(40.0))


many = jax.jit(jax.vmap(lambda steps: one(steps)[0]))

STEPS, SLOTS = 81, 4


def measure(r, *, reference=False) -> dict[str, Any]:
    """Short episodes go on without an active ego, among empty slots: one program serves them all."""
    steps, n = r["active"].shape
    rest, lacking = STEPS - steps, SLOTS - n
    r = {k: np.concatenate([x, np.repeat(x[-1:], rest, 0)]) for k, x in r.items()}
    r["active"][steps:, r["slot"][0]] = False
    for flag in FLAGS:
        r[flag][steps:] = flag != "arrived"
    r["t"][steps:] += DT * np.arange(1, rest + 1)
    for name in PER_VEHICLE:
        fill = np.zeros((STEPS, lacking, *r[name].shape[2:]), r[name].dtype)
        r[name] = np.concatenate([r[name], fill], 1)
    found = jax.device_get(one(as_steps(r)))[reference]
    assert all(np.isfinite(x.value) for x in found.values())
    return on_host(found)


# --- episodes with known answers -----------------------------------------------------------------------


@pytest.mark.engine
def test_a_free_drive():
    arrived = np.arange(61) == 60
    found = measure(free(arrived=arrived))
    assert set(found) == set(NAMES)
    expected = {
        "arrived": 1.0, "success": 1.0, "completion": 1.0, "completion_time": 6.0, "duration": 6.0,
        "mean_speed": 10.0, "contacts": 0.0, "at_fault_contacts": 0.0, "near_misses": 0.0, "ttc_exposed": 0.0,
        "speeding": 0.0, "overspeed": 0.0, "max_overspeed": 0.0, "off_road": 0.0, "off_route": 0.0,
        "against_flow": 0.0, "wrong_way": 0.0, "red_lights": 0.0, "stop_signs": 0.0, "max_jerk": 0.0,
        "rss_longitudinal": 0.0, "rss_lateral": 0.0, "rss_no_response": 0.0, "comfortable": 1.0,
        "nuplan_no_at_fault_collisions": 1.0, "nuplan_drivable_area": 1.0, "nuplan_driving_direction": 1.0,
        "nuplan_making_progress": 1.0, "nuplan_ttc": 1.0, "nuplan_speed_limit": 1.0, "nuplan_comfort": 1.0,
        "carla_score": 100.0, "carla_penalty": 1.0, "limsim_faithful_comfort": 1.0,
        "limsim_faithful_safety": 1.0, "limsim_corrected_comfort": 1.0, "limsim_corrected_safety": 1.0,
    }  # fmt: skip
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-3), name
    assert found["distance"] == found["progress"] == pytest.approx(60.0, abs=1e-3)
    absent = {k for k, x in found.items() if x is None}
    assert absent == {
        "min_ttc", "min_ttc_time", "min_ttc_1d", "min_ttc_2d", "min_thw", "max_drac", "max_drac_time",
        "min_pet", "min_pet_time", "min_distance", "rss_first_time", "contact_time", "contact_other",
        "contact_type", "contact_at_fault", "contact_responsibility", "contact_delta_v", "max_delta_v",
        "off_road_time", "red_light_time", "policy_failed_time", "min_ttc_other", "max_drac_other",
        "near_miss_ttc", "near_miss_time", "near_miss_other",
    }  # fmt: skip
    # without traffic the limit is the reference: 10 of 15 m/s
    assert found["limsim_faithful_efficiency"] == pytest.approx(10 / 15, rel=1e-4)
    assert found["limsim_faithful_total"] == pytest.approx(75 + 25 * 10 / 15, rel=1e-4)
    assert found["nuplan_progress"] == pytest.approx(10 / 15, rel=0.02)


@pytest.mark.engine
def test_not_there_nothing_measured():
    r = free(30)
    r["active"][:, 0] = False
    found = measure(r)
    assert {k for k, x in found.items() if x is not None} == set()


def test_completion_and_progress():
    found = measure(free(31))  # 3 s
    assert found["arrived"] == found["success"] == 0.0
    assert found["progress"] == found["distance"] == pytest.approx(30.0, abs=1e-3)
    assert found["completion"] == pytest.approx(0.15, abs=1e-5)
    assert found["completion_time"] is None
    assert found["duration"] == pytest.approx(3.0)
    assert found["carla_score"] == pytest.approx(15.0, abs=1e-3)
    assert found["nuplan_progress"] == pytest.approx(30 / 45, abs=1e-3)  # 3 s at the limit of 15 m/s
    assert found["limsim_faithful_total"] == pytest.approx(0.15 * found["limsim_faithful_drive"], rel=1e-4)
    assert found["limsim_faithful_drive"] == pytest.approx(0.6 * (75 + 25 * 10 / 15), rel=1e-4)
    assert found["limsim_corrected_drive"] == pytest.approx(75 + 25 * 10 / 15, rel=1e-4)


def test_progress_beyond_the_goal_is_not_more_than_all():
    found = measure(free(to_go=50.0 - np.arange(61.0)))
    assert found["completion"] == 1.0 and found["progress"] == pytest.approx(60.0)


def test_a_start_alone_has_no_mean_speed():
    r = free(30)
    r["active"][1:, 0] = False
    found = measure(r)
    assert found["duration"] == 0.0 and found["mean_speed"] is found["nuplan_score"] is None


def test_half_a_metre_off_the_route():
    found = measure(free(v=0.1, on_route=np.zeros(61, bool)))
    assert found["distance"] == pytest.approx(0.6) and found["off_route"] == pytest.approx(1.0)


def test_a_given_reference_counts_for_nuplan():
    found = measure(free(31), reference=True)
    assert found["nuplan_progress"] == pytest.approx(0.75, abs=1e-4)
    assert found["nuplan_score"] == pytest.approx((5 * 0.75 + 11) / 16, abs=1e-4)


def closing(steps=31, **changes):
    """A leader at 5 m/s, 30 m ahead of the ego at 10 m/s: TTC 6 s at first, 15 m and 3 s at the end."""
    r = record(steps, (0, 0, 0, 10.0), [(35, 0, 0, 5.0)])
    gap = 30.0 - 5.0 * DT * np.arange(steps)
    return r | {"lead": np.ones(steps, np.int32), "lead_gap": gap} | changes


def test_a_leader_that_comes_nearer():
    found = measure(closing())
    assert found["min_ttc"] == found["min_ttc_1d"] == pytest.approx(3.0, abs=1e-4)
    assert found["min_ttc_2d"] == pytest.approx(3.0, abs=1e-4)
    assert found["min_ttc_time"] == pytest.approx(6.0)  # 3 s after the start at 3 s
    assert found["min_thw"] == pytest.approx(1.5, abs=1e-4)
    assert found["max_drac"] == pytest.approx(25 / 30, rel=1e-4)
    assert found["max_drac_time"] == pytest.approx(6.0)
    assert found["min_distance"] == pytest.approx(15.0, abs=1e-4)
    # RSS: 10 * 0.5 + 0.25 + 11^2 / 8 - 25 / 16 = 18.8125 m, from the step at 2.3 s on: 8 of 30
    assert found["rss_longitudinal"] == pytest.approx(8 / 30, abs=1e-5)
    assert found["rss_first_time"] == pytest.approx(5.3, abs=1e-4)
    # half a second to respond: not braking from the sixth step on
    assert found["rss_no_response"] == pytest.approx(3 / 30, abs=1e-5)
    braking = np.where(np.arange(31) > 27, -4.0, 0.0)
    assert measure(closing(a=braking))["rss_no_response"] == 0.0
    # the TTC is below 3 s from 3.1 s on
    assert measure(closing(41))["ttc_exposed"] == pytest.approx(10 * DT, abs=1e-4)
    # the step in which it starts has no duration
    near = record(21, (0, 0, 0, 10.0), [(0, 0, 0, 0.0)])
    near["box"][:, 1, 0] = near["box"][:, 0, 0] + LENGTH + 20.0
    assert measure(near)["ttc_exposed"] == pytest.approx(2.0, abs=1e-4)


def test_vehicles_that_are_not_relevant_or_not_active_are_not_met():
    r = closing(lead=np.full(31, -1, np.int32))
    r["relevant"][:, 1] = False
    found = measure(r)
    assert found["min_ttc"] is None and found["nuplan_ttc"] == 1.0
    assert found["min_distance"] == pytest.approx(15.0, abs=1e-4)  # a distance it is
    r["changing"][10, 0] = True  # then the ego leaves its lane for a moment
    assert measure(r)["min_ttc_2d"] == pytest.approx(measure(closing())["min_ttc_2d"] + 2.0, abs=1e-3)
    r = closing()
    r["active"][:, 1] = False
    found = measure(r)
    assert found["min_ttc"] is found["min_thw"] is found["min_distance"] is None


def test_a_collision_course_is_one_along_the_lanes_too():
    """Boxes on straight lines meet; paths do not."""
    crossing = [(25.0, -25.0, np.pi / 2, 10.0)]  # where the ego is after 2.5 s
    r = record(20, (0, 0, 0, 10.0), crossing)
    assert measure(r)["min_ttc"] < 0.5 and measure(r)["min_ttc_other"] == 1.0
    apart = {k: x.copy() for k, x in r.items()}
    apart["meets"][:, 1] = NONE
    assert measure(apart)["min_ttc"] is None and measure(apart)["near_misses"] == 0.0
    apart["changing"][:] = True  # a lane change is one of the paths
    assert measure(apart)["min_ttc"] is None
    far = record(3, (0, 0, 0, 10.0), [(100.0, -100.0, np.pi / 2, 10.0)])
    far["meets"][:, 1] = NONE
    assert measure(far)["min_ttc"] > 5.0  # so far ahead paths are not followed


@pytest.mark.parametrize(("along", "ttc"), [(0.25, 0.25), (1.9, 1.9), (4.9, 4.9), (5.5, None)])
def test_the_later_of_two_times_counts(along, ttc):
    """A neighbour comes nearer at 1 m/s on a straight line; it is abreast 0.1 s away."""
    r = record(2, (0, 0, 0, 10.0), [(0, -2.1, np.arctan(0.1), np.hypot(10.0, 1.0))])
    r["velocity"][:, 1] = [10.0, 1.0]
    r["box"][:, 1, :3] = r["box"][:, 0, :3] - np.array([0, 2.1, 0])
    assert measure(r)["min_ttc"] == pytest.approx(0.1, abs=1e-3)
    r["meets"][:, 1] = r["t"][-1] + along
    found = measure(r)["min_ttc"]
    assert found is None if ttc is None else found == pytest.approx(ttc, abs=1e-3)


@pytest.mark.parametrize(
    ("speed", "way", "near"), [(4.0, 10.0, 0.0), (8.0, 11.5, 0.0), (14.0, 10.0, 1.0), (6.0, 3.0, 1.0)]
)
def test_a_vehicle_that_closes_up_calmly_behind_a_standing_ego_is_no_near_miss(speed, way, near):
    """It brakes over `way` m and stops half a metre behind; only the first ones brake calmly."""
    a = speed**2 / (2 * way)  # m/s^2
    v = np.maximum(speed - a * DT * np.arange(61), 0.0)
    stop = float(np.sum(v[1:]) * DT)
    r = record(61, (0, 0, 0, 0.0), [(-stop - 0.5 - LENGTH, 0, 0, v)])
    assert measure(r)["near_misses"] == 1.0
    r["follows"][:, 1] = True
    found = measure(r)
    assert found["near_misses"] == near and found["contacts"] == 0.0


def test_less_than_a_metre_is_not_taken_for_one():
    """With 1.5 m/s and 0.3 m left a vehicle has to brake with 3.75 m/s^2, with 1 m left with 1.1."""
    v = np.maximum(1.5 - 4.5 * DT * np.arange(61), 0.0)
    stop = float(np.sum(v[1:]) * DT)
    r = record(61, (0, 0, 0, 0.0), [(-0.3 - LENGTH, 0, 0, v)])
    assert stop < 0.25
    r["follows"][:, 1] = True
    assert measure(r)["near_misses"] == 1.0


@pytest.mark.parametrize(
    ("speed", "way", "near"), [(4.0, 10.0, 0.0), (8.0, 11.5, 0.0), (14.0, 10.0, 1.0), (6.0, 3.0, 1.0)]
)
@pytest.mark.parametrize("leader", [False, True])
def test_an_ego_that_closes_up_calmly_behind_a_standing_vehicle_has_no_near_miss(speed, way, near, leader):
    """As the test before with the roles swapped; its time to collision is measured all the same."""
    v = np.maximum(speed - speed**2 / (2 * way) * DT * np.arange(61), 0.0)
    stop = float(np.sum(v[1:]) * DT)
    r = record(61, (0, 0, 0, v), [(stop + 0.5 + LENGTH, 0, 0, 0.0), (500.0, 0, 0, 10.0)])
    assert measure(r)["near_misses"] == 1.0
    r["leads"][:, 1:] = True
    if leader:  # the gap along the lane counts too
        r["lead"][:] = 1
        r["lead_gap"] = r["box"][:, 1, 0] - r["box"][:, 0, 0] - LENGTH
    found = measure(r)
    assert found["near_misses"] == near and found["min_ttc"] < 1.5
    assert found["near_miss_other"] == (1.0 if near else None)
    if near:
        assert found["near_miss_ttc"] < 1.5 and found["near_miss_time"] > r["t"][0]


def test_a_vehicle_that_touches_is_met_wherever_it_is_going():
    r = record(31, (0, 0, 0, 20.0), [(30, 0, 0, 0.0)])  # it would be through the other in half a second
    assert measure(r)["contacts"] == 1.0
    for name, value in (("relevant", False), ("meets", NONE), ("follows", True)):
        r[name][:, 1] = value
    found = measure(r)
    assert found["contacts"] == 1.0 and found["min_ttc"] == 0.0 and found["min_ttc_other"] == 1.0
    assert found["min_ttc_time"] == found["contact_time"]


def test_it_does_not_matter_in_which_slots_the_ego_and_its_leader_are():
    r = record(31, (0, 0, 0, 12.0), [(60, 0, 0, 8.0)], lead=np.full(31, 1, np.int32))
    r["lead_gap"] = r["box"][:, 1, 0] - r["box"][:, 0, 0] - LENGTH
    swapped = {name: x[:, ::-1] if name in PER_VEHICLE else x for name, x in r.items()}
    swapped |= {"slot": np.full(31, 1, np.int32), "lead": np.full(31, 0, np.int32)}
    found, expected = measure(swapped), measure(r)
    assert expected["min_ttc_1d"] == pytest.approx((55 - 4 * 3) / 4)
    for name in ("min_ttc_other", "max_drac_other"):
        assert (found.pop(name), expected.pop(name)) == (0, 1)
    assert found == expected


def test_a_vehicle_that_is_left_behind_is_as_far_away_as_it_is():
    r = record(31, (0, 0, 0, 9.0), [(-12.0, 0, 0, 2.0)])
    assert measure(r)["min_distance"] == pytest.approx(12.0 - LENGTH, abs=1e-4)


@pytest.mark.parametrize(("v", "response"), [(0.0, False), (0.2, True)])
def test_an_ego_that_stands_too_near_need_not_brake(v, response):
    r = record(31, (0, 0, 0, v), [(LENGTH + 0.2, 0, 0, v)], lead=np.ones(31, np.int32))
    found = measure(r | {"lead_gap": np.full(31, 0.2)})
    assert found["rss_longitudinal"] == 1.0 and (found["rss_no_response"] > 0.5) == response
    assert response or found["rss_no_response"] == 0.0


def test_near_misses_are_episodes():
    """A crossing car, twice a short TTC in between a longer one; the second time it oscillates."""
    v = np.full(61, 10.0)
    ttc = np.concatenate(
        [np.linspace(5, 1.2, 15), np.linspace(1.4, 4, 15), [1.45, 1.6, 1.4, 1.9, 1.3] * 6, [4.0]]
    )
    r = record(61, (0, 0, 0, v), [(0, 0, 0, 0.0)])
    r["box"][:, 1, 0] = r["box"][:, 0, 0] + ttc * 10 + LENGTH
    found = measure(r)
    assert found["near_misses"] == 2.0
    assert found["min_ttc"] == pytest.approx(1.2, abs=1e-3)
    assert found["min_ttc_1d"] is None
    assert found["nuplan_ttc"] == 1.0
    # a contact is no near miss; by the ego's fault it is a TTC of 0 to nuPlan
    r["box"][55, 1, 0] = r["box"][55, 0, 0] + LENGTH - 0.1
    found = measure(r)
    assert (found["near_misses"], found["contacts"], found["nuplan_ttc"]) == (1.0, 1.0, 0.0)


def test_each_near_miss_has_its_own_contacts():
    """Two vehicles come close one after the other, and both are hit: neither is a near miss."""
    r = record(61, (0, 0, 0, 10.0), [(0, 0, 0, 0.0)] * 2)
    x = r["box"][:, 0, 0]
    ttc = np.full((61, 2), 5.0)
    ttc[5:16, 0] = ttc[40:51, 1] = 1.0
    r["box"][:, 1:, 0] = x[:, None] + 10 * ttc + LENGTH
    assert measure(r)["near_misses"] == 2.0
    for k, step in ((0, 12), (1, 45)):
        r["box"][step, k + 1, 0] = x[step] + LENGTH - 0.1
    found = measure(r)
    assert (found["contacts"], found["near_misses"]) == (2.0, 0.0)


def test_a_near_miss_with_contacts_is_none():
    """Two are hit one after the other while the TTC to a third stays at 1 s."""
    far, x = record(41, (0, 0, 0, 10.0), [(0, 0, 0, 0.0)] * 3), LENGTH + 10.0
    far["box"][:, 1:, 1] = 50.0, -50.0, 100.0
    far["box"][:, 3, :2] = far["box"][:, 0, :2] + np.array([x, 0.0])
    assert measure(far)["near_misses"] == 1.0
    for k, step in ((1, 10), (2, 14)):
        far["box"][step, k, :2] = far["box"][step, 0, :2] + np.array([0.0, WIDTH])
    found = measure(far)
    assert (found["contacts"], found["near_misses"]) == (2.0, 0.0)


def test_a_contact():
    r = closing(81)
    r["lead_gap"] = np.maximum(r["lead_gap"], 0.0)
    found = measure(r)
    expected = {
        "contacts": 1.0, "at_fault_contacts": 1.0, "contact_time": 9.0, "contact_other": 1.0,
        "contact_type": ContactType.FRONT, "contact_at_fault": 1.0, "contact_delta_v": 2.5,
        "contact_responsibility": Responsibility.EGO, "max_delta_v": 2.5, "near_misses": 0.0, "min_ttc": 0.0,
        "success": 0.0, "nuplan_no_at_fault_collisions": 0.0, "nuplan_score": 0.0, "nuplan_ttc": 0.0,
        "carla_penalty": 0.6, "ttc_exposed": 3.0,
    }  # fmt: skip
    for name, value in expected.items():
        assert found[name] == pytest.approx(float(value), abs=1e-3), name
    parts = ("comfort", "efficiency", "safety")
    for version in ("faithful", "corrected"):
        c, e, s = (found[f"limsim_{version}_{part}"] for part in parts)
        assert found[f"limsim_{version}_drive"] == pytest.approx(60 * (c / 4 + e / 4 + s / 2), rel=1e-4)


def test_a_contact_at_the_fault_of_the_other_vehicle():
    r = record(61, (0, 0, 0, 5.0), [(-20, 0, 0, 12.0)], arrived=np.arange(61) == 60)
    found = measure(r)
    assert (found["contacts"], found["at_fault_contacts"], found["success"]) == (1.0, 0.0, 0.0)
    assert Responsibility(int(found["contact_responsibility"])) == Responsibility.OTHER
    assert found["nuplan_no_at_fault_collisions"] == found["nuplan_ttc"] == 1.0  # it comes from behind
    assert found["nuplan_score"] > 0.7
    assert found["carla_penalty"] == pytest.approx(0.6)  # CARLA asks only whether the ego stands
    assert found["limsim_faithful_drive"] < 0.7 * found["limsim_corrected_drive"]


@pytest.mark.parametrize(
    ("y", "changing", "junction", "kept"),
    [
        (0.0, False, False, 0.0),
        (-12.0, False, False, 1.0),
        (-12.0, True, False, 0.0),
        (-12.0, False, True, 0.0),
    ],
)
def test_nuplans_ttc_looks_ahead_and_in_junctions_aside(y, changing, junction, kept):
    """A car that comes from the right, 72 degrees off the heading, or stands ahead; ever 0.6 s away."""
    steps = 31
    if y:
        r = record(steps, (0, 0, 0, 10.0), [(2.5, y, np.pi / 2, 0.0)])
        r["box"][:, 1, :2] = r["box"][:, 0, :2] + np.array([2.5, y])
        r["velocity"][:, 1] = [10.0, 14.0]  # 8.5 m to the ego's side
    else:
        r = record(steps, (0, 0, 0, 10.0), [(11.0, 0, 0, 0.0)])
        r["box"][:, 1, 0] = r["box"][:, 0, 0] + 11.0
    r["changing"][:, 0] = changing
    r["in_junction"] = np.full(steps, junction)
    found = measure(r)
    assert found["min_ttc"] == pytest.approx(8.5 / 14 if y else 0.6, rel=1e-3)
    assert found["min_distance"] == pytest.approx(8.5 if y else 6.0, rel=1e-4)  # near in time is no touch
    assert found["nuplan_ttc"] == kept


@pytest.mark.parametrize(
    ("v", "relevant", "kept"), [(0.01, True, 0.0), (0.01, False, 1.0), (9.0, False, 1.0)]
)
def test_nuplans_ttc_is_of_vehicles_that_may_meet_an_ego_that_moves(v, relevant, kept):
    r = record(31, (0, 0, 0, v), [(11.0, 0, 0, 0.0)])
    r["box"][:, 1, 0] = r["box"][:, 0, 0] + 11.0
    r["velocity"][:, 1] = [v - 10.0, 0.0]
    r["relevant"][:, 1] = relevant
    assert measure(r)["nuplan_ttc"] == kept


@pytest.mark.parametrize(("x", "v"), [(-11.0, 10.0), (11.0, 0.0)])
def test_nuplans_ttc_does_not_ask_for_more_than_the_ego_can_do(x, v):
    """In a junction, a vehicle 0.6 s behind; and a standing ego with a vehicle that comes from ahead."""
    r = record(31, (0, 0, 0, v), [(x, 0, 0, 0.0)], in_junction=np.ones(31, bool))
    r["box"][:, 1, 0] = r["box"][:, 0, 0] + x
    r["velocity"][:, 1] = [v - np.sign(x) * 10.0, 0.0]
    found = measure(r)
    assert found["min_ttc"] == pytest.approx(0.6, rel=1e-3)
    assert found["nuplan_ttc"] == 1.0


def test_speeding():
    v = np.where((np.arange(61) >= 20) & (np.arange(61) < 35), 17.0, 14.0)
    found = measure(free(v=v, on_lane=np.arange(61) != 30))
    assert found["speeding"] == pytest.approx(14 / 60, abs=1e-4)  # off the lanes there is no limit
    assert found["max_overspeed"] == pytest.approx(2.0)
    assert found["overspeed"] == pytest.approx(2.0 * 14 * DT, rel=1e-4)
    assert found["nuplan_speed_limit"] == pytest.approx(1 - 2.8 / (2.23 * 6), rel=1e-4)
    assert measure(free(v=17.0))["overspeed"] == pytest.approx(2.0 * 6, rel=1e-4)  # not for the start


def test_off_the_road_and_off_the_route():
    steps = np.arange(61)
    off, on_route = (steps >= 20) & (steps < 26), (steps < 40) | (steps >= 50)
    found = measure(free(off_road=off, on_route=on_route, arrived=steps == 60))
    assert found["arrived"] == 1.0
    assert found["off_road"] == pytest.approx(0.1, abs=1e-5)
    assert found["off_road_time"] == pytest.approx(5.0)
    assert found["off_route"] == pytest.approx(16 / 60, rel=1e-4)
    assert found["nuplan_drivable_area"] == found["nuplan_score"] == found["success"] == 0.0
    assert found["carla_penalty"] == pytest.approx(1 - 16 / 60, rel=1e-4)
    assert found["limsim_corrected_drive"] == pytest.approx(0.6 * (75 + 25 * 10 / 15), rel=1e-4)


def test_against_the_flow():
    heading = np.where((np.arange(61) >= 20) & (np.arange(61) < 24), np.pi, 0.0)  # four steps of 1 m
    found = measure(free(lane_heading=heading))
    assert found["wrong_way"] == pytest.approx(4 / 60, abs=1e-5)
    assert found["against_flow"] == 0.0  # within a second it drives more with the flow
    heading = np.where((np.arange(61) >= 20) & (np.arange(61) < 27), np.pi, 0.0)
    assert measure(free(lane_heading=heading))["against_flow"] == pytest.approx(3.0, abs=1e-3)  # 7 of 11
    assert measure(free(lane_heading=heading))["nuplan_driving_direction"] == 0.5
    heading = np.full(61, np.pi)
    found = measure(free(lane_heading=heading))
    assert found["against_flow"] == pytest.approx(11.0, abs=1e-3)
    assert (found["wrong_way"], found["nuplan_driving_direction"]) == (1.0, 0.0)
    assert measure(free(v=0.2, lane_heading=heading))["wrong_way"] == 1.0
    # the record of the start is no step: 5 steps of 1 m
    few = measure(free(6, lane_heading=np.full(6, np.pi)))["against_flow"]
    assert few == pytest.approx(5.0, abs=1e-3)
    # a step off the lanes neither adds nor takes away
    gap = np.arange(61) == 23
    heading = np.where((np.arange(61) >= 20) & (np.arange(61) < 27), np.pi, 0.0)
    assert measure(free(lane_heading=heading, on_lane=~gap))["against_flow"] == pytest.approx(2.0, abs=1e-3)
    # an ego that stands, or only rolls, goes nowhere
    assert measure(free(v=0.0))["wrong_way"] == measure(free(v=0.05))["wrong_way"] == 0.0
    # without a lane there is no direction
    heading = np.full(61, np.pi)
    assert measure(free(lane_heading=heading, on_lane=np.zeros(61, bool)))["against_flow"] == 0.0


def test_signals_and_signs():
    steps = np.arange(61)
    found = measure(free(red_light=(steps == 12) | (steps == 40), stop_sign=steps == 33))
    assert (found["red_lights"], found["stop_signs"]) == (2.0, 1.0)
    assert found["carla_penalty"] == pytest.approx(0.49 * 0.8)


def test_too_near_beside():
    """0.5 m apart, then 0.12 m; RSS asks for 0.1 + 2 * 0.03125 m of two that keep their lanes."""
    r = record(61, (0, 0, 0, 10.0), [(1.0, 2.5, 0, 10.0)])
    r["box"][41:, 1, 1] = 2.12
    found = measure(r)
    assert found["rss_lateral"] == pytest.approx(20 / 60, abs=1e-5)
    assert found["rss_first_time"] == pytest.approx(7.1, abs=1e-4)
    r["velocity"][:, 1, 1] = -0.8  # it comes nearer: 0.425 + 0.506 m more
    assert measure(r)["rss_lateral"] == 1.0
    r["box"][:, 1, 2] = np.pi  # oncoming traffic is judged by its own rules
    assert measure(r)["rss_lateral"] == 0.0


def test_pet_comes_from_the_zones():
    steps = np.arange(61)
    zone = np.tile(np.array([5, -1], np.int32), (61, 1))
    ego, other = np.zeros((61, 2), bool), np.zeros((61, 2), bool)
    ego[10:15, 0] = True
    other[(steps >= 27) & (steps < 30), 0] = True
    found = measure(free(zone=zone, zone_ego=ego, zone_other=other))
    assert found["min_pet"] == pytest.approx(1.2, abs=1e-4)
    assert found["min_pet_time"] == pytest.approx(5.7, abs=1e-4)


def test_an_ego_that_left_is_not_followed_by_another():
    """Its slot is taken by a car that drives against the flow into a wall."""
    r = free(61, arrived=np.arange(61) == 30)
    first = measure({k: x.copy() for k, x in r.items()})
    r["active"][30, 0] = False  # as in the engine: it is gone in the step in which it arrives
    r["v"][31:] = 30.0
    r["a"][31:] = -9.0
    r["lane_heading"][31:] = np.pi
    r["off_road"] = np.arange(61) > 30
    found = measure(r)
    assert first["completion_time"] == found["completion_time"] == pytest.approx(3.0)
    assert found["success"] == found["completion"] == 1.0
    assert found["wrong_way"] == found["off_road"] == found["max_overspeed"] == 0.0
    assert found["min_acceleration"] == pytest.approx(0.0, abs=1e-4)


def test_the_step_of_arrival_counts_in_time_and_distance():
    r = free(61, v=np.linspace(8.0, 12.0, 61), arrived=np.arange(61) == 30)
    there = measure({k: x.copy() for k, x in r.items()})
    r["active"][30:, 0] = False
    r["to_go"][30:] = 0.0
    found = measure(r)
    assert found["duration"] == there["duration"] == pytest.approx(3.0)
    assert found["distance"] == pytest.approx(r["moved"][:31].sum()) == there["distance"]
    assert found["mean_speed"] == pytest.approx(r["moved"][:31].sum() / 3.0, rel=1e-5)
    assert found["progress"] == pytest.approx(200.0)  # to the goal itself


# --- failures that end an episode early ------------------------------------------------------------------

SCORES = ("nuplan_score", "carla_score", "limsim_faithful_total", "limsim_corrected_total")


@pytest.mark.parametrize("step", [1, 4, 30])
def test_a_policy_that_breaks_is_a_failure_with_scores_of_0(step):
    r = free(61, broken=np.arange(61) >= step, arrived=np.arange(61) >= 40)
    r["v"][step:] = 99.0  # numbers of that step and later do not count
    found = measure(r)
    assert (found["policy_failed"], found["success"], found["arrived"]) == (1.0, 0.0, 0.0)
    assert found["policy_failed_time"] == pytest.approx(3.0 + step * DT, abs=1e-4)
    assert found["duration"] == pytest.approx(step * DT, abs=1e-4)
    assert found["distance"] == pytest.approx((step - 1) * DT * 10, abs=1e-3)
    assert [found[name] for name in SCORES] == [0.0] * 4
    if step > 20:
        assert found["limsim_corrected_safety"] > 0 and found["limsim_faithful_comfort"] > 0
    fine = measure(free(61))
    assert (fine["policy_failed"], fine["policy_failed_time"]) == (0.0, None)
    if step > 1:  # otherwise no step is driven
        assert {k for k, x in found.items() if x is None} < {k for k, x in fine.items() if x is None}


def test_out_of_time_is_an_ego_that_is_still_on_its_way():
    steps = np.arange(STEPS)
    assert measure(free(STEPS))["out_of_time"] == 1.0
    assert measure(free(STEPS, arrived=steps == 70))["out_of_time"] == 0.0
    assert measure(free(STEPS, broken=steps >= 70))["out_of_time"] == 0.0
    assert measure(free(STEPS, off_road=steps == 20))["out_of_time"] == 0.0  # it failed before
    assert measure(free(STEPS - 1))["out_of_time"] == 0.0  # it left elsewhere


def test_a_policy_that_breaks_as_the_ego_arrives_has_failed():
    found = measure(free(61, broken=np.arange(61) >= 30, arrived=np.arange(61) == 30))
    assert (found["policy_failed"], found["arrived"], found["success"]) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("steps", [2, 5, 9, 15])
def test_nothing_is_missing_because_the_ego_crashed_early(steps):
    """It drives into a standing car, or is hit from behind, and the episode ends within the second."""

    def crash(steps, ahead):
        r = record(61, (0, 0, 0, 10.0), [(0, 0, 0, 0.0 if ahead else 14.0)])
        r["box"][:, 1, 0] = r["box"][:, 0, 0] + (LENGTH + 0.5) * (1 if ahead else -1)
        r["box"][steps - 1 :, 1, 0] = r["box"][steps - 1 :, 0, 0] + (LENGTH - 0.2) * (1 if ahead else -1)
        r["active"][steps:, r["slot"][0]] = False
        return measure(r)

    for ahead in (True, False):
        late, early = crash(61, ahead), crash(steps, ahead)
        assert early["contacts"] == late["contacts"] == 1.0
        assert {k for k, x in early.items() if x is None} == {k for k, x in late.items() if x is None}
        if steps < 10:
            assert early["limsim_corrected_total"] == early["limsim_faithful_total"] == 0.0
            assert early["worst_second"] == 0.0
            assert early["worst_second_time"] == pytest.approx(early["contact_time"], abs=1e-4)
        assert (early["nuplan_score"] == 0.0) == ahead


def test_an_ego_that_arrives_within_its_first_second_has_no_second_to_judge():
    found = measure(free(6, arrived=np.arange(6) == 5))
    assert found["arrived"] == 1.0 and found["worst_second"] is found["limsim_corrected_total"] is None
    assert found["mean_speed"] == pytest.approx(10.0) and found["nuplan_score"] > 0
    none = measure(free(1))
    assert none["duration"] == 0.0 and none["mean_speed"] is none["nuplan_score"] is None


def test_an_ego_that_was_never_there_has_no_metrics():
    found = measure(free(STEPS, active=np.zeros((STEPS, 1), bool)))
    assert found["out_of_time"] is found["mean_speed"] is found["nuplan_score"] is None


def test_a_contact_at_the_start_is_judged():
    r = record(2, (0, 0, 0, 10.0), [(LENGTH - 0.5, 0, 0, 0.0)])
    r["active"][1:, 0] = False
    found = measure(r)
    assert (found["contacts"], found["duration"], found["nuplan_score"]) == (1.0, 0.0, 0.0)


def test_the_worst_second_is_the_one_in_which_the_ego_brakes():
    v = 14.0 - 0.6 * np.clip(np.arange(61) - 21, 0, 8)  # 6 m/s^2 in the third second
    found = measure(free(61, v=v))
    assert found["worst_second_time"] == pytest.approx(6.0, abs=1e-3)
    assert found["worst_second"] < measure(free(61))["worst_second"]


def test_carla_counts_no_contact_of_a_standing_ego_and_repeats_within_5_m_once():
    """Cars touch it one after the other, each for a step."""

    def touched(at, v=10.0):
        r = record(61, (0, 0, 0, v), [(0, 40, 0, 0.0)] * 3)
        r["box"][:, 1:, 1] = 40.0
        for k, step in enumerate(at, 1):
            r["box"][step, k, :2] = r["box"][step, 0, :2] + np.array([0.0, WIDTH - 0.1])
        found = measure(r)
        assert found["contacts"] == len(at)
        assert found["carla_penalty"] == pytest.approx(0.6 ** found["carla_collisions"], rel=1e-5)
        return found["carla_collisions"]

    assert touched([10, 20, 30]) == 3.0  # 10 m apart
    assert touched([10, 14]) == 1.0  # 4 m
    assert touched([10, 14, 17]) == 2.0  # 4 m, and 7 m from the one that counted
    assert touched([10, 20], v=0.0) == 0.0
    assert touched([10, 20], v=0.09) == 0.0 and touched([10], v=0.11) == 1.0
    # away and back: the ego has been farther than 5 m from the first place
    away = np.where(np.arange(61) < 20, 10.0, 0.0)
    r = record(61, (0, 0, 0, away), [(0, 40, 0, 0.0)] * 3)
    r["box"][:, 1:, 1] = 40.0
    r["box"][25:, 0, 0] = r["box"][10, 0, 0]
    r["velocity"][25:, 0, 0] = 1.0
    for k, step in ((1, 10), (2, 30)):
        r["box"][step, k, :2] = r["box"][step, 0, :2] + np.array([0.0, WIDTH - 0.1])
    assert measure(r)["carla_collisions"] == 2.0


def test_an_ego_that_was_lost_is_not_followed_by_another():
    r = free(61)
    r["active"][30:35, 0] = False
    r["off_road"] = np.arange(61) > 34
    found = measure(r)
    assert found["duration"] == pytest.approx(2.9) and found["distance"] == pytest.approx(29.0)
    assert found["success"] == found["off_road"] == 0.0


def test_an_ego_that_enters_late_starts_then():
    r = free(61)
    r["active"][:5, 0] = False
    r["arrived"] = np.arange(61) < 5  # of the vehicle that had the slot before
    found = measure(r)
    assert found["duration"] == pytest.approx(5.5) and found["distance"] == pytest.approx(55.0)
    assert found["arrived"] == 0.0


# --- what must not matter ------------------------------------------------------------------------------


def random_record(seed, n=9, steps=40):
    rng = np.random.default_rng(seed)
    others = [
        (*rng.uniform(-25, 25, 2), rng.uniform(-np.pi, np.pi), np.abs(rng.normal(8, 5))) for _ in range(n - 1)
    ]
    v = np.clip(10 + np.cumsum(rng.normal(size=steps)) * 0.3, 0, 16)
    r = record(steps, (0, 0, 0.4, v), others)
    r["active"][:, 1:] = rng.random((steps, n - 1)) < 0.97
    r["changing"][:] = rng.random((steps, n)) < 0.2
    r["violation"][:] = rng.random((steps, n)) < 0.1
    r["b_max"][:] = rng.uniform(5, 9, n)
    r["relevant"][:] = rng.random((steps, n)) < 0.8
    r["box"][:, :, 3] = rng.uniform(4, 9, n)
    lead = rng.integers(1, n, steps // 10).repeat(10)
    r["lead"], r["lead_gap"] = lead.astype(np.int32), rng.uniform(2, 40, steps)
    r["zone"] = np.tile(np.array([4, 9], np.int32), (steps, 1))
    r["zone_ego"], r["zone_other"] = rng.random((2, steps, 2)) < 0.2
    r["v_others"], r["others"] = rng.uniform(4, 16, steps), rng.random(steps) < 0.5
    for name in ("off_road", "red_light", "waits_at_red", "in_junction"):
        r[name] = rng.random(steps) < 0.1
    return r


def with_empty_slots(r, number=3):
    """The same record with slots at the end that hold NaN."""
    out = dict(r)
    for name in PER_VEHICLE:
        fill = np.full_like(r[name][:, :number], np.nan if r[name].dtype == float else 1)
        out[name] = np.concatenate([r[name], fill], 1)
    out["active"][:, -number:] = False
    out["b_max"][:, -number:] = 0.0
    return out


def shuffled(r, order):
    """The same record with vehicles (and zones) in other slots."""
    out = {k: x[:, order] if k in PER_VEHICLE else x for k, x in r.items()}
    place = np.argsort(order)
    out["slot"] = place[r["slot"]].astype(np.int32)
    out["lead"] = np.where(r["lead"] < 0, -1, place[r["lead"]]).astype(np.int32)
    return out | {k: r[k][:, ::-1] for k in ("zone", "zone_ego", "zone_other")}


def stack(records):
    return jax.tree.map(lambda *x: jnp.stack(x), *map(as_steps, records))


def assert_same(a, b):
    assert set(a) == set(b)
    for name in a:
        x, y = (np.asarray(value, float) for value in (a[name], b[name]))
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5, err_msg=name)


@pytest.mark.engine
def test_slots_do_not_matter():
    """Neither their order nor empty ones."""
    rng = np.random.default_rng(0)
    records = [with_empty_slots(random_record(seed)) for seed in range(12)]
    orders = [rng.permutation(12) for _ in records]
    a = on_host(many(stack(records)))
    b = on_host(many(stack([shuffled(r, order) for r, order in zip(records, orders, strict=True)])))
    slots = ("contact_other", "min_ttc_other", "max_drac_other", "near_miss_other")
    others = {name: (a.pop(name), b.pop(name)) for name in slots}
    assert_same(a, b)
    for name, (here, there) in others.items():
        for k, order in enumerate(orders):
            if not np.isnan(here[k]) and not ("contact" not in name and a["min_ttc"][k] == 0):  # of several
                assert np.argsort(order)[int(here[k])] == int(there[k]), name
        assert np.sum(~np.isnan(here)) > 3, name
    assert np.nanmin(a["min_pet"]) < 1 and np.nanmax(a["contacts"]) > 1
    empty = shuffled(records[4], np.array([*range(9, 12), *range(9)]))
    alone = random_record(4)
    assert_same(
        on_host(one(as_steps(alone))[0]) | dict.fromkeys(slots, 0),
        on_host(one(as_steps(empty))[0]) | dict.fromkeys(slots, 0),
    )


def side_by_side():
    """The ego drifts to its left, off the middle of its lane, next to another one, first 0.15 m away."""
    r = record(61, (0, 0, 0.02, 10.0), [(1.0, 2.15, 0.02, 10.0)], lane_heading=np.zeros(61))
    r["box"][30:, 1, 1] += 0.4
    return r


@pytest.mark.parametrize("make", [lambda: random_record(5, n=SLOTS), side_by_side])
def test_where_north_is_does_not_matter(make):
    """The world turned and moved as a whole."""
    r = make()
    angle, move = 2.2, np.array([31.0, -17.0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s], [-s, c]])  # of rows
    turned = {k: x.copy() for k, x in r.items()}
    turned["box"][..., :2] = r["box"][..., :2] @ turn + move
    turned["box"][..., 2] += angle
    turned["velocity"] = r["velocity"] @ turn
    turned["lane_heading"] = r["lane_heading"] + angle
    one, other = measure(r), measure(turned)
    assert one["distance"] > 20
    for name, value in one.items():
        assert other[name] == (value if value is None else pytest.approx(value, rel=1e-3, abs=2e-3)), name
    if make is side_by_side:
        assert 0 < one["rss_lateral"] < 1


@pytest.mark.engine
def test_the_size_of_the_batch_does_not_matter():
    records = [with_empty_slots(random_record(seed)) for seed in range(12)]
    batch = on_host(many(stack(records)))
    pair = on_host(many(stack([records[7], records[0]])))
    assert_same(pair, {name: value[[7, 0]] for name, value in batch.items()})
    traces = len(TRACES)
    again = on_host(many(stack([records[0], records[7]])))
    assert_same(again, {name: value[[0, 7]] for name, value in batch.items()})
    assert len(TRACES) == traces  # other worlds of the same shape are the same program
    assert_same(on_host(one(as_steps(records[7]))[0]), {name: value[7] for name, value in batch.items()})
