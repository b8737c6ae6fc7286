"""Pictures and videos: what is drawn agrees with the trace, and files are what their suffix says."""

import sys
from typing import Any

import jax
import numpy as np
import pytest

pytest.importorskip("matplotlib")
from fake_traces import GONE, HIT, LATE, OWN, N, T, small_trace
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import imread
from PIL import Image

from limsim_jax.maps.lane_map import absolute, lane_rows
from limsim_jax.maps.outline import signal_bars
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.report import video
from limsim_jax.report.frames import COLLIDED, EGO, SIGNALS, Scene, draw_frame
from limsim_jax.report.stills import Camera, Captions, MapPage
from limsim_jax.report.video import write_picture, write_video
from limsim_jax.simulation.ending import Watch, ending
from limsim_jax.simulation.trace import Trace


@pytest.fixture(scope="module")
def world() -> Any:
    return small_trace("roundabout")


def frames_of(image: Any) -> int:
    return image.n_frames


def axes():
    return Figure(figsize=(12, 12), dpi=200).add_axes((0, 0, 1, 1))


def test_boxes_lie_where_the_trace_says(world):
    network, lane_map, trace = world
    near = (-40.0, -40.0, 60.0, 60.0)
    drawn = draw_frame(axes(), network, lane_map, trace, 0.5, bounds=near)["vehicles"]
    paths = [path.vertices[:-1] for path in drawn.get_paths()]
    assert len(paths) == N - 1
    for slot, path in enumerate(paths):
        x, y, heading, length, width = trace.box[4, slot]
        x, y = absolute(lane_map, x, y)
        along = (path - (x, y)) @ (np.cos(heading), np.sin(heading))
        across = (path - (x, y)) @ (-np.sin(heading), np.cos(heading))
        np.testing.assert_allclose([along.min(), along.max()], [-length / 2, length / 2], atol=1e-4)
        np.testing.assert_allclose([across.min(), across.max()], [-width / 2, width / 2], atol=1e-4)
        front = along > 0
        assert np.ptp(across[~front]) == pytest.approx(width, abs=1e-4)  # only front corners are cut
        assert np.ptp(across[along > along.max() - 1e-3]) < 0.6 * width
    np.testing.assert_allclose(drawn.get_array(), trace.v[4, :-1])


def test_egos_and_collided_are_marked(world):
    network, lane_map, trace = world
    drawn = draw_frame(axes(), network, lane_map, trace, egos=[OWN])
    edges = drawn["vehicles"].get_edgecolor()
    assert (edges == to_rgba(EGO)).all(1).tolist() == [False, False, False, True]  # on top
    assert (edges == to_rgba(COLLIDED)).all(1).tolist() == [False, True, False, False]
    x, y = absolute(lane_map, *trace.box[-1, HIT, :2])
    np.testing.assert_allclose(drawn["collided"].get_xydata(), [[x, y]])


def test_tails_end_where_another_vehicle_had_the_slot(world):
    network, lane_map, trace = world
    tails = draw_frame(axes(), network, lane_map, trace, tail=0.85)["tails"].get_segments()
    assert [len(tail) for tail in tails] == [9, 9, 9, 6]
    np.testing.assert_allclose(tails[0][-1], np.stack(absolute(lane_map, *trace.box[-1, 0, :2])))


def test_stop_lines_show_what_the_programs_say():
    network, lane_map, trace = small_trace("intersection")
    durations = np.asarray(lane_map.signals.duration)
    phases = int((durations[0] > 0).sum())
    programs = durations.shape[0] - 1
    phase = np.zeros_like(trace.phase)
    phase[:, :programs] = np.arange(T)[:, None] % phases
    trace = trace._replace(phase=phase)
    rows, ax = lane_rows(network), axes()
    seen = set()
    for k in range(phases):
        drawn = draw_frame(ax, network, lane_map, trace, float(trace.time[k]))["signals"]
        colors = [tuple(color) for color in drawn.get_colors()]
        middles = np.array([segment.mean(0) for segment in drawn.get_segments()])
        for movement in network.movements:
            light = int(np.asarray(lane_map.signals.lane_program)[rows[movement.via[0]]])
            link = int(np.asarray(lane_map.signals.lane_link)[rows[movement.via[0]]])
            if light < 0:
                continue
            state = SignalState(int(np.asarray(lane_map.signals.state)[light, k, link]))
            lane = network.lanes[movement.incoming]
            end = lane.pose(np.asarray(lane_map.stop_s)[rows[movement.incoming]])[0].reshape(-1)[:2]
            near = np.hypot(*(middles - end).T) < 2.0
            assert to_rgba(SIGNALS[state]) in [colors[i] for i in np.flatnonzero(near)]
            seen.add(state)
    assert {SignalState.RED, SignalState.YELLOW} < seen
    # no lamp of the map itself, whose yellow would be taken for a signal
    assert not [artist for artist in ax.get_children() if (artist.get_gid() or "").startswith("lights")]


def test_bars_of_one_lane_lie_as_its_turns_do():
    """Left, straight, right from left to right; none overlaps another."""
    network, lane_map, _ = small_trace("intersection")
    rows = lane_rows(network)
    bars, behind = signal_bars(network, lane_map)
    rank = {"left": 0, "slight_left": 1, "straight": 2, "slight_right": 3, "right": 4}
    turn = {rows[m.via[0]]: rank[m.turn.name.lower()] for m in network.movements if m.via}
    shared = 0
    for lane in network.drivable_lanes():
        mine = [
            i for i, row in enumerate(behind) if lane.successors and row in {rows[x] for x in lane.successors}
        ]
        if len(mine) < 2:
            continue
        heading = lane.heading[-1]
        left = bars[mine] @ (-np.sin(heading), np.cos(heading))  # [K, 2]
        order = np.argsort(-left.mean(-1))
        assert [turn[int(behind[mine[int(i)]])] for i in order] == sorted(turn[int(behind[i])] for i in mine)
        np.testing.assert_allclose(left[order][:-1, 1], left[order][1:, 0], atol=1e-6)
        shared += 1
    assert shared


def test_a_frame_shows_nothing_of_earlier_frames(world):
    network, lane_map, trace = world
    scene = Scene(network, lane_map, trace, [OWN])
    page = MapPage(network, scene, Captions(scene, []), 0.0, None, 50)
    first, other, again = page.frames([0, T - 1, 0])
    assert (first != other).any() and (first == again).all()


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_video(world, suffix, tmp_path):
    network, lane_map, trace = world
    path = tmp_path / f"traffic.{suffix}"
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    write_video(path, network, lane_map, trace, fps=5, every=3)
    if suffix == "gif":
        with Image.open(path) as image:
            assert (frames_of(image), image.info["duration"]) == (4, 200)
            first = np.asarray(image.convert("RGB"), int)
            image.seek(3)
            last = np.asarray(image.convert("RGB"), int)
        moved = np.abs(first - last).max(-1) > 40
        assert 0 < moved.mean() < 0.02  # vehicles and the clock, nothing else
    else:
        assert path.read_bytes()[4:8] == b"ftyp"


def test_video_follows_a_slot(world, tmp_path):
    network, lane_map, trace = world
    far = trace.box.copy()
    far[:, OWN, 0] += 20 * np.arange(T)  # 200 m/s: out of the first view
    path = tmp_path / "follow.gif"
    write_video(path, network, lane_map, trace._replace(box=far), every=T // 2, follow=OWN)
    with Image.open(path) as image:
        frames = []
        for k in range(frames_of(image)):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB"), int))
    assert len(frames) == 2
    pink = [np.abs(frame - np.array([0xD8, 0x1B, 0x8C])).max(-1) < 30 for frame in frames]
    assert all(p.any() and p.shape == (720, 1280) for p in pink)  # in view before and after


def test_picture(world, tmp_path):
    network, lane_map, trace = world
    write_picture(tmp_path / "end.png", network, lane_map, trace)
    write_picture(tmp_path / "start.png", network, lane_map, trace, at=0.1)
    end, start = imread(tmp_path / "end.png"), imread(tmp_path / "start.png")
    assert end.shape == start.shape and 0 < (end != start).any(-1).mean() < 0.02


def test_the_camera_stays_above_its_vehicle(world):
    """The vehicle is where the view says, drawn to scale on a map that lies under it."""
    network, lane_map, trace = world
    scene = Scene(network, lane_map, trace, [OWN])
    camera = Camera(network, scene, Captions(scene, []), OWN, 0.0, 100)
    for k, pixels in zip((0, 6, T - 1), camera.frames([0, 6, T - 1]), strict=True):
        assert pixels.shape == (720, 1280, 3)
        rows, columns = np.nonzero(np.abs(pixels - np.array([0xD8, 0x1B, 0x8C], float)).max(-1) < 30)
        middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
        offset = (scene.xy[k, OWN] - camera.places[k]) * (1, -1) * camera.scale
        np.testing.assert_allclose(middle, np.array([640, 360]) + offset, atol=4)
        assert np.hypot(np.ptp(columns), np.ptp(rows)) < 1.4 * np.hypot(*trace.box[k, OWN, 3:]) * camera.scale
    whole = camera.tile.copy()
    (low, _), (bottom, _) = camera.ax.get_xlim(), camera.ax.get_ylim()
    assert camera.scale == pytest.approx(720 / 70)
    first = np.round((np.array([low, bottom]) - camera.corner) * camera.scale)
    np.testing.assert_allclose(np.array([low, bottom]), camera.corner + first / camera.scale)
    assert whole.shape == (1440, 2560, 4)


def test_captions_tell_key_moments_while_they_happen(world):
    network, lane_map, trace = world
    scene = Scene(network, lane_map, trace, [OWN])
    moments = [
        {"kind": "contact", "time": 0.4, "value": 3.21, "other": HIT},
        {"kind": "off_road", "time": 9.0, "value": None, "other": np.nan},
    ]
    captions = Captions(scene, moments)
    assert captions.at(0.5) == ("contact, delta-v 3.2 m/s, at 0.4 s", HIT)
    assert captions.at(5.0) == ("", None)
    assert captions.at(8.0) == ("off the road, at 9.0 s", None)


def arriving(trace: Trace, step: int) -> Trace:
    """The same with an ego that has left at its goal in the step after this one."""
    active, t = trace.active.copy(), np.arange(T)
    active[step + 1 :, OWN] = False
    to_go = np.where(t <= step, 0.5 * (step + 1 - t), np.where(t == step + 1, 0.0, np.nan))
    return trace._replace(active=active, driven=np.full((T, 1), OWN), to_go=to_go)


def test_an_ego_ends_where_it_arrives_or_leaves(world):
    _, _, trace = world
    assert ending(trace, OWN) == (T - 1, False) and ending(trace, GONE) is None
    assert ending(arriving(trace, 5), OWN) == (5, True)
    assert ending(arriving(trace, 5), HIT) == (T - 1, False)  # the distance is that of another vehicle
    assert ending(trace, LATE) == (5, False)  # another vehicle gets the slot
    left = trace._replace(active=trace.active & (np.arange(T)[:, None] < 7))
    assert ending(left, OWN) == (6, False)


def test_a_watch_waits_for_the_last_ego_and_some_time_more(world):
    _, _, trace = world
    early, late = arriving(trace, 2), arriving(trace, 5)
    both: Trace = jax.tree.map(lambda x, y: np.stack([x, y]), early, late)

    def ends(trace: Trace, egos: list[int], after: float) -> int | None:
        """The step after which the watch is content; it is told two steps at a time."""
        watch, told = Watch(egos, after), range(2, T + 1, 2)
        found = [watch(jax.tree.map(lambda x: x[:, k - 2 : k], trace)) for k in told]  # noqa: B023
        return told[found.index(True)] if True in found else None

    assert ends(both, [OWN, OWN], 0.0) == 8  # the last one arrives in the sixth step
    assert ends(both, [OWN, OWN], 0.25) == 10  # steps are 0.1 s apart: by the ninth one
    assert ends(both, [OWN, HIT], 0.0) is None  # the second is on the road to the end
    assert ends(both._replace(driven=None), [OWN, OWN], 0.0) is None


def test_an_ego_is_not_drawn_after_its_arrival(world, tmp_path):
    network, lane_map, trace = world
    scene = Scene(network, lane_map, arriving(trace, 5), [OWN])
    assert scene.active[:, OWN].tolist() == [True] * 6 + [False] * 6
    assert scene.active[:, HIT].all()
    assert Captions(scene, []).at(0.6) == ("arrived, at 0.7 s", None)
    fields: Any = [None if x is None else np.repeat(x, 5, 0) for x in arriving(trace, 2)]
    long = Trace(*fields)._replace(time=0.1 * np.arange(1, 5 * T + 1))
    write_video(tmp_path / "a.gif", network, lane_map, long, egos=[OWN], every=10)
    write_video(tmp_path / "b.gif", network, lane_map, long, egos=[OWN], every=10, begin=1.0, end=5.5)
    with Image.open(tmp_path / "a.gif") as a, Image.open(tmp_path / "b.gif") as b:
        # arrival at 1.1 s, and 2 s more; 1.0 to 5.5 s
        assert (frames_of(a), frames_of(b)) == (4, 5)


REFUSALS: dict[str, Any] = {
    "suffix": (lambda w, p: write_video(p / "x.avi", *w), "x.avi"),
    "picture suffix": (lambda w, p: write_picture(p / "x.jpg", *w), ".png"),
    "time": (lambda w, p: write_picture(p / "x.png", *w, at=99.0), "time = 99"),
    "slot": (lambda w, p: write_video(p / "x.gif", *w, follow=N), f"slot {N}"),
    "span": (lambda w, p: write_video(p / "x.gif", *w, begin=1.0, end=0.5), "no step in between"),
    "fps": (lambda w, p: write_video(p / "x.gif", *w, fps=0), "frames per second"),
    "every": (lambda w, p: write_video(p / "x.gif", *w, every=0), "every 0"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case, world, tmp_path):
    call, clue = REFUSALS[case]
    with pytest.raises(ValueError, match=clue) as caught:
        call(world, tmp_path)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_empty_trace(world):
    network, lane_map, trace = world
    with pytest.raises(ValueError, match="empty"):
        draw_frame(axes(), network, lane_map, trace._replace(time=trace.time[:0]))


def test_missing_ffmpeg_is_told(world, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ModuleNotFoundError, match="imageio-ffmpeg"):
        write_video(tmp_path / "x.mp4", *world)
    assert not list(tmp_path.iterdir())
    video.check_suffix("x.gif", video.VIDEO_SUFFIXES)  # needs no ffmpeg
