"""Language drivers without an engine: descriptions, answers, faults of servers, cache, caps, time."""

import importlib.util
import json
from typing import Any

import chat_server as stub
import numpy as np
import pytest

from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.base import policy_name
from limsim_jax.policies.host import FAR
from limsim_jax.policies.language import answers, memory
from limsim_jax.policies.language.answers import CallStatus, Reply, parse
from limsim_jax.policies.language.describe import (
    MOST_TOKENS,
    PLAIN,
    STYLES,
    available,
    description,
    token_bound,
)
from limsim_jax.policies.language.driver import LanguageDriver, language
from limsim_jax.policies.language.rules import rule_action
from limsim_jax.policies.language.scene import NONE, Facts, Neighbour
from limsim_jax.policies.language.store import read_answers, shares
from limsim_jax.policies.registry import POLICIES
from limsim_jax.traffic.ego import Meta

needs_httpx = pytest.mark.skipif(importlib.util.find_spec("httpx") is None, reason="needs httpx")
OFFERED = {action: action.name for action in Meta}


def some_facts(rng) -> Facts:
    def other():
        gap = rng.choice([NONE, rng.uniform(0, 150)])
        return Neighbour(float(gap), float(rng.uniform(0, 35)) if gap < NONE else 0.0)

    shown = rng.random() < 0.5
    facts: list[Any] = [
        float(rng.uniform(0, 35)), float(rng.uniform(8, 36)), *(other() for _ in range(5)),
        int(rng.integers(0, 7)) if shown else int(SignalState.OFF),
        float(rng.uniform(0, 150)) if shown else FAR,
        int(rng.integers(-2, 3)), float(rng.uniform(0, 2000)), *(bool(rng.random() < 0.5) for _ in "lr"),
    ]  # fmt: skip
    return Facts(*facts)


def test_a_description_tells_all_facts_in_few_tokens():
    rng = np.random.default_rng(0)
    same = 0
    for _ in range(500):
        told = some_facts(rng)
        for style in STYLES.values():
            assert token_bound(description(style, told)) <= MOST_TOKENS
        read = stub.read_description(description(PLAIN, told))
        assert (read.light, read.to_go, read.left, read.right) == (
            told.light,
            told.to_go,
            told.left,
            told.right,
        )
        for mine, theirs in zip(read[2:7], told[2:7], strict=True):
            np.testing.assert_allclose(mine, theirs, atol=0.0501)
        np.testing.assert_allclose(
            [*read[:2], read.light_distance], [*told[:2], told.light_distance], atol=0.0501
        )
        same += rule_action(read) == rule_action(told)
    assert same >= 490, "rounding to one decimal turns the rules seldom"


@pytest.mark.parametrize("name", STYLES)
def test_every_style_reads_what_it_asks_for(name):
    style = STYLES[name]
    told = some_facts(np.random.default_rng(1))._replace(left=True, right=False)
    offered = available(style, told)
    assert Meta.RIGHT not in offered and Meta.LEFT in offered
    form = {
        "json": '{{"reason": "LEFT is taken", "action": "{}"}}',
        "hashes": "I could take 3 or 4.\n#### {}",
        "decision": "## Description\nx\n## Reasoning\nTurn-left?\n## Decision\n{}\n",
    }[style.form]
    for action, label in offered.items():
        assert parse(Reply(form.format(label)), offered) == (CallStatus.OK, action)
    assert parse(Reply(form.format(style.labels[Meta.RIGHT])), offered) == (CallStatus.ILLEGAL, None)


GOOD = [
    ('{"action": "KEEP", "reason": "free"}', Meta.KEEP),
    ('Sure! ```json\n{"reason": "x", "action": "stop"}\n```', Meta.STOP),
    ("First KEEP, but then I choose DECELERATE.", Meta.DECELERATE),
    ("I would slow down here.", Meta.DECELERATE),
    ("**LEFT**", Meta.LEFT),
]
BAD = [
    "", " ", "{", "}", "[]", "null", "42", "#### ", "#### 42", "#### nine", "## Decision", "## Decision\n",
    '{"action": null}', '{"action": []}', '{"action": "FLY"}', '{"act": "KEEP"}', '{"reason": "LEFT is free"',
    '{"action": {"name": "KEEP"}}', '{"action": true}', "\x00\x01", "\ufffd\ufffd", "keepsake", "leftover",
    "I cannot tell.", "{" * 3000, "<html>", "8", "-1", "????", '{"action": ""}',
]  # fmt: skip


def test_parsing():
    for text, action in GOOD:
        assert parse(Reply(text), OFFERED) == (CallStatus.OK, action), text
    assert len(BAD) == 30
    for text in BAD:
        assert parse(Reply(text), OFFERED) == (CallStatus.ILLEGAL, None), text
    assert parse(Reply('{"action": "KEEP"}', finish="length"), OFFERED)[0] is CallStatus.TRUNCATED
    assert parse(Reply("KEEP", refused=True), OFFERED)[0] is CallStatus.REFUSED
    assert answers.read_reply({"choices": []}) is None and answers.read_reply([]) is None


# --- over HTTP


def scene(worlds=1, time=0.0):
    """Egos alone on a straight road below the limit: the rules accelerate."""
    from limsim_jax.policies.host import Observation
    from limsim_jax.policies.language.scene import Scene

    one, many = np.ones((worlds, 1), np.float32), np.zeros((worlds, 1, 2), np.float32)
    values = dict.fromkeys(Observation._fields, 0 * one)
    values |= {name: many for name in Observation._fields if name.startswith("other_")}
    way = np.broadcast_to(2.5 * np.arange(9, dtype=np.float32), (worlds, 1, 9))
    values |= {"way_x": way, "way_y": 0 * way, "way_heading": 0 * way, "way_limit": 0 * way}
    v = 10 + np.arange(worlds, dtype=np.float32)[:, None]
    values |= {"time": np.full(worlds, time, np.float32), "v": v, "limit": 90 * one, "length": 5 * one}
    values |= {"there": many > 0, "to_go": (0 * one).astype(int), "light_distance": FAR * one}
    values |= {"light": (0 * one).astype(int) + int(SignalState.OFF)}
    return Scene(Observation(**values), one > 0, one > 2, 3.5 * one)


def drive(server, worlds=1, times=(0.0,), **options):
    options = {"server": server.url, "model": "model", "timeout": 1.5, "check": False} | options
    driver = language(**options).function
    assert isinstance(driver, LanguageDriver)
    memory, found = np.zeros((worlds, 1, 6), np.float32), []
    for time in times:
        command, memory = driver(scene(worlds, time), memory)
        found.append(command["meta"][:, 0].tolist())
    return found, driver


TRUNCATED = stub.chat('{"reason": "the car ahe', finish="length")
KEEP = stub.decision("DECELERATE")
FAULTS = {
    "fine": (stub.always(KEEP), "ok", Meta.DECELERATE, 1),
    "image to a text model": (
        stub.always(stub.error(500, "image input is not supported, mmproj")), "http", None, 1,
    ),
    "no response_format": (
        lambda request, _: KEEP if "response_format" not in request
        else stub.error(400, "response_format type must be one of text"), "ok", Meta.DECELERATE, 3,
    ),
    "only json_object": (
        lambda request, _: KEEP if request["response_format"]["type"] == "json_object"
        else stub.error(400, "Unable to generate parser for this template"), "ok", Meta.DECELERATE, 2,
    ),
    "only max_tokens": (
        lambda request, _: KEEP if "max_tokens" in request
        else stub.error(400, "unknown field max_completion_tokens"), "ok", Meta.DECELERATE, 2,
    ),
    "prompt too long": (
        stub.always(stub.error(400, "long", type="exceed_context_size_error", n_ctx=512)), "http", None, 1,
    ),
    "bad request": (stub.always(stub.error(400, "n must be 1")), "http", None, 1),
    "not supported": (stub.always(stub.error(501, "off", type="not_supported_error")), "http", None, 1),
    "truncated": (stub.always(TRUNCATED), "truncated", Meta.KEEP, 2),
    "truncated, then fine": (stub.first(TRUNCATED, KEEP), "repaired", Meta.DECELERATE, 2),
    "illegal, then fine": (stub.first(stub.chat("hm"), KEEP), "repaired", Meta.DECELERATE, 2),
    "lane that is not there": (stub.always(stub.decision("RIGHT")), "illegal", Meta.KEEP, 2),
    "hang": (stub.always(stub.hang), "timeout", None, 1),
    "hang up": (stub.first(stub.hang_up, KEEP), "ok", Meta.DECELERATE, 2),
    "429 in seconds": (stub.first(stub.limited("0"), KEEP), "ok", Meta.DECELERATE, 2),
    "429 by a date": (stub.first(stub.limited(stub.date_now()), KEEP), "ok", Meta.DECELERATE, 2),
    "429 for long": (stub.always(stub.limited("60")), "http", None, 1),
    "no retry": (stub.always((503, {}, {"x-should-retry": "false"})), "http", None, 1),
    "HTML 502": (stub.always((502, "<html>bad gateway</html>", {"retry-after-ms": "1"})), "http", None, 3),
    "HTML 200": (stub.always((200, "<html>hello</html>", {})), "http", None, 1),
    "no choices": (stub.always({"choices": []}), "http", None, 1),
    "refusal": (stub.always(stub.chat(None, refusal="I will not drive")), "refused", Meta.KEEP, 1),
    "filter": (stub.always(stub.chat("", finish="content_filter")), "refused", Meta.KEEP, 1),
    "tool": (stub.always(stub.chat(None, "tool_calls", tool_calls=[{"id": "1"}])), "illegal", Meta.KEEP, 2),
    "split UTF-8": (stub.always(stub.in_pieces(stub.chat("Übermäßig → STOP"))), "ok", Meta.STOP, 1),
    "wrong key": (stub.always(stub.error(401, f"Incorrect key {stub.KEY}")), "http", None, 1),
    "no model": (stub.always(stub.error(404, "model not found")), "http", None, 1),
}  # fmt: skip


@needs_httpx
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_ends_in_an_action_and_a_status(name, tmp_path, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", stub.KEY)
    script, status, action, calls = FAULTS[name]
    with stub.serving(script) as server:
        found, driver = drive(server, log=str(tmp_path / "log.jsonl"), cache=str(tmp_path / "cache.db"))
        assert len(server.requests) == calls
    (answer,) = driver.log.answers
    assert (answer.status, answer.calls) == (status, calls)
    assert found == [[Meta.ACCELERATE if action is None else action]], "the rules drive where none answers"
    assert read_answers(tmp_path / "log.jsonl") == driver.log.answers
    assert shares(driver.log.answers)[status] == 1.0
    assert not any(stub.KEY.encode() in path.read_bytes() for path in tmp_path.iterdir())
    assert stub.KEY not in repr(driver)


@needs_httpx
def test_malformed_answers_never_raise():
    with stub.serving(lambda _, number: stub.chat(BAD[number % len(BAD)])) as server:
        found, driver = drive(server, worlds=30)
    assert {x.status for x in driver.log.answers} == {CallStatus.ILLEGAL}
    assert found == [[Meta.KEEP] * 30]


@needs_httpx
def test_reruns_from_the_cache_are_equal_without_a_server(tmp_path):
    times, cache = (0.0, 0.5, 1.0), str(tmp_path / "cache.db")
    script = lambda _, number: stub.decision(["KEEP", "STOP", "LEFT"][number % 3])  # noqa: E731
    with stub.serving(script) as server:
        before, _ = drive(server, 5, times, cache=cache)
        asked = len(server.requests)
        assert asked == 5, "the same question a second later is known"
    after, driver = drive(server, 5, times, cache=cache)
    assert after == before and not any(x.calls for x in driver.log.answers)
    assert after[1] == [Meta.KEEP if x == Meta.LEFT else x for x in after[0]], (
        "a lane change is asked for once"
    )
    again, driver = drive(server, 5, times, cache=cache)
    assert (again, len(driver.log.answers)) == (before, 10)


@needs_httpx
def test_caps_hold_and_the_rules_drive_on():
    with stub.serving(stub.always(KEEP)) as server:
        found, driver = drive(server, worlds=4, max_calls=5, retries=0)
        assert len(server.requests) == 2, "a question may need a repair"
        assert found == [[Meta.DECELERATE] * 2 + [Meta.ACCELERATE] * 2]
        assert [x.status for x in driver.log.answers] == ["ok", "ok", "fallback", "fallback"]
        _, driver = drive(server, 1, (0.0, 1.0, 2.0), max_cost=0.0)
        assert shares(driver.log.answers)["fallback"] == 1.0
        _, driver = drive(server, 1, (0.0,), max_tokens=1)
        driver(scene(2, 0.0), np.zeros((2, 1, 6), np.float32))
        assert [x.status for x in driver.log.answers] == ["ok", "ok", "fallback"]


@needs_httpx
@pytest.mark.parametrize(
    ("latency", "slow_at"),
    [(0.0, [0, 0.5, 1, 1.5, 2, 2.5, 3]), (0.5, [0.5, 1, 1.5, 2, 2.5, 3]), (2.0, [2, 2.5])],
)
def test_an_answer_counts_after_its_latency_for_one_period(latency, slow_at):
    times = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    with stub.serving(stub.always(KEEP)) as server:
        found, _ = drive(server, 1, times, latency=latency)
    assert [
        time for time, (action,) in zip(times, found, strict=True) if action == Meta.DECELERATE
    ] == slow_at
    assert all(action in (Meta.KEEP, Meta.DECELERATE) for (action,) in found)


@needs_httpx
def test_a_graph_of_questions_is_recorded():
    with stub.serving(
        lambda request, _: KEEP if "response_format" in request else stub.chat("A bus.")
    ) as server:
        found, driver = drive(server, graph=True)
        assert found == [[Meta.DECELERATE]]
        assert [x.node for x in driver.log.answers] == ["scene", "risk", "plan", "action"]
        roles = [x["role"] for x in server.requests[-1]["messages"]]
        assert roles == ["system", "user"] + ["user", "assistant"] * 3 + ["user"]


@needs_httpx
def test_memories_of_failures_are_shown_and_never_of_tests(tmp_path):
    told = [some_facts(np.random.default_rng(k)) for k in range(3)]
    with stub.serving(stub.always(KEEP)) as server:
        _, driver = drive(server)
        failed = [driver.log.answers[0]] * 3
        learnt = driver.reflect(told, failed, seed=4)
        assert len(learnt) == 3
        with pytest.raises(ValueError, match="seed 5: odd seeds are for tests"):
            driver.reflect(told, failed, seed=5)
        memory.write_memories(tmp_path / "m.jsonl", learnt)
        assert memory.similar(learnt, told[1], 1)[0].scene == description(PLAIN, told[1])
        drive(server, memory=str(tmp_path / "m.jsonl"), shots=2)
        assert len(server.requests[-1]["messages"]) == 1 + 2 * 2 + 1
    assert not set(memory.train_seeds(50)) & set(memory.test_seeds(50))
    (tmp_path / "m.jsonl").write_text((tmp_path / "m.jsonl").read_text().replace('"seed": 4', '"seed": 7'))
    with pytest.raises(ValueError, match="seed 7"):
        memory.read_memories(tmp_path / "m.jsonl")


@needs_httpx
def test_pictures_are_sent_as_png():
    with stub.serving(stub.always(stub.chat("## Decision\nDeceleration"))) as server:
        options = {"style": "limsim_pp_vision", "images": lambda scene, ego: [b"\x89PNG one", b"\x89PNG two"]}
        found, _ = drive(server, **options)
        assert found == [[Meta.DECELERATE]]
        parts = server.requests[0]["messages"][-1]["content"]
        assert [x["type"] for x in parts] == ["image_url", "image_url", "text"]
        assert parts[0]["image_url"]["url"].startswith("data:image/png;base64,")


@needs_httpx
def test_bad_input_is_one_line_before_anything_runs(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-wrong")
    make: Any = language
    no_images = stub.error(500, "image input is not supported")
    with stub.serving(stub.always(no_images)) as server:
        options = {"server": server.url, "model": "model"}
        cases = [
            ({"model": "gpt-9"}, "model: 'gpt-9' is unknown to http.*; it has model"),
            ({"style": "haiku"}, "style: 'haiku'; known are plain, limsim_pp"),
            ({"style": "limsim_pp_vision"}, "needs images of cameras"),
            ({"style": "limsim_pp_vision", "images": lambda *_: []}, "model: 'model' takes no images"),
            ({"server": "localhost:80"}, "server: 'localhost:80'; expected a URL"),
            ({"server": "http://user:sk-wrong@host/v1"}, "no key in the URL"),
            ({"latency": -1.0}, "latency -1.0 s"),
            ({"memory": "nowhere.jsonl"}, "memory: nowhere.jsonl: No such file"),
        ]
        for change, text in cases:
            with pytest.raises(ValueError, match=text) as caught:
                make(**options | change)
            assert "\n" not in str(caught.value) and "sk-wrong" not in str(caught.value)
        server.key = stub.KEY
        with pytest.raises(ValueError, match=r"refuses the key in \$OPENAI_API_KEY"):
            make(**options)
    with pytest.raises(ValueError, match=r"server: no answer from http://127\.0\.0\.1"):
        make(**options)
    monkeypatch.delenv("LIMSIM_MODEL", raising=False)
    with pytest.raises(ValueError, match=r"model: none; set the option model or \$LIMSIM_MODEL"):
        language(server=server.url)


def test_it_has_a_name():
    assert POLICIES["language"] is language
    if importlib.util.find_spec("httpx") is not None:
        assert policy_name(language("http://127.0.0.1/v1", "model", check=False)) == "language"
    assert json.dumps([x.value for x in CallStatus]) == json.dumps(
        ["ok", "repaired", "illegal", "truncated", "refused", "timeout", "http", "fallback"]
    )
