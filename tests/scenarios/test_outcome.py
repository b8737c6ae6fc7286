"""How variants ended, counted by hand."""

from pathlib import Path

import pyarrow as pa

from limsim_jax import cli
from limsim_jax.scenarios.openscenario.outcome import Tally, outcome, totals, variants
from limsim_jax.sweeps.store import Results

ABOUT = {"openscenario": {"file": "1", "template": "2"}, "asked": None, "variants": 4}


def results(**provenance):
    """Two policies and the careful driver on a file, and a sweep of another kind."""
    rows = [
        # scenario, policy, seed, passed, contacts, gap
        ("cut", "mine", 1, 0, 2, 20.0), ("cut", "mine", 0, 0, 1, 10.0),
        ("cut", "mine", 2, 0, 0, 30.0), ("cut", "mine", 3, 1, 0, 40.0),
        ("cut", "r157_careful", 0, 0, 1, 10.0), ("cut", "r157_careful", 1, 1, 0, 20.0),
        ("cut", "r157_careful", 2, 1, 0, 30.0), ("cut", "r157_careful", 3, 1, 0, 40.0),
        ("out", "mine", 0, 0, 1, None), ("out", "mine", 1, 1, 0, None),
        ("ramp", "mine", 0, None, 1, None),
    ]  # fmt: skip
    names = ("scenario", "policy", "seed", "passed", "contacts", "parameter_gap")
    episodes = pa.table(dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)))
    about = {
        ("cut", "mine"): ABOUT, ("cut", "r157_careful"): ABOUT | provenance, ("out", "mine"): ABOUT,
        ("ramp", "mine"): {},
    }  # fmt: skip
    return Results(Path("there"), episodes, pa.table({}), {}, about)


def test_variants_are_counted():
    found = outcome(results())
    assert found == [
        Tally("cut", "mine", 4, 1, 2, 1), Tally("cut", "r157_careful", 4, 3, 1, 0),
        Tally("out", "mine", 2, 1, 1, None),
    ]  # fmt: skip
    assert totals(found) == [Tally("all", "mine", 6, 2, 3, None), Tally("all", "r157_careful", 4, 3, 1, 0)]
    mine = variants(results())["cut", "mine"]
    assert mine.seed.tolist() == [0, 1, 2, 3]
    assert mine.preventable is not None and mine.preventable.tolist() == [False, True, False, False]
    assert mine.parameters["gap"].tolist() == [10, 20, 30, 40]
    assert not variants(results())["out", "mine"].parameters


def test_other_variants_tell_nothing():
    for changed in ({"asked": 4}, {"variants": 5}, {"openscenario": {"file": "1", "template": "3"}}):
        assert next(x.preventable for x in outcome(results(**changed))) is None


def test_other_experiments_have_no_careful_driver(capsys):
    assert cli.main(["sweep", "ramp", "--preventable"]) == 2
    assert "--preventable: only of a .xosc" in capsys.readouterr().err
