"""Lessons from failures: which decisions are looked at, what is kept, and that tests stay tests."""

import importlib.util
from types import SimpleNamespace
from typing import Any

import chat_server as stub
import numpy as np
import pytest

from limsim_jax.bridges.chat.faults import always
from limsim_jax.bridges.chat.replies import decision
from limsim_jax.policies.language.answers import CallStatus
from limsim_jax.policies.language.driver import language
from limsim_jax.policies.language.memory import Memory, read_memories
from limsim_jax.policies.language.reading import read_description
from limsim_jax.policies.language.scene import numbers
from limsim_jax.policies.language.store import Answer
from limsim_jax.sweeps.answers import check_seeds
from limsim_jax.sweeps.reflect import failed_decisions, reflect
from limsim_jax.sweeps.runner import sweep
from limsim_jax.sweeps.store import Entry, Outcome, ResultsError, Shards, open_results, register

ENTRY = Entry("ramp", "language", {"chunk": 8}, {"success": "1 if it is there"})
CONTACTS = {0: 4.5, 1: 2.5}
"""Seeds with a contact, s; seeds from 4 on succeed."""


def scene_text(seed, time):
    return (
        f"Ego: speed {seed + time:.1f} m/s, limit 20.0 m/s.\nAhead: none.\nSignal: none.\n"
        "Route: stay on this lane.\nActions: KEEP = hold the speed; DECELERATE = brake gently."
    )


def answer(seed, time, node="action"):
    text = scene_text(seed, time)
    facts = numbers(read_description(text)[0])
    return Answer(seed, 0, time, node, "hash", CallStatus.OK, "KEEP", scene=text, facts=facts)


@pytest.fixture
def results(tmp_path):
    seeds = np.arange(6)
    moments: dict[str, Any] = {"seed": list(CONTACTS), "ego": [0, 0], "rank": [1, 1]}
    moments |= {"kind": ["contact"] * 2, "time": list(CONTACTS.values())}
    found = Outcome(
        seeds, np.zeros(6, np.int32), {"success": (seeds > 3).astype(float)},
        moments, np.arange(6).astype(np.uint64),
        {k: [answer(k, float(t), n) for t in range(8) for n in ("scene", "action")] for k in range(6)},
    )  # fmt: skip
    register(tmp_path / "r", [ENTRY])
    Shards(tmp_path / "r", ENTRY).write(found)
    return open_results(tmp_path / "r")


def test_the_last_decisions_before_failures_on_even_seeds_are_looked_at(results):
    found = dict(failed_decisions(results, "ramp", "language", last=2))
    assert {seed: [x.time for x in some] for seed, some in found.items()} == {0: [3.0, 4.0], 2: [6.0, 7.0]}


@pytest.mark.skipif(importlib.util.find_spec("httpx") is None, reason="needs httpx")
def test_what_is_learnt_is_kept_once_and_never_tested_on(results, tmp_path):
    names = {"scenario": "ramp", "policy": "language"}
    with stub.serving(always(decision("DECELERATE", "it was close"))) as server:
        driver = language(server.url, "model").function
        for _ in range(2):  # the second time learns the same scenes anew
            reflect(results, driver, tmp_path / "m.jsonl", **names)  # pyright: ignore[reportArgumentType]
        asked = server.requests[-1]["messages"][-1]["content"]
        assert "ended in a failure" in asked and scene_text(2, 7.0) in asked
        learnt = read_memories(tmp_path / "m.jsonl")
        assert sorted(x.seed for x in learnt) == [0, 0, 0, 2, 2, 2]
        assert {x.answer for x in learnt} == {decision("DECELERATE", "it was close")}
        taught = language(server.url, "model", memory=str(tmp_path / "m.jsonl"))
        worlds = SimpleNamespace(
            scenario="ramp", policy="language", chunk=8, units={}, compile=lambda: pytest.fail("compiled"),
            notes=SimpleNamespace(drivers=[taught.function]),
        )  # fmt: skip
        check_seeds(worlds, [1, 3])
        with pytest.raises(ValueError, match=r"ramp/language: seed 2 taught the memory; .*--odd-seeds"):
            sweep([worlds], range(1, 5), tmp_path / "s")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ResultsError, match=r"no answers of a language model on even seeds of ramp \(other\)"):
        reflect(results, SimpleNamespace(), tmp_path / "m.jsonl", scenario="ramp", policy="other")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="odd seeds are for tests"):
        Memory(5, (), "", "")
