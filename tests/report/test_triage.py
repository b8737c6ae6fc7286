"""Failures in groups, their representatives, and the page."""

from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest

from limsim_jax.api import triage as api
from limsim_jax.metrics.blame import ContactType, Responsibility
from limsim_jax.report.triage import Finding, clusters_of, rows_of, write_page
from limsim_jax.sweeps.variation import Variation

clusters: Any = clusters_of  # of doubles of results


def row(seed, **given):
    plain = {
        "scenario": "town", "policy": "mine", "seed": seed, "ego": 0, "success": 1.0, "contacts": 0.0,
        "off_road": 0.0, "red_lights": 0.0, "policy_failed": 0.0, "out_of_time": 0.0, "contact_time": None,
        "contact_type": None, "contact_responsibility": None, "max_delta_v": None, "min_ttc": 3.0,
        "mean_speed": 8.0, "distance": 100.0,
    }  # fmt: skip
    return plain | given


def hit(seed, time, delta_v, kind=ContactType.FRONT, party=Responsibility.EGO):
    return row(
        seed, success=0.0, contacts=1.0, contact_time=time, contact_type=float(kind), max_delta_v=delta_v,
        contact_responsibility=float(party), min_ttc=0.0,
    )  # fmt: skip


ROWS = [
    *[row(k) for k in range(10)],
    hit(10, 5.0, 2.0),
    hit(11, 6.0, 3.0),
    hit(12, 30.0, 12.0),
    hit(13, 8.0, 1.0, ContactType.REAR, Responsibility.OTHER),
    row(14, success=0.0, red_lights=1.0),
    row(15, success=0.0, out_of_time=1.0),
    row(16, success=0.0),
    row(17, success=0.0, policy_failed=1.0, contacts=1.0),
    row(18, scenario="other", success=0.0),
]


@pytest.fixture
def stored():
    groups = {("town", "mine"): {}, ("other", "mine"): {}}
    return SimpleNamespace(episodes=pa.Table.from_pylist(ROWS), provenance=groups)


def test_failures_are_grouped_by_what_happened(stored):
    found = clusters(stored, "town", "mine")
    said = {x.words: [member.seed for member in x.members] for x in found}
    assert said == {
        "the ego hit a moving vehicle with its front; responsible: the ego": [10, 11, 12],
        "the policy failed": [17],
        "the ego was hit from behind; responsible: the other vehicle": [13],
        "ran a red light": [14],
        "out of time": [15],
        "missed the criteria of success": [16],
    }
    assert len(found[0].members) == 3, "the largest group first"
    assert found[0].share.estimate == pytest.approx(3 / 18)


def test_the_representative_is_in_the_middle(stored):
    assert clusters(stored, "town", "mine")[0].typical.seed == 11
    assert clusters(stored, "town", "mine")[0].typical.time == 6.0


def test_a_sweep_without_failures_has_no_groups():
    rows = pa.Table.from_pylist([row(k) for k in range(3)])
    assert clusters(SimpleNamespace(episodes=rows), "town", "mine") == []


def test_the_table_and_the_page(stored, tmp_path):
    found = [Finding(x, "T of <vehicle> 3", "replays/a.html") for x in clusters(stored, "town", "mine")]
    rows = rows_of(found)
    assert rows[0][0].startswith("3  (17 % [") and rows[0][2] == "seed 11 at 6.0 s"
    sections = [
        {"title": "a", "notes": ["b"], "head": ("c",), "rows": [[("seed 1", "replays/a.html")], ["<x>"]]}
    ]
    page = write_page(tmp_path / "triage.html", "Title", "about", sections).read_text()
    assert '<a href="replays/a.html">seed 1</a>' in page and "&lt;x&gt;" in page and "<x>" not in page


class Double:
    """Results whose worlds are never run: what changes are looked for is noted."""

    def __init__(self, stored, tmp_path):
        self.stored, self.path, self.replayed = stored, tmp_path, []

    def __len__(self):
        return len(ROWS)

    def worlds_of(self, scenario, policy):
        return f"{scenario} worlds"

    def replay(self, seed, *, scenario, policy):
        self.replayed.append(seed)
        return SimpleNamespace(save=lambda path: None)


def test_each_representative_is_changed_and_shown(stored, tmp_path, monkeypatch):
    asked = []

    def least_change(worlds, seed, happened, *, until):
        asked.append((worlds, seed, until))
        return Variation(True, None, (), 5)

    monkeypatch.setattr("limsim_jax.sweeps.variation.least_change", least_change)
    double: Any = Double(stored, tmp_path)
    found = api.triage(double, scenario="town", most=2, page=tmp_path / "triage.html")
    assert asked[0] == ("town worlds", 11, 6.0) and len(asked) == 2
    assert [x.change for x in found] == ["no change of one vehicle"] * 2 + [""] * 4
    page = (tmp_path / "triage.html").read_text()
    assert "seed 11 at 6.0 s</a>" in page and "responsible: the other vehicle" in page
    assert double.replayed == [11, found[1].cluster.typical.seed]


def test_the_event_of_a_group_is_told_by_its_metric(stored, monkeypatch):
    judged = {}

    def least_change(worlds, seed, happened, *, until):
        import numpy as np

        names = ("contacts", "off_road", "red_lights", "policy_failed", "out_of_time")
        for name in names:
            metrics = {x: np.array([float(x == name)]) for x in names} | {"success": np.array([1.0])}
            if happened(metrics)[0]:
                judged.setdefault(seed, []).append(name)
        return Variation(False, None, (), 1)

    monkeypatch.setattr("limsim_jax.sweeps.variation.least_change", least_change)
    api.triage(Double(stored, None), scenario="town", page=None)  # pyright: ignore[reportArgumentType]
    assert judged == {11: ["contacts"], 13: ["contacts"], 14: ["red_lights"], 15: ["out_of_time"],
                      17: ["policy_failed"]}  # fmt: skip
