"""Random road networks: the same map from the same number, and all kinds can be read."""

import hashlib

import numpy as np
import pytest
from random_roads import KINDS, kind_of, write_map
from random_roads.loads import SIZES, demand_of, load, table_sizes

from limsim_jax.maps import read_network

pytest.importorskip("sumo", reason="eclipse-sumo is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("random_maps")


@pytest.mark.parametrize("seed", range(12))
def test_maps_of_all_kinds_can_be_read(seed, folder):
    made = write_map(seed, folder)
    assert made.kind == kind_of(seed)
    network = read_network(made.path)
    lanes = list(network.drivable_lanes())
    assert len(lanes) > 1
    assert network.movements or made.of == "road"
    assert all(np.isfinite(lane.xyz).all() for lane in lanes)


def test_twelve_maps_are_of_all_kinds():
    assert {kind_of(seed) for seed in range(12)} == set(KINDS)


@pytest.mark.parametrize("seed", [2, 3, 9])  # a chain, a motorway, a roundabout
def test_a_seed_always_draws_the_same_map(seed, folder, tmp_path):
    first, second = (write_map(seed, where).path.read_bytes() for where in (folder, tmp_path))
    assert hashlib.sha256(first).digest() == hashlib.sha256(second).digest()


def test_generated_networks_are_the_same_up_to_the_date(folder, tmp_path):
    texts = [write_map(1, where).path.read_text() for where in (folder, tmp_path)]
    first, second = (text[text.index("<net ") :] for text in texts)
    assert first == second


def test_maps_of_a_class_have_the_same_shapes(folder):
    """Two maps and their demands, of which a program sees no difference."""
    shapes = []
    for seed in (3, 9):
        loaded = load(read_network(write_map(seed, folder).path))
        assert loaded.size == "small"
        assert table_sizes(loaded.lane_map) == SIZES["small"].maps
        demand, rate = demand_of(loaded, "moderate", seed, 60.0)
        assert rate > 0
        assert demand.initial == SIZES["small"].demand["vehicles"]
        shapes.append([np.shape(x) for x in (*vars(demand).values(),) if hasattr(x, "shape")])
    assert shapes[0] == shapes[1]


def test_high_demand_is_more_than_low(folder):
    loaded = load(read_network(write_map(9, folder).path))
    rates = [demand_of(loaded, level, 9, 60.0)[1] for level in ("low", "moderate", "high")]
    assert rates == sorted(rates)
    assert rates[0] < rates[-1]
