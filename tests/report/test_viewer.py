"""The interactive replay: what the page shows in a real browser is what the trace says."""

import base64
import dataclasses
import json
import os
import re
import select
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.maps.lane_map import VEHICLE_CLASSES, absolute, lane_ids, lane_rows, pose
from limsim_jax.maps.signals import SignalState
from limsim_jax.report.video import EGO, SIGNALS
from limsim_jax.report.viewer import DRIVEN, write_viewer
from limsim_jax.rollout import Trace
from limsim_jax.types import Status

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


class Browser:
    """A headless Chromium, driven by its DevTools protocol through two pipes."""

    def __init__(self, program: str) -> None:
        self.profile = tempfile.TemporaryDirectory(prefix="limsim-jax-viewer-", ignore_cleanup_errors=True)
        from_us, self.to = os.pipe()
        self.come, from_it = os.pipe()
        # the browser reads its commands from descriptor 3 and answers on 4
        start = (
            "import os, sys; r, w = (os.dup(int(x)) for x in sys.argv[1:3]); os.dup2(r, 3); os.dup2(w, 4);"
            "[os.set_inheritable(x, True) for x in (3, 4)]; os.execvp(sys.argv[3], sys.argv[3:])"
        )
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
                   "--no-first-run", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio",
                   "--disable-background-networking", f"--user-data-dir={self.profile.name}"]  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, "-c", start, str(from_us), str(from_it), program, *options],
            pass_fds=(from_us, from_it),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(from_it)
        self.rest, self.number, self.events = b"", 0, []
        self.session: str | None = None
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result; what else comes in goes to `events`."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + 60
        while True:
            while b"\0" not in self.rest:
                if not select.select([self.come], [], [], max(0, until - time.monotonic()))[0]:
                    raise TimeoutError(f"no answer to {method}")
                more = os.read(self.come, 1 << 20)
                if not more:
                    raise RuntimeError("the browser has ended")
                self.rest += more
            line, _, self.rest = self.rest.partition(b"\0")
            answer = json.loads(line)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def run(self, script: str) -> Any:
        """The value of an expression of JavaScript, awaited."""
        done = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def open(
        self, path: Path, fragment: str = "", *, size: tuple[int, int] = (1280, 800), dark: bool = False
    ) -> dict[str, str]:
        """Load a page from disk and wait for its first frame; returns what it says about itself."""
        self.events.clear()
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=size[0],
            height=size[1],
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Page.navigate", url="about:blank")
        self.send("Page.navigate", url=path.as_uri() + fragment)
        self.run("""new Promise(done => { const look = () => {
            const data = document.body && document.body.dataset;
            data && (data.ready || data.error) ? done() : setTimeout(look, 20); }; look(); })""")
        return self.state()

    def state(self) -> dict[str, str]:
        """The data attributes of the page after the next frame."""
        frame = "requestAnimationFrame(() => requestAnimationFrame(() => done({...document.body.dataset})))"
        return self.run(f"new Promise(done => {frame})")

    def fact(self, name: str) -> float:
        return float(self.run(f"document.querySelector('[data-field={name}]').dataset.value || 'NaN'"))

    def text(self, selector: str) -> str:
        return self.run(f"document.querySelector({json.dumps(selector)}).textContent")

    def middle(self, selector: str) -> tuple[float, float]:
        script = (
            f"(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector({json.dumps(selector)})"
        )
        return tuple(self.run(f"{script}.getBoundingClientRect())"))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> dict[str, str]:
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", buttons=1, clickCount=1)
        return self.state()

    def key(self, key: str, code: str = "", **more: Any) -> dict[str, str]:
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, **more)
        return self.state()

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        try:
            self.session = None
            self.send("Browser.close")
        except (OSError, RuntimeError, TimeoutError):
            self.process.kill()
        os.close(self.to)
        os.close(self.come)
        self.process.wait(30)
        self.profile.cleanup()


# --- a world made by hand ----------------------------------------------------------------------------

T, DT = 60, 0.1
SELF, LEAD, TURNS, AGAIN, HIT, NEVER = range(6)  # slots
N = NEVER + 1
LENGTH = np.array([4.0, 5.5, 4.4, 4.8, 12.0, 4.6])
WIDTH = np.array([1.7, 1.9, 1.8, 1.75, 2.5, 1.8])
SWAP = 31  # step at which another vehicle has the slot AGAIN, without a step between
TIME = np.float32(DT) * np.arange(1, T + 1, dtype=np.float32)
CLASSES = np.array([0, 1, 0, 4, 3, 5])
TAKEN, GIVEN = 10, 40  # steps from and until which TURNS is driven by the policy
EVERY, AHEAD = 5, 21  # steps per decision, moments of a plan


def driven(lane_map: Any, route: list[int], way: Any) -> tuple[Any, Any]:
    """Lane and s after so many metres along a route that starts at s = 0 of its first lane."""
    ends = np.cumsum([float(lane_map.length[lane]) for lane in route])
    i = np.minimum(np.searchsorted(ends, way, side="right"), len(route) - 1)
    return np.array(route)[i], way - np.concatenate([[0.0], ends])[i]


def made() -> Any:
    """The intersection: SELF drives straight on behind LEAD; TURNS leaves the same lane by another way."""
    network, lane_map = bundled("intersection")
    rows = lane_rows(network)
    ways: dict[str, list[list[int]]] = {}
    for movement in network.movements:
        route = [rows[lane] for lane in (movement.incoming, *movement.via, movement.outgoing)]
        ways.setdefault(movement.incoming, []).append(route)
    straight, turn = next(routes for routes in ways.values() if len(routes) > 1)[:2]
    other, far = (routes[0] for routes in list(ways.values())[-2:])
    end = float(lane_map.length[straight[0]])
    shape = (T, N)
    step = np.arange(T)
    v = np.zeros(shape, np.float32)
    v[:, SELF], v[:, LEAD], v[:, TURNS], v[:, AGAIN], v[:, HIT] = 11.0, 7.5 + 0.01 * step, 9.0, 13.0, 0.5
    lane, s = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    starts = {SELF: (straight, end - 34.0), LEAD: (straight, end - 6.0), TURNS: (turn, end - 17.0)}
    for slot, (route, at) in starts.items():
        way = at + DT * np.cumsum(v[:, slot])
        lane[:, slot], s[:, slot] = driven(lane_map, route, way)
    lane[:, HIT], s[:, HIT] = far[0], 60.0
    lane[:, AGAIN] = np.where(step < SWAP, other[0], far[0])
    s[:, AGAIN] = np.where(step < SWAP, 20.0 + 1.3 * step, 100.0 + 1.3 * (step - SWAP))
    centre = s - LENGTH / 2
    x, y, heading = pose(lane_map, lane, centre.astype(np.float32))
    size = [np.broadcast_to(size, shape) for size in (LENGTH, WIDTH)]
    a = np.zeros(shape, np.float32)
    a[:, SELF], a[:, HIT] = -0.75 - 0.01 * step, -3.0
    vehicle = np.where(np.arange(N) < AGAIN, -1, np.arange(N) + 40) + 0 * step[:, None]
    vehicle[SWAP:, AGAIN] = 77
    active = np.ones(shape, bool)
    active[:, NEVER] = False
    active[50:, LEAD] = False
    phase = np.zeros((T, lane_map.signals.duration.shape[0]), np.int32)
    phase[30:, 0] = 1
    status = np.where((np.arange(N) == HIT) & (step[:, None] >= 10), int(Status.COLLIDED), 0)
    fields: dict[str, Any] = dict(
        time=TIME, active=active, vehicle=vehicle.astype(np.int32), lane=lane, s=s, d=0.125 - 0 * s, v=v, a=a,
        box=np.stack([x, y, heading, *size], -1).astype(np.float32),
        status=status.astype(np.int32), phase=phase, **planned(x, y, heading, step),
        vehicle_class=np.broadcast_to(CLASSES, shape), to_go=np.where(step < 55, 312.5 - 1.1 * step, np.nan),
    )  # fmt: skip
    return network, lane_map, Trace(**fields)


def planned(x: Any, y: Any, heading: Any, step: Any) -> dict[str, Any]:
    """SELF is always driven by the policy, TURNS for a while; HIT, too, but there is no plan for it."""
    turns = np.where((step >= TAKEN) & (step < GIVEN), TURNS, -1)
    decided = step // EVERY * EVERY
    tau = DT * np.arange(AHEAD)
    plan = np.full((T, 3, AHEAD, 2), np.nan, np.float32)
    for row, (slot, v) in enumerate(((SELF, 12.0), (TURNS, 6.0))):
        along, left = v * tau, 4.0 * tau**2
        x0, y0, angle = (np.asarray(z)[decided, slot][:, None] for z in (x, y, heading))
        plan[:, row, :, 0] = x0 + along * np.cos(angle) - left * np.sin(angle)
        plan[:, row, :, 1] = y0 + along * np.sin(angle) + left * np.cos(angle)
    plan[turns < 0, 1] = np.nan
    return {
        "driven": np.stack([0 * step + SELF, turns, 0 * step + HIT], -1).astype(np.int32),
        "plan": plan,
        "plan_time": (DT * decided[:, None] + tau).astype(np.float32),
    }


MOMENTS = [
    {"kind": "contact", "time": 4.0, "value": 3.21, "other": HIT, "responsible": "other", "rank": 1,
     "module": None, "avoidable_by_ego": None},
    {"kind": "near_miss", "time": 1.5, "value": np.float64(0.92), "other": np.int32(LEAD),
     "responsible": "shared", "rank": 2, "module": "prediction"},
    {"kind": "hard_brake", "time": 2.5, "value": -4.5, "other": None, "responsible": None, "rank": 3},
]  # fmt: skip


@pytest.fixture(scope="module")
def world() -> Any:
    return made()


def payload(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a page holds: its texts and its columns of numbers, unpacked without the code that packs."""
    found = re.search(r'<script type="application/octet-stream" id="data">([^<]*)</script>', path.read_text())
    assert found is not None
    block = zlib.decompress(base64.b64decode(found[1]))
    start = 4 + int.from_bytes(block[:4], "little")
    meta = json.loads(block[4:start])
    columns = {}
    for name, (offset, count, row, scale) in meta["columns"].items():
        planes = np.frombuffer(block, np.uint8, 4 * count, start + offset).reshape(4, count).astype(np.int64)
        bits = planes[0] + (planes[1] << 8) + (planes[2] << 16) + (planes[3] << 24)
        delta = np.where(bits % 2 == 1, -(bits + 1) // 2, bits // 2)
        columns[name] = np.cumsum(delta.reshape(-1, max(row, 1)), 1) / scale
    return meta, columns


@pytest.fixture(scope="module")
def page(world: Any, tmp_path_factory: Any) -> Path:
    network, lane_map, trace = world
    path = tmp_path_factory.mktemp("viewer") / "replay.html"
    interest = np.broadcast_to(np.arange(N) != AGAIN, (T, N))
    write_viewer(
        path, network, lane_map, trace, ego=SELF, moments=MOMENTS, interest=interest,
        title="a <b>bold</b> title",
    )  # fmt: skip
    return path


# --- the file ----------------------------------------------------------------------------------------


def test_the_file_holds_the_numbers_of_the_trace(world, page):
    network, lane_map, trace = world
    meta, columns = payload(page)
    np.testing.assert_allclose(columns["time"][0], TIME, atol=5e-5)
    np.testing.assert_array_equal(columns["vehicle"].T, np.where(trace.active, trace.vehicle + 2, 0))
    x, y, heading, length, width = np.moveaxis(trace.box, -1, 0)
    expected = {"x": (x, 0.005), "y": (y, 0.005), "heading": (heading, 5e-5), "length": (length, 0.005),
                "width": (width, 0.005), "v": (trace.v, 0.005), "a": (trace.a, 0.005), "s": (trace.s, 0.005),
                "d": (trace.d, 0.005), "lane": (trace.lane, 0), "status": (trace.status, 0)}  # fmt: skip
    for name, (values, off) in expected.items():
        there = trace.active
        np.testing.assert_allclose(
            columns[name].T[there], values[there], atol=1.01 * off + 1e-5, err_msg=name
        )
    assert meta["network"]["lanes"] == lane_ids(network)
    assert [row["time"] for row in meta["moments"]] == [1.5, 2.5, 4.0]  # in order of time
    west, east = columns["border_x"].min(), columns["border_x"].max()
    shift = meta["network"]["origin"][0]
    assert shift == int(lane_map.origin[0])
    assert west + shift < network.bounds()[0] + 1 and east + shift > network.bounds()[2] - 1


def test_a_slot_that_nobody_is_in_costs_nothing_and_may_hold_anything(world, tmp_path):
    network, lane_map, trace = world
    box, v = trace.box.copy(), trace.v.copy()
    box[:, NEVER], v[50:, LEAD] = np.nan, np.inf
    lane = np.where(trace.active, trace.lane, 99_999)
    write_viewer(tmp_path / "a.html", network, lane_map, trace._replace(box=box, v=v, lane=lane))
    _, columns = payload(tmp_path / "a.html")
    assert (columns["x"][NEVER] == 0).all()
    assert (columns["v"][LEAD, 50:] == columns["v"][LEAD, 49]).all()


def test_leaders_are_those_on_the_way_that_the_vehicle_takes(world, page):
    _, lane_map, trace = world
    _, columns = payload(page)
    lead, gap = columns["lead"].T, columns["gap"].T
    end = float(lane_map.length[trace.lane[0, SELF]])
    # On their common lane the vehicle that will turn is nearer; when it is gone, the one that goes straight.
    both = trace.active[:, LEAD] & (trace.lane[:, TURNS] == trace.lane[:, SELF])
    assert 3 < both.sum() < 40
    assert (lead[both, SELF] == TURNS).all()
    after = trace.active[:, LEAD] & ~both
    assert after.sum() > 5 and (lead[after, SELF] == LEAD).all()
    # of the two on the common lane, one has the other ahead only while their ways are one
    assert lead[0, TURNS] == LEAD
    turned = ~both & (trace.lane[:, LEAD] != trace.lane[0, LEAD])
    assert (lead[turned & (trace.lane[:, SELF] == trace.lane[0, SELF]), TURNS] == -1).all()
    # gap by the distances driven: 28 m between the fronts at first
    at = [end - 34.0 + DT * np.cumsum(trace.v[:, SELF]), end - 6.0 + DT * np.cumsum(trace.v[:, LEAD])]
    np.testing.assert_allclose(gap[after, SELF], (at[1] - at[0] - LENGTH[LEAD])[after], atol=0.01)
    assert (lead[:, LEAD] == -1).all() and (lead[50:, SELF] == -1).all()


def test_times_to_collision_are_gap_over_closing_speed_on_a_straight_lane(world, tmp_path):
    network, lane_map, trace = world
    alone = trace.active & (np.arange(N) < AGAIN)
    write_viewer(tmp_path / "a.html", network, lane_map, trace._replace(active=alone))
    _, columns = payload(tmp_path / "a.html")
    k = 3
    gap = trace.s[k, TURNS] - LENGTH[TURNS] - trace.s[k, SELF]
    assert columns["ttc"][SELF, k] == pytest.approx(gap / (11.0 - 9.0), abs=0.006)
    assert columns["soonest"][SELF, k] == pytest.approx(gap / (11.0 - 9.0), abs=0.006)
    assert columns["soonest_of"][SELF, k] == TURNS
    assert columns["ttc"][LEAD, k] == -1  # nobody ahead
    assert columns["soonest_of"][TURNS, k] in (LEAD, SELF)


def test_the_first_box_to_be_touched_may_come_from_the_side(world, tmp_path):
    network, lane_map, trace = world
    box, v = trace.box.copy(), trace.v.copy()
    # 8 m/s east, and from the south 5 m/s north: its front reaches the side of the first after 2 s
    box[:, SELF, :3], box[:, LEAD, :3] = [0, 0, 0], [16, -10 - 0.5 * (LENGTH[LEAD] + WIDTH[SELF]), np.pi / 2]
    v[:, SELF], v[:, LEAD] = 8.0, 5.0
    box[:, [TURNS, AGAIN, HIT], 0] = 1e4
    write_viewer(tmp_path / "a.html", network, lane_map, trace._replace(box=box, v=v))
    _, columns = payload(tmp_path / "a.html")
    assert columns["soonest"][SELF, 0] == columns["soonest"][LEAD, 0] == pytest.approx(2.0, abs=0.006)
    assert columns["soonest_of"][SELF, 0] == LEAD and columns["soonest_of"][LEAD, 0] == SELF


def test_a_clock_that_stands_still_ends_the_replay(world, tmp_path):
    network, lane_map, trace = world
    time = np.concatenate([TIME[:25], np.tile(TIME[20:25], 7)])
    write_viewer(tmp_path / "a.html", network, lane_map, trace._replace(time=time))
    meta, columns = payload(tmp_path / "a.html")
    assert meta["steps"] == 25 and columns["time"][0, -1] == pytest.approx(2.5)


def test_every_third_step(world, tmp_path):
    network, lane_map, trace = world
    write_viewer(tmp_path / "a.html", network, lane_map, trace, every=3)
    meta, columns = payload(tmp_path / "a.html")
    assert meta["steps"] == 20
    np.testing.assert_allclose(columns["s"][SELF], trace.s[::3, SELF], atol=0.006)


def test_a_minute_of_64_vehicles_is_less_than_a_megabyte(tmp_path):
    network, lane_map = bundled("long_route")
    rng = np.random.default_rng(0)
    shape = (600, 64)
    v = np.clip(np.cumsum(rng.normal(0, 0.1, shape), 0) + 10, 0, 30).astype(np.float32)
    s = (20 + 0.1 * np.cumsum(v, 0)).astype(np.float32)
    lane = np.broadcast_to(rng.integers(0, len(lane_ids(network)), 64), shape).astype(np.int32)
    x, y, heading = pose(lane_map, lane, s)
    box = np.stack([x, y, heading, 0 * v + 4.6, 0 * v + 1.8], -1).astype(np.float32)
    fields: dict[str, Any] = dict(
        time=np.arange(1, 601) / 10, active=v > -1, vehicle=lane, lane=lane, s=s,
        d=rng.normal(0, 0.2, shape).astype(np.float32), v=v, a=rng.normal(0, 1, shape).astype(np.float32),
        box=box, status=0 * lane, phase=np.zeros((600, lane_map.signals.duration.shape[0]), np.int32),
    )  # fmt: skip
    write_viewer(tmp_path / "a.html", network, lane_map, Trace(**fields))
    assert (tmp_path / "a.html").stat().st_size < 1e6


def test_plans_are_kept_once_per_decision_in_quarters_of_a_second(world, page, tmp_path):
    _, lane_map, trace = world
    meta, columns = payload(page)
    assert meta["plan"] == {"points": 9, "per_second": 4}
    of = columns["plan_of"].astype(int)
    np.testing.assert_array_equal(columns["driven"].T, trace.driven)
    np.testing.assert_array_equal(of.T >= 0, np.isfinite(trace.plan).all((-1, -2)))
    assert columns["plan_x"].shape == (T // EVERY + (GIVEN - TAKEN) // EVERY, 9)
    for row in (0, 1):
        for k in np.flatnonzero(of[row] >= 0):
            for axis, letter in enumerate("xy"):
                at = np.interp(0.25 * np.arange(9), DT * np.arange(AHEAD), trace.plan[k, row, :, axis])
                np.testing.assert_allclose(columns[f"plan_{letter}"][of[row, k]], at, atol=0.006)
    np.testing.assert_allclose(columns["to_go"][0, :55], trace.to_go[:55], atol=0.006)
    assert (columns["to_go"][0, 55:] == -1).all()
    # the distance to the goal is that of the first ego: nobody else's
    write_viewer(tmp_path / "a.html", bundled("intersection")[0], lane_map, trace, ego=LEAD)
    assert "to_go" not in payload(tmp_path / "a.html")[1]


def test_plans_of_a_minute_take_less_than_half_a_megabyte(world, tmp_path):
    network, lane_map, trace = world
    repeats, rows = 10, 9
    rng = np.random.default_rng(1)
    fields: Any = [np.concatenate([x] * repeats) for x in trace]
    many = Trace(*fields)._replace(time=np.arange(1, T * repeats + 1) / 10)
    decisions = np.cumsum(rng.normal(0, 0.3, (T * repeats // EVERY, rows, 50, 2)) + 1.0, 2)
    plan = np.repeat(decisions, EVERY, 0).astype(np.float32)
    driven = np.broadcast_to(np.arange(rows) % N, (T * repeats, rows))
    plan_time = np.repeat(0.5 * np.arange(len(decisions)), EVERY)[:, None] + 0.1 * np.arange(50)
    bare, full = tmp_path / "bare.html", tmp_path / "full.html"
    write_viewer(bare, network, lane_map, many._replace(plan=None, plan_time=None))
    write_viewer(full, network, lane_map, many._replace(plan=plan, driven=driven, plan_time=plan_time))
    assert 1e4 < full.stat().st_size - bare.stat().st_size < 5e5


def test_a_trace_without_egos_is_shown_without_theirs(world, tmp_path):
    network, lane_map, trace = world
    names = ("vehicle_class", "driven", "to_go", "plan", "plan_time")
    write_viewer(tmp_path / "a.html", network, lane_map, trace._replace(**dict.fromkeys(names)), ego=SELF)
    meta, columns = payload(tmp_path / "a.html")
    assert meta["plan"] is None and not {"class", "driven", "to_go", "plan_of"} & set(columns)


def test_the_file_needs_nothing_else(page):
    text = re.sub(r'id="data">[^<]*<', "", page.read_text())
    assert not re.search(
        r"https?:|//[a-z]|@import|url\(|\bfetch\(|XMLHttpRequest|<link|\ssrc=|import\(", text
    )
    assert "default-src 'none'" in text
    assert "{{" not in text


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(ego=N), f"ego {N}? the trace has slots 0 to {N - 1}"),
        (dict(ego=-1), "ego -1?"),
        (dict(every=0), "every 0 steps"),
        (dict(moments=[{"kind": "contact"}]), "moment 0 has no time"),
        (dict(moments=[MOMENTS[0], {"time": 2.0}]), "moment 1 has no kind"),
        (dict(moments=[{"kind": "contact", "time": float("nan")}]), "moment 0 has no time"),
        (dict(moments=[{"kind": "contact", "time": 60.0}]), "(contact) is at 60 s; the trace goes to 6 s"),
        (dict(moments=[{"kind": "contact", "time": 1.0, "other": 9}]), "other vehicle 9? the trace has"),
        (dict(interest=[(1.0, np.zeros((4, 3)))]), "polygon of interest 0 of shape (4, 3)"),
        (dict(interest=[(1.0, np.eye(4, 2)), (0.5, np.eye(4, 2))]), "polygon of interest 1 is at 0.5 s"),
        (dict(interest=[(1.0, np.full((4, 2), np.nan))]), "not finite"),
        (dict(interest=np.ones((T, N + 1))), "interest of shape"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line(world, tmp_path, change, message):
    network, lane_map, trace = world
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        write_viewer(tmp_path / "a.html", network, lane_map, trace, **change)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_trace_that_does_not_fit_is_refused(world, tmp_path):
    network, lane_map, trace = world
    path = tmp_path / "a.html"
    with pytest.raises(ValueError, match="empty"):
        write_viewer(path, network, lane_map, Trace(*(x[:0] for x in trace)))
    with pytest.raises(ValueError, match=r"v of shape \(60, 7\) instead of \(60, 6\): of another trace"):
        write_viewer(path, network, lane_map, trace._replace(v=np.zeros((T, N + 1), np.float32)))
    with pytest.raises(ValueError, match=r"phase of shape .*another map"):
        write_viewer(path, network, lane_map, trace._replace(phase=trace.phase[:, :-1]))
    with pytest.raises(ValueError, match="on lane 5000; the map has lanes 0 to"):
        write_viewer(path, network, lane_map, trace._replace(lane=trace.lane % 1 + 5000))
    with pytest.raises(ValueError, match="classes from 6 to 10; they are 0 to 5"):
        write_viewer(path, network, lane_map, trace._replace(vehicle_class=trace.vehicle_class + 6))
    with pytest.raises(ValueError, match="driven: slots beyond those of the trace, 0 to 5"):
        write_viewer(path, network, lane_map, trace._replace(driven=trace.driven + 4))
    with pytest.raises(ValueError, match=r"plan of shape \(60, 2, 21, 2\) instead of \(60, 3, 21, 2\)"):
        write_viewer(path, network, lane_map, trace._replace(plan=trace.plan[:, 1:]))
    with pytest.raises(ValueError, match=r"plan of shape \(60, 3, 21, 2\) instead of \(60, 3, 20, 2\)"):
        write_viewer(path, network, lane_map, trace._replace(plan_time=trace.plan_time[:, 1:]))
    with pytest.raises(ValueError, match="plan of 1 moments"):
        short = trace._replace(plan=trace.plan[:, :, :1], plan_time=trace.plan_time[:, :1])
        write_viewer(path, network, lane_map, short)
    with pytest.raises(ValueError, match=r"use \.html"):
        write_viewer(tmp_path / "a.txt", network, lane_map, trace)


def test_the_file_is_written_whole_or_not_at_all(world, tmp_path, monkeypatch):
    network, lane_map, trace = world
    path = tmp_path / "a.html"
    path.write_text("as before")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(os, "fsync", full)
        write_viewer(path, network, lane_map, trace)
    assert [file.name for file in tmp_path.iterdir()] == ["a.html"] and path.read_text() == "as before"
    with pytest.raises(OSError, match="nowhere"):
        write_viewer(tmp_path / "nowhere" / "a.html", network, lane_map, trace)


# --- in a browser ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    browser = Browser(program)
    yield browser
    browser.close()


def problems(browser: Browser) -> list[Any]:
    """Errors of the page, and everything that it asked of a network."""
    bad = [
        event
        for event in browser.events
        if event.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")
    ]
    asked = [event["params"]["request"]["url"] for event in browser.events
             if event.get("method") == "Network.requestWillBeSent"]  # fmt: skip
    return bad + [url for url in asked if not url.startswith(("file:", "about:"))]


def centre(state: dict[str, str], slot: int) -> tuple[float, float]:
    """Where a vehicle is on the canvas."""
    places = dict(
        (int(i), (float(x), float(y))) for i, x, y in (v.split(",") for v in state["vehicles"].split())
    )
    return places[slot]


def on_screen(browser: Browser, at: tuple[float, float]) -> tuple[float, float]:
    x, y = browser.run("(b => [b.x, b.y])(document.getElementById('view').getBoundingClientRect())")
    return x + at[0], y + at[1]


def pixel(browser: Browser, x: float, y: float) -> tuple[int, ...]:
    script = f"[...document.getElementById('view').getContext('2d').getImageData({x}, {y}, 1, 1).data]"
    return tuple(browser.run(script)[:3])


def rgb(color: str) -> tuple[int, ...]:
    return tuple(int(color[i : i + 2], 16) for i in (1, 3, 5))


def test_the_page_shows_the_step_and_the_vehicle_that_the_address_asks_for(world, page, browser):
    network, lane_map, trace = world
    for k, slot in ((12, SELF), (37, TURNS), (40, AGAIN), (9, HIT)):
        state = browser.open(page, f"#t={TIME[k]:.1f}&select={slot}")
        assert state["step"] == str(k) and float(state["time"]) == pytest.approx(TIME[k], abs=1e-3)
        assert state["selected"] == str(slot) and state["playing"] == "false"
        assert state["count"] == str(trace.active[k].sum())
        for name in ("v", "a", "s"):
            assert browser.fact(name) == pytest.approx(getattr(trace, name)[k, slot], abs=0.006), name
        x, y = absolute(lane_map, *trace.box[k, slot, :2])
        assert browser.fact("x") == pytest.approx(x, abs=0.006)
        assert float(browser.run("document.querySelector('[data-field=x]').dataset.y")) == pytest.approx(
            y, abs=0.006
        )
        assert browser.text("[data-field=lane]") == lane_ids(network)[trace.lane[k, slot]]
        assert browser.text("[data-field=class]").startswith(VEHICLE_CLASSES[CLASSES[slot]])
        assert browser.text("#who") == f"Slot {slot}"
        assert f"{trace.v[k, slot]:.2f} m/s" in browser.text("[data-field=v]")
        assert problems(browser) == [] and "error" not in state
    assert browser.text("#bits") == ""  # not yet
    browser.open(page, f"#t={TIME[10]:.1f}&select={HIT}")
    assert browser.text("#bits") == "collided"


def test_gap_and_times_to_collision_are_shown(world, page, browser):
    _, _, trace = world
    browser.open(page, f"#t={TIME[3]:.1f}&select={SELF}")
    gap = trace.s[3, TURNS] - LENGTH[TURNS] - trace.s[3, SELF]
    assert browser.fact("gap") == pytest.approx(gap, abs=0.006)
    assert f"slot {TURNS}" in browser.text("[data-field=gap]")
    assert browser.fact("ttc") == pytest.approx(gap / 2.0, abs=0.006)
    _, columns = payload(page)
    assert browser.fact("soonest") == columns["soonest"][SELF, 3] < gap / 2.0  # somebody from the side
    assert browser.text("[data-field=soonest]").endswith(f"slot {columns['soonest_of'][SELF, 3]:.0f}")
    browser.open(page, f"#t={TIME[3]:.1f}&select={LEAD}")
    assert browser.text("[data-field=gap]") == "nobody ahead" and np.isnan(browser.fact("ttc"))


def test_between_steps_vehicles_move_evenly_but_not_from_one_vehicle_to_the_next(page, browser):
    places = {}
    for at in (TIME[SWAP - 1], TIME[SWAP - 1] + 0.05, TIME[SWAP]):
        state = browser.open(page, f"#t={at:.3f}&view=fit")
        places[round(float(at), 2)] = {slot: centre(state, slot) for slot in (SELF, AGAIN)}
        scale = float(state["scale"])
    before, between, after = places.values()
    middle = np.mean([before[SELF], after[SELF]], 0)
    assert np.hypot(*np.subtract(after[SELF], before[SELF])) == pytest.approx(1.1 * scale, abs=0.2)
    np.testing.assert_allclose(between[SELF], middle, atol=0.16)
    assert np.hypot(*np.subtract(after[AGAIN], before[AGAIN])) > 50
    assert between[AGAIN] == before[AGAIN]


def test_clicks_keys_and_moments(page, browser):
    state = browser.open(page, "#t=2&view=fit")
    state = browser.click(*on_screen(browser, centre(state, HIT)))
    assert state["selected"] == str(HIT)
    state = browser.click(*on_screen(browser, (5, 5)))
    assert state["selected"] == ""
    assert browser.key("ArrowRight")["step"] == "20"
    assert browser.key("ArrowLeft")["step"] == "19"
    assert browser.key("ArrowRight", modifiers=8)["step"] == "29"  # shift: a second
    assert browser.key("Home")["step"] == "0" and browser.key("End")["step"] == str(T - 1)
    state = browser.key("e")
    assert state["selected"] == str(SELF) and state["follow"] == "true"
    assert browser.key("Escape")["selected"] == ""

    buttons = browser.run("[...document.querySelectorAll('#moments ol button')].map(b => b.textContent)")
    assert [text.split(" s")[0] for text in buttons] == ["1.5", "2.5", "4.0"]
    assert (
        "near miss" in buttons[0]
        and "TTC 0.92 s" in buttons[0]
        and "responsible: both, prediction" in buttons[0]
    )
    assert (
        "contact, delta-v 3.21 m/s (worst)" in buttons[2]
        and "the other" in buttons[2]
        and f"slot {HIT}" in buttons[2]
    )
    state = browser.click(*browser.middle("#moments li:nth-child(3) button"))
    assert float(state["time"]) == 4.0 and state["selected"] == str(SELF) and state["follow"] == "true"
    assert browser.key("p")["time"] == "2.5000" and browser.key("p")["time"] == "1.5000"
    state = browser.click(*browser.middle("#time .mark:nth-of-type(2)"))
    assert state["time"] == "2.5000" and state["playing"] == "false"
    assert problems(browser) == []


def test_dragging_in_plots_and_on_the_time_line_moves_the_time(page, browser):
    browser.open(page, f"#select={SELF}")
    _, y = browser.middle("#plot_v")
    left, width = browser.run(
        "(b => [b.x + 30, b.width - 36])(document.getElementById('plot_v').getBoundingClientRect())"
    )
    state = browser.click(left + 0.25 * width, y)
    first, last = float(TIME[0]), float(TIME[-1])
    assert float(state["time"]) == pytest.approx(first + 0.25 * (last - first), abs=0.02)
    browser.mouse("mousePressed", left + 0.25 * width, y, button="left", buttons=1)
    browser.mouse("mouseMoved", left + 0.75 * width, y, button="left", buttons=1)
    browser.mouse("mouseReleased", left + 0.75 * width, y, button="left")
    assert float(browser.state()["time"]) == pytest.approx(first + 0.75 * (last - first), abs=0.02)
    left, top, width = browser.run(
        "(b => [b.x, b.y + 20, b.width])(document.getElementById('time').getBoundingClientRect())"
    )
    assert float(browser.click(left + 0.4 * width, top)["time"]) == pytest.approx(
        first + 0.4 * (last - first), abs=0.02
    )


def test_it_plays_at_the_speed_chosen_and_stops_at_the_end(page, browser):
    state = browser.open(page, "#t=0.1&speed=2&play=1")
    assert state["playing"] == "true" and state["speed"] == "2"
    browser.run("new Promise(done => setTimeout(done, 500))")
    at = float(browser.key(" ")["time"])
    assert 0.4 < at < 5.0  # a slow machine shows fewer frames, none of them longer than 0.25 s
    assert float(browser.state()["time"]) == at
    browser.open(page, "#t=5.5&speed=8&play=1")
    browser.run("new Promise(done => setTimeout(done, 700))")
    state = browser.state()
    assert state["playing"] == "false" and float(state["time"]) == pytest.approx(float(TIME[-1]), abs=1e-3)
    browser.run("document.getElementById('play').click()")
    assert float(browser.state()["time"]) < 5.0  # from the start again


def test_the_wheel_zooms_about_the_cursor_and_drags_move_the_map(page, browser):
    def under(state: dict[str, str], x: float, y: float) -> tuple[float, float]:
        """Where on the map a point of the window is."""
        left, top, wide, high = browser.run(
            "(b => [b.x, b.y, b.width, b.height])(view.getBoundingClientRect())"
        )
        scale = float(state["scale"])
        right, up = (x - left - wide / 2) / scale, (top + high / 2 - y) / scale
        return float(state["x"]) + right, float(state["y"]) + up

    state = browser.open(page, "#t=2&view=fit")
    scale, place = float(state["scale"]), under(state, 200, 150)
    browser.mouse("mouseWheel", 200, 150, deltaX=0, deltaY=-400)
    state = browser.state()
    assert float(state["scale"]) > 1.5 * scale
    np.testing.assert_allclose(under(state, 200, 150), place, atol=0.3)
    browser.mouse("mousePressed", 200, 150, button="left", buttons=1)
    for x, y in ((230, 130), (260, 110)):
        browser.mouse("mouseMoved", x, y, button="left", buttons=1)
    browser.mouse("mouseReleased", 260, 110, button="left")
    state = browser.state()
    np.testing.assert_allclose(under(state, 260, 110), place, atol=0.3)
    assert state["selected"] == str(SELF)  # a drag is no click
    state = browser.open(page, f"#t=2&select={TURNS}&follow=1")
    state = browser.key("ArrowRight")
    middle = browser.run(
        "(b => [b.width / 2, b.height / 2])(document.getElementById('view').getBoundingClientRect())"
    )
    np.testing.assert_allclose(centre(state, TURNS), middle, atol=0.1)


def test_two_fingers_zoom(page, browser):
    state = browser.open(page, "#t=2&view=fit")
    scale = float(state["scale"])
    browser.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    try:
        for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
            points = [{"x": 400 + side * apart, "y": 300, "id": i} for i, side in enumerate((-1, 1))]
            browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        browser.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert float(browser.state()["scale"]) == pytest.approx(2 * scale, rel=0.05)
    finally:
        browser.send("Emulation.setTouchEmulationEnabled", enabled=False)


def test_colours_tell_the_ego_lights_and_brakes(world, page, browser):
    _, _, trace = world
    meta, columns = payload(page)
    state = browser.open(page, f"#t={TIME[20]:.1f}&select={SELF}&follow=1")
    x, y = centre(state, SELF)
    nose = np.array([np.cos(trace.box[20, SELF, 2]), -np.sin(trace.box[20, SELF, 2])])
    assert pixel(browser, *(np.array([x, y]) + 0.42 * LENGTH[SELF] * float(state["scale"]) * nose)) == rgb(
        EGO
    )

    seen = set()
    for k in (20, 40):
        states = columns["light_state"][:, k]
        for bar in range(4):
            at = [columns[f"light_{axis}"][0, 2 * bar : 2 * bar + 2].mean() for axis in "xy"]
            view = f"view={at[0] + meta['network']['origin'][0]},{at[1] + meta['network']['origin'][1]},30"
            browser.open(page, f"#t={TIME[k]:.1f}&select={HIT}&follow=0&{view}", size=(700, 500))
            middle = browser.run("(c => [c.width / 2, c.height / 2])(document.getElementById('view'))")
            color = rgb(SIGNALS[SignalState(int(states[bar]))])
            assert pixel(browser, *middle) == color, (k, bar)
            seen.add(color)
    assert len(seen) > 1

    def rear(k: int, slot: int) -> tuple[int, ...]:
        state = browser.open(page, f"#t={TIME[k]:.1f}&select={slot}&follow=1")
        heading, scale = trace.box[k, slot, 2], float(state["scale"])
        ahead = np.array([np.cos(heading), -np.sin(heading)])
        left = np.array([-np.sin(heading), -np.cos(heading)])
        corner = (1.2 - 0.5 * LENGTH[slot] * scale) * ahead + 0.35 * WIDTH[slot] * scale * left
        return pixel(browser, *(np.array(centre(state, slot)) + corner))

    def red(color: tuple[int, ...]) -> bool:
        return color[0] > 200 and color[1] < 90 and color[2] < 90

    assert not red(rear(10, SELF)) and red(rear(50, SELF)) and red(rear(5, HIT))  # at a = -0.85, -1.25, -3


def near(color: tuple[int, ...], other: str) -> bool:
    return max(abs(a - b) for a, b in zip(color, rgb(other), strict=True)) < 60


def test_plans_are_drawn_where_they_lead_until_the_next_decision(world, page, browser):
    _, lane_map, trace = world
    at = np.stack(absolute(lane_map, trace.plan[..., 0], trace.plan[..., 1]), -1)  # [T, 3, H, 2]
    after = {0: 15, 1: 20}  # 0.1 s: dots at 2 s, and the line between the dots

    def seen(k: int, row: int, of: int) -> tuple[int, ...]:
        """The colour at step k of where the plan of step `of` leads."""
        x, y = at[of, row, after[row]]
        browser.open(page, f"#t={TIME[k]:.1f}&select={HIT}&follow=0&view={x},{y},12")
        browser.run(hide)
        browser.state()
        middle = browser.run("(c => [c.width / 2, c.height / 2])(document.getElementById('view'))")
        return pixel(browser, *middle)

    for row, color, k in ((0, EGO, 22), (1, DRIVEN, 12)):
        hide = ""
        assert near(seen(k, row, k), color) and near(seen(k + 2, row, k), color), row
        assert not near(seen(k + 3, row, k), color) and near(seen(k + 3, row, k + 3), color), row
        hide = "document.querySelector('[data-layer=plan]').click()"
        assert not near(seen(k, row, k), color), row
        assert problems(browser) == []
    hide = ""
    assert not near(seen(GIVEN, 1, GIVEN - 1), DRIVEN)
    for i, wide in ((20, True), (15, False)):  # dots at whole seconds
        (x, y), along = at[22, 0, i], at[22, 0, i] - at[22, 0, i - 1]
        heading = float(np.arctan2(along[1], along[0]))
        browser.open(page, f"#t={TIME[22]:.1f}&select={HIT}&follow=0&view={x},{y},12")
        width, height = browser.run("(c => [c.width / 2, c.height / 2])(document.getElementById('view'))")
        beside = (width + 2.4 * np.sin(heading), height + 2.4 * np.cos(heading))
        assert near(pixel(browser, *beside), EGO) == wide


def test_whom_the_policy_drives_is_outlined(world, page, browser):
    _, lane_map, trace = world

    def outline(k: int, slot: int) -> tuple[int, ...]:
        scale = 10
        x, y = (float(z) for z in absolute(lane_map, *trace.box[k, slot, :2]))
        browser.open(page, f"#t={TIME[k]:.1f}&select={AGAIN}&follow=0&view={x},{y},{scale}")
        browser.run("document.querySelector('[data-layer=plan]').click()")
        state = browser.state()
        heading = trace.box[k, slot, 2]
        left = np.array([-np.sin(heading), -np.cos(heading)])
        return pixel(browser, *(np.array(centre(state, slot)) + (0.5 * WIDTH[slot] * scale + 2) * left))

    assert near(outline(TAKEN, TURNS), DRIVEN) and near(outline(GIVEN - 1, TURNS), DRIVEN)
    assert not near(outline(TAKEN - 1, TURNS), DRIVEN) and not near(outline(GIVEN, TURNS), DRIVEN)
    assert not near(outline(TAKEN, LEAD), DRIVEN) and not near(outline(TAKEN, SELF), DRIVEN)
    assert near(outline(2, HIT), DRIVEN)  # by a policy without trajectories
    assert browser.run("document.getElementById('outlined').checkVisibility()")
    for slot, driver in ((SELF, "the policy"), (LEAD, "the traffic model"), (TURNS, "the policy")):
        browser.open(page, f"#t={TIME[TAKEN]:.1f}&select={slot}")
        assert browser.text("[data-field=driver]") == driver


def test_the_distance_of_the_ego_to_its_goal(world, page, browser):
    _, _, trace = world
    for k in (0, 33):
        browser.open(page, f"#t={TIME[k]:.1f}&select={SELF}")
        assert browser.fact("to_go") == pytest.approx(trace.to_go[k], abs=0.006)
        assert browser.text("#at_to_go") == f"{trace.to_go[k]:.1f}"
    browser.open(page, f"#t={TIME[57]:.1f}&select={SELF}")
    assert np.isnan(browser.fact("to_go")) and browser.text("#at_to_go") == ""
    left, top, width, height = browser.run(
        "(b => [b.x + 30, b.y, b.width - 36, b.height])(plot_to_go.getBoundingClientRect())"
    )
    state = browser.click(left + 0.5 * width, top + 0.5 * height)
    first, last = float(TIME[0]), float(TIME[-1])
    assert float(state["time"]) == pytest.approx(first + 0.5 * (last - first), abs=0.02)
    # the line falls from left to right; axes: 0 at 3 px above the bottom, 1.06 times the most at the top
    k = 20
    x = 30 + (TIME[k] - TIME[0]) / (TIME[-1] - TIME[0]) * width
    y = (height - 3) - trace.to_go[k] / (1.06 * trace.to_go[0]) * (height - 3 - 4)
    script = f"[...plot_to_go.getContext('2d').getImageData({x:.0f}, {y:.0f} - 1, 1, 3).data]"
    colors = np.reshape(browser.run(script), (3, 4))[:, :3]
    accent = (11, 98, 168)
    assert np.abs(colors - accent).max(-1).min() < 80
    browser.open(page, f"#t={TIME[3]:.1f}&select={LEAD}")
    visible = "document.querySelector('{}').checkVisibility()"
    assert not browser.run(visible.format("[data-field=to_go]")) and not browser.run(visible.format("#goal"))
    assert problems(browser) == []


def test_names_from_files_stay_text(world, tmp_path, browser):
    network, lane_map, trace = world
    evil = "</script><script>document.body.dataset.hacked = 1</script><img src=x onerror=alert(1)>{{DATA}}"
    lanes = {}
    for i, (name, lane) in enumerate(network.lanes.items()):
        name = evil + name if i == 0 else name
        lanes[name] = dataclasses.replace(lane, id=name)
    named = dataclasses.replace(
        network, name=evil, source=f"/maps/{evil.replace('/', '_')}.xodr", lanes=lanes
    )
    moments = [{"kind": evil, "time": 1.0, "responsible": evil, "module": evil}]
    write_viewer(tmp_path / "a.html", named, lane_map, trace, moments=moments)
    assert (tmp_path / "a.html").read_text().count("<script") == 2
    state = browser.open(tmp_path / "a.html", f"#select={SELF}")
    assert "hacked" not in state and browser.text("#title") == evil and browser.run("document.title") == evil
    assert browser.run("document.querySelectorAll('img').length") == 0 and problems(browser) == []
    assert evil in browser.text("#moments li")


@pytest.mark.parametrize("size", [(1280, 800), (390, 780), (900, 420)])
@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_into_windows_of_all_sizes_by_day_and_night(page, browser, size, dark):
    state = browser.open(page, f"#t=3&select={SELF}", size=size, dark=dark)
    assert problems(browser) == [] and "error" not in state
    wide, high = browser.run("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert wide <= size[0] and high <= size[1]
    ground = browser.run("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", ground)[:3])) < 200) == dark
    assert (sum(pixel(browser, 2, 2)) < 300) == dark
    box = browser.run("(b => [b.width, b.height])(document.getElementById('view').getBoundingClientRect())")
    assert box[0] >= 300 and box[1] >= 180


def test_it_runs_in_a_frame_of_a_notebook(page, tmp_path, browser):
    outer = tmp_path / "notebook.html"
    srcdoc = page.read_text().replace("&", "&amp;").replace('"', "&quot;")
    look = """const look = () => { const body = document.querySelector('iframe').contentDocument.body;
        const data = body && body.dataset;
        if (data && (data.ready || data.error)) Object.assign(document.body.dataset, data);
        else setTimeout(look, 20); }; look();"""
    sandbox = 'sandbox="allow-scripts allow-same-origin"'
    outer.write_text(f'<body><iframe srcdoc="{srcdoc}" {sandbox}></iframe><script>{look}</script>')
    state = browser.open(outer)
    assert state["ready"] == "1" and "error" not in state and state["count"] == "5"


def test_who_gets_the_slot_of_the_ego_is_not_the_ego(world, tmp_path, browser):
    network, lane_map, trace = world
    write_viewer(tmp_path / "a.html", network, lane_map, trace, ego=AGAIN)
    for k, ego in ((SWAP - 1, True), (SWAP, False)):
        state = browser.open(tmp_path / "a.html", f"#t={TIME[k]:.1f}&select={AGAIN}&follow=1")
        assert browser.run("document.getElementById('isego').hidden") != ego
        nose = np.array([np.cos(trace.box[k, AGAIN, 2]), -np.sin(trace.box[k, AGAIN, 2])])
        at = np.array(centre(state, AGAIN)) + 0.42 * LENGTH[AGAIN] * float(state["scale"]) * nose
        assert (pixel(browser, *at) == rgb(EGO)) == ego


def test_a_trace_without_vehicles_or_with_one_step_is_shown(world, tmp_path, browser):
    network, lane_map, trace = world
    write_viewer(tmp_path / "a.html", network, lane_map, Trace(*(x[:1] for x in trace)))
    state = browser.open(tmp_path / "a.html", f"#select={SELF}&play=1")
    assert state["count"] == "5" and problems(browser) == []
    write_viewer(tmp_path / "b.html", network, lane_map, trace._replace(active=0 * trace.active > 0))
    state = browser.open(tmp_path / "b.html", f"#select={SELF}&t=3")
    assert state["count"] == "0" and state["selected"] == "" and problems(browser) == []
