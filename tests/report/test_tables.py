"""Tables of results: intervals against published values and scipy, what is missing, the worst seeds."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_results import NAN, ONE, UNITS, broken_policies, crashes, made
from pyarrow.csv import read_csv

from limsim_jax.metrics.catalog import describe
from limsim_jax.report import tables
from limsim_jax.report.tables import headline, lookup, summary, worst, write_csv
from limsim_jax.statistics import bootstrap, wilson
from limsim_jax.sweeps.store import Results


def rows_of(results: Results, **kwargs: Any) -> dict[str, dict[str, Any]]:
    return {metric: row for (_, _, metric), row in lookup(summary(results, **kwargs)).items()}


def test_shares_have_wilsons_interval_and_means_the_bootstrap():
    rng = np.random.default_rng(1)
    success = (rng.random(57) < 0.8) * 1.0
    speed = rng.gamma(2, 3, 57)
    rows = rows_of(made({ONE: {"success": success, "mean_speed": speed}}))
    expected = wilson(int(success.sum()), 57)
    found = rows["success"]
    assert (found["estimate"], found["lower"], found["upper"]) == expected
    assert (found["kind"], found["seeds"], found["measured"], found["bound"]) == ("proportion", 57, 57, None)
    found, expected = rows["mean_speed"], bootstrap(speed)
    assert found["kind"] == "mean"
    assert found["estimate"] == pytest.approx(expected.estimate, rel=1e-12)
    assert [found["lower"], found["upper"]] == pytest.approx(expected[1:], abs=0.02 * np.ptp(expected[1:]))
    assert [found["minimum"], found["median"], found["maximum"]] == pytest.approx(
        [speed.min(), np.median(speed), speed.max()], rel=1e-12
    )


def test_means_of_one_value_and_of_none():
    rows = rows_of(made({ONE: {"mean_speed": [5.0, NAN], "min_ttc": [NAN, NAN]}}))
    assert (rows["mean_speed"]["estimate"], rows["mean_speed"]["lower"]) == (5.0, None)
    assert rows["min_ttc"]["estimate"] is None and rows["min_ttc"]["measured"] == 0


def test_what_was_not_measured_is_left_out_and_counted():
    time = [NAN, 40.0, 50.0, NAN, 60.0]
    results = made({ONE: {"completion_time": time, "arrived": [0, 1, 1, 0, 1]}})
    row = rows_of(results)["completion_time"]
    assert (row["seeds"], row["measured"], row["estimate"], row["minimum"]) == (5, 3, 50.0, 40.0)
    results = made({ONE: {"min_ttc": [NAN, *np.linspace(1, 3, 9)], "contacts": [0] * 10}})
    text = headline(results)
    cells = {row[0]: row[1] for row in text.rows}
    assert cells["least TTC, median, s"].startswith("2.0 [") and cells["least TTC, median, s"].endswith(
        "(of 9)"
    )
    assert any("of n" in note for note in text.notes)


def test_what_never_happened_has_a_one_sided_bound():
    n = 30
    results = made(
        {ONE: {"success": [1] * n, "contacts": [0] * n, "traffic_collided": [0] * n, "distance": [500] * n}}
    )
    rows = rows_of(results)
    bound = 1 - 0.05 ** (1 / n)  # P(0 of n) = (1 - p)^n = 5 %
    assert rows["had_contact"]["bound"] == pytest.approx(bound)
    assert rows["traffic_collided"]["bound"] == pytest.approx(bound)
    assert rows["success"]["bound"] == pytest.approx(1 - bound)
    assert rows["crashes_per_1000_km"]["bound"] == pytest.approx(-np.log(0.05) / 0.015)
    cells = {row[0]: row[1] for row in headline(results).rows}
    assert cells["episodes with a contact, %"] == "0 (at most 9.5)"
    assert cells["success, %"] == "100 (at least 90)"
    assert cells["vehicles that collided, per episode"] == "0 (above 0 in at most 9.5 %)"


def test_crashes_per_distance_count_an_episode_once_and_have_the_exact_interval():
    """Garwood's limits for 3 events: 0.6187 and 8.7673 (95 %)."""
    contacts = [0, 2, 1, 0, 5, NAN]
    results = made({ONE: {"contacts": contacts, "distance": [100e3, 200e3, 300e3, 0, 400e3, 7e9]}})
    row = rows_of(results)["crashes_per_1000_km"]
    assert (row["kind"], row["measured"], row["estimate"]) == ("rate", 5, 3.0)
    assert [row["lower"], row["upper"]] == pytest.approx([0.6187, 8.7673], abs=1e-4)


def test_a_share_that_is_no_share_is_a_mean():
    rows = rows_of(made({ONE: {"nuplan_comfort": [0, 0.5, 1], "comfortable": [0, 1, 1]}}))
    assert (rows["nuplan_comfort"]["kind"], rows["comfortable"]["kind"]) == ("mean", "proportion")


def test_labels_are_not_averaged():
    rows = rows_of(made({ONE: {"contact_other": [3, 8], "contact_type": [1, 5], "contacts": [1, 1]}}))
    assert not {"contact_other", "contact_type", "seed", "digest"} & set(rows)
    labels = {name for name, meaning in UNITS.items() if describe(name, meaning).kind == "label"}
    slots = {"contact_other", "min_ttc_other", "max_drac_other", "near_miss_other"}
    assert labels == slots | {"contact_type", "contact_responsibility"}


def test_neither_the_order_of_rows_nor_other_scenarios_change_a_number():
    rng = np.random.default_rng(4)
    own = {"mean_speed": rng.gamma(2, 1, 40), "contacts": rng.poisson(0.3, 40), "distance": rng.random(40)}
    alone = made({ONE: own})
    both = made({("ramp", "x"): {"mean_speed": rng.random(3)}, ONE: own})
    mixed = both.episodes.take(rng.permutation(both.episodes.num_rows))
    mixed = Results(both.path, mixed, both.moments, both.units, both.provenance)
    expected = lookup(summary(alone))
    found = {key: row for key, row in lookup(summary(mixed)).items() if key[:2] == ONE}
    assert found == expected
    assert list(tables.groups(mixed)) == [("ramp", "x"), ONE]  # as in the provenance


def test_no_episodes_and_a_level_that_is_none():
    results = made({ONE: {"contacts": [0.0]}})
    with pytest.raises(ValueError, match="the level must lie"):
        summary(results, level=95)
    empty = Results(Path("there"), results.episodes.slice(0, 0), results.moments, {}, {})
    with pytest.raises(ValueError, match="there holds no finished"):
        summary(empty)


def test_a_broken_policy_is_worse_than_any_crash_and_heads_the_table():
    found = worst(broken_policies(), k=5).to_pylist()
    assert [row["seed"] for row in found][:4] == [3, 17, 30, 5]
    assert [row["policy_failed"] for row in found] == [True, True, True, False, False]
    assert found[0]["kind"] == "policy_failed" and found[0]["reason"].startswith("mine.py:7")
    cells = [row[0] for row in headline(broken_policies()).rows]
    assert cells[1:3] == ["POLICY FAILED, %", "success, %"]
    assert "POLICY FAILED, %" not in [row[0] for row in headline(crashes()).rows]


def test_failed_policies_are_told_by_reason():
    failures = tables.failed_policies(broken_policies())
    assert [(failure.seeds, failure.episodes) for failure in failures] == [([3, 30], 40), ([17], 40)]
    assert tables.failed_policies(crashes()) == []
    many = tables.Failure(ONE, "boom", list(range(9)), 1000)
    assert many.text == (
        "policy like_traffic failed in 9 of 1,000 episodes of highway: boom (seeds 0, 1, 2, 3, 4, 5, ...)"
    )


def failing() -> Results:
    """An episode for each cause of failure, in their order, and two successes."""
    flags = ("policy_failed", "at_fault_contacts", "contacts", "off_road", "out_of_time")
    n = len(tables.CAUSES) + 2
    columns: dict[str, Any] = {name: np.zeros(n) for name in flags}
    for k, name in enumerate(flags):
        columns[name][k] = 1
    columns["contacts"][1] = 1
    columns["out_of_time"][0] = 1  # the first cause counts
    columns["arrived"] = np.isin(np.arange(n), (6, 7, 8)) * 1.0
    columns["success"] = np.isin(np.arange(n), (7, 8)) * 1.0
    return made({ONE: columns})


def test_causes_of_failure():
    found = tables.causes(failing().episodes).tolist()
    assert found == [*tables.CAUSES, "", ""]
    note = headline(failing()).notes[0]
    assert note == (
        "highway: 7 of 9 without success: 1 the policy failed, 1 contact at the ego's fault, 1 other "
        "contact, 1 off the road, 1 out of time, 1 left elsewhere than at its goal, 1 arrived against the "
        "criteria of success."
    )
    cells = [row[0] for row in headline(failing()).rows]
    assert cells[2:4] == ["success, %", "out of time, %"]
    calm = made({ONE: {"success": [1, 1], "arrived": [1, 1], "contacts": [0, 0]}})
    assert tables.causes(calm.episodes).tolist() == ["", ""]
    assert headline(calm).notes[0].startswith("Brackets") and "out of time, %" not in str(headline(calm))
    assert tables.causes(made({ONE: {"contacts": [1]}}).episodes).tolist() == [""]  # success is not known


def test_the_worst_seeds_are_ranked_by_severity():
    found = worst(crashes(), k=20).to_pylist()
    assert [row["seed"] for row in found] == [6, 7, 5, 4, 3, 2, 1, 0]
    assert [row["place"] for row in found] == list(range(1, 9))
    first = found[0]
    assert (first["kind"], first["time"], first["other"], first["responsible"]) == ("contact", 12.0, 3, "ego")
    assert (first["module"], first["avoidable_by_ego"], first["avoidable_by_other"]) == (
        "planning",
        True,
        False,
    )
    # without a moment of its own: from the row
    assert (found[1]["responsible"], found[1]["time"], found[1]["kind"]) == ("shared", 13.0, None)
    assert [row["at_fault"] for row in found] == [True, True] + 6 * [False]
    assert [row["delta_v"] for row in found[:5]] == [1.0, 0.5, 9.0, 4.0, None]
    assert (found[5]["kind"], found[5]["time"], found[5]["responsible"]) == ("near_miss", 6.0, None)
    assert found[7]["min_ttc"] is None
    assert worst(crashes(), k=2).num_rows == 2


def test_the_worst_by_a_metric():
    def seeds(metric: str) -> list[int]:
        return worst(crashes(), metric, 3).column("seed").to_pylist()

    assert seeds("nuplan_score") == [6, 5, 4]  # less is worse; an episode without one is left out
    assert worst(crashes(), "nuplan_score", 20).num_rows == 7
    assert seeds("max_delta_v") == [5, 4, 6]  # more is worse
    assert seeds("min_ttc") == [4, 5, 6]
    assert worst(crashes(), "nuplan_score", 1).column("metric").to_pylist() == [0.0]
    with pytest.raises(ValueError, match="no metric 'speed' in results; there are contacts"):
        worst(crashes(), "speed")
    with pytest.raises(ValueError, match="neither more nor less of 'contact_time' is worse"):
        worst(crashes(), "contact_time")


def test_which_way_is_better():
    up = ["success", "completion", "min_ttc", "min_acceleration", "nuplan_ttc", "carla_score", "mean_speed"]
    down = ["contacts", "max_jerk", "off_road", "completion_time", "had_contact", "traffic_collided",
            "speeding", "rms_jerk", "max_drac", "traffic_mean_travel_time", "ttc_exposed"]  # fmt: skip
    neither = ["min_ttc_time", "contact_time", "duration", "contact_other", "traffic_entered"]
    for direction, names in ((1, up), (-1, down), (0, neither)):
        assert {name: tables.better(name) for name in names} == dict.fromkeys(names, direction)


def test_the_short_list_has_a_column_per_scenario():
    results = made(
        {
            ("a", "p"): {"success": [1, 0, 1, 1], "mean_speed": [9, 10, 11, 12]},
            ("b", "p"): {"success": [0] * 4},
        }
    )
    text = headline(results)
    assert text.header == ["", "a", "b"]
    assert text.rows[0] == ["seeds", "4", "4"]
    assert text.rows[1] == ["success, %", "75 [30, 95]", "0 (at most 53)"]
    assert text.rows[2][2] == ""  # no speed in b
    two = made({("a", "p"): {"success": [1, 1]}, ("a", "q"): {"success": [0, 1]}})
    assert headline(two).header == ["", "a / p", "a / q"]


def test_csv(tmp_path):
    results = crashes()
    paths = write_csv(results, tmp_path / "deep" / "csv")
    assert [path.name for path in paths] == ["summary.csv", "worst.csv", "episodes.csv", "moments.csv"]
    tabled = summary(results)
    back = read_csv(paths[0])
    assert back.column("metric").to_pylist() == tabled.column("metric").to_pylist()
    np.testing.assert_allclose(
        [x if x is not None else NAN for x in back.column("upper").to_pylist()],
        [x if x is not None else NAN for x in tabled.column("upper").to_pylist()],
    )
    assert read_csv(paths[1]).column("seed").to_pylist() == [6, 7, 5, 4, 3, 2, 1, 0]
    assert read_csv(paths[2]).num_rows == 8


def test_notebooks_show_a_table():
    table = tables.TextTable(["seed", "what"], [["3", "contact"], ["5", ""]], ["first note", "second"])
    assert table._repr_markdown_().splitlines() == [
        "| seed | what |",
        "| --- | ---: |",
        "| 3 | contact |",
        "| 5 |  |",
        "",
        "first note  ",
        "second  ",
    ]


def test_tables_print_in_columns_and_show_as_html():
    table = tables.TextTable(["", "a < b"], [["seeds", "10"], ["success, %", "100"]], ["a note"])
    assert str(table).splitlines() == [
        "            a < b",
        "-----------------",
        "seeds          10",
        "success, %    100",
        "",
        "a note",
    ]
    assert repr(table) == str(table)
    html = table._repr_html_()
    assert "<th" in html and "a &lt; b" in html and html.endswith("<div>a note</div>")


def test_a_demand_that_does_not_fit_is_told():
    def worlds(entered, waiting, full):
        counts = {"traffic_entered": entered, "traffic_waiting": waiting, "traffic_full": full}
        return {name: np.asarray(x, float) for name, x in counts.items()}

    found = made(
        {
            ("highway", "a"): worlds([100, 120], [310, 290], [0, 0]),
            ("highway", "b"): worlds([100, 120], [310, 290], [0, 0]),
            ("ramp", "a"): worlds([50, 50], [30, 40], [9, 0]),
            ("town", "a"): worlds([500, 500], [4, 6], [0, 0]),
        }
    )
    told = [note for note in headline(found).notes if "outside" in note]
    assert told == [
        "highway: 300 of 410 vehicles per episode were still outside at the end; the roads took no more.",
        "ramp: 35 of 85 vehicles per episode were still outside at the end; all slots were taken: more "
        "`slots` let them in.",
    ]


def test_the_table_says_what_a_policy_knows():
    worlds = {("ramp", name): {"mean_speed": [9.0, 8.0]} for name in ("a", "b", "c", "d")}
    told = {
        ("ramp", name): {"knows": what}
        for name, what in zip("abc", ("state", "view", "sensors"), strict=True)
    }
    found = headline(made(worlds, provenance=told))
    assert found.rows[1] == ["knows of other vehicles", "all", "what it sees", "what its sensors give", ""]
    assert headline(made(worlds)).rows[1][0] != "knows of other vehicles"
