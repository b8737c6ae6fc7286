"""Differences by seed: against scipy, published p-values, and what must be refused."""

import numpy as np
import pytest
from fake_results import NAN, made
from scipy import stats

from limsim_jax.report.compare import compare, comparison_text
from limsim_jax.statistics import bootstrap

A, B = ("highway", "idm"), ("highway", "mcts")


def rows_of(comparison):
    return {row["metric"]: row for row in comparison.table.to_pylist()}


def pair(n=60, seed=0, **more):
    """B is 0.5 m/s faster on the same seeds, and has contacts on others."""
    rng = np.random.default_rng(seed)
    luck = rng.normal(0, 3, n)
    a = {"mean_speed": 10 + luck, "contacts": (np.arange(n) < 9) * 2}
    hit = np.isin(np.arange(n), (8, 20)) * 1
    b = {"mean_speed": 10.5 + luck + rng.normal(0, 0.2, n), "contacts": hit}
    return made({A: a}, path="a", **more), made({B: b}, path="b", **more)


def test_means_differ_as_scipy_says():
    a, b = pair()
    row = rows_of(compare(a, b))["mean_speed"]
    x, y = (r.episodes.column("mean_speed").to_numpy() for r in (a, b))
    expected = bootstrap(y - x)
    width = expected.high - expected.low
    assert row["difference"] == pytest.approx(expected.estimate, rel=1e-9)
    assert [row["lower"], row["upper"]] == pytest.approx(expected[1:], abs=0.04 * width)
    assert row["p"] == pytest.approx(stats.ttest_rel(y, x).pvalue, rel=1e-9)
    assert (row["mean_a"], row["mean_b"], row["pairs"]) == pytest.approx((x.mean(), y.mean(), 60))
    assert row["better"] == "B"
    assert width < 0.1 * np.ptp(bootstrap(x)[1:])  # what both share has cancelled


def test_shares_are_tested_on_the_seeds_that_differ():
    """9 seeds collide in A, 2 in B, 1 of them in both: 8 and 1 are discordant."""
    row = rows_of(compare(*pair()))["had_contact"]
    assert (row["kind"], row["a_not_b"], row["b_not_a"]) == ("proportion", 8, 1)
    assert row["difference"] == pytest.approx((2 - 9) / 60)
    assert row["p"] == pytest.approx(stats.binomtest(1, 9).pvalue)
    assert row["better"] == "B"
    assert rows_of(compare(*pair(), level=0.99))["had_contact"]["better"] is None
    assert rows_of(compare(*pair()))["mean_speed"]["a_not_b"] is None


def test_swapping_turns_the_signs():
    a, b = pair()
    there, back = rows_of(compare(a, b)), rows_of(compare(b, a))
    for name, row in there.items():
        other = back[name]
        assert other["difference"] == pytest.approx(-row["difference"], abs=1e-12)
        assert other["p"] == pytest.approx(row["p"], rel=1e-9)
        assert {row["better"], other["better"]} in ({"A", "B"}, {None})


def test_only_seeds_in_both_and_measured_in_both():
    a = {"seed": [3, 1, 2, 9], "completion_time": [30, 10, NAN, 90], "arrived": [1, 1, 0, 1]}
    b = {"seed": [1, 2, 3, 0], "completion_time": [11, 22, 36, 70], "arrived": [1, 1, 1, 1]}
    found = compare(made({A: a}, path="a"), made({B: b}, path="b"))
    row = rows_of(found)["completion_time"]
    assert (row["pairs"], row["measured_a_only"], row["measured_b_only"]) == (2, 0, 1)
    assert row["difference"] == pytest.approx((1 + 6) / 2)
    assert rows_of(found)["arrived"]["pairs"] == 3
    assert found.notes == ["highway: 3 seeds in both; left out 1 only in A and 1 only in B"]


def test_the_main_metrics_come_first_then_strong_evidence():
    rng = np.random.default_rng(5)
    luck = rng.normal(size=(3, 50))
    a = made({A: {"mean_speed": luck[0], "max_jerk": luck[1], "min_ttc": luck[2]}}, path="a")
    noise = rng.normal(size=(3, 50))
    b = {"mean_speed": luck[0] + 0.1 * noise[0], "max_jerk": luck[1] + 1 + noise[1], "min_ttc": luck[2]}
    found = compare(a, made({B: b | {"digest": range(50, 100)}}, path="b"))
    assert found.table.column("metric").to_pylist() == ["min_ttc", "max_jerk", "mean_speed"]
    rows = rows_of(found)
    assert [rows[name]["better"] for name in ("max_jerk", "mean_speed", "min_ttc")] == ["A", None, None]
    assert rows["max_jerk"]["p_adjusted"] == pytest.approx(3 * rows["max_jerk"]["p"])
    assert (rows["min_ttc"]["p"], rows["min_ttc"]["lower"], rows["min_ttc"]["upper"]) == (1.0, 0.0, 0.0)
    text = comparison_text(found, k=1)
    assert text.rows[0][0] == "min_ttc" and text.rows[0][-1] == ""
    assert text.notes[-1] == "2 more rows, by evidence: --rows 3"
    assert [row[0] for row in comparison_text(found).rows] == ["min_ttc"]  # of these the one main metric
    assert len(comparison_text(found, k=3).rows) == 3


def test_crashes_per_distance_are_compared_over_all_seeds():
    n = 40
    a = {"contacts": (np.arange(n) < 12) * 2, "distance": np.full(n, 5e4)}
    b = {"contacts": (np.arange(n) < 2) * 1, "distance": np.full(n, 1e5), "digest": range(n, 2 * n)}
    row = rows_of(compare(made({A: a}, path="a"), made({B: b}, path="b")))["crashes_per_1000_km"]
    assert (row["kind"], row["mean_a"], row["mean_b"]) == ("rate", pytest.approx(6.0), pytest.approx(0.5))
    assert row["difference"] == pytest.approx(-5.5) and row["lower"] < -5.5 < row["upper"] < 0
    assert row["p"] == pytest.approx(stats.binomtest(12, 14, 1 / 3).pvalue)
    assert row["better"] == "B"


def test_two_policies_of_one_directory():
    columns = {"success": [1, 1, 0, 1, 0, 0]}
    both = made({A: columns, B: {"success": [1, 1, 1, 1, 1, 0]}, ("ramp", "idm"): columns})
    found = compare(both)
    row = rows_of(found)["success"]
    assert (row["scenario"], row["policy_a"], row["policy_b"], row["b_not_a"]) == (
        "highway",
        "idm",
        "mcts",
        2,
    )
    assert found.notes[-1] == "not in both, left out: ramp"
    assert rows_of(compare(both, policies=("mcts", "idm")))["success"]["a_not_b"] == 2
    with pytest.raises(ValueError, match=r"policies idm and rl to compare .*; name two of idm, mcts"):
        compare(both, policies=("idm", "rl"))
    with pytest.raises(ValueError, match="holds one policy, idm; give the results of another one"):
        compare(made({A: columns}))


def test_episodes_that_are_the_same_are_counted():
    a = made({A: {"success": [1, 0, 1], "digest": [5, 6, 7]}}, path="a")
    b = made({A: {"success": [1, 0, 1], "digest": [5, 0, 7]}}, path="b")
    said = "highway: 3 seeds in both; in 2 of them the two episodes are the same, bit by bit"
    assert compare(a, b).notes == [said]


def provenance(**change):
    experiment = {
        "name": "highway",
        "horizon": 60.0,
        "traffic": {"density": 12.0, "flow": [{"rate": 900.0}]},
        "ego": {"policy": "idm", "driver": {"T": 1.2}, "start": "west"},
    }
    found = {"map": {"file": "h.xodr", "hash": "aa"}, "experiment": experiment, "version": "1"}
    for dotted, value in change.items():
        *tables, last = dotted.split("__")
        at = found
        for name in tables:
            at = at[name]
        at[last] = value
    return found


def compared(**change):
    """Results that differ in provenance only."""
    a = made({A: {"success": [1, 0]}}, provenance={A: provenance()}, path="a")
    b = made({B: {"success": [1, 0], "digest": [8, 9]}}, provenance={B: provenance(**change)}, path="b")
    return compare(a, b)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (dict(map__hash="bb"), "map.hash is 'aa' in a (idm) and 'bb' in b (mcts)"),
        (dict(experiment__traffic__density=13.0), "experiment.traffic.density is 12.0 in a"),
        (dict(experiment__traffic__flow=[{"rate": 8.0}]), "experiment.traffic.flow is [{'rate': 900.0}]"),
        (dict(experiment__ego__start="east"), "experiment.ego.start is 'west' in a"),
        (dict(experiment__horizon=30.0), "experiment.horizon is 60.0 in a"),
        (dict(experiment__success={"min_ttc": 1.0}), "experiment.success.min_ttc is not set in a"),
    ],
)  # fmt: skip
def test_another_world_is_refused(change, said):
    with pytest.raises(ValueError) as error:
        compared(**change)
    assert said in str(error.value) and "\n" not in str(error.value)
    assert str(error.value).startswith("highway: the same seed is not the same world: ")


def test_the_policy_may_differ_and_the_version_is_told():
    assert compared(experiment__ego__policy="mcts", experiment__ego__options={"depth": 3}).notes == []
    assert compared(experiment__ego__driver={"T": 0.8}, map__file="other.xodr").notes == []
    assert compared(version="2").notes == [
        "highway: A and B were not made by the same program: version '1' and '2'"
    ]


def test_nothing_in_common_is_refused():
    a = made({A: {"success": [1, 0]}}, path="a")
    with pytest.raises(ValueError, match="no scenario in common: a has highway; b has ramp"):
        compare(a, made({("ramp", "idm"): {"success": [1]}}, path="b"))
    with pytest.raises(ValueError, match="highway: no seed in common: 0 to 1 in a, 5 to 6"):
        compare(a, made({A: {"success": [1, 0], "seed": [5, 6]}}, path="b"))
    with pytest.raises(ValueError, match="the level must lie"):
        compare(a, a, level=0)
