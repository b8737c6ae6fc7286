"""`Map` as users meet it."""

import pytest

import limsim_jax as lj


def test_a_map_draws_itself_and_writes_a_file(tmp_path):
    pytest.importorskip("matplotlib")
    town = lj.load_map("roundabout")
    drawing = town.draw(tmp_path / "map.svg", bounds=(-60, -60, 60, 60), dpi=40)
    assert drawing._repr_png_().startswith(b"\x89PNG")
    assert (tmp_path / "map.svg").read_text().startswith("<?xml")
