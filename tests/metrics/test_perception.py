"""Scores of perception against loops in NumPy, scipy and shapely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import shapely.affinity
from scipy.optimize import linear_sum_assignment

from limsim_jax.metrics.perception import (
    Boxes,
    average_precision,
    clear_mot,
    intersection_over_union,
    prediction_errors,
    within,
)

T, D, K = 12, 7, 5

_precision = jax.jit(average_precision, static_argnames=("distance", "iou"))
_mot = jax.jit(clear_mot, static_argnums=2)


def polygon(box):
    x, y, heading, length, width = box
    flat = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    return shapely.affinity.translate(
        shapely.affinity.rotate(flat, heading, origin=(0, 0), use_radians=True), x, y
    )


def episode(seed, *, noise=0.8, swaps=0.05):
    """A truth that moves, and tracks that err, get lost, are made up and change their ids."""
    rng = np.random.default_rng(seed)
    start, way = rng.uniform(-25, 25, (K, 2)), rng.normal(0, 1, (K, 2))
    place = start + way * np.arange(T)[:, None, None]
    truth = {
        "there": rng.random((T, K)) < 0.85, "id": np.tile(np.arange(K), (T, 1)), "x": place[..., 0],
        "y": place[..., 1], "heading": np.tile(rng.uniform(-3, 3, K), (T, 1)),
        "length": np.full((T, K), 4.5), "width": np.full((T, K), 1.8), "score": np.ones((T, K)),
    }  # fmt: skip
    found = {name: np.zeros((T, D)) for name in truth}
    for t in range(T):
        order = rng.permutation(D)
        for k, d in enumerate(order):
            real = k < K
            if real:
                found["x"][t, d], found["y"][t, d] = place[t, k] + rng.normal(0, noise, 2)
                found["heading"][t, d] = truth["heading"][t, k] + rng.normal(0, 0.1)
                found["there"][t, d] = truth["there"][t, k] and rng.random() < 0.85
                found["id"][t, d] = k if rng.random() > swaps else k + 100 * (t + 1)
            else:
                found["x"][t, d], found["y"][t, d] = rng.uniform(-25, 25, 2)
                found["there"][t, d], found["id"][t, d] = rng.random() < 0.3, -1 - t * D - d
    found["length"][:], found["width"][:] = 4.3, 1.9
    found["score"][:] = rng.random((T, D))
    return found, truth


def boxes(table):
    kinds = {"there": bool, "id": np.int32}
    return Boxes(**{name: jnp.asarray(x.astype(kinds.get(name, np.float32))) for name, x in table.items()})


def gap(found, truth, t, d, k):
    return np.hypot(found["x"][t, d] - truth["x"][t, k], found["y"][t, d] - truth["y"][t, k])


def ap_by_loops(found, truth, good, better):
    """nuScenes' average precision, detection by detection. `better` orders matches, `good` accepts them."""
    rows = []
    total = int(truth["there"].sum())
    for t in range(T):
        free = set(np.flatnonzero(truth["there"][t]))
        for d in sorted(np.flatnonzero(found["there"][t]), key=lambda d: -found["score"][t, d]):
            values = {k: better(t, d, k) for k in free}
            best = min(values, key=lambda k: values[k], default=None)
            hit = best is not None and bool(good(values[best]))
            if best is not None and hit:
                free.remove(best)
            rows.append((found["score"][t, d], hit))
    rows.sort(key=lambda row: -row[0])
    hits = np.cumsum([hit for _, hit in rows])
    precision, recall = hits / np.arange(1, len(rows) + 1), hits / total
    curve = np.interp(np.linspace(0, 1, 101), recall, precision, right=0)
    return np.maximum(curve[11:] - 0.1, 0).mean() / 0.9


@pytest.mark.parametrize("seed", range(4))
def test_average_precision_is_that_of_a_loop(seed):
    # a recall of the grid that is on a step of the curve falls on either side of it
    found, truth = episode(seed)
    for distance in (0.5, 2.0):
        expected = ap_by_loops(
            found, truth, lambda v, m=distance: v <= m, lambda t, d, k: gap(found, truth, t, d, k)
        )
        score = _precision(boxes(found), boxes(truth), distance=distance)
        assert float(score) == pytest.approx(expected, abs=2e-3)

    def overlap(t, d, k):
        one, two = (
            polygon([table[name][t, n] for name in ("x", "y", "heading", "length", "width")])
            for table, n in ((found, d), (truth, k))
        )
        return -one.intersection(two).area / one.union(two).area

    expected = ap_by_loops(found, truth, lambda v: v <= -0.3, overlap)
    score = _precision(boxes(found), boxes(truth), iou=0.3)
    assert float(score) == pytest.approx(expected, abs=2e-3)


def test_perfect_and_useless_detectors():
    _, truth = episode(0)
    every = boxes(truth)
    nothing = every._replace(there=jnp.zeros_like(every.there))
    for kind in ({"distance": 0.5}, {"iou": 0.9}):
        assert float(_precision(every, every, **kind)) == pytest.approx(1, abs=1e-6)
        assert float(_precision(nothing, every, **kind)) == 0
        assert np.isnan(float(_precision(every, nothing, **kind)))
    with pytest.raises(ValueError, match="either a distance or an iou"):
        average_precision(every, every)


def test_intersection_over_union_is_that_of_shapely():
    rng = np.random.default_rng(0)
    low, high = (-2, -2, -4, 1, 1), (2, 2, 4, 6, 6)
    a, b = rng.uniform(low, high, (2, 400, 5))
    a[:50, :2] += 1000  # far from the origin, and apart
    b[50:100] = a[50:100]  # the same
    b[100:150] = a[100:150]
    b[100:150, 2] += np.pi / 2
    b[150:200, :3], b[150:200, 3:] = a[150:200, :3], a[150:200, 3:] / 2  # within
    pairs = zip(map(polygon, a), map(polygon, b), strict=True)
    expected = [p.intersection(q).area / p.union(q).area for p, q in pairs]
    arrays = (jnp.asarray(x, jnp.float32) for x in (a, b))
    found = jax.jit(jax.vmap(intersection_over_union))(*arrays)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def mot_by_loops(found, truth, most):
    last, misses, false, switches, away, matches = {}, 0, 0, 0, 0.0, 0
    for t in range(T):
        free_d = [d for d in range(D) if found["there"][t, d]]
        free_k = [k for k in range(K) if truth["there"][t, k]]
        near = np.array([[gap(found, truth, t, d, k) for k in range(K)] for d in range(D)])
        pairs = []
        for k in list(free_k):
            same = [d for d in free_d if found["id"][t, d] == last.get(k) and near[d, k] <= most]
            if same:
                pairs.append((same[0], k))
                free_d.remove(same[0])
                free_k.remove(k)
        if free_d and free_k:
            cost = near[np.ix_(free_d, free_k)]
            cost[cost > most] = 1e6
            for i, j in zip(*linear_sum_assignment(cost), strict=True):
                if cost[i, j] < 1e6:
                    pairs.append((free_d[i], free_k[j]))
        for d, k in pairs:
            switches += k in last and last[k] != found["id"][t, d]
            last[k] = found["id"][t, d]
            away += near[d, k]
        matches += len(pairs)
        misses += truth["there"][t].sum() - len(pairs)
        false += found["there"][t].sum() - len(pairs)
    total = truth["there"].sum()
    return 1 - (misses + false + switches) / total, away / matches, misses, false, switches, total


@pytest.mark.parametrize("seed", range(4))
def test_tracking_is_that_of_a_loop_with_scipy(seed):
    found, truth = episode(seed)
    score = _mot(boxes(found), boxes(truth), K)
    expected = np.array(mot_by_loops(found, truth, 2.0), float)
    np.testing.assert_allclose(np.array(score, float), expected, rtol=1e-5)
    assert int(score.switches) > 0 or seed


def test_a_track_is_kept_while_another_is_nearer():
    """One body; its track moves off by 1.5 m while a second one appears on the spot."""
    zero = np.zeros((2, 1))
    truth = {"there": zero == 0, "id": zero, "x": zero, "y": zero, "heading": zero, "score": zero}
    truth |= {"length": zero + 4, "width": zero + 2}
    pair = np.zeros((2, 2))
    found = {name: pair for name in truth} | {"length": pair + 4, "width": pair + 2}
    found |= {
        "there": np.array([[1, 0], [1, 1]]),
        "id": np.array([[7, 8], [7, 8]]),
        "x": np.array([[0.5, 0], [1.5, 0.2]]),
    }
    score = _mot(boxes(found), boxes(truth), 1)
    assert (int(score.switches), int(score.false), int(score.misses)) == (0, 1, 0)
    assert float(score.motp) == pytest.approx(1.0)


def test_a_perfect_tracker():
    _, truth = episode(1)
    every = boxes(truth)
    score = _mot(every, every, K)
    assert float(score.mota) == 1 and float(score.motp) == 0 and int(score.bodies) == truth["there"].sum()
    nothing = every._replace(there=jnp.zeros_like(every.there))
    assert np.isnan(float(_mot(nothing, nothing, K).mota))


def test_prediction_errors_are_those_of_a_loop():
    rng = np.random.default_rng(3)
    predicted, truth = rng.normal(0, 2, (6, 3, 8, 2)), rng.normal(0, 2, (6, 8, 2))
    valid = rng.random((6, 8)) < 0.7
    valid[2] = False
    ade, fde = [], []
    for v in range(6):
        steps = np.flatnonzero(valid[v])
        if len(steps):
            errors = [[np.linalg.norm(predicted[v, m, h] - truth[v, h]) for h in steps] for m in range(3)]
            ade.append(min(np.mean(e) for e in errors))
            fde.append(min(e[-1] for e in errors))
    guess, real = (jnp.asarray(x, jnp.float32) for x in (predicted, truth))
    score = prediction_errors(guess, real, jnp.asarray(valid), miss=1.5)
    np.testing.assert_allclose(
        np.array(score), [np.mean(ade), np.mean(fde), np.mean(np.array(fde) > 1.5)], rtol=1e-5
    )
    none = prediction_errors(jnp.zeros((2, 1, 3, 2)), jnp.zeros((2, 3, 2)), jnp.zeros((2, 3), bool))
    assert np.isnan(np.array(none)).all()


def test_the_range_of_what_counts():
    _, truth = episode(0)
    near = within(boxes(truth), 15.0)
    expected = truth["there"] & (np.hypot(truth["x"], truth["y"]) <= 15)
    np.testing.assert_array_equal(near.there, expected)
