"""Language drivers in the engine: a model that reads descriptions drives like the same rules in JAX."""

import importlib.util
import json

import chat_server as stub
import numpy as np
import pytest

from limsim_jax.policies.language.driver import language
from limsim_jax.policies.language.rules import RuleTable
from limsim_jax.policies.language.store import read_answers, shares
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import EgoTable, ExperimentFile, TrafficTable

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(importlib.util.find_spec("httpx") is None, reason="needs httpx"),
]
SEEDS = range(2)


def episodes(policy):
    ego = EgoTable(start="1-", lane=2, s=60.0, v=12.0, goal="2-")
    experiment = ExperimentFile(
        name="small", map="highway", horizon=20.0, slots=32, ego=(ego,), traffic=TrafficTable(vehicles=20)
    )
    return Episodes(experiment, chunk=len(SEEDS), policy=policy)


def test_a_model_that_reads_drives_like_the_rules_in_jax(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", stub.KEY)
    rules = episodes(RuleTable()).run(SEEDS)
    cache, log = str(tmp_path / "cache.db"), str(tmp_path / "log.jsonl")
    with stub.serving(stub.by_rules) as server:
        driver = episodes(language(server.url, "model", cache=cache, log=log))
        model = driver.run(SEEDS)
        asked = len(server.requests)
    answers = read_answers(tmp_path / "log.jsonl")
    assert asked > 10 and shares(answers)["ok"] == 1.0
    assert {x.action for x in answers} != {"KEEP"}
    assert not model.metrics["policy_failed"].any()
    distance = rules.metrics["distance"], model.metrics["distance"]
    print("distance", *distance, asked, shares(answers))
    np.testing.assert_allclose(distance[1].mean(), distance[0].mean(), rtol=0.01)
    again = driver.run(SEEDS)  # the server is gone
    np.testing.assert_array_equal(again.digest, model.digest)
    assert stub.KEY not in json.dumps(driver.provenance(), default=str)
