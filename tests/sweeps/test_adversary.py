"""Searches for failures: found where they are known, plausible, changed back, and no probability."""

import copy
import itertools
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, norm

from limsim_jax.sweeps import adversary as module
from limsim_jax.sweeps.adversary import (
    Hit,
    Plain,
    change_less,
    least_worlds,
    search,
)
from limsim_jax.sweeps.experiment import ExperimentError
from limsim_jax.sweeps.plausible import Plausible, unusual
from limsim_jax.sweeps.store import Outcome, ResultsError
from limsim_jax.traffic.demand.draws import Layout, Number

adversary: Any = module.adversary  # of doubles of episodes

UNITS = {
    "contacts": "bodies touched", "at_fault_contacts": "of them at fault", "min_ttc": "s",
    "min_distance": "m", "max_delta_v": "m/s", "duration": "s", "distance": "m",
}  # fmt: skip
VEHICLES, EACH = 20, 10
LATE = 19
"""The vehicle that comes in after the end."""

FAR = 4.0
"""Standard deviations from the middle to the event."""


def one_number(z):
    """A long T of vehicle 3: the event is `FAR` away."""
    return FAR - z[:, 3 * EACH]


def two_vehicles(z):
    """Two numbers of two vehicles: the event is `FAR` away, in the direction between them."""
    return FAR - (z[:, 3 * EACH] - z[:, 5 * EACH + 1]) / np.sqrt(2)


class Town:
    """Worlds of twenty vehicles with ten numbers each; a rule tells how far the event is."""

    scenario, chunk, egos, units = "town", 20, 1, UNITS
    experiment = SimpleNamespace(horizon=60.0)

    given: Any = None

    def __init__(self, rule, policy="still", version="1"):
        each = ["T", *(f"x{j}" for j in range(1, EACH))]
        numbers = [Number(what, k, -1, 0, k) for k in range(VEHICLES) for what in each]
        shapes = {"roles": (VEHICLES, 2), "order": (0,)}
        self.layout = Layout(tuple(numbers), np.array(["normal"] * len(numbers)), shapes, {})
        self.town, self.rule, self.policy = SimpleNamespace(lane_ids=["main"]), rule, policy
        self.version, self.counter = version, [0]

    def numbers(self, seeds):
        rows = [np.random.default_rng(seed).standard_normal(self.layout.size) for seed in seeds]
        return np.array(rows, np.float32)

    def scenario_of(self, seed):
        due = np.where(np.arange(VEHICLES) == LATE, 99.0, 1.0)
        return SimpleNamespace(schedule=SimpleNamespace(time=due))

    def from_numbers(self, given):
        other = copy.copy(self)
        other.given = given
        return other

    def provenance(self):
        return {"source": self.version}

    def run(self, seeds):
        assert 1 <= len(seeds) <= self.chunk
        self.counter[0] += len(seeds)
        left = self.rule(self.layout.to_normals(self.given(np.asarray(seeds))[0]))
        hit, n = left <= 0, len(left)
        metrics = {
            "contacts": hit.astype(float),
            "at_fault_contacts": hit.astype(float),
            "min_ttc": np.maximum(left, 0),
            "min_distance": np.full(n, 5.0),
            "max_delta_v": np.where(hit, -left, np.nan),
            "duration": np.full(n, 30.0),
            "distance": np.full(n, 300.0),
        }
        return Outcome(np.asarray(seeds), np.zeros(n, np.int32), metrics, {}, np.zeros(n, np.uint64))


# --- how plausible -----------------------------------------------------------------------------------


def groups_of(sizes):
    ends = np.cumsum([0, *sizes])
    return {f"vehicle {k}": np.arange(a, b) for k, (a, b) in enumerate(itertools.pairwise(ends))}


def test_shares_are_those_of_chi_squared_and_of_the_normal():
    z = np.array([0.5, -2.0, 1.0, 3.5, 0.0, 9.0])
    plausible = Plausible(groups_of([2, 3]), 0.01)  # the sixth number does not count
    found = plausible.of(z)
    assert found.world == pytest.approx(chi2.sf(0.25 + 4 + 1 + 12.25, 5), rel=1e-12)
    assert found.vehicle == pytest.approx(1 - (1 - chi2.sf(13.25, 3)) ** 2, rel=1e-9)
    assert found.number == pytest.approx(1 - (1 - 2 * norm.sf(3.5)) ** 5, rel=1e-9)
    assert found.most == "vehicle 1" and found.largest == 3.5
    assert found.distance == pytest.approx(np.sqrt(17.5))
    assert found.least == min(found.world, found.vehicle, found.number) == found.number
    assert found.as_json()["least"] == found.least


def test_each_share_is_uniform_over_random_worlds():
    """A share of p is undercut in a share p of random worlds."""
    z = np.random.default_rng(0).standard_normal((4000, 40))
    plausible = Plausible(groups_of([10, 20, 5, 5]), 0.01)
    found = [plausible.of(x) for x in z]
    for name in ("world", "vehicle", "number"):
        share = np.array([getattr(x, name) for x in found])
        for p in (0.01, 0.2, 0.7):
            assert (share < p).mean() == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / len(z)))


def test_an_unusual_driver_is_seen_among_a_thousand_numbers():
    z = np.random.default_rng(1).standard_normal(1000)
    z[500] = 6.0
    found = Plausible(groups_of([20] * 50), 0.01).of(z)
    assert found.world > 0.05 and found.number < 1e-5 and found.least == found.number


def test_the_nearest_plausible_world():
    plausible = Plausible(groups_of([10] * 20), 0.05)
    z = np.random.default_rng(2).standard_normal((50, 201)) * 1.5
    z[0] = 0.1
    found = plausible.nearest(z)
    assert all(plausible.holds(x) for x in found) and not plausible.holds(z[1])
    assert max(plausible.of(x).least for x in found[1:]) == pytest.approx(0.05, rel=1e-6), "on the bound"
    assert (found[0] == z[0]).all() and (found[:, 200] == z[:, 200]).all()


def test_the_most_unusual_numbers_are_named():
    z = np.array([0.0, -2.0, 1.0, 9.0])
    found = unusual(z, ["a", "b", "c", "d"], np.array([0, 1, 2]), 5)
    assert [str(x) for x in found] == ["b: -2.0", "c: +1.0"]


# --- the search --------------------------------------------------------------------------------------


def plain(count, size=60):
    z = np.random.default_rng(3).standard_normal((count, size))
    return [Plain(k, x, float(5 - x[7])) for k, x in enumerate(z)]


def searched(rule, **given):
    asked = []

    def ask(z):
        asked.append(z)
        return rule(z)

    everything = Plausible(groups_of([10] * 6), 0.01)
    options = {"starts": 3, "members": 16, "worlds": 2000, "most": 4, "seed": 0}
    found, begun = search(ask, plain(12), lambda _: everything, **(options | given))
    return found, begun, np.concatenate(asked) if asked else np.zeros((0, 60)), asked, everything


def test_failures_are_found_one_per_start_and_all_searches_run_in_one_batch():
    found, begun, worlds, batches, plausible = searched(lambda z: 5 - (z[:, 7] + z[:, 8]) / np.sqrt(2))
    assert len(found) == 4 == len({hit.seed for hit in found}) and begun >= 4
    for hit in found:
        assert (hit.z[7] + hit.z[8]) / np.sqrt(2) >= 5 and plausible.holds(hit.z) and hit.searched
    assert {len(batch) for batch in batches} == {3 * 16}, "three searches at once, refilled"
    assert all(plausible.holds(z) for z in worlds), "no world that is not plausible runs"


def test_an_event_that_cannot_happen_ends_with_nothing():
    found, begun, worlds, _, _ = searched(lambda z: np.full(len(z), 7.0))
    assert found == [] and begun == 12, "a search that leads nowhere makes room for the next start"
    assert len(worlds) == 12 * module.PATIENCE * 16, "and the search ends before its worlds do"


def test_a_search_keeps_to_its_worlds():
    _, _, worlds, _, _ = searched(lambda z: 50 - z[:, 7], worlds=150)
    assert len(worlds) == 3 * 3 * 16, "the next generation does not fit"
    found, begun, worlds, _, _ = searched(lambda z: 50 - z[:, 7], worlds=15)
    assert (found, begun, len(worlds)) == ([], 0, 0)


def test_an_event_out_of_plausible_reach_is_not_found():
    """One number at 7 standard deviations: the search gets to the bound and no farther."""
    found, _, worlds, _, _ = searched(lambda z: 7 - z[:, 7])
    bound = norm.isf((1 - 0.99 ** (1 / 60)) / 2)
    assert found == [] and worlds[:, 7].max() == pytest.approx(bound, abs=0.05)


def test_equal_seeds_search_alike():
    rule = lambda z: 5 - (z[:, 7] + z[:, 8]) / np.sqrt(2)  # noqa: E731
    one, two, other = (searched(rule, seed=seed) for seed in (1, 1, 2))
    assert len(one[2]) == len(two[2]) and (one[2] == two[2]).all()
    assert one[2][:16].tobytes() != other[2][:16].tobytes()
    assert not np.allclose(one[2][:16], one[2][16:32]), "searches of a run differ, too"


def test_one_number_is_enough_for_a_search():
    only = Plausible({"v": np.array([7])}, 0.01)
    found, _ = search(
        lambda z: 2.5 - z[:, 7], plain(3), lambda _: only, starts=2, members=8, worlds=800, most=1, seed=0
    )
    assert found and found[0].z[7] >= 2.5


# --- changing less -----------------------------------------------------------------------------------


DRIVERS = np.arange(201) % 10 != 1
"""Of ten numbers of a vehicle the second says where it is."""


def test_bodies_and_drivers_go_to_the_middle_before_places():
    z = np.random.default_rng(6).standard_normal((1, 200))
    plausible, asked = Plausible(groups_of([10] * 20), 0.01), []

    def ask(worlds):
        asked.extend(worlds)
        return (~DRIVERS[:200] & (worlds == 0)).any(1) - 0.5

    (hit,) = change_less(ask, [Hit(z[0], 0, True, plausible)], DRIVERS[:200], 200, 0)
    assert (hit.z[DRIVERS[:200]] == 0).all() and (hit.z[~DRIVERS[:200]] == z[0, ~DRIVERS[:200]]).all()
    first = [(world[DRIVERS[:200]] == 0).all() for world in asked].index(True)
    assert all((world[~DRIVERS[:200]] != 0).all() for world in asked[: first + 1])


def test_what_is_left_is_what_the_event_hangs_on():
    z = np.random.default_rng(4).standard_normal((3, 201))
    z[:, 33], z[:, 71] = 3.0, -3.5
    plausible = Plausible(groups_of([10] * 20), 0.01)
    hits = [Hit(x, k, True, plausible) for k, x in enumerate(z)]
    asked = []

    def ask(worlds):
        asked.append(len(worlds))
        return np.maximum(2 - worlds[:, 33], worlds[:, 71] + 2)

    assert not any(hit.narrowed for hit in hits)
    for hit, before in zip(change_less(ask, hits, DRIVERS, 2000, 0), hits, strict=True):
        assert hit.narrowed
        assert np.flatnonzero(hit.z).tolist() == [33, 71], "also the number that does not count is gone"
        assert 2 <= hit.z[33] <= 2.3 and -2.7 <= hit.z[71] <= -2, "as near to the middle as steps go"
        assert (hit.seed, hit.searched) == (before.seed, True)
    assert sum(asked) < 3 * module.ENOUGH and len(asked) < 40, "one batch for all failures"


def test_changing_less_keeps_the_event_and_to_its_worlds():
    z = np.random.default_rng(5).standard_normal((2, 200))
    z[:, 33] = 3.0
    plausible, asked = Plausible(groups_of([10] * 20), 0.01), []

    def ask(worlds):
        asked.append(len(worlds))
        return 2 - worlds[:, 33]

    hits = change_less(ask, [Hit(x, k, True, plausible) for k, x in enumerate(z)], DRIVERS[:200], 25, 0)
    assert sum(asked) <= 25 and all(hit.z[33] >= 2 for hit in hits)
    unchanged = change_less(ask, [Hit(x, 0, True, plausible) for x in z], DRIVERS[:200], 3, 0)
    assert not any(hit.narrowed for hit in unchanged)
    assert all((hit.z == x).all() for hit, x in zip(unchanged, z, strict=True))


# --- in worlds ---------------------------------------------------------------------------------------


def test_failures_are_about_as_far_from_the_middle_as_the_event():
    for rule, slack in ((one_number, 1 / 0.9), (two_vehicles, 1.25)):
        found = adversary(Town(rule), "contact", None, worlds=1500, least_plausible=0.005)
        assert len(found.failures) == 5
        for failure in found.failures:
            assert FAR - 1e-3 <= failure.plausibility.distance <= slack * FAR
            assert failure.plausibility.least >= 0.005 * (1 - 1e-5)


def test_what_failures_hang_on_is_named():
    found = adversary(Town(two_vehicles), "contact", None, worlds=1500)
    said = {one.what: one.z for one in found.failures[0].unusual}
    names = {"T of vehicle 4 that enters on lane main", "x1 of vehicle 6 that enters on lane main"}
    assert set(said) == names and found.failures[0].changed == 2
    assert said["T of vehicle 4 that enters on lane main"] > 1
    text = str(found)
    assert "T of vehicle 4 that enters on lane main: +" in text and "more number" not in text


def test_failures_can_be_run_again():
    found = adversary(Town(two_vehicles), "contact", None, worlds=1500)
    again = found.episodes.run(range(len(found.failures))).metrics
    assert (again["contacts"] == 1).all()
    told = [failure.metrics["max_delta_v"] for failure in found.failures]
    np.testing.assert_allclose(again["max_delta_v"], told)
    assert [failure.number for failure in found.failures] == list(range(len(found.failures)))


def test_the_table_says_that_it_is_no_probability():
    found = adversary(Town(one_number), "contact", None, worlds=1500)
    for text in (str(found), json.dumps(found.as_json()), module.Adversary.__doc__, module.__doc__):
        assert text and ("no probability" in text or "not how often they happen" in text)
    assert "probability" not in {name for failure in found.as_json()["failures"] for name in failure}


def test_an_impossible_event_is_an_honest_end():
    town = Town(lambda z: np.full(len(z), 3.0))
    found = adversary(town, "contact", None, reference=Town(one_number, "other"), worlds=600)
    assert found.failures == () and found.values.shape == (0, town.layout.size)
    assert "none found, which does not mean that there is none" in str(found)
    assert found.worlds.total == town.counter[0] <= 600 and found.worlds.reference == 0


def test_a_common_event_needs_no_search():
    town = Town(lambda z: 0.5 - z[:, 30])
    found = adversary(town, "contact", None, worlds=1000)
    assert found.plain == 5 and found.starts == found.hits == found.worlds.search == 0
    assert not any(failure.searched for failure in found.failures) and found.worlds.plain < 100
    assert all(failure.seed < 100 for failure in found.failures)


def test_plain_worlds_that_are_not_plausible_are_no_failures(monkeypatch):
    monkeypatch.setattr(module, "change_less", lambda ask, hits, *_: list(hits))
    always = Town(lambda z: np.full(len(z), -1.0))
    found = adversary(always, "contact", None, worlds=1000, least_plausible=0.5)
    assert found.plain == 5 and all(failure.plausibility.least >= 0.5 for failure in found.failures)


def test_a_failure_that_is_not_narrowed_down_says_so():
    found = adversary(Town(lambda z: two_vehicles(z) - 1.5), "contact", None, worlds=250)
    vague = [failure for failure in found.failures if not failure.narrowed]
    assert 0 < len(vague) < len(found.failures), "worlds go to the first failures first"
    assert "not narrowed down: some of " in str(found)


def test_equal_failures_count_once():
    found = adversary(Town(lambda z: np.full(len(z), -1.0)), "contact", None, worlds=1000)
    assert len(found.failures) == 1, "the world with all numbers in the middle"
    assert found.failures[0].changed == 0 and "every number is in the middle" in str(found)
    assert found.plain == 5


def test_vehicles_that_come_after_the_end_do_not_count():
    late = LATE * EACH
    found = adversary(Town(lambda z: FAR - z[:, late]), "contact", None, worlds=800)
    assert found.failures == ()
    hits = adversary(Town(lambda z: 0.5 - z[:, late]), "contact", None, worlds=800).failures
    assert hits and all(failure.changed == 0 for failure in hits), "its numbers stay those of the seed"


@pytest.mark.parametrize("bound", [0.3, 0.01])
def test_no_failure_is_less_plausible_than_the_bound(bound):
    found = adversary(Town(one_number), "contact", None, worlds=1000, least_plausible=bound)
    assert all(failure.plausibility.least >= bound * (1 - 1e-5) for failure in found.failures)
    assert bool(found.failures) == (bound == 0.01), "4 standard deviations are too far for 30 %"


def test_the_reference_marks_what_it_fails_at_too():
    hard = lambda z: np.where(z[:, 10] > 0.2, 1.0, -1.0)  # noqa: E731  # fails where a number is in the middle
    with_both = adversary(Town(one_number), "contact", None, reference=Town(hard, "sure"), worlds=1500)
    assert [failure.avoided for failure in with_both.failures] == [False] * len(with_both.failures)
    assert "unsolved by sure, too" in str(with_both) and with_both.worlds.reference > 0
    easy = adversary(
        Town(one_number), "contact", None, reference=Town(lambda z: 1 + 0 * z[:, 0], "calm"), worlds=1500
    )
    assert all(failure.avoided for failure in easy.failures) and "avoided by calm" in str(easy)
    none = adversary(Town(one_number), "contact", None, worlds=1500)
    assert {failure.avoided for failure in none.failures} == {None} and none.worlds.reference == 0


def test_failures_that_the_reference_avoids_come_first():
    half = lambda z: np.where(z[:, 3 * EACH] > 2.8, 1.0, -1.0)  # noqa: E731
    found = adversary(Town(two_vehicles), "contact", None, reference=Town(half, "half"), worlds=1500)
    marks = [failure.avoided for failure in found.failures]
    assert marks == sorted(marks, reverse=True) and {True, False} == set(marks)
    again = half(Town(half).layout.to_normals(found.values)) > 0
    assert again.tolist() == marks


def test_an_interrupted_search_goes_on(tmp_path):
    one = Town(two_vehicles)
    calm = Town(lambda z: 1 + 0 * z[:, 0], "calm")
    told = []
    whole = adversary(
        one, "contact", tmp_path / "whole", reference=calm, worlds=1000, tell=lambda *x: told.append(x)
    )
    assert one.counter[0] + calm.counter[0] == whole.worlds.total <= 1000
    assert told == sorted(told) and told[-1] == (whole.worlds.total, 1000)
    stopped = Town(two_vehicles)
    with pytest.raises(KeyboardInterrupt):
        adversary(stopped, "contact", tmp_path / "part", reference=calm, worlds=1000, tell=_stop_after(400))
    assert "failures" not in json.loads((tmp_path / "part" / "adversary.json").read_text())
    rest, again = Town(two_vehicles), Town(two_vehicles)
    found = adversary(rest, "contact", tmp_path / "part", reference=calm, worlds=1000)
    assert 0 < rest.counter[0] < one.counter[0] and (found.values == whole.values).all()
    kept = json.loads((tmp_path / "part" / "adversary.json").read_text())
    assert kept["failures"] == json.loads(json.dumps(whole.as_json()["failures"])) and kept["made_by"]
    assert adversary(again, "contact", tmp_path / "part", reference=calm, worlds=1000).worlds == whole.worlds
    assert again.counter[0] == 0
    with np.load(tmp_path / "part" / "failures.npz") as arrays:
        assert (arrays["values"] == whole.values).all()
    assert not list(tmp_path.rglob("*.part"))


def _stop_after(worlds):
    def tell(done, most):
        assert done <= most == 1000
        if done > worlds:
            raise KeyboardInterrupt

    return tell


def test_another_search_needs_another_folder(tmp_path):
    from limsim_jax.sweeps.estimate import estimate

    adversary(Town(one_number), "contact", tmp_path, worlds=600)
    with pytest.raises(ResultsError, match=r"made with seed = 0, now 5; use another folder"):
        adversary(Town(one_number), "contact", tmp_path, worlds=600, seed=5)
    with pytest.raises(ResultsError, match="holds the results of an adversary; name another folder"):
        estimate(Town(one_number), "contact", tmp_path, worlds=5000)  # pyright: ignore[reportArgumentType]
    adversary(Town(one_number), "contact", tmp_path, worlds=600, seed=5, fresh=True)
    assert json.loads((tmp_path / "adversary.json").read_text())["made_by"]["adversary"]["seed"] == 5


FAULTS = [
    ("crash", {}, "event: 'crash'; known are contact, fault, and conditions such as min_ttc<1"),
    ("contact", {"worlds": 50}, "worlds: 50 are too few for 4 starts with 200 random numbers; at least "),
    ("contact", {"starts": 0}, "starts: 0; at least 1"),
    ("contact", {"most": 0}, "most: 0; at least 1 failure"),
    ("contact", {"least_plausible": 1.0}, "least_plausible: 1; a share of random worlds between 0 and 1"),
    ("contact", {"least_plausible": np.nan}, "least_plausible: nan; a share of random worlds"),
    ("contact", {"seed": -1}, "seed: -1; at least 0"),
    ("contact", {"reference": Town(one_number)}, "reference: 'still' is the policy under test; name another"),
]


@pytest.mark.parametrize(("event", "given", "said"), FAULTS, ids=[said[:30] for *_, said in FAULTS])
def test_faults_are_one_line(event, given, said, tmp_path):
    town = Town(one_number)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        adversary(town, event, tmp_path / "out", **{"worlds": 600, **given})
    assert said in str(error.value) and town.counter[0] == 0 and not (tmp_path / "out").exists()


def test_the_least_number_of_worlds_is_enough():
    needed = least_worlds(200, 4, 5)
    found = adversary(Town(one_number), "contact", None, worlds=needed)
    assert 0 < found.worlds.search and found.worlds.total <= needed and found.starts >= 4
    with pytest.raises(ValueError, match=f"at least {needed}"):
        adversary(Town(one_number), "contact", None, worlds=needed - 1)


def test_no_ego_no_adversary():
    town = Town(one_number)
    town.egos = 0
    with pytest.raises(ValueError, match="town: ego: there is none, so no event of one"):
        adversary(town, "contact", None)


# --- with the engine ---------------------------------------------------------------------------------


def crossing():
    import limsim_jax as lj

    return lj.Experiment(
        map="intersection", name="crossing", horizon=12, slots=32, vehicles=20, flows=[],
        ego=lj.Ego(start="6-", s=60.0, goal="2", policy="constant_speed"),
    )  # fmt: skip


def test_an_unknown_reference_is_one_line():
    import limsim_jax as lj

    said = r"^reference: crossing: ego.policy: unknown policy 'nope'; [^\n]+$"
    with pytest.raises(ExperimentError, match=said):
        lj.adversary(crossing(), reference="nope", progress=False)


@pytest.mark.engine
def test_a_blind_ego_fails_where_a_reference_does_not(tmp_path):
    """The ego drives on at constant speed; traffic brakes for it where it can."""
    import limsim_jax as lj

    found = lj.adversary(
        crossing(), "contact", reference="like_traffic", worlds=80, starts=1, most=6, chunk=4, out=tmp_path,
        progress=False,
    )  # fmt: skip
    assert 0 < found.plain < len(found.failures) and found.hits and found.worlds.total <= 80
    metrics = found.episodes.run(range(4)).metrics
    assert (metrics["contacts"] > 0).all()
    for failure in found.failures:
        assert failure.avoided is True and failure.plausibility.least >= 0.01
    world = found.replay(0, explain=False)
    assert world.metrics["contacts"] == metrics["contacts"][0]
    with pytest.raises(ValueError, match="failure 9: there are"):
        found.replay(9)
    assert json.loads((tmp_path / "adversary.json").read_text())["reference"] == "like_traffic"
