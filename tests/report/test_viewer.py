"""The interactive replay: the file holds the numbers of the trace."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_replays import (
    AGAIN,
    AHEAD,
    DT,
    EVERY,
    GIVEN,
    HIT,
    LEAD,
    LENGTH,
    MOMENTS,
    NEVER,
    SELF,
    TAKEN,
    TIME,
    TURNS,
    WIDTH,
    N,
    T,
    intersection_trace,
    payload,
    write_replay,
)
from traffic_worlds import bundled

from limsim_jax.maps.lane_map import lane_ids, pose
from limsim_jax.report.viewer import write_viewer
from limsim_jax.simulation.trace import Trace


@pytest.fixture(scope="module")
def world() -> Any:
    return intersection_trace()


@pytest.fixture(scope="module")
def page(world: Any, tmp_path_factory: Any) -> Path:
    return write_replay(world, tmp_path_factory.mktemp("viewer") / "replay.html")


@pytest.mark.engine
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


@pytest.mark.engine
def test_an_empty_slot_costs_nothing_and_may_hold_anything(world, tmp_path):
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
    assert columns["ttc"][LEAD, k] == -1  # none ahead
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


def test_what_follows_the_arrival_of_the_ego_is_left_out(world, tmp_path):
    network, lane_map, trace = world
    to_go = np.maximum(30.0 - np.asarray(trace.time) * 10, 0.0)  # 3 s
    active = np.array(trace.active)
    active[to_go <= 0, SELF] = False
    there = trace._replace(active=active, to_go=to_go)
    write_viewer(tmp_path / "a.html", network, lane_map, there, ego=SELF)
    meta, columns = payload(tmp_path / "a.html")
    assert (
        meta["arrived"] == pytest.approx(3.0, abs=0.11) and meta["steps"] == round(10 * meta["arrived"]) + 20
    )
    on = columns["vehicle"][SELF] > 0
    assert on.sum() == round(10 * meta["arrived"]) - 1
    assert [(row["label"], row["time"]) for row in meta["moments"]] == [("arrived", meta["arrived"])]
    late = [{"kind": "unsafe", "time": 5.5}]
    write_viewer(tmp_path / "b.html", network, lane_map, there, ego=SELF, moments=late)
    assert payload(tmp_path / "b.html")[0]["steps"] == T  # no moment is cut off
    write_viewer(tmp_path / "c.html", network, lane_map, there)
    assert payload(tmp_path / "c.html")[0]["steps"] == T  # nothing ends without an ego


def test_every_third_step(world, tmp_path):
    network, lane_map, trace = world
    write_viewer(tmp_path / "a.html", network, lane_map, trace, every=3)
    meta, columns = payload(tmp_path / "a.html")
    assert meta["steps"] == 20
    np.testing.assert_allclose(columns["s"][SELF], trace.s[::3, SELF], atol=0.006)


@pytest.mark.engine
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
    # the distance to the goal is that of the first ego alone
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
        (dict(ego=N), f"ego {N}: the trace has slots 0 to {N - 1}"),
        (dict(ego=-1), "ego -1:"),
        (dict(every=0), "every 0 steps"),
        (dict(moments=[{"kind": "contact"}]), "moment 0 has no time"),
        (dict(moments=[MOMENTS[0], {"time": 2.0}]), "moment 1 has no kind"),
        (dict(moments=[{"kind": "contact", "time": float("nan")}]), "moment 0 has no time"),
        (dict(moments=[{"kind": "contact", "time": 60.0}]), "(contact) is at 60 s; the trace goes to 6 s"),
        (dict(moments=[{"kind": "contact", "time": 1.0, "other": 9}]), "other vehicle 9: the trace has"),
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
    with pytest.raises(ValueError, match=r"v of shape \(60, 7\) instead of \(60, 6\): .*another trace"):
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
