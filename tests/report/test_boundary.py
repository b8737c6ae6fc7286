"""Maps of where variants pass: against counts in loops, and on the page."""

import re

import numpy as np
import pytest
from fake_results import made

from limsim_jax.report.page import write_report
from limsim_jax.report.page.boundary import CELLS, axes, counts, drawing, telling
from limsim_jax.scenarios.openscenario.outcome import Variants

ABOUT = {"openscenario": {"file": "1"}, "asked": None, "words": {"kind": ["a/car.xosc", "<bus>"]}}


def many(n=200, seed=0):
    """Variants that fail at high speeds and short gaps; `side` changes nothing."""
    rng = np.random.default_rng(seed)
    speed, gap = rng.integers(1, 6, n) * 10.0, rng.integers(0, 4, n) * 5.0
    parameters = {"speed": speed, "gap": gap, "side": rng.integers(0, 2, n) * 2.0 - 1, "one": np.full(n, 7.0)}
    passed = speed < 20 + 2 * gap
    return Variants(np.arange(n), passed, ~passed, None, parameters | {"late": np.full(n, np.nan)}, {})


def test_counts_are_those_of_a_loop():
    one = many()
    x, y, side = axes(one)
    assert (x.name, x.labels, y.name) == ("speed", ("10", "20", "30", "40", "50"), "gap")
    found = counts(~one.passed, x, y)
    for row, gap in enumerate((0, 5, 10, 15)):
        for column, speed in enumerate((10, 20, 30, 40, 50)):
            here = (one.parameters["speed"] == speed) & (one.parameters["gap"] == gap) & ~one.passed
            assert found[row, column] == here.sum()
    np.testing.assert_array_equal(counts(~one.passed, x, None)[0], found.sum(0))
    # speed and gap tell all, the side nothing
    assert telling(one.passed, x, y) == pytest.approx(1)
    assert (
        telling(one.passed, x, y)
        > telling(one.passed, x, side)
        > telling(one.passed, side)
        == (pytest.approx(0, abs=0.05))
    )
    chance = x._replace(cell=np.arange(200) % 60, labels=("",) * 60)
    assert telling(one.passed, chance) == pytest.approx(0, abs=0.15)  # 0.3 by chance alone
    assert telling(np.ones(200, bool), x, y) == telling(one.passed[:4], *(_first(a, 4) for a in (x, y))) == 0


def _first(axis, n):
    return axis._replace(cell=axis.cell[:n])


def test_many_values_share_cells():
    values = np.linspace(0, 24, 1000)
    one = Variants(np.arange(1000), values > 3, values <= 3, None, {"x": values}, {})
    (axis,) = axes(one)
    assert len(axis.labels) == CELLS and axis.labels[1] == "2…"
    np.testing.assert_array_equal(axis.cell, np.minimum((values / 2).astype(int), CELLS - 1))


def test_a_map_says_what_it_shows():
    one = many()
    one = one._replace(preventable=~one.passed & (one.parameters["gap"] == 0))
    x, y, _ = axes(one)
    svg = str(drawing(one, x, y))
    total, failed = counts(np.ones(200, bool), x, y), counts(~one.passed, x, y)
    told = re.findall(r"<title>speed (\d+), gap (\d+): (\d+) of (\d+) fail(?:, (\d+) preventable)?<", svg)
    assert len(told) == 20
    for speed, gap, bad, of, prevented in told:
        cell = int(gap) // 5, int(speed) // 10 - 1
        assert (int(bad), int(of)) == (failed[cell], total[cell])
        assert int(prevented or 0) == (failed[cell] if gap == "0" else 0)
    assert svg.count("var(--ego)") == 4  # 10 m/s passes with any gap


def test_the_page_has_maps_and_the_worst_variants(tmp_path):
    n, group, other = 60, ("cut", "mine"), ("cut", "r157_careful")
    speed, kind = np.arange(n) % 6 * 10.0, np.arange(n) % 2.0
    contacts = (speed > 20) * 1.0
    rows = {
        "passed": 1 - contacts, "contacts": contacts, "success": 1 - contacts,
        "max_delta_v": np.where(contacts, speed / 10 + np.arange(n) / 100, np.nan),
        "parameter_speed": speed, "parameter_kind": kind,
    }  # fmt: skip
    safe = rows | {"passed": np.ones(n), "contacts": np.zeros(n), "max_delta_v": np.full(n, np.nan)}
    results = made({group: rows, other: safe}, provenance={group: ABOUT, other: ABOUT}, path="my results")
    text = write_report(results, tmp_path / "r.html").read_text()
    part = text[text.index('id="boundary"') : text.index('id="moments"')]
    assert "cut / mine: 30 of 60 variants pass, 30 collide, 30 of these preventable" in part
    assert "<b>cut / r157_careful</b>: 60 of 60 variants pass" in part
    assert part.count("<svg") == 1 and "&lt;bus&gt;" in part and "<bus>" not in part
    worst = re.findall(r'<td class="number">(\d+)</td><td>contact, delta-v (\S+) m/s, preventable</td>', part)
    assert worst == [("59", "5.6"), ("53", "5.5"), ("47", "5.5"), ("41", "5.4"), ("35", "5.3")]
    assert "speed 50, kind" in part
    assert "limsim-jax replay &#39;my results&#39; --policy mine --seed 59" in part
    # results of an experiment have no such part
    assert 'id="boundary"' not in write_report(made({group: rows}), tmp_path / "r.html").read_text()
