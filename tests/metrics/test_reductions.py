"""Means, extremes and episodes of a stream against the same of the whole record."""

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.metrics.reductions import Episodes, Least, Mean, measured, on_host


def f(x):
    return jnp.asarray(x, jnp.float32)


def test_what_means_nothing_is_0():
    value, valid = measured(f([3.0, np.nan, -2.0]), jnp.asarray([True, False, False]))
    assert value.tolist() == [3.0, 0.0, 0.0] and valid.tolist() == [True, False, False]
    assert measured(f([1.0, 2.0])).valid.all()
    row = on_host(
        {"one": measured(f(2.5)), "none": measured(f(2.5), False), "some": measured(f([1, 2]), True)}
    )
    assert (row["one"], row["none"], row["some"].tolist()) == (2.5, None, [1.0, 2.0])
    assert np.isnan(on_host({"x": measured(f([1.0, 2.0]), jnp.asarray([True, False]))})["x"][1])


def test_streams_are_reductions_of_the_record():
    rng = np.random.default_rng(2)
    x, where = rng.integers(-5, 6, (50, 4)) * 1.0, rng.random((50, 4)) < 0.4
    where[:, 3] = False
    x[~where] = np.where(rng.random((~where).sum()) < 0.5, np.nan, -99.0)
    t = np.broadcast_to(np.arange(50.0)[:, None], x.shape)

    def step(carry, row):
        mean, least = carry
        x, t, where = row
        return (mean.add(x, where), least.add(x, t, where)), None

    start = Mean.empty(4), Least.empty(4)
    (mean, least), _ = jax.lax.scan(step, start, (f(x), f(t), jnp.asarray(where)))
    for result in (mean.result(), least.result(), least.when()):
        assert result.valid.tolist() == [True, True, True, False]
    for k in range(3):
        kept, times = x[where[:, k], k], t[where[:, k], k]
        np.testing.assert_allclose(mean.result().value[k], kept.mean(), rtol=1e-6)
        assert float(least.result().value[k]) == kept.min()
        assert float(least.when().value[k]) == times[np.argmin(kept)]  # the first of equals
    assert float(mean.result().value[3]) == float(least.when().value[3]) == 0.0


def test_episodes_have_hysteresis():
    x = [5, 1, 3, 1, 5, 5, 1, 1, 3, 5, 3]  # below 2 one begins, above 4 it ends
    episodes = Episodes.empty()
    numbers = []
    for value in x:
        episodes = episodes.add(jnp.asarray(value < 2), jnp.asarray(value > 4))
        numbers.append((int(episodes.number), bool(episodes.inside)))
    inside = [0, 1, 1, 1, 0, 0, 1, 1, 1, 0, 0]
    assert numbers == list(zip(np.cumsum(np.diff([0, *inside]) > 0).tolist(), map(bool, inside), strict=True))
