"""Perception of a recorded world against the truth: worlds whose scores are known by hand."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.api.map import load_map
from limsim_jax.api.perception import AHEAD, DISTANCES, OVERLAPS, SAMPLE, judged
from limsim_jax.api.world import World
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.objects import Detector
from limsim_jax.sensors.rig import Lidar, Rig
from limsim_jax.simulation.trace import Trace

T, DT = 61, 0.1
EGO, STEADY, FASTER, LEAVES, HIDDEN, FAR = range(6)
N = FAR + 1
LIDAR = Lidar(z=0.8, elevations=(-0.02, 0.0, 0.02), columns=720)
EXACT = Detector(lidar=LIDAR).without_errors()
TIME = DT * np.arange(1, T + 1)


@pytest.fixture(scope="module")
def world():
    """All drive along x. STEADY is ahead at the speed of the ego, with HIDDEN right before it.

    FASTER comes from behind on the left and accelerates by 1 m/s^2. LEAVES stands on the right until it goes.
    FAR is out of reach.
    """
    network, lane_map = bundled("intersection")
    v = np.zeros((T, N), np.float32)
    v[:, [EGO, STEADY, HIDDEN]] = 6.0
    v[:, FASTER] = 5.0 + 1.0 * TIME
    x = np.zeros((T, N))
    x[:, EGO], x[:, STEADY], x[:, HIDDEN] = 6 * TIME, 6 * TIME + 15, 6 * TIME + 21
    x[:, FASTER], x[:, LEAVES], x[:, FAR] = 5 * TIME + 0.5 * TIME**2 - 12, 25.0, 300.0
    y = np.zeros((T, N)) + np.array((0.0, 0.0, 3.5, -3.5, 0.0, 0.0))
    size = np.broadcast_to((4.6, 1.8), (T, N, 2)).copy()
    size[:, STEADY] = 8.0, 2.5
    size[:, HIDDEN] = 3.0, 1.2
    box = np.concatenate([np.stack([x, y, 0 * x], -1), size], -1).astype(np.float32)
    active = np.ones((T, N), bool)
    active[30:, LEAVES] = False
    whole, zero = np.zeros((T, N), np.int32), np.zeros((T, N), np.float32)
    fields: dict[str, Any] = dict(
        time=TIME.astype(np.float32), active=active, vehicle=whole + np.arange(N, dtype=np.int32), lane=whole,
        s=zero, d=zero, v=v, a=zero, box=box, status=whole, vehicle_class=whole,
        phase=np.zeros((T, lane_map.signals.duration.shape[0]), np.int32),
    )  # fmt: skip
    return World("scene", "policy", 0, EGO, load_map(network), Trace(**fields), {}, [])


def seen_of(film, k, slot):
    """The row of a vehicle in a list, or None."""
    rows = np.flatnonzero(film.objects.there[k] & (film.objects.id[k] == slot))
    return rows[0] if rows.size else None


@pytest.mark.engine
def test_what_is_seen_exactly_is_found_exactly(world):
    found = world.perception(detector=EXACT)
    assert found.looks == 13  # 0.1 s, and every half a second to 6 s
    assert found.ap_distance == {
        at: pytest.approx(1) for at in DISTANCES
    } and found.map_distance == pytest.approx(1)
    assert found.ap_iou == {at: pytest.approx(1) for at in OVERLAPS}
    assert (found.mota, found.motp, found.recall, found.precision) == (1, pytest.approx(0, abs=1e-4), 1, 1)
    assert found.misses == found.false == found.switches == 0
    # STEADY and FASTER in all looks, LEAVES until 3 s; HIDDEN and FAR never
    assert found.bodies == 2 * 13 + 7
    # constant velocity is right for all but FASTER, which is 0.5 a t^2 further on
    assert (
        found.ade == found.true_ade
        and found.fde == found.true_fde
        and found.miss_rate == found.true_miss_rate
    )
    ahead = np.arange(1, 7) * SAMPLE
    off, ends, kinds = [], [], []
    for at in film_times():
        left = ahead[at + ahead <= TIME[-1] + 1e-6]
        if left.size:
            off.append(np.mean(0.5 * left**2))
            ends.append(0.5 * left[-1] ** 2)
        kinds += [0.0] * (left.size > 0)  # STEADY
    kinds += [0.0] * sum(at + SAMPLE <= 3.0 + 1e-6 for at in film_times())  # LEAVES while it is there
    count = len(off) + len(kinds)
    assert found.ade == pytest.approx(sum(off) / count, abs=2e-3)
    assert found.fde == pytest.approx(sum(ends) / count, abs=2e-3)
    assert found.miss_rate == pytest.approx(sum(e > 2 for e in ends) / count)
    assert AHEAD == 3.0


def film_times():
    return [0.1, *np.arange(1, 13) * 0.5]


@pytest.mark.engine
def test_a_late_list_costs_its_age_times_the_speed(world):
    late = dataclasses.replace(EXACT, latency=0.4)
    found = world.perception(detector=late, every=1.0)
    film = world.film(Rig(lidar=LIDAR), detector=late, every=1.0)
    k = 4  # at 4 s: seen at 3.6 s, when it was 2.4 m further back
    row = seen_of(film, k, STEADY)
    assert film.objects.x[k, row] == pytest.approx(15 - 6 * 0.4, abs=1e-3)
    assert found.true_ade < found.ade
    # of STEADY all places are 2.4 m off: no match within 2 m, a match within 4 m
    assert found.ap_distance[2.0] < 0.7 < found.ap_distance[4.0]
    assert 0 < found.recall < 1 and found.misses == found.false > 0


@pytest.mark.engine
def test_scores_are_those_of_loops_over_the_film(world):
    rough = Detector(lidar=LIDAR, position_noise=0.6, misses=0.2, false_tracks=1.0, speed_noise=0.5)
    faults = Faults(position_drift=0.3)
    options = {"detector": rough, "every": 0.2, "faults": faults}
    found = world.perception(**options)
    film = world.film(Rig(lidar=LIDAR), **options)
    lists, truth = judged(film)
    matches, entries, bodies = 0, int(np.sum(lists.there)), int(np.sum(truth.there))
    for k in range(len(film)):
        # lists are so sparse that the nearest entry within 2 m is the only one
        free = set(np.flatnonzero(lists.there[k]))
        for j in np.flatnonzero(truth.there[k]):
            near = {i: math.hypot(lists.x[k, i] - truth.x[k, j], lists.y[k, i] - truth.y[k, j]) for i in free}
            best = min(near, key=lambda i: near[i], default=None)
            if best is not None and near[best] <= 2:
                free.remove(best)
                matches += 1
    assert (found.bodies, found.misses, found.false) == (bodies, bodies - matches, entries - matches)
    assert found.recall == pytest.approx(matches / bodies) and found.precision == pytest.approx(
        matches / entries
    )
    assert 0.5 < found.recall < 0.95 and found.false > 5
    ade, fde = [], []
    for k, step in enumerate(film.step):
        px, py, h = film.objects.pose.x[k], film.objects.pose.y[k], film.objects.pose.heading[k]
        for i in np.flatnonzero(lists.there[k]):
            slot = film.objects.id[k, i]
            off = []
            for n in range(1, 7):
                later = step + 5 * n
                if (
                    slot >= 0
                    and later < T
                    and world.trace.active[later, slot]
                    and world.trace.active[step, slot]
                ):
                    x = film.objects.x[k, i] + film.objects.vx[k, i] * 0.5 * n
                    y = film.objects.y[k, i] + film.objects.vy[k, i] * 0.5 * n
                    wx = px + math.cos(h) * x - math.sin(h) * y
                    wy = py + math.sin(h) * x + math.cos(h) * y
                    off.append(math.dist((wx, wy), world.trace.box[later, slot, :2]))
            if off:
                ade.append(np.mean(off))
                fde.append(off[-1])
    assert found.ade == pytest.approx(np.mean(ade), rel=1e-4)
    assert found.fde == pytest.approx(np.mean(fde), rel=1e-4)
    assert found.miss_rate == pytest.approx(np.mean(np.array(fde) > 2), abs=1e-6)
    assert found.true_ade < found.ade  # perception has its share
    columns = found.columns()
    assert columns["ap_0.5m"] == found.ap_distance[0.5] and columns["ap_iou_0.7"] == found.ap_iou[0.7]
    assert columns["ap_0.5m"] < columns["ap_4m"] and columns["ap_iou_0.7"] < columns["ap_iou_0.3"]
    assert found.table().num_rows == len(columns) and "mota" in repr(found)
    assert world.perception(**options) == found


@pytest.mark.engine
def test_nothing_to_judge_is_nan_and_bad_numbers_are_refused(world):
    alone = dataclasses.replace(
        world, trace=world.trace._replace(active=world.trace.active & (np.arange(N) == EGO))
    )
    found = alone.perception(detector=EXACT)
    assert found.bodies == 0
    assert all(
        math.isnan(x) for x in (found.mota, found.recall, found.precision, found.ade, found.map_distance)
    )
    with pytest.raises(ValueError, match="reach: 0 m; expected more than 0"):
        world.perception(reach=0)
    near = world.perception(detector=EXACT, reach=10.0)
    assert 0 < near.bodies < 20  # STEADY is 15 m ahead
