"""Answers of a language model in a replay."""

from typing import Any

from limsim_jax.metrics.answers import LANGUAGE, METERED, language_columns
from limsim_jax.policies.language.answers import CallStatus
from limsim_jax.policies.language.store import Answer
from limsim_jax.report.viewer.answers import answer_rows


def answer(time, status=CallStatus.OK, node="action", **fields: Any):
    fields = {"text": f"at {time}"} | fields
    return Answer(3, 0, time, node, "abc" * 20, status, "KEEP", **fields)


def test_each_decision_is_a_row_with_the_steps_before_it():
    rows = answer_rows(
        [
            answer(0.0, node="scene", text="a bus"),
            answer(0.0, calls=2, latency=0.5, prompt_tokens=90, answer_tokens=7, scene="Ego: ..."),
            answer(1.0),
            answer(2.0, CallStatus.HTTP, text="", error="HTTP 500", calls=3),
        ]
    )
    assert [x["time"] for x in rows] == [0.0, 1.0, 2.0]
    assert rows[0]["steps"] == [{"node": "scene", "text": "a bus"}] and not rows[1]["steps"]
    assert rows[0]["spent"] == "2 calls, 0.50 s, 90 + 7 tokens" and rows[1]["spent"] == "known already"
    assert (rows[2]["text"], rows[2]["good"], rows[0]["scene"]) == ("HTTP 500", False, "Ego: ...")


def test_columns_of_rows():
    asked = [
        answer(0.0, node="risk", calls=1, latency=1.0, prompt_tokens=10, answer_tokens=1, cost=0.5),
        answer(0.0, calls=1, latency=3.0, prompt_tokens=20, answer_tokens=2, cost=0.25),
        answer(1.0),
        answer(2.0, CallStatus.TIMEOUT, calls=3, latency=2.0),
        answer(3.0, CallStatus.FALLBACK),
    ]
    found = language_columns([asked, []])
    assert list(found) == [x.name for x in LANGUAGE] and METERED < set(found)
    assert all(x[1] != x[1] for x in found.values()), "no value where no model was asked"
    first = {name.removeprefix("language_"): x[0] for name, x in found.items()}
    assert (first["ok"], first["timeout"], first["fallback"], first["cached"]) == (0.5, 0.25, 0.25, 0.25)
    assert [first[name] for name in ("questions", "calls", "prompt_tokens", "answer_tokens")] == [4, 5, 30, 3]
    assert (first["cost"], first["latency"]) == (0.75, 2.0)
