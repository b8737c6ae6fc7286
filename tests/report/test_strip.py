"""What an ego senses as pixels: the strip shows its film, frame by frame."""

import dataclasses
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")
from fake_films import HIGH, HUES, RASTER, WIDE, film_of
from fake_traces import OWN, small_trace
from matplotlib.image import imread
from PIL import Image

from limsim_jax.report.strip import REACH, SURFACES, Strip, frame_at, palette, surfaces
from limsim_jax.report.video import write_picture, write_video
from limsim_jax.sensors.bev import CHANNELS

TIMES = (0.1, 0.5, 1.0)


@pytest.fixture(scope="module")
def film():
    return film_of(TIMES, np.zeros((3, 3)))


def frames_of(image: Any) -> int:
    return image.n_frames


def start_of(strip):
    """Left edge of the first panel."""
    used = sum(w > 0 for w in strip.widths)
    return max(4, (strip.width - sum(strip.widths) - 4 * (used - 1)) // 2)


@pytest.mark.parametrize("k", [0, 2])
def test_pictures_have_the_colours_of_the_film(film, k):
    strip = Strip(film)
    page = strip.draw(k)
    assert page.shape == (strip.height, 1280, 3)
    x0, wide, high = start_of(strip), strip.widths[0] / 2, strip.height - 8
    rows = (np.arange(HIGH) + 0.5) / HIGH * (high - 2) + 4
    columns = (np.arange(WIDE) + 0.5) / WIDE * (wide - 2)
    for camera in range(2):
        found = page[rows.astype(int)[:, None], (x0 + camera * wide + columns).astype(int)]
        same = (found == film.pictures.color[k, camera]).all(-1)
        assert same[2:].all() and same[:, 9:].all()  # the name covers the corner


def test_points_lie_where_rays_ended(film):
    strip = Strip(film, 1200)
    page = strip.draw(1).astype(int)
    x0 = start_of(strip) + strip.widths[0] + 4
    middle = np.array([x0 + strip.widths[1] / 2, 4 + (strip.height - 8) / 2])
    scale = (strip.height - 8) / 2 / REACH
    lidar = film.rig.lidar
    seen = 0
    for r, rise in enumerate(lidar.elevations):
        for a in range(lidar.columns):
            away = film.scan.range[1, r, a]
            turn = 2 * np.pi * a / lidar.columns
            x, y = 1.0 + away * np.cos(rise) * np.cos(turn), away * np.cos(rise) * np.sin(turn)
            u, v = np.round(middle - scale * np.array([y, x])).astype(int)
            inside = max(abs(x), abs(y)) < REACH - 2
            if away < 60 and inside and film.scan.slot[1, r, a] >= 0:
                near = page[v - 1 : v + 1, u - 1 : u + 1].reshape(-1, 3)
                seen += 1
                assert (near[:, 0] > 100).any(), (r, a)  # yellow, or the line of a box
    assert seen > 4


def test_the_view_from_above_shows_the_highest_layer():
    bev = np.zeros((len(CHANNELS), 2, 3), np.float32)
    for cell, names in {
        0: "drivable",
        1: "drivable route",
        2: "drivable route mark",
        3: "mark occupied",
    }.items():
        for name in names.split():
            bev[CHANNELS.index(name)].flat[cell] = 1
    assert surfaces(bev).flatten().tolist() == [1, 2, 3, 4, 0, 0]
    assert surfaces(np.stack([bev, 0 * bev])).shape == (2, 2, 3)
    assert len(SURFACES) == 5


def test_moments_have_the_last_frame_before_them():
    time = np.array([0.5, 1.0, 2.0])
    assert [frame_at(time, at) for at in (0.0, 0.5, 0.99, 1.0, 5.0)] == [0, 0, 0, 1, 2]


def test_a_film_of_many_colours_keeps_the_frequent_ones(film):
    assert {tuple(c) for c in palette(film)} == {tuple(c) for c in HUES}
    many = film.pictures.color.copy()
    many[0, 0] = np.arange(HIGH * WIDE * 3).reshape(HIGH, WIDE, 3) % 251
    many[1, 0, ..., 0] = np.arange(HIGH * WIDE).reshape(HIGH, WIDE)
    full = dataclasses.replace(film, pictures=film.pictures._replace(color=np.repeat(many, 3, 0)))
    found = {tuple(c) for c in palette(full)}
    assert len(found) <= 256 and {tuple(c) for c in HUES} <= found


@pytest.mark.parametrize(("names", "layers"), [((), (0.0,)), (("front",), ()), (tuple("abcdef"), (0.0,))])
def test_rigs_of_all_kinds_fit(names, layers):
    film = film_of(TIMES, np.zeros((3, 3)), names=names, layers=layers)
    strip = Strip(film)
    assert strip.draw(0).shape == (strip.height, 1280, 3) and 60 < strip.height <= 330
    assert (strip.widths[0] > 0) == bool(names) and (strip.widths[1] > 0) == bool(layers)
    assert strip.widths[2] / (strip.height - 8) == pytest.approx(12 / 24, abs=0.02)
    assert RASTER.side * 2 / (RASTER.ahead + RASTER.behind) == 12 / 24


def test_videos_and_pictures_have_the_strip_below(film, tmp_path):
    network, lane_map, trace = small_trace("roundabout")
    strip = Strip(film)
    path = tmp_path / "a.gif"
    write_video(path, network, lane_map, trace, follow=OWN, sensors=film, every=5)
    with Image.open(path) as video:
        assert frames_of(video) == 3 and video.size == (1280, 720 + strip.height)
        shown = []
        for k in range(3):
            video.seek(k)
            shown.append(np.asarray(video.convert("RGB")).astype(int)[720:])
    for k, frame in enumerate((0, 1, 2)):  # at 0.1, 0.6 and 1.1 s
        off = np.abs(shown[k] - strip.draw(frame)).max(-1)
        assert np.mean(off > 40) < 0.02, k  # by the palette of the video
    write_picture(tmp_path / "a.png", network, lane_map, trace, 0.6, follow=OWN, sensors=film)
    wide = Strip(film, 1920)
    picture = np.round(255 * imread(tmp_path / "a.png")[..., :3]).astype(np.uint8)
    assert picture.shape == (1080 + wide.height, 1920, 3)
    np.testing.assert_array_equal(picture[1080:], wide.draw(1))


def test_a_film_is_a_video_of_its_own(film, tmp_path):
    film.save(tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as video:
        assert frames_of(video) == 3 and video.size == (1280, Strip(film).height)
        assert video.info["duration"] == pytest.approx(450, abs=15)  # ms, the median of 0.4 and 0.5 s
    with pytest.raises(ValueError, match=r"cannot write 'a.avi': use .gif, .mp4 or .npz"):
        film.save("a.avi")
    with pytest.raises(ValueError, match="0 frames per second"):
        film.save(tmp_path / "b.gif", fps=0)
    stored = np.load(film.save(tmp_path / "deep" / "a.npz"))
    np.testing.assert_array_equal(stored["pictures_color"], film.pictures.color)
    np.testing.assert_array_equal(stored["objects_x"], film.objects.x)
    np.testing.assert_array_equal(stored["believed_x"], film.objects.pose.x)
