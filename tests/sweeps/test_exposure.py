"""Exposure: counts against a loop over a trace, coverage against hand-computed examples, pages and faults."""

import functools
import itertools
import json
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax import cli
from limsim_jax.api import exposure as api
from limsim_jax.maps.lane_map import pose
from limsim_jax.metrics.domain import (
    DIMENSIONS,
    MANOEUVRES,
    ROADS,
    SIDEWAYS,
    STANDS,
    Dimension,
    domain_of,
)
from limsim_jax.metrics.exposure import NEVER, CountExposure, Sparse
from limsim_jax.metrics.safety import NO_GAP
from limsim_jax.policies.base import LikeTraffic, Policy
from limsim_jax.policies.several import Several
from limsim_jax.report.exposure import write_page
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.sweeps import exposure as exposure_module
from limsim_jax.sweeps.coverage import greedy_cover, growth, unseen
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentFile
from limsim_jax.sweeps.exposure import Counter, Exposure, Visit
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control
from limsim_jax.types import Status

# --- counts against a loop over every step


@dataclass(frozen=True)
class Weave(Policy):
    """Steers to the left and to the right, over lines."""

    def __call__(self, config, lane_map, state, memory, key):
        """Steering swings within 6 s."""
        swing = 0.03 * jnp.sin(config.time(state.step) * (2 * np.pi / 6))
        nothing = jnp.zeros(state.egos.slot.shape[0])
        return Command(control=Control(acceleration=nothing, steering=nothing + swing)), memory


class Seen(NamedTuple):
    """What the oracle looks at, of a step."""

    state: Any
    box: Any
    other: Any
    gap: Any
    x: Any


def seen(lane_map):
    def record(tick):
        other, gap = tick.decision.obstacles
        return Seen(tick.state, tick.box, other[:, 0], gap[:, 0], tick.x)

    return record


SEEDS = (1, 0, 5)


@functools.cache
def counter() -> Counter:
    """A crossing with lights and empty slots.

    Its egos are one of the traffic, one that leaves its lane, and one that soon arrives.
    """
    egos = {"start": "6-", "s": 60.0, "goal": "2"}, {"start": "1", "s": 40.0, "goal": "4"}
    told = {
        "name": "crossing", "map": "intersection", "horizon": 60.0, "slots": 32,
        "ego": [*egos, {"start": "2_0_-3", "s": 100.0, "goal": "2"}],
        "traffic": {"vehicles": 20, "flow": [{"rate": 350}]},
    }  # fmt: skip
    policy = Several((LikeTraffic(), Weave(), LikeTraffic()))
    found = Counter(Episodes(ExperimentFile.model_validate(told), chunk=4, policy=policy), domain_of())
    run = replace(found.worlds.rollout, record=seen)
    found.worlds = Worlds(run, found.worlds.lane_map, found.episodes.sample, chunk=4)
    return found


@functools.cache
def traced():
    """The worlds of `SEEDS`, a chunk that is not full, and all of their steps: one program."""
    worlds = counter().worlds
    return worlds.replay(worlds.start(SEEDS), count=len(SEEDS))


def below(dimension: Dimension, x: Any) -> int:
    """Edges that are not above a number."""
    return sum(bool(x >= np.float32(edge)) for edge in dimension.edges)


def loop(world: int, ego: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps and first steps of the cells of an ego, by a loop over the trace."""
    domain, places, lane_map = counter().domain, measure().places, counter().worlds.lane_map
    steps, first = np.zeros(domain.size, int), np.full(domain.size, NEVER)
    records = traced().trace
    goal = int(records.state.goal[world, 0, ego])
    is_goal, length = np.asarray(lane_map.routes.is_goal), np.asarray(lane_map.length)
    over = False
    for t in range(records.box.shape[1]):
        box, other, gap, x = (y[world, t] for y in records[1:])
        state = SimpleNamespace(
            **{
                name: np.asarray(getattr(records.state, name))[world, t]
                for name in ("active", "status", "lane", "s", "v", "side", "goal", "step")
            }
        )
        there = bool(state.active[ego]) and not state.status[ego] & int(Status.NOT_FINITE)
        if over or not there:
            over = True  # it was there at the start
            continue
        lane, v = int(state.lane[ego]), state.v[ego]
        place = {"speed": 0, "gap": DIMENSIONS[1].size - 1, "ttc": DIMENSIONS[2].size - 1}
        place["speed"] = below(DIMENSIONS[0], v)
        lead = int(other[ego])
        if lead >= 0 and state.active[lead]:
            way = max(np.float32(np.float32(gap[ego] + x[lead]) - x[ego]), np.float32(0))
            if way < NO_GAP:
                place["gap"] = below(DIMENSIONS[1], way)
                if v > state.v[lead]:
                    ttc = way / np.float32(v - state.v[lead])
                    place["ttc"] = below(DIMENSIONS[2], ttc)
        road = ROADS[places.road[lane]]
        side = int(state.side[ego])
        if ego == 1 and side:  # it moves in the plane
            heading = float(pose(lane_map, lane, state.s[ego])[2])
            sideways = float(v) * np.sin(float(box[ego, 2]) - heading)
            beside = int((lane_map.left if side > 0 else lane_map.right)[lane])
            side = int(np.sign(sideways)) if beside >= 0 and abs(sideways) >= SIDEWAYS else 0
        if v < STANDS:
            does = "stands"
        elif road == "junction":
            does = MANOEUVRES[places.turn[lane]]
        else:
            does = {0: "keeps lane", 1: "changes left", -1: "changes right"}[side]
        number = 0
        for dimension in domain.dimensions:
            own = {"manoeuvre": does, "road": road}.get(dimension.name)
            number = number * dimension.size + (
                place[dimension.name] if own is None else dimension.bins.index(own)
            )
        steps[number] += 1
        first[number] = min(first[number], state.step)
        over = bool(is_goal[lane, goal] and is_goal[lane, state.goal[ego]] and state.s[ego] > length[lane])
    return steps, first


def measure() -> CountExposure:
    found = counter().worlds.rollout.measure
    assert isinstance(found, CountExposure)
    return found


@pytest.mark.engine
@pytest.mark.parametrize("ego", [0, 1, 2])
@pytest.mark.parametrize("world", range(len(SEEDS)))
def test_counts_are_those_of_a_loop_over_the_trace(world, ego):
    steps, first = loop(world, ego)
    found = traced().measures
    assert steps.sum() > 20 and (steps > 0).sum() >= 2
    np.testing.assert_array_equal(found.steps[world, ego], steps)
    np.testing.assert_array_equal(found.first[world, ego], first)


@pytest.mark.engine
def test_the_worlds_have_what_the_loop_is_to_tell_apart():
    """Unequal rows, an ego that leaves early, empty slots, lane changes of the free ego and a junction."""
    steps = traced().measures.steps
    totals = steps[: len(SEEDS)].sum(-1)
    assert len({steps[k].tobytes() for k in range(len(SEEDS))}) == len(SEEDS), "no row is as another"
    assert totals[:, 2].max() < 300 and (totals[:, :2] == 600).all()
    active = traced().trace.state.active
    assert not active.all() and active.any()
    kinds = [
        {tuple(counter().domain.cell(k).values())[3:] for k in np.nonzero(steps[:, ego].sum(0))[0]}
        for ego in (0, 1)
    ]
    both = {("changes left", "town"), ("turns left", "junction"), ("stands", "town"), ("keeps lane", "town")}
    assert both <= kinds[0] and both - {("stands", "town")} <= kinds[1]
    reached = steps.sum((0, 1)) > 0
    cells = [counter().domain.cell(k) for k in np.flatnonzero(reached & ~counter().possible)]
    assert all(cell["road"] == "off lanes" for cell in cells), "the rest of what happens is possible"


@pytest.mark.engine
def test_the_rows_of_an_exposure_are_those_counts():
    found = counter().count(SEEDS)
    steps = traced().measures.steps[: len(SEEDS)]
    assert found.total == pytest.approx(steps.sum() * 0.1)
    np.testing.assert_allclose(found.seconds.ravel(), steps.sum((0, 1)) * 0.1)
    np.testing.assert_array_equal(found.worlds.ravel(), (steps.sum(1) > 0).sum(0))
    assert found.seeds == SEEDS and found.egos == 3
    stands = found.seeds_for({"speed": 0.0})
    wanted = [seed for k, seed in enumerate(SEEDS) if steps[k].reshape(3, 7, -1)[:, 0].sum()]
    assert stands == wanted


# --- coverage, by hand

# worlds 0 to 3 and cells 0 to 5
WORLD = np.array([0, 0, 0, 1, 1, 2, 2, 2, 3])
CELL = np.array([0, 1, 2, 0, 1, 2, 3, 4, 5])


def test_a_cover_takes_the_world_with_the_most_new_cells():
    # 0 and 2 have three each: 0 comes first, then 2 adds 3 and 4, 3 adds 5
    assert greedy_cover(WORLD, CELL) == [(0, 3), (2, 2), (3, 1)]
    assert greedy_cover(WORLD[:0], CELL[:0]) == []
    rng = np.random.default_rng(0)
    pairs = np.unique(rng.integers(0, [12, 30], (150, 2)), axis=0).T
    left, found = set(pairs[1].tolist()), []
    while left:
        gains = [len(left & set(pairs[1][pairs[0] == k].tolist())) for k in range(12)]
        best = int(np.argmax(gains))
        found.append((best, gains[best]))
        left -= set(pairs[1][pairs[0] == best].tolist())
    assert greedy_cover(*pairs) == found


def test_growth_is_the_mean_over_all_orders():
    worlds = [set(CELL[WORLD == k].tolist()) for k in range(4)]
    for many in range(5):
        means = [len(set().union(*some)) for some in itertools.combinations(worlds, many)]
        assert growth(CELL, 4, np.array([many]))[0] == pytest.approx(np.mean(means))


def test_what_is_unseen_comes_from_cells_of_a_single_world():
    steps = np.array([10, 5, 1, 20, 4, 6, 3, 2, 9])
    found = unseen(WORLD, CELL, steps, 5)
    # cells 3, 4 and 5 are of one world each: 3 + 2 + 9 of 60 steps; the fifth world has been nowhere
    assert found.share == pytest.approx(14 / 60) and found.once == 3
    assert found.cells == pytest.approx(3 / 5)
    assert np.isnan(unseen(WORLD[:0], CELL[:0], steps[:0], 2).share)


def test_the_unseen_share_is_what_another_world_brings():
    """Of random worlds, the mean over many is the time of one more world in new cells."""
    rng = np.random.default_rng(1)
    p = 1.0 / np.arange(1, 200) ** 1.5
    p /= p.sum()
    said, true = [], []
    for _ in range(300):
        draws = rng.multinomial(8, p, 11)
        world, cell = np.nonzero(draws[:10])
        said.append(unseen(world, cell, draws[world, cell], 10).share)
        true.append(draws[10][draws[:9].sum(0) == 0].sum() / 8)
    error = np.std(np.subtract(said, true)) / np.sqrt(300)
    assert abs(np.mean(said) - np.mean(true)) < 4 * error and error < 0.02


# --- the exposure of a few rows


def small(**changes) -> Exposure:
    """Speed and gap with two edges each: 3 by 4 cells, four seeds; cells 3 and 11 are impossible."""
    domain = domain_of(["speed", "gap"], {"speed": [1, 10], "gap": [5, 50]})
    found = Sparse(
        world=np.array([0, 0, 1, 2, 2, 3]), ego=np.array([0, 0, 0, 0, 0, 0]),
        cell=np.array([0, 5, 5, 5, 6, 3]), steps=np.array([10, 40, 30, 10, 5, 5]),
        first=np.array([1, 11, 1, 1, 11, 7]),
    )  # fmt: skip
    possible = np.ones(12, bool)
    possible[[3, 11]] = False
    plain: dict[str, Any] = {
        "scenario": "town", "policy": "mine", "seeds": (10, 11, 12, 13), "egos": 1, "dt": 0.1,
        "domain": domain, "possible": possible, "found": found,
    }  # fmt: skip
    return Exposure(**(plain | changes))


def searched() -> Exposure:
    more = Sparse(*(np.array(x) for x in ([0, 1, 1], [0, 0, 0], [5, 7, 8], [9, 9, 9], [4, 5, 6])))
    return small(more=small(seeds=(14, 15), found=more))


def test_time_and_worlds_of_cells():
    found = small()
    assert found.total == pytest.approx(10.0)
    assert found.seconds.tolist() == [[1.0, 0, 0, 0.5], [0, 8.0, 0.5, 0], [0, 0, 0, 0]]
    assert found.worlds.tolist() == [[1, 0, 0, 1], [0, 3, 1, 0], [0, 0, 0, 0]]
    speed = found.over("speed")
    assert speed.seconds.tolist() == [1.5, 8.5, 0] and speed.worlds.tolist() == [2, 3, 0]
    assert [x.estimate for x in speed.shares()] == pytest.approx([0.15, 0.85, 0])
    assert np.isnan(speed.shares()[0].low), "too few worlds for an interval"


def test_intervals_of_shares_come_from_the_spread_of_worlds():
    rng = np.random.default_rng(2)
    part = rng.integers(10, 90, 40)
    rows = Sparse(
        np.repeat(np.arange(40), 2), np.zeros(80, int), np.tile([0, 1], 40),
        np.stack([part, 100 - part], 1).ravel(), np.ones(80, int),
    )  # fmt: skip
    found = small(seeds=tuple(range(40)), found=rows).shares()
    half = 1.96 * (part / 100).std() / np.sqrt(40)
    assert found[0].low == pytest.approx(part.mean() / 100 - half, abs=0.01)
    assert found[0].high == pytest.approx(part.mean() / 100 + half, abs=0.01)
    assert found[0].low + found[1].high == pytest.approx(1) and found[2] == (0, 0, 0)


def test_uncovered_cells_leave_out_the_impossible():
    found = small()
    cells = found.uncovered()
    assert len(cells) == 7 and {"speed": "10 and more", "gap": "no leader"} not in cells
    assert {"speed": "10 and more", "gap": "below 5"} in cells
    assert found.over("speed").uncovered() == [{"speed": "10 and more"}]
    assert len(searched().uncovered()) == 5 and len(searched().uncovered(searched=False)) == 7


def test_seeds_of_cells():
    found = small()
    assert found.seeds_for({"speed": 5.0, "gap": "5 to 50"}) == [10, 11, 12]
    assert found.visits({"speed": "below 1"}) == [
        Visit(10, 0, 0.1, 1.0),
        Visit(13, 0, 7 * 0.1, 0.5),
    ]
    rare = dict((tuple(cell.values()), [x.seed for x in seen]) for cell, seen in found.rare(1))
    assert rare == {
        ("below 1", "below 5"): [10], ("below 1", "no leader"): [13], ("1 to 10", "50 and more"): [12],
    }  # fmt: skip
    # the search reaches two new cells, and one that is covered
    more = searched().reached()
    assert [(tuple(x.cell.values()), x.seed) for x in more] == [
        (("1 to 10", "no leader"), 15), (("10 and more", "below 5"), 15),
    ]  # fmt: skip
    assert searched().seeds_for({"speed": 20, "gap": 1}) == [15]
    assert searched().seeds_for({"speed": 5.0, "gap": 6}) == [10, 11, 12, 14], "those of a search are last"


def test_sets_of_seeds_and_what_is_to_come():
    found = small()
    assert found.cover() == [(10, 2), (12, 1), (13, 1)]
    assert sum(x.adds for x in found.cover(1)) == 2 + 4
    assert found.growth(1)[1][-1] == pytest.approx(2 + 4), "bins of both dimensions, apart"
    at, cells = found.growth()
    assert (
        at.tolist() == [0, 1, 2, 3, 4] and cells[-1] == pytest.approx(4) and cells[1] == pytest.approx(6 / 4)
    )
    assert found.unseen().share == pytest.approx(2.0 / 10.0) and found.unseen().cells == pytest.approx(3 / 4)


def test_two_egos_of_a_world_are_one_world():
    rows = Sparse(*(np.array(x) for x in ([0, 0], [0, 1], [5, 5], [3, 4], [8, 2])))
    found = small(seeds=(1,), egos=2, found=rows)
    assert found.worlds[1, 1] == 1 and found.unseen().once == 1 and found.cover() == [(1, 1)]
    assert [x.ego for x in found.visits({"speed": 5})] == [0, 1]


def test_tables_and_text():
    found = searched()
    rows = found.table().to_pylist()
    assert len(rows) == 11 and rows[0]["worlds"] == 3 and rows[0]["first_seed"] == 10
    assert sum(row["seconds"] for row in rows) == pytest.approx(10)
    assert [row["searched"] for row in rows if row["searched"]] == [15, 15]
    told = json.loads(json.dumps(found.as_json()))
    assert told["unseen"]["once"] == 3 and told["not_covered"] and told["search"]["seeds"] == [14, 15]
    assert [x["cell"] for x in told["covered"]] == [[0, 0], [0, 3], [1, 1], [1, 2]]
    assert "4 of 11 cells are covered; 2 further seeds reach 2 more" in str(found)
    assert "not covered: 10 and more\n" in str(small())
    assert "not covered: 10 and more (seed 15)\n" in str(found), "only the search reaches it"


def test_the_page_shows_what_is_covered_and_what_is_not(tmp_path):
    page = write_page(tmp_path / "exposure.html", searched(), {10: "replays/a.html"}).read_text()
    assert page.count('class="open"') == 5 + 1 and page.count('class="searched"') == 2 + 1
    assert page.count('class="never"') == 1 + 1, "a possible cell counts as such if it was reached"
    assert '<a href="replays/a.html#t=0.0">seed 10 at 0.1 s</a>' in page and "seed 13 at 0.7 s" in page
    assert "seed 15 at 0.5 s" in page and "http" not in page.replace("http-equiv", "").replace(
        "http://www.w3.org/2000/svg", ""
    )


def test_a_single_dimension_has_a_page(tmp_path):
    page = write_page(tmp_path / "exposure.html", small().over("speed")).read_text()
    assert "Time by dimension" in page and "Pairs of dimensions" not in page


def test_replays_are_of_the_seeds_with_the_most_rare_cells(tmp_path):
    saved = []

    def again(seed, ego):
        return SimpleNamespace(save=lambda path: saved.append((seed, path.name)))

    page = api.write(small(again=again), tmp_path / "out", replays=2)
    assert saved == [(10, "town-mine-10.html"), (12, "town-mine-12.html")]
    assert json.loads((page.parent / "exposure.json").read_text())["scenario"] == "town"
    with pytest.raises(ValueError, match="cannot make its worlds again"):
        small().replay(10)


# --- searches without an engine


class Doubles:
    """Worlds whose cell is their seed."""

    def __init__(self, episodes, domain):
        self.possible, self.domain, self.ran = np.arange(12) < 9, domain, []

    def count(self, seeds, *, tell=None, enough=None):
        done = []
        for first in range(0, len(seeds), 2):
            done += seeds[first : first + 2]
            self.ran.append(len(done))
            if tell is not None:
                tell(len(done))
            if enough is not None and enough(np.array(seeds[first : first + 2]) % 12):
                break
        k = np.arange(len(done))
        rows = Sparse(k, 0 * k, np.array(done) % 12, 0 * k + 1, 0 * k + 1)
        return small(seeds=tuple(done), found=rows, possible=self.possible)


@pytest.mark.parametrize(("search", "further"), [(0, None), (3, 3), (50, 12)])
def test_a_search_ends_when_all_possible_cells_are_reached(search, further, monkeypatch):
    monkeypatch.setattr(exposure_module, "Counter", Doubles)
    told = []
    domain, nothing = small().domain, cast("Any", None)
    found, _ = exposure_module.exposure(
        nothing, domain, [0, 1, 3], search=search, tell=lambda *x: told.append(x)
    )
    assert told[-1] == (3 + (further or 0), 3 + search)
    if further is None:
        assert found.more is None
        return
    assert found.more is not None and found.more.seeds == tuple(range(4, 4 + further))
    assert len(found.uncovered()) == (3 if further == 3 else 0), "seed 14 reaches cell 2"


# --- what makes no sense


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seeds": 0}, "seeds: 0; between 1 and 2^31"),
        ({"seeds": []}, "seeds: none; at least one is needed"),
        ({"seeds": [3, 3]}, "seeds: one is there twice"),
        ({"seeds": [-1]}, "seeds: from -1 to -1; they must be within 0"),
        ({"search": -1}, "search: -1; at least 0"),
        ({"dimensions": ["sped"]}, "no dimension 'sped'; did you mean 'speed'?"),
        ({"edges": {"gap": [5, 5]}}, "edges: gap: 5, 5; they have to rise"),
        ({"experiment": "paper"}, "experiment: 5 scenarios at once"),
    ],
)
def test_what_makes_no_sense_is_one_line(options, said):
    given: dict[str, Any] = {"experiment": "highway"} | options
    with pytest.raises(ValueError, match=r"\w") as error:
        api.exposure(given.pop("experiment"), **given)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_an_experiment_without_an_ego_has_no_exposure():
    with pytest.raises(ValueError, match="town: exposure is that of an ego, and there is none"):
        Counter(SimpleNamespace(egos=0, scenario="town"), domain_of())  # pyright: ignore[reportArgumentType]


def test_names_of_dimensions_are_checked():
    with pytest.raises(ValueError, match="no dimension 'sped'; did you mean 'speed'"):
        small().over("sped")
    with pytest.raises(ValueError, match="over: name dimensions, of speed, gap"):
        small().over()
    with pytest.raises(ValueError, match="gap: no bin 'far'; there are below 5, 5 to 50"):
        small().seeds_for({"gap": "far"})
    with pytest.raises(ValueError, match="ways: 0; at least 1 dimension"):
        small().cover(0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--edges", "gap"), "--edges: 'gap'; NAME=X,Y is expected, as gap=5,20,50"),
        (("--edges", "gap=5,x"), "NAME=X,Y is expected"),
        (("--edges", "gap=5,2"), "edges: gap: 5, 2; they have to rise"),
        (("--dimensions", "sped"), "did you mean 'speed'?"),
        (("--seeds", "0"), "--seeds"),
        (("--policy", "nothing"), "unknown policy 'nothing'"),
    ],
)
def test_options_of_the_command_that_make_no_sense_are_one_line(options, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["exposure", "highway", *options]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert "nothing" in options or not (tmp_path / "results").exists()


def test_the_command_prints_and_writes(capsys, tmp_path, monkeypatch):
    asked = {}

    def run(experiment, **options):
        asked.update(options, name=experiment.name)
        return searched()

    monkeypatch.setattr(api, "exposure", run)
    out = tmp_path / "out"
    options = ["--seeds", "4", "--search", "2", "--edges", "speed=1,10", "--edges", "gap=5,50"]
    options += ["--dimensions", "speed,gap", "--replays", "0", "--out", str(out)]
    assert cli.main(["exposure", "highway", *options]) == 0
    assert asked["name"] == "highway" and asked["seeds"] == 4 and asked["search"] == 2
    assert asked["dimensions"] == ["speed", "gap"] and asked["edges"] == {"speed": [1, 10], "gap": [5, 50]}
    said = capsys.readouterr().out
    assert "town, mine" in said and "6 worlds in" in said and "exposure.html" in said
    assert (out / "exposure.json").exists() and (out / "exposure.html").exists()
