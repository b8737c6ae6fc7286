"""Estimates of rare events in worlds: where the probability is known, resumed, refused."""

import copy
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from limsim_jax.sweeps import estimate as module
from limsim_jax.sweeps.estimate import worlds_per_level
from limsim_jax.sweeps.events import event_of
from limsim_jax.sweeps.store import Outcome, ResultsError
from limsim_jax.traffic.demand.draws import Layout, Number

estimate: Any = module.estimate  # of doubles of episodes

UNITS = {
    "contacts": "bodies touched", "at_fault_contacts": "of them at fault", "min_ttc": "s",
    "min_distance": "m", "max_delta_v": "m/s", "duration": "s", "distance": "m",
}  # fmt: skip
SECONDS, METRES = 36.0, 500.0


class NumberedEpisodes:
    """Worlds whose time to collision is a sum of two of their five numbers; below 0 it is a contact."""

    scenario, policy, chunk, egos, units = "wall", "blind", 64, 1, UNITS

    given: Any = None

    def __init__(self, p: float, version: str = "1"):
        self.beta, self.version, self.worlds_run = -norm.ppf(p), version, 0
        numbers = [Number("gap", -1, 0, 0, 0), *(Number("T", k, -1, 0, k) for k in range(4))]
        kinds = np.array(["uniform", *["normal"] * 4])
        self.layout = Layout(tuple(numbers), kinds, {"roles": (4, 2), "order": (0,)}, {})
        self.town = SimpleNamespace(lane_ids=["main"])
        self.counter = [0]

    def from_numbers(self, given):
        other = copy.copy(self)
        other.given = given
        return other

    def provenance(self):
        return {"source": self.version, "chunk": self.chunk, "device": "abacus"}

    def run(self, seeds):
        assert 1 <= len(seeds) <= self.chunk
        self.counter[0] += len(seeds)
        values, policy_seeds = self.given(np.asarray(seeds))
        assert len(set(policy_seeds.tolist())) == len({row.tobytes() for row in values})
        z = self.layout.to_normals(values)
        left = self.beta + (z[:, 0] - z[:, 1]) / np.sqrt(2)  # a short gap, and a long T
        hit = left <= 0
        metrics = {
            "contacts": hit.astype(float),
            "at_fault_contacts": (hit & (z[:, 2] > 0)).astype(float),
            "min_ttc": np.maximum(left, 0),
            "min_distance": np.full(len(z), 5.0),
            "max_delta_v": np.where(hit, -left, np.nan),
            "duration": np.full(len(z), SECONDS),
            "distance": np.full(len(z), METRES),
        }
        rows = np.asarray(seeds, np.int64)
        return Outcome(rows, np.zeros(len(rows), np.int32), metrics, {}, np.zeros(len(rows), np.uint64))


def test_the_probability_is_within_its_interval_and_scales_with_exposure():
    p = 1e-3
    found = estimate(NumberedEpisodes(p), "contact", None, worlds=10_000)
    assert found.probability.low < p < found.probability.high
    assert found.per_hour.estimate == pytest.approx(found.probability.estimate * 3600 / SECONDS)
    assert found.per_million_km.high == pytest.approx(found.probability.high * 1e9 / METRES)
    assert found.worlds <= 10_000
    text = str(found)
    assert "per million km" in text and "36.0 s and 0.500 km per episode" in text


def test_half_of_the_contacts_are_at_fault():
    found = estimate(NumberedEpisodes(0.02), "fault", None, worlds=20_000)
    assert found.probability.low < 0.01 < found.probability.high
    assert all(failure.metrics["at_fault_contacts"] == 1 for failure in found.failures)


def test_failures_are_different_worlds_and_can_be_run_again():
    found = estimate(NumberedEpisodes(1e-3), "contact", None, worlds=5_000)
    assert len({row.tobytes() for row in found.values}) == len(found.failures) > 10
    weights = [failure.weight for failure in found.failures]
    assert sum(weights) == pytest.approx(1) and weights == sorted(weights, reverse=True)
    again = found.episodes.run(range(min(64, len(found.failures)))).metrics
    assert (again["contacts"] == 1).all()
    told = [failure.metrics["max_delta_v"] for failure in found.failures][:64]
    np.testing.assert_allclose(again["max_delta_v"], told)


def test_what_sets_failures_apart():
    found = estimate(NumberedEpisodes(1e-4), "contact", None, worlds=20_000)
    said = {shift.what: shift.mean.estimate for shift in found.shifts}
    assert said["gap before arrival 1 on lane main"] < -2
    assert said["T of vehicle 1 that enters on lane main"] > 2
    assert "T of vehicle 4 that enters on lane main" not in said


@pytest.mark.parametrize("method", ["subset", "crude", "cross-entropy"])
def test_methods_agree(method):
    found = estimate(NumberedEpisodes(0.01), "contact", None, method=method, worlds=12_000)
    assert found.probability.low < 0.01 < found.probability.high
    assert found.worlds <= 12_000


def test_an_event_that_is_not_seen_has_a_bound():
    found = estimate(NumberedEpisodes(1e-9), "contact", None, worlds=2_000, least=1e-3)
    assert found.probability.estimate == 0 and 0.5e-3 < found.probability.high < 1.5e-3
    assert not found.failures and "below" in str(found)


def test_conditions_on_a_metric():
    found = estimate(NumberedEpisodes(1e-3), "min_ttc<0.5", None, worlds=6_000)
    truth = norm.cdf(-(NumberedEpisodes(1e-3).beta - 0.5))
    assert found.probability.low < truth < found.probability.high


def test_an_interrupted_estimate_goes_on(tmp_path, monkeypatch):
    one = NumberedEpisodes(1e-3)
    whole = estimate(one, "contact", tmp_path / "whole", worlds=2_000)
    stopped = NumberedEpisodes(1e-3)
    with pytest.raises(KeyboardInterrupt):
        estimate(stopped, "contact", tmp_path / "part", worlds=2_000, tell=_stop_after(700))
    rest = NumberedEpisodes(1e-3)
    found = estimate(rest, "contact", tmp_path / "part", worlds=2_000)
    assert 0 < rest.counter[0] < one.counter[0]
    assert found.probability == whole.probability and (found.values == whole.values).all()
    kept = json.loads((tmp_path / "part" / "estimate.json").read_text())
    assert kept["per_episode"]["estimate"] == whole.probability.estimate
    again = NumberedEpisodes(1e-3)
    assert estimate(again, "contact", tmp_path / "part", worlds=2_000).probability == whole.probability
    assert again.counter[0] == 0
    values, weights = module.failures_of(tmp_path / "part")
    assert (values == whole.values).all() and sum(weights) == pytest.approx(1)


def _stop_after(worlds):
    def tell(done, most):
        if done > worlds:
            raise KeyboardInterrupt

    return tell


def test_a_damaged_batch_runs_again(tmp_path):
    whole = estimate(NumberedEpisodes(1e-2), "contact", tmp_path, worlds=2_000)
    (tmp_path / "worlds" / "000001.npz").write_bytes(b"broken")
    again = NumberedEpisodes(1e-2)
    assert estimate(again, "contact", tmp_path, worlds=2_000).probability == whole.probability
    assert 0 < again.counter[0] < 200


def test_a_fresh_estimate_leaves_no_failures_of_another(tmp_path):
    estimate(NumberedEpisodes(1e-2), "contact", tmp_path, worlds=2_000)
    assert (tmp_path / "failures.npz").exists()
    estimate(NumberedEpisodes(1e-12, "2"), "contact", tmp_path, worlds=2_000, least=1e-3, fresh=True)
    assert not (tmp_path / "failures.npz").exists()


def test_another_estimate_needs_another_folder(tmp_path):
    estimate(NumberedEpisodes(1e-2), "contact", tmp_path, worlds=2_000)
    with pytest.raises(ResultsError, match=r"made with event = contact, now min_ttc<1; use another folder"):
        estimate(NumberedEpisodes(1e-2), "min_ttc<1", tmp_path, worlds=2_000)
    with pytest.raises(ResultsError, match="made with another version of limsim_jax"):
        estimate(NumberedEpisodes(1e-2, "2"), "contact", tmp_path, worlds=2_000)
    fresh = NumberedEpisodes(1e-2, "2")
    estimate(fresh, "contact", tmp_path, worlds=2_000, fresh=True)
    assert fresh.counter[0] > 500
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "results.json").write_text("{}")
    with pytest.raises(ResultsError, match="holds the results of a sweep; name another folder"):
        estimate(fresh, "contact", tmp_path / "sweep", worlds=2_000)


FAULTS = [
    ("crash", {}, "event: 'crash'; known are contact, fault, and conditions such as min_ttc<1"),
    ("min_tcc<1", {}, "event: no metric 'min_tcc'; did you mean min_ttc or min_distance?"),
    ("min_ttc<soon", {}, "event: 'soon' in 'min_ttc<soon' is no number"),
    ("contact", {"worlds": 100}, "worlds: 100 are too few for subset down to 0.0001; at least 1100"),
    ("contact", {"worlds": 100, "method": "crude"}, "worlds: 100 are too few for crude"),
    ("contact", {"runs": 2}, "runs: 2; at least 10"),
    ("contact", {"method": "auto"}, "method: 'auto'; known are subset, crude, cross-entropy"),
    ("contact", {"method": "splitting"}, "method: 'splitting'; known are subset"),
    ("contact", {"least": 2.0}, "least: 2; a probability between 0 and 1"),
    ("contact", {"level": 95.0}, "the level must lie between 0 and 1"),
]


@pytest.mark.parametrize(("event", "given", "said"), FAULTS, ids=[said[:30] for *_, said in FAULTS])
def test_faults_are_one_line(event, given, said):
    episodes = NumberedEpisodes(0.1)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        estimate(episodes, event, None, **{"worlds": 2_000, **given})
    assert said in str(error.value) and episodes.counter[0] == 0


def test_a_refused_estimate_leaves_no_folder(tmp_path):
    wide = NumberedEpisodes(0.1)
    wide.layout = Layout(wide.layout.numbers * 10, np.tile(wide.layout.kinds, 10), wide.layout.shapes, {})
    with pytest.raises(ValueError, match="cross-entropy serves 30 dimensions at most, and there are 50"):
        estimate(wide, "contact", tmp_path / "out", method="cross-entropy")
    assert not (tmp_path / "out").exists()


def test_no_ego_no_event():
    episodes = NumberedEpisodes(0.1)
    episodes.egos = 0
    with pytest.raises(ValueError, match="wall: ego: there is none, so no event of one"):
        estimate(episodes, "contact", None)


@pytest.mark.parametrize("method", ["subset", "crude", "cross-entropy"])
def test_no_method_runs_more_worlds_than_allowed(method):
    for worlds in (2_000, 7_777):
        found = estimate(NumberedEpisodes(1e-12), "contact", None, method=method, worlds=worlds, least=1e-3)
        assert 0.4 * worlds < found.worlds <= worlds
        assert worlds_per_level(worlds, method, 1e-3) >= 20


def columns(**given):
    plain = {"contacts": 0.0, "at_fault_contacts": 0.0, "min_ttc": np.nan, "min_distance": 30.0}
    return {k: np.array([x]) for k, x in (plain | {"max_delta_v": np.nan} | given).items()}


def test_the_limit_state_leads_to_a_contact():
    limit = event_of("contact", UNITS).limit
    worlds = [
        columns(min_distance=np.nan),  # alone
        columns(),
        columns(min_distance=2.0),
        columns(min_ttc=6.0),
        columns(min_ttc=1.0),
        columns(min_ttc=0.0, min_distance=1.0),  # side by side
        columns(min_ttc=0.0, min_distance=0.3),
        columns(contacts=1.0, min_ttc=0.0, max_delta_v=0.0),
        columns(contacts=1.0, min_ttc=0.0, max_delta_v=9.0),
    ]
    g = np.concatenate([limit(world) for world in worlds])
    assert (np.diff(g) < 0).all() and (g[:7] > 0).all() and (g[7:] < 0).all()


def test_a_contact_without_fault_leads_less_far_than_a_near_one():
    limit = event_of("fault", UNITS).limit
    hit = columns(contacts=1.0, min_ttc=0.0, max_delta_v=9.0)
    guilty = columns(contacts=1.0, at_fault_contacts=1.0, min_ttc=0.0, max_delta_v=9.0)
    near = columns(min_ttc=0.2, min_distance=1.0)
    assert limit(near)[0] < limit(hit)[0] < limit(columns(min_ttc=1.0))[0]
    assert limit(guilty)[0] < 0


def test_bounds_of_conditions_count_as_they_are_written():
    value = {"min_ttc": np.array([1.0, np.nan])}
    assert event_of("min_ttc<1", UNITS).limit(value)[0] > 0
    assert event_of("min_ttc<=1", UNITS).limit(value)[0] <= 0
    assert event_of("min_ttc>=1", UNITS).limit(value)[0] <= 0
    assert event_of("min_ttc > 1", UNITS).limit(value)[0] > 0
    assert (event_of("min_ttc<1", UNITS).limit(value)[1] > 0) and event_of("min_ttc>1", UNITS).limit(value)[
        1
    ] > 0
