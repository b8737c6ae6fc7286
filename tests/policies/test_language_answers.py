"""Language drivers without an engine: descriptions, answers, faults of servers, cache, caps, time."""

import base64
import importlib.util
import io
import json
from dataclasses import replace
from typing import Any

import chat_server as stub
import matplotlib.pyplot as plt
import numpy as np
import pytest

from limsim_jax import cli
from limsim_jax.bridges.chat.faults import FAULTS, always
from limsim_jax.bridges.chat.replies import decision, error
from limsim_jax.bridges.chat.server import ChatServer
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.base import policy_name
from limsim_jax.policies.host import FAR
from limsim_jax.policies.language import answers, memory
from limsim_jax.policies.language.answers import CallStatus, Reply, parse
from limsim_jax.policies.language.describe import (
    LIMSIM_PP,
    MOST_TOKENS,
    PLAIN,
    STYLES,
    available,
    description,
    token_bound,
    worked_example,
)
from limsim_jax.policies.language.driver import LanguageDriver, language
from limsim_jax.policies.language.reading import read_description
from limsim_jax.policies.language.rules import rule_action
from limsim_jax.policies.language.scene import NONE, Facts, Neighbour, facts_of, numbers
from limsim_jax.policies.language.store import Cache, read_answers, shares
from limsim_jax.policies.registry import POLICIES
from limsim_jax.sensors.rig import Lidar, Rig
from limsim_jax.traffic.ego import Meta

LIDAR_ONLY = Rig(lidar=Lidar())
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
        assert facts_of(numbers(told)) == told
        read = read_description(description(PLAIN, told))[0]
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
    options = {"server": server.url, "model": "model", "timeout": 30.0, "check": False} | options
    driver = language(**options).function
    assert isinstance(driver, LanguageDriver)
    memory, found = np.zeros((worlds, 1, 6), np.float32), []
    for time in times:
        command, memory = driver(scene(worlds, time), memory)
        found.append(command["meta"][:, 0].tolist())
    return found, driver


SLOWER = decision("DECELERATE")
ENDS = {
    "fine": ("ok", Meta.DECELERATE, 1),
    "image to a text model": ("http", None, 1),
    "no response_format": ("ok", Meta.DECELERATE, 3),
    "only json_object": ("ok", Meta.DECELERATE, 2),
    "only max_tokens": ("ok", Meta.DECELERATE, 2),
    "prompt too long": ("http", None, 1),
    "bad request": ("http", None, 1),
    "not supported": ("http", None, 1),
    "truncated": ("truncated", Meta.KEEP, 2),
    "truncated, then fine": ("repaired", Meta.DECELERATE, 2),
    "illegal, then fine": ("repaired", Meta.DECELERATE, 2),
    "lane that is not there": ("illegal", Meta.KEEP, 2),
    "hang": ("timeout", None, 1),
    "hang up": ("ok", Meta.DECELERATE, 2),
    "429 in seconds": ("ok", Meta.DECELERATE, 2),
    "429 by a date": ("ok", Meta.DECELERATE, 2),
    "429 for long": ("http", None, 1),
    "no retry": ("http", None, 1),
    "HTML 502": ("http", None, 3),
    "HTML 200": ("http", None, 1),
    "no choices": ("http", None, 1),
    "refusal": ("refused", Meta.KEEP, 1),
    "filter": ("refused", Meta.KEEP, 1),
    "tool": ("illegal", Meta.KEEP, 2),
    "split UTF-8": ("ok", Meta.STOP, 1),
    "wrong key": ("http", None, 1),
    "no model": ("http", None, 1),
}
"""Status, action (None: that of the rules) and calls after each fault."""


@needs_httpx
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_ends_in_an_action_and_a_status(name, tmp_path, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", stub.KEY)
    status, action, calls = ENDS[name]
    with stub.serving(FAULTS[name]) as server:
        files: dict[str, Any] = {"log": str(tmp_path / "log.jsonl"), "cache": str(tmp_path / "cache.db")}
        found, driver = drive(server, timeout=1.0 if name == "hang" else 30.0, **files)
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
    script = lambda _, number: decision(["KEEP", "STOP", "LEFT"][number % 3])  # noqa: E731
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
    with stub.serving(always(SLOWER)) as server:
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
    [
        (None, [0, 0.5, 1, 1.5, 2, 2.5, 3]),
        (0.0, [0, 0.5, 1, 1.5, 2, 2.5, 3]),
        (0.5, [0.5, 1, 1.5, 2, 2.5, 3]),
        (2.0, [2, 2.5]),
    ],
)
def test_an_answer_counts_after_its_latency_for_one_period(latency, slow_at):
    times = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    with stub.serving(always(SLOWER)) as server:
        found, _ = drive(server, 1, times, latency=latency)
    assert [
        time for time, (action,) in zip(times, found, strict=True) if action == Meta.DECELERATE
    ] == slow_at
    assert all(action in (Meta.KEEP, Meta.DECELERATE) for (action,) in found)


@needs_httpx
def test_a_graph_of_questions_is_recorded():
    with stub.serving(
        lambda request, _: SLOWER if "response_format" in request else stub.chat("A bus.")
    ) as server:
        found, driver = drive(server, graph=True)
        assert found == [[Meta.DECELERATE]]
        assert [x.node for x in driver.log.answers] == ["scene", "risk", "plan", "action"]
        roles = [x["role"] for x in server.requests[-1]["messages"]]
        assert roles == ["system", "user"] + ["user", "assistant"] * 3 + ["user"]


@needs_httpx
def test_memories_of_failures_are_shown_and_never_of_tests(tmp_path):
    told = [some_facts(np.random.default_rng(k)) for k in range(3)]
    with stub.serving(always(SLOWER)) as server:
        _, driver = drive(server)
        first = driver.log.answers[0]
        assert description(PLAIN, facts_of(first.facts)) == first.scene
        failed = [replace(first, scene=description(PLAIN, x), facts=numbers(x)) for x in told]
        learnt = driver.reflect(failed, seed=4)
        assert len(learnt) == 3
        with pytest.raises(ValueError, match="seed 5: odd seeds are for tests"):
            driver.reflect(failed, seed=5)
        memory.write_memories(tmp_path / "m.jsonl", learnt)
        assert memory.similar(learnt, told[1], 1)[0].scene == description(PLAIN, told[1])
        drive(server, memory=str(tmp_path / "m.jsonl"), shots=2)
        assert len(server.requests[-1]["messages"]) == 1 + 2 * 2 + 1
    assert not set(memory.train_seeds(50)) & set(memory.test_seeds(50))
    (tmp_path / "m.jsonl").write_text((tmp_path / "m.jsonl").read_text().replace('"seed": 4', '"seed": 7'))
    with pytest.raises(ValueError, match="seed 7"):
        memory.read_memories(tmp_path / "m.jsonl")


@needs_httpx
def test_the_order_of_limsim_pp_has_a_worked_example_that_is_right():
    told, offered = read_description(worked_example(LIMSIM_PP)[0])
    answered = parse(Reply(worked_example(LIMSIM_PP)[1]), offered)
    assert answered == (CallStatus.OK, rule_action(told)) == (CallStatus.OK, Meta.DECELERATE)
    with stub.serving(always(stub.chat("#### 2"))) as server:
        found, _ = drive(server, style="limsim_pp")
        roles = [x["role"] for x in server.requests[-1]["messages"]]
    assert (found, roles) == ([[Meta.DECELERATE]], ["system", "user", "assistant", "user"])


@needs_httpx
def test_pictures_are_sent_as_png():
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (1, 1, 3, 6, 8, 3), np.uint8)
    with stub.serving(always(stub.chat("## Decision\nDeceleration"))) as server:
        policy = language(server.url, "model", style="limsim_pp_vision")
        assert policy.needs_scenery and len(policy.observe.rig.cameras) == 3  # pyright: ignore
        seen = scene()._replace(pictures=pictures)
        command, _ = policy.function(seen, np.zeros((1, 1, 6), np.float32))
        assert command["meta"].tolist() == [[Meta.DECELERATE]]
        parts = server.requests[-1]["messages"][-1]["content"]
    assert [x["type"] for x in parts] == ["text"] * 2 + ["image_url"] * 3 + ["text"]
    assert "these cameras: front_left, front, front_right" in parts[1]["text"]
    for part, picture in zip(parts[2:], pictures[0, 0], strict=False):
        head, data = part["image_url"]["url"].split(",")
        assert head == "data:image/png;base64"
        read = plt.imread(io.BytesIO(base64.b64decode(data)), format="png")
        np.testing.assert_array_equal(np.round(read * 255), picture)
    assert not language(server.url, "model", check=False).needs_scenery


@needs_httpx
def test_bad_input_is_one_line_before_anything_runs(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-wrong")
    make: Any = language
    no_images = error(500, "image input is not supported")
    with stub.serving(always(no_images)) as server:
        options = {"server": server.url, "model": "model"}
        cases = [
            ({"model": "gpt-9"}, "model: 'gpt-9' is unknown to http.*; it has model"),
            ({"style": "haiku"}, "style: 'haiku'; known are plain, limsim_pp"),
            ({"style": "limsim_pp_vision"}, "model: 'model' takes no images"),
            ({"cameras": "front"}, "model: 'model' takes no images"),
            ({"cameras": "roof"}, "cameras: 'roof'; known are front, three, six"),
            ({"cameras": LIDAR_ONLY}, "cameras: the rig has none"),
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


@needs_httpx
def test_the_server_of_the_command_line(capsys, monkeypatch):
    """It serves the models that it names, until it is stopped."""
    served = []
    monkeypatch.setattr(ChatServer, "wait", lambda self: served.append(self))
    monkeypatch.setenv("MY_KEY", stub.KEY)
    assert cli.main(["serve", "chat", "--model", "rules", "--port", "0", "--key-variable", "MY_KEY"]) == 0
    (server,) = served
    assert capsys.readouterr().out == f"listening on {server.url}, models: rules\n"
    with server:
        found, _ = drive(server, model="rules", key_variable="MY_KEY")
        assert found == [[Meta.ACCELERATE]], "as the rules in JAX"
    wrong = {"--model=gpt": "'gpt'; known are rules, faults, camera", "--key-variable=NO": "$NO is empty"}
    for change, text in wrong.items():
        assert cli.main(["serve", "chat", change]) == 2
        assert text in capsys.readouterr().err


def test_replies_are_written_when_the_cache_is_saved(tmp_path):
    first, reply = Cache(tmp_path / "replies.db"), Reply("KEEP", prompt_tokens=10)
    first.put("a", reply)
    assert first.get("a") == reply and Cache(tmp_path / "replies.db").get("a") is None
    first.put("a", Reply("LEFT"))  # the first reply stays
    first.save()
    again = Cache(tmp_path / "replies.db")
    assert again.get("a") == reply and again.get("b") is None
