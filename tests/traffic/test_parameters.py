"""The table of numbers of the behaviour model."""

import pytest

from limsim_jax.traffic.parameters import PARAMETERS


@pytest.mark.parametrize("row", PARAMETERS, ids=lambda x: f"{x.group}.{x.name}")
def test_every_number_is_explained_and_within_its_range(row):
    assert row.bounds[0] <= row.value <= row.bounds[1]
    assert row.unit in {"1", "s", "m", "m/s", "m/s^2", "m/s^3", "rad"}
    assert row.meaning and row.source


def test_names_are_unique_within_a_group():
    assert len({(x.group, x.name) for x in PARAMETERS}) == len(PARAMETERS) > 60
