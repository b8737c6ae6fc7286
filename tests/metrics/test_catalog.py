"""Descriptions of all metrics: complete, in the order of the results, and without contradictions."""

import re

import pytest

from limsim_jax.metrics.catalog import DERIVED, EGO, TOTALS, TRAFFIC, catalog, describe, headlines
from limsim_jax.metrics.description import SECTIONS, Description
from limsim_jax.metrics.ego import NAMES
from limsim_jax.metrics.measure import Metric
from limsim_jax.metrics.observer import EvaluateEgo, EvaluateTraffic
from limsim_jax.metrics.traffic import NAMES as TRAFFIC_NAMES
from limsim_jax.simulation.rollout import Totals

ALL = (*catalog(), *DERIVED)


def test_names_are_unique_and_every_description_is_complete():
    names = [column.name for column in ALL]
    assert len(names) == len(set(names))
    for column in ALL:
        assert column.meaning and column.section in SECTIONS, column.name
        assert column.formula or column in TOTALS, column.name
        assert column.share == column.meaning.startswith(("1 if", "0 or 1")), column.name


def test_columns_are_those_of_the_evaluators():
    assert list(EvaluateEgo().units) == [column.name for column in (*EGO, *TRAFFIC)]
    assert list(EvaluateTraffic().units) == [f"traffic_{name}" for name in TRAFFIC_NAMES]
    assert list(NAMES) == [column.name for column in EGO]
    assert [column.name for column in catalog()][: len(EGO)] == list(NAMES)


def test_totals_are_fields_of_the_totals_of_a_world():
    fields = set(Totals.__dataclass_fields__)
    assert {column.name.removeprefix("traffic_") for column in TOTALS} <= fields


def test_derived_metrics_follow_from_columns():
    columns = {column.name for column in catalog()}
    assert all(column.of in columns for column in DERIVED)
    assert not any(column.of for column in catalog())


@pytest.mark.parametrize(
    ("name", "sign"),
    [
        ("success", 1),
        ("min_ttc", 1),
        ("contacts", -1),
        ("worst_second", 1),
        ("duration", 0),
        ("red_light_time", 0),
    ],
)
def test_which_values_are_better(name, sign):
    assert describe(name).sign == sign


def test_times_of_events_are_neither_good_nor_bad():
    trips = {"completion_time", "traffic_mean_travel_time", "out_of_time"}
    for column in catalog():
        if re.search("_time$", column.name) and column.name not in trips:
            assert column.better == "neither", column.name


def test_the_short_list_is_in_the_order_of_its_places():
    found = headlines()
    places = [column.headline.place for column in found if column.headline]
    assert places == list(range(len(found)))
    assert [column.name for column in found[:2]] == ["policy_failed", "success"]


def test_unknown_names_are_described_by_their_meaning():
    assert describe("min_ttc", "anything").meaning.startswith("s, least time")
    assert describe("was_late", "1 if it was late") == Description(
        "was_late", "1 if it was late", "Own metrics", kind="proportion"
    )
    assert describe("traffic_trams", "trams").section == "Traffic"
    assert describe("first_slot", "slot of the first").kind == "label"


def test_results_on_disk_tell_which_values_of_an_own_metric_are_better():
    class Late(Metric):
        name, unit, better = "late", "1 if it was late", "lower"

    column = Late().description
    assert column.meaning == "1 if it was late; lower is better"
    assert describe(column.name, column.meaning) == column
