"""Figures for notebooks: what is drawn is what the tables hold."""

from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pyarrow as pa
import pytest
from fake_results import NAN, crashes, made
from fake_traces import HIT, OWN, small_trace

from limsim_jax.report import plots
from limsim_jax.statistics import median_interval, wilson

A, B = ("highway", "idm"), ("highway", "mcts")


@pytest.fixture(autouse=True)
def closed() -> Any:
    yield
    plt.close("all")


def pair() -> Any:
    rng = np.random.default_rng(0)
    speed = rng.normal(10, 1, 40)
    own = {"mean_speed": speed, "contacts": np.zeros(40), "seed": range(40)}
    other = {"mean_speed": speed[5:] + 1, "contacts": [1] * 5 + [0] * 30, "seed": range(5, 40)}
    return made({A: own, B: other})


def test_time_space_follows_a_route_and_leaves_gaps_where_a_vehicle_is_away():
    rows = [  # time, vehicle, lane, s, v
        (0.0, 1, "a", 5.0, 10.0), (0.1, 1, "a", 6.0, 11.0), (0.2, 1, "b", 1.0, 12.0),
        (0.0, 2, "x", 0.0, 3.0), (0.1, 2, "a", 10.0, 4.0), (0.2, 2, "x", 1.0, 5.0), (0.3, 2, "b", 2.0, 6.0),
    ]  # fmt: skip
    table = pa.table(dict(zip(("time", "vehicle", "lane", "s", "v"), zip(*rows, strict=True), strict=True)))
    ax: Any = plots.time_space(table, along=["a", "b"])
    lines: Any = ax.collections[0]
    # lane b begins where the table's greatest s on lane a ends: at 10 m
    np.testing.assert_allclose(lines.get_segments(), [[[0.0, 5.0], [0.1, 6.0]], [[0.1, 6.0], [0.2, 11.0]]])
    np.testing.assert_allclose(lines.get_array(), [11.0, 12.0])
    with pytest.raises(ValueError, match="no vehicle is on q"):
        plots.time_space(table, along=["q"])
    with pytest.raises(ValueError, match="no column v; it has"):
        plots.time_space(table.drop_columns(["v"]), along=["a"])
    two = table.append_column("seed", pa.array([1, 1, 1, 2, 2, 2, 2]))
    with pytest.raises(ValueError, match="several worlds"):
        plots.time_space(two, along=["a"])
    lines = plots.time_space(two, along=["a", "b"], seed=1).collections[0]
    assert len(lines.get_segments()) == 2


def test_distributions_have_a_curve_and_the_median_of_each_policy():
    results = pair()
    ax: Any = plots.distribution(results, "mean_speed")
    curve, bar, *rest = ax.lines
    x = results.episodes["mean_speed"].to_numpy()[:40]
    assert set(x) <= set(curve.get_xdata())
    assert bar.get_xdata().tolist() == list(median_interval(x)[1:])
    assert len(rest) == 2 and [text.get_text() for text in ax.get_legend().get_texts()] == ["idm", "mcts"]
    with pytest.raises(ValueError, match="no metric 'speed' in results; there are"):
        plots.distribution(results, "speed")
    only = plots.distribution(made({A: {"min_ttc": [NAN, 1.0, 2.0]}}), "min_ttc", label="TTC, s")
    assert only.get_xlabel() == "TTC, s" and len(only.lines) == 1  # too few for bounds of a median


def test_shares_have_wilsons_interval_after_every_seed():
    ax: Any = plots.share_by_seeds(pair(), "contacts")
    line = ax.lines[1]
    np.testing.assert_allclose(line.get_ydata()[[0, 4, 34]], [100, 100, 500 / 35])
    corners = ax.collections[1].get_paths()[0].vertices
    expected = wilson(5, 35)
    found = corners[corners[:, 0] == 35][:, 1]
    np.testing.assert_allclose([found.min(), found.max()], [100 * expected.low, 100 * expected.high])


def test_pairs_are_the_common_seeds():
    ax: Any = plots.paired(pair(), "mean_speed", ("idm", "mcts"))
    passes, hits, equal = ax.lines
    assert (len(passes.get_xdata()), len(hits.get_xdata())) == (30, 5)
    for line in (passes, hits):
        np.testing.assert_allclose(np.asarray(line.get_ydata()) - line.get_xdata(), 1.0)
    np.testing.assert_array_equal(equal.get_xdata(), equal.get_ydata())
    assert ax.get_title() == "mean difference +1, p < 0.0001"
    with pytest.raises(ValueError, match="no policy 'x' in highway; there are idm, mcts"):
        plots.paired(pair(), "mean_speed", ("idm", "x"))
    with pytest.raises(ValueError, match="name one of highway"):
        plots.paired(pair(), "mean_speed", ("idm", "mcts"), scenario="ramp")


def test_moments_stand_at_their_times_in_the_row_of_their_kind():
    ax: Any = plots.moments(crashes())
    (line,) = ax.lines
    labels = [label.get_text() for label in ax.get_yticklabels()]
    assert labels == ["contact", "near miss"]
    found = {(x, labels[round(y)]) for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)}
    assert found == {(12.0, "contact"), (11.5, "near miss"), (6.0, "near miss")}


def test_fundamental_diagrams_show_flow_or_speed():
    points = {"simulated": ([10.0, 50.0], [900.0, 2000.0])}
    both: Any = (plots.fundamental_diagram(points, speed=wanted).lines[0] for wanted in (False, True))
    flow, speed = both
    assert list(flow.get_xydata()[:, 1]) == [900.0, 2000.0]
    assert list(speed.get_xydata()[:, 1]) == [90.0, 40.0]
    with pytest.raises(ValueError, match="1 densities but 2 flows"):
        plots.fundamental_diagram({"x": ([1.0], [2.0, 3.0])})


def test_around_a_moment_are_speeds_and_the_distance():
    _, _, trace = small_trace("roundabout")
    speeds, distance = plots.around(trace, {"ego": OWN, "other": HIT}, 0.6, before=0.35, after=0.25)
    shown = (trace.time > 0.25) & (trace.time < 0.85)
    np.testing.assert_allclose(speeds.lines[0].get_ydata(), trace.v[shown, OWN])
    apart = np.hypot(*(trace.box[shown, OWN, :2] - trace.box[shown, HIT, :2]).T)
    np.testing.assert_allclose(distance.lines[0].get_ydata(), apart, rtol=1e-6)
    gone = SimpleNamespace(**trace._asdict() | {"active": trace.active & (trace.time < 0.45)[:, None]})
    (one,) = np.atleast_1d(plots.around(gone, {"ego": OWN}, 0.6))
    assert len(one.lines[0].get_xdata()) == 4
