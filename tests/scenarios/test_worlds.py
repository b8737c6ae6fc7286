"""Scenarios on their maps."""

import pytest
import xosc
from osc_worlds import road

from limsim_jax.scenarios.openscenario.episodes import episodes_of
from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.scenarios.openscenario.source import OpenScenarioError


def test_maps_are_found(tmp_path):
    (tmp_path / "road.xodr").write_text(road())
    lost = xosc.write(tmp_path, xosc.scenario(road="nowhere.xodr"), "lost.xosc")
    with pytest.raises(OpenScenarioError, match=r"map 'nowhere.xodr' is not found; .* with --map"):
        episodes_of(openscenario(lost), None)
    from limsim_jax.scenarios.openscenario.episodes import map_of

    named = openscenario(xosc.write(tmp_path, xosc.scenario(road="Road"), "named.xosc")).scenario()
    assert map_of(named, tmp_path).name == "road"


def test_places_that_are_not_there(tmp_path):
    (tmp_path / "road.xodr").write_text(road())
    for place, said in (
        (xosc.lane(-5, 50), "road '1' has no lane -5; lanes are -2, -1, 1, 2"),
        (xosc.lane(-1, 5000), "s = 5000 is not on lane -1 of road '1', from 0 to 2000"),
        (xosc.lane(-1, 50, road=7), "there is no road '7'; roads are 1"),
    ):
        path = xosc.write(tmp_path, xosc.scenario(init=xosc.start("Ego", place)))
        with pytest.raises(OpenScenarioError, match=said) as raised:
            episodes_of(openscenario(path), None)
        assert "\n" not in str(raised.value)
