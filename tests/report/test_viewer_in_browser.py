"""The interactive replay: what the page shows in a real browser is what the trace says."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, centre, chromium, near, on_screen, pixel, problems, rgb
from fake_replays import (
    AGAIN,
    CLASSES,
    GIVEN,
    HIT,
    LEAD,
    LENGTH,
    SELF,
    SWAP,
    TAKEN,
    TIME,
    TURNS,
    WIDTH,
    T,
    intersection_trace,
    payload,
    write_replay,
)

from limsim_jax.maps.lane_map import VEHICLE_CLASSES, absolute, lane_ids
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.report.frames import EGO, SIGNALS
from limsim_jax.report.viewer import DRIVEN, write_viewer
from limsim_jax.simulation.trace import Trace


@pytest.fixture(scope="module")
def world() -> Any:
    return intersection_trace()


@pytest.fixture(scope="module")
def page(world: Any, tmp_path_factory: Any) -> Path:
    return write_replay(world, tmp_path_factory.mktemp("viewer") / "replay.html")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    yield from chromium()


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
    assert browser.fact("soonest") == columns["soonest"][SELF, 3] < gap / 2.0  # a vehicle from the side
    assert browser.text("[data-field=soonest]").endswith(f"slot {columns['soonest_of'][SELF, 3]:.0f}")
    browser.open(page, f"#t={TIME[3]:.1f}&select={LEAD}")
    assert browser.text("[data-field=gap]") == "none ahead" and np.isnan(browser.fact("ttc"))


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
        "contact, delta-v 3.2 m/s (worst)" in buttons[2]
        and "the other" in buttons[2]
        and f"slot {HIT}" in buttons[2]
    )
    state = browser.click(*browser.middle("#moments li:nth-child(3) button"))
    assert float(state["time"]) == 4.0 and state["selected"] == str(SELF) and state["follow"] == "true"
    assert browser.key("p")["time"] == "2.5000" and browser.key("p")["time"] == "1.5000"
    state = browser.click(*browser.middle("#time .mark:nth-of-type(2)"))
    assert state["time"] == "2.5000" and state["playing"] == "false"
    assert problems(browser) == []


def test_keys_belong_to_the_map_after_a_click_on_a_button(page, browser):
    browser.open(page, "#t=2")
    browser.click(*browser.middle("#moments li:nth-child(3) button"))
    assert browser.run("document.activeElement.id") == "view"
    state = browser.key(" ")
    assert state["playing"] == "true"  # and not the button again
    browser.key(" ")
    browser.run("document.getElementById('play').focus()")
    browser.key("Enter", text="\r", windowsVirtualKeyCode=13)
    assert browser.run("document.activeElement.id") == "play"  # chosen by keyboard: the focus stays


def test_the_address_leads_to_the_moment_shown(page, browser):
    browser.open(page, f"#t=2&select={HIT}")
    browser.key("ArrowRight")
    browser.run("new Promise(done => setTimeout(done, 500))")
    assert browser.run("location.hash") == f"#t=2.1&select={HIT}&follow=0"
    assert problems(browser) == []


def test_a_replay_ends_where_the_ego_arrives(world, tmp_path, browser):
    network, lane_map, trace = world
    to_go = np.maximum(30.0 - np.asarray(trace.time) * 10, 0.0)  # 3 s
    active = np.array(trace.active)
    active[to_go <= 0, SELF] = False
    there = trace._replace(active=active, to_go=to_go)
    write_viewer(tmp_path / "a.html", network, lane_map, there, ego=SELF)
    state = browser.open(tmp_path / "a.html", "#t=99")
    assert float(state["time"]) == pytest.approx(5.0, abs=1e-3)  # 2 s more
    assert (
        browser.text("#span").endswith("arrived")
        and browser.run("document.getElementById('isego').hidden") is False
    )
    assert str(SELF) not in [vehicle.split(",")[0] for vehicle in state["vehicles"].split()]
    assert "arrived" in browser.text("#moments li")
    state = browser.open(tmp_path / "a.html", "#t=2.9")
    assert str(SELF) in [vehicle.split(",")[0] for vehicle in state["vehicles"].split()]
    assert problems(browser) == []


def test_plots_have_the_time_axis_of_the_slider(page, browser):
    browser.open(page, f"#select={LEAD}")  # which leaves at 5 s
    _, y = browser.middle("#plot_v")
    left, width = browser.run("(b => [b.x + 30, b.width - 36])(plot_v.getBoundingClientRect())")
    first, last = float(TIME[0]), float(TIME[-1])
    state = browser.click(left + 0.9 * width, y)
    assert float(state["time"]) == pytest.approx(first + 0.9 * (last - first), abs=0.02)


def test_buttons_fit_fingers_on_a_phone(page, browser):
    browser.open(page, f"#t=3&select={SELF}", size=(390, 780))
    script = """[...document.querySelectorAll("button:not(.mark), select, summary")]
        .filter(x => x.checkVisibility())
        .map(x => [x.id || x.className, x.getBoundingClientRect().width, x.getBoundingClientRect().height])"""
    small = [row for row in browser.run(script) if min(row[1:]) < 44]
    assert not small


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


def test_vehicles_that_the_policy_drives_are_outlined(world, page, browser):
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
        if (data && (data.ready || data.error)) { Object.assign(document.body.dataset, data); return; }
        setTimeout(look, 20); }; look();"""
    sandbox = 'sandbox="allow-scripts allow-same-origin"'
    outer.write_text(f'<body><iframe srcdoc="{srcdoc}" {sandbox}></iframe><script>{look}</script>')
    state = browser.open(outer)
    assert state["ready"] == "1" and "error" not in state and state["count"] == "5"


def test_the_next_vehicle_in_the_slot_of_the_ego_is_not_the_ego(world, tmp_path, browser):
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
