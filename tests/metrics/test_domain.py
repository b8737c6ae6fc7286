"""Cells of the operational design domain: bins at their edges, what a map has, and steps that count."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.metrics import domain as domain_module
from limsim_jax.metrics import exposure as exposure_module
from limsim_jax.metrics.domain import (
    CHANGE_LEFT,
    DIMENSIONS,
    GAP_EDGES,
    IN_JUNCTION,
    IN_TOWN,
    KEEP,
    MANOEUVRES,
    NAMES,
    OFF_LANES,
    ON_MOTORWAY,
    ON_RAMP,
    ON_RURAL,
    ROADS,
    SPEED_EDGES,
    STAND,
    STANDS,
    STRAIGHT,
    TTC_EDGES,
    TURN_LEFT,
    TURN_RIGHT,
    Dimension,
    Domain,
    Places,
    domain_of,
    places_of,
    possible,
)
from limsim_jax.metrics.exposure import NEVER, Counted, CountExposure, Moment, cell_of, joined, over, sparse
from limsim_jax.metrics.safety import NO_GAP
from limsim_jax.types import Config

# lanes 0 to 4: town, motorway with a neighbour, a left turn, a ramp, the null lane
PLACES = Places(
    np.array([IN_TOWN, ON_MOTORWAY, IN_JUNCTION, ON_RAMP, OFF_LANES], np.int32),
    np.array([STRAIGHT, STRAIGHT, TURN_LEFT, STRAIGHT, STRAIGHT], np.int32),
)


def moment(**given) -> Moment:
    """Egos that keep a lane in town at 10 m/s, alone."""
    plain: dict[str, Any] = {
        "step": 1, "there": True, "arrived": False, "lane": 0, "v": 10.0, "gap": NO_GAP, "v_leader": 0.0,
        "side": 0,
    }  # fmt: skip
    types = {"v": np.float32, "gap": np.float32, "v_leader": np.float32, "there": bool, "arrived": bool}
    values = {name: np.asarray(x, types.get(name, np.int32)) for name, x in (plain | given).items()}
    shape = np.broadcast_shapes(*(x.shape for x in values.values()))
    return Moment(**{name: jnp.asarray(np.broadcast_to(x, shape)) for name, x in values.items()})


def bins_of(now: Moment, domain: Domain | None = None) -> list[dict[str, str]]:
    domain = Domain() if domain is None else domain
    return [domain.cell(k) for k in np.atleast_1d(cell_of(domain, PLACES, now)).tolist()]


@pytest.mark.parametrize(("name", "edges"), [("speed", SPEED_EDGES), ("gap", GAP_EDGES), ("ttc", TTC_EDGES)])
def test_an_edge_belongs_to_the_bin_above(name, edges):
    dimension = DIMENSIONS[NAMES.index(name)]
    at = np.asarray(edges, np.float32)
    below = np.nextafter(at, np.float32(0))
    for k, x in enumerate(at):
        assert dimension.bin(float(x)) == k + 1 and dimension.bin(float(below[k])) == k
    given = {
        "speed": lambda x: moment(v=x, side=0),
        "gap": lambda x: moment(gap=x),
        # closing by 1 m/s: the gap in m is the TTC in s
        "ttc": lambda x: moment(gap=x, v=10.0, v_leader=9.0),
    }[name]
    assert [x[name] for x in bins_of(given(at))] == list(dimension.bins[1 : len(edges) + 1])
    assert [x[name] for x in bins_of(given(below))] == list(dimension.bins[: len(edges)])


def test_a_leader_and_its_absence():
    found = bins_of(moment(gap=[NO_GAP, 30.0, 30.0, 0.0], v_leader=[0.0, 10.0, 12.0, 9.0]))
    assert [x["gap"] for x in found] == ["no leader", "20 to 50", "20 to 50", "below 2"]
    assert [x["ttc"] for x in found] == ["not closing", "not closing", "not closing", "below 1.5"]


def test_manoeuvres_are_the_first_that_holds():
    now = moment(
        v=[0.4, STANDS, 5.0, 5.0, 5.0, 5.0, 5.0], side=[1, 1, -1, 0, 1, 0, 0], lane=[0, 0, 1, 1, 2, 3, -1]
    )
    found = bins_of(now)
    assert [x["manoeuvre"] for x in found] == [
        "stands", "changes left", "changes right", "keeps lane", "turns left", "keeps lane", "keeps lane",
    ]  # fmt: skip
    assert [x["road"] for x in found] == [
        "town", "town", "motorway", "motorway", "junction", "ramp", "off lanes",
    ]  # fmt: skip


def test_cells_have_numbers_in_the_order_of_the_dimensions():
    domain = domain_of(["gap", "speed"], {"gap": [5, 50], "speed": [1, 10]})
    assert domain.names == ("speed", "gap") and domain.shape == (3, 4)
    assert domain.cell(6) == {"speed": "1 to 10", "gap": "50 and more"}
    assert np.flatnonzero(domain.matching({"speed": 5.0, "gap": 60})).tolist() == [6]
    assert np.flatnonzero(domain.matching({"gap": "no leader"})).tolist() == [3, 7, 11]
    less, cells = domain.over(["gap"])
    assert less.names == ("gap",) and cells.tolist() == [0, 1, 2, 3] * 3
    three = domain_of(["speed", "gap", "ttc"], {"gap": [5], "speed": [1], "ttc": [2]})
    less, cells = three.over(["ttc", "speed"])
    assert less.names == ("speed", "ttc") and cells.tolist() == [0, 1, 2, 0, 1, 2, 0, 1, 2, *[3, 4, 5] * 3]


def test_bins_have_names_of_their_own():
    assert Dimension("gap", "m", (5.0,)).bins == ("below 5", "5 and more")
    assert Dimension("gap", "m", (100.0, 100.2)).bins == ("below 100.0", "100.0 to 100.2", "100.2 and more")


@pytest.mark.parametrize(
    ("dimensions", "edges", "said"),
    [
        (["sped"], None, "no dimension 'sped'; did you mean 'speed'?"),
        ([], None, "dimensions: the list is empty; there are speed, gap"),
        ("speed", None, "dimensions: 'speed' is text; a list is expected"),
        (["gap", "gap"], None, "dimensions: 'gap' stands twice"),
        (None, {"weather": [1]}, "no dimension 'weather'"),
        (None, {"gap": [5, 5]}, "edges: gap: 5, 5; they have to rise"),
        (None, {"gap": [5, 2]}, "edges: gap: 5, 2; they have to rise"),
        (None, {"gap": [0, 2]}, "edges: gap: 0; numbers above 0 are expected"),
        (None, {"gap": []}, "edges: gap: none; numbers above 0 are expected"),
        (None, {"gap": [float("nan")]}, "edges: gap: nan; numbers above 0"),
        (None, {"gap": ["far"]}, "numbers are expected"),
        (None, {"road": [1]}, "edges: 'road' has kinds, no edges"),
        (None, {"gap": range(1, 300)}, "cells; at most 250,000"),
    ],
)  # fmt: skip
def test_domains_that_make_no_sense_are_one_line(dimensions: Any, edges: Any, said):
    with pytest.raises(ValueError, match=r"dimension|edges") as error:
        domain_of(dimensions, edges)
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("where", [{"gaps": 1}, {"gap": "none"}, {"road": 3}])
def test_bins_that_are_not_there_are_one_line(where):
    with pytest.raises(ValueError, match=r"no dimension 'gaps'|no bin") as error:
        Domain().matching(where)
    assert "\n" not in str(error.value)


# --- maps


def test_roads_and_turns_of_maps():
    network, lane_map = bundled("intersection")
    places = places_of(network, lane_map)
    rows = {lane: k for k, lane in enumerate(x.id for x in network.drivable_lanes())}
    assert places.road[-1] == OFF_LANES
    for lane in network.drivable_lanes():
        assert places.road[rows[lane.id]] == (IN_JUNCTION if lane.junction else IN_TOWN)
    turns = [places.turn[rows[via]] for m in network.movements for via in m.via]
    assert [turns.count(x) for x in (STRAIGHT, TURN_RIGHT, TURN_LEFT)] == [6, 4, 4]
    roads = places_of(*bundled("highway")).road
    limit = np.asarray(bundled("highway")[1].speed_limit)
    assert set(roads[limit > 30]) == {ON_MOTORWAY} and ON_RURAL in roads[limit < 28]


def reachable(name: str, *dimensions: str) -> set[tuple[str, ...]]:
    network, lane_map = bundled(name)
    domain = domain_of(dimensions)
    there = possible(domain, places_of(network, lane_map), lane_map)
    return {tuple(domain.cell(k).values()) for k in np.flatnonzero(there)}


def test_cells_that_are_impossible_by_construction_are_none_to_reach():
    pairs = reachable("intersection", "gap", "ttc")
    assert ("no leader", "not closing") in pairs and ("no leader", "below 1.5") not in pairs
    assert ("2 to 5", "below 1.5") in pairs
    speeds = reachable("intersection", "speed", "manoeuvre")
    assert ("below 0.5", "stands") in speeds and ("below 0.5", "keeps lane") not in speeds
    assert ("0.5 to 8.33", "stands") not in speeds and ("0.5 to 8.33", "turns left") in speeds
    triple = reachable("intersection", "speed", "gap", "ttc")
    assert ("0.5 to 8.33", "5 to 10", "below 1.5") in triple  # 10 m/s would be 12.5 m
    assert ("0.5 to 8.33", "20 to 50", "below 1.5") not in triple
    assert ("36.1 and more", "100 and more", "below 1.5") in triple  # at 67 m/s


def test_a_map_has_some_roads_only():
    roads = reachable("highway", "manoeuvre", "road")
    assert {road for _, road in roads} == {"rural", "motorway"}
    assert ("changes left", "motorway") in roads and ("turns left", "motorway") not in roads
    crossing = reachable("intersection", "manoeuvre", "road")
    assert ("turns left", "junction") in crossing and ("keeps lane", "junction") not in crossing
    assert {road for _, road in crossing} == {"town", "junction"}


# --- steps that count


def count(records: list[Moment], goal: int = 0) -> Counted:
    """Steps of one ego, one decision each."""
    _, lane_map = bundled("intersection")
    measure = CountExposure(domain_of(["speed"]), places_of(*bundled("intersection")), 1)
    config = Config(dt=0.1)
    shape = 1, measure.domain.size
    none = Counted(jnp.zeros(shape, jnp.int32), jnp.full(shape, NEVER, jnp.int32))
    no = jnp.zeros(1, bool)
    carry = exposure_module.ExposureCarry(none, jnp.full(1, goal, jnp.int32), no, no)
    update = jax.jit(lambda carry, x: measure.update(config, lane_map, carry, x))
    for record in records:
        carry = update(carry, record)
    return jax.device_get(measure.result(config, lane_map, carry))


def test_steps_count_from_the_first_to_the_last_of_the_ego():
    """Before it is there, and once it has left, nothing counts: another vehicle may have its slot."""
    there = [[False], [True], [True], [False], [True]]
    step = [[1], [2], [3], [4], [5]]
    later = moment(there=np.ones((5, 1), bool), step=np.arange(6, 11)[:, None], v=20.0)
    found = count([moment(there=there, step=step, v=[[1.0], [1.0], [9.0], [9.0], [9.0]]), later])
    assert found.steps.tolist() == [[0, 1, 1, 0, 0, 0, 0]]
    assert found.first.tolist() == [[NEVER, 2, 3, NEVER, NEVER, NEVER, NEVER]]


def test_the_step_of_arrival_is_the_last():
    _, lane_map = bundled("intersection")
    lane, goal = (int(x[0]) for x in np.nonzero(np.asarray(lane_map.routes.is_goal)))
    arrives = moment(arrived=[[False], [True], [False]], lane=lane, step=[[1], [2], [3]])
    assert count([arrives], goal).steps.sum() == 2
    other = next(k for k in range(lane_map.routes.is_goal.shape[1]) if not lane_map.routes.is_goal[lane, k])
    assert count([arrives], other).steps.sum() == 3, "the goal of another lane is no arrival"


def test_counts_as_rows_and_over_fewer_dimensions():
    steps = np.zeros((2, 1, 6), int)
    steps[0, 0, [0, 1, 4]], steps[1, 0, 4] = [3, 2, 1], 7
    first = np.where(steps > 0, 10 + np.arange(6), NEVER)
    found = joined([sparse(Counted(steps[:1], first[:1])), sparse(Counted(steps[1:], first[1:]), 1)])  # pyright: ignore[reportArgumentType]
    assert found.world.tolist() == [0, 0, 0, 1] and found.cell.tolist() == [0, 1, 4, 4]
    assert found.steps.tolist() == [3, 2, 1, 7]
    rows = over(found, np.array([0, 0, 0, 1, 1, 1]))
    assert list(zip(*(x.tolist() for x in rows), strict=True)) == [
        (0, 0, 0, 5, 10), (0, 0, 1, 1, 14), (1, 0, 1, 7, 14),
    ]  # fmt: skip


def test_names_and_numbers_agree():
    assert MANOEUVRES[STAND] == "stands" and MANOEUVRES[KEEP] == "keeps lane"
    assert MANOEUVRES[CHANGE_LEFT] == "changes left" and ROADS[OFF_LANES] == "off lanes"
    assert domain_module.domain_of().size == Domain().size
