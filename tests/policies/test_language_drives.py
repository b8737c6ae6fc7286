"""Language drivers in the engine: like the same rules in JAX, kept, repeatable, with and without latency.

One compiled program serves all tests: its driver asks the server of this module, whose model they choose.
"""

import importlib.util
import json
from collections import Counter
from types import SimpleNamespace

import chat_server as stub
import numpy as np
import pytest

from limsim_jax.api.results import Results, rebuild
from limsim_jax.bridges.chat.rules import rules
from limsim_jax.bridges.chat.server import ChatServer
from limsim_jax.policies.language.answers import CallStatus
from limsim_jax.policies.language.rules import RuleTable
from limsim_jax.policies.language.store import Cache
from limsim_jax.report.tables import headline
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import EgoTable, ExperimentFile, TrafficTable
from limsim_jax.sweeps.runner import sweep, verify
from limsim_jax.sweeps.store import open_results

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(importlib.util.find_spec("httpx") is None, reason="needs httpx"),
]
SEEDS = range(2)
PRICES = {"prompt_price": 2.0, "answer_price": 4.0}


def episodes(policy=None, options=None):
    """Worlds in which the ego starts below the limit, under a policy or under `language` as a file has it."""
    told = {} if options is None else {"policy": "language", "options": options}
    ego = EgoTable(start="1-", lane=2, s=60.0, v=26.0, goal="2-", **told)
    experiment = ExperimentFile(
        name="small", map="highway", horizon=20.0, slots=64, ego=(ego,), traffic=TrafficTable(vehicles=50)
    )
    return Episodes(experiment, chunk=len(SEEDS), policy=policy)


@pytest.fixture(scope="module")
def drive():
    """Worlds that a language model drives, its driver, and the server, whose `model` each test sets."""
    said = SimpleNamespace(model=rules, number=0)

    def model(request):
        said.number += 1
        return said.model(request)

    with ChatServer({"model": model}, key=stub.KEY) as server:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OPENAI_API_KEY", stub.KEY)
            worlds = episodes(options={"server": server.url, "model": "model", **PRICES})
            yield SimpleNamespace(
                worlds=worlds, driver=worlds.notes.drivers[0], server=server, said=said, patch=patch
            )


@pytest.fixture(autouse=True)
def anew(drive):
    """A driver that knows nothing, and the model of rules."""
    drive.said.model, drive.said.number = rules, 0
    change(drive.driver, cache=Cache(None), latency=None)
    drive.driver.told.clear()
    drive.server.key = stub.KEY


def change(driver, **values):
    """The driver of a compiled program with other settings."""
    for name, value in values.items():
        object.__setattr__(driver, name, value)


def test_a_model_that_reads_drives_like_the_rules_in_jax(drive):
    by_rules = episodes(RuleTable()).run(SEEDS)
    model = drive.worlds.run(SEEDS)
    answers = [x for some in model.answers.values() for x in some]
    assert {x.status for x in answers} == {CallStatus.OK}
    chosen = Counter(x.action for x in answers)
    print(chosen)
    assert min(chosen["ACCELERATE"], chosen["KEEP"]) > 0, chosen
    distance = by_rules.metrics["distance"], model.metrics["distance"]
    print("distance", *distance, chosen)
    np.testing.assert_allclose(distance[1].mean(), distance[0].mean(), rtol=0.01)
    # a model that brakes drives another way: the agreement means something
    change(drive.driver, cache=Cache(None))
    drive.said.model = lambda request: '{"reason": "", "action": "DECELERATE"}'
    other = drive.worlds.run(SEEDS).metrics["distance"]
    assert (other < 0.8 * distance[0]).all()


def test_a_sweep_keeps_what_the_model_answered(drive, tmp_path):
    # every third answer is none
    drive.said.model = lambda request: "hm" if drive.said.number % 3 == 2 else rules(request)
    sweep([drive.worlds], SEEDS, tmp_path)
    stored = open_results(tmp_path)
    table = stored.episodes.to_pydict()
    assert sum(table["language_calls"]) == drive.said.number > 20
    shares = {name: table[f"language_{name}"] for name in ("ok", "repaired", "illegal")}
    np.testing.assert_allclose(np.sum(list(shares.values()), 0), 1)
    # over both worlds: in which of them a question is the third one is chance, and an equal question is not
    # asked again
    assert 0 < np.mean(shares["ok"]) < 1
    assert all(10 < x <= 20 for x in table["language_questions"])
    prices = [
        PRICES[f"{name}_price"] * np.array(table[f"language_{name}_tokens"]) for name in ("prompt", "answer")
    ]
    np.testing.assert_allclose(table["language_cost"], np.sum(prices, 0) / 1e6, rtol=1e-6)
    results = Results(stored)
    answers = results.answers(1)
    assert [x.time for x in answers] == list(range(int(table["language_questions"][1])))
    assert {x.world for x in answers} == {1}
    assert any(label == "answers: ok, %" for label, *_ in headline(stored).rows)
    assert not any(stub.KEY.encode() in path.read_bytes() for path in tmp_path.rglob("*.*"))
    assert stub.KEY not in json.dumps(drive.worlds.provenance(), default=str)

    # a replay takes what was answered: no question reaches the server
    asked = drive.said.number
    change(drive.driver, cache=Cache(None))
    drive.server.key = "another"
    results._made["small", "language"] = drive.worlds
    again = results.replay(1)
    assert list(again.answers) == answers
    for name in ("distance", "language_illegal", "language_calls"):
        assert again.metrics[name] == pytest.approx(table[name][1], rel=1e-4), name
    again.save(tmp_path / "replay.html")
    assert verify(stored, [drive.worlds]).ok
    assert drive.said.number == asked
    rebuild(stored, "small", "language")  # without a word to the server, which refuses the key


def test_reruns_from_the_cache_are_equal_to_the_byte(drive, tmp_path):
    change(drive.driver, cache=Cache(tmp_path / "replies.db"))
    first = drive.worlds.run(SEEDS)
    asked = drive.said.number
    change(drive.driver, cache=Cache(tmp_path / "replies.db"))
    second = drive.worlds.run(SEEDS)
    assert drive.said.number == asked > 0
    np.testing.assert_array_equal(second.digest, first.digest)
    assert (second.metrics["language_cached"] == 1).all() and not second.metrics["language_calls"].any()
    assert stub.KEY.encode() not in (tmp_path / "replies.db").read_bytes()


def test_a_latency_of_zero_is_paused_bit_for_bit(drive):
    ends = {}
    for latency in (None, 0.0, 2.0):
        change(drive.driver, latency=latency)
        ends[latency] = drive.worlds.run(SEEDS).digest.tolist()
    assert ends[0.0] == ends[None]
    assert not set(ends[2.0]) & set(ends[None])
