"""The replay shows what the ego senses, at the moment of the slider."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
from browser import chromium, problems
from fake_films import HIGH, RASTER, WIDE, film_of
from fake_replays import SELF, TIME, intersection_trace, payload

from limsim_jax.report.strip import surfaces
from limsim_jax.report.viewer import write_viewer

FRAMES = np.array([0, 9, 19, 29])  # steps


@pytest.fixture(scope="module")
def world():
    return intersection_trace()


@pytest.fixture(scope="module")
def film(world):
    return film_of(TIME[FRAMES], world[2].box[FRAMES, SELF, :3] + np.array((0, 0, 0.6), np.float32))


@pytest.fixture(scope="module")
def page(world, film, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "replay.html"
    write_viewer(path, *world, ego=SELF, sensors=film)
    return path


@pytest.fixture(scope="module")
def browser():
    yield from chromium()


def blocks_of(path):
    """Blocks of bytes of a page, unpacked without the code that packs."""
    data = re.search(r'id="data">([^<]*)<', path.read_text())
    assert data is not None
    block = zlib.decompress(base64.b64decode(data[1]))
    start = 4 + int.from_bytes(block[:4], "little")
    places = json.loads(block[4:start])["blocks"]
    return {name: np.frombuffer(block, np.uint8, n, start + at) for name, (at, n) in places.items()}


def test_the_file_holds_the_film(film, page):
    meta, columns = payload(page)
    blocks, sense = blocks_of(page), meta["sense"]
    np.testing.assert_allclose(columns["sense_time"][0], film.time, atol=1e-4)
    colors = np.array(sense["cameras"]["palette"], np.uint8)
    found = colors[blocks["pictures"].reshape(2, len(FRAMES), HIGH, WIDE)]
    np.testing.assert_array_equal(np.moveaxis(found, 0, 1), film.pictures.color)
    assert sense["cameras"]["names"] == ["front", "back"]
    low, high = blocks["ranges"].reshape(2, len(FRAMES), 2, 12).astype(int)
    code = low + 256 * high
    back = film.scan.range < 60
    assert back.any() and not back.all()
    np.testing.assert_array_equal(code > 0, back)
    np.testing.assert_allclose((code & 32767)[back] * 0.1, film.scan.range[back], atol=0.051)
    np.testing.assert_array_equal((code >= 32768)[back], film.scan.slot[back] >= 0)
    np.testing.assert_array_equal(blocks["bev"].reshape(len(FRAMES), *RASTER.shape), surfaces(film.bev))
    np.testing.assert_allclose(columns["object_x"][:2], film.objects.x[:, :2].T, atol=0.006)
    np.testing.assert_array_equal(columns["object_there"], film.objects.there.T)
    assert (columns["object_x"][2] == 0).all()  # an entry that is not there may hold anything


def test_a_page_without_sensors_has_no_place_for_them(world, browser, tmp_path):
    write_viewer(tmp_path / "a.html", *world, ego=SELF)
    state = browser.open(tmp_path / "a.html", "#t=2")
    assert problems(browser) == [] and "shot" not in state
    for name in ("sense", "sensing"):
        assert browser.run(f"document.getElementById('{name}').hidden")


def middles(browser, name, across, down):
    """Colours of a canvas at the middles of a grid of cells, `[down, across, 3]`."""
    script = f"""(c => {{ const ctx = c.getContext('2d'), found = [];
        for (let y = 0; y < {down}; y++) for (let x = 0; x < {across}; x++)
          found.push(...ctx.getImageData(Math.floor((x + 0.5) * c.width / {across}),
                                         Math.floor((y + 0.5) * c.height / {down}), 1, 1).data.slice(0, 3));
        return found; }})(document.getElementById('{name}'))"""
    return np.array(browser.run(script)).reshape(down, across, 3)


def test_the_strip_shows_the_frame_of_the_slider(film, page, browser):
    for at, frame in ((TIME[0], 0), (TIME[9], 1), (TIME[18], 1), (TIME[19], 2), (TIME[40], 3)):
        state = browser.open(page, f"#t={at:.2f}")
        assert state["shot"] == str(frame) and problems(browser) == [] and "error" not in state
        seen = middles(browser, "cameras", 2 * WIDE, HIGH)
        expected = np.concatenate(list(film.pictures.color[frame]), 1)
        same = (seen == expected).all(-1)
        assert same[3:].all()  # names cover the upper corners
        assert state["points"] == str(int((film.scan.range[frame] < 60).sum()))
    assert f"{film.time[3]:.1f} s" not in browser.text("#clock")
    # the slider moves it
    state = browser.key("Home")
    assert state["shot"] == "0"
    assert (
        middles(browser, "cameras", 2 * WIDE, HIGH)[3:] == np.concatenate(list(film.pictures.color[0]), 1)[3:]
    ).all()


def test_the_view_from_above_and_the_object_list_are_drawn(film, page, browser):
    browser.open(page, f"#t={TIME[19]:.2f}")
    meta, _ = payload(page)
    rows, columns = RASTER.shape
    colors = np.array(meta["sense"]["raster"]["palette"])
    seen = middles(browser, "bev", columns, rows)
    expected = colors[surfaces(film.bev[2])]
    assert (seen == expected).all(-1).mean() > 0.75  # boxes and the ego lie above
    # on the map the box of the object list is where the ego believes it to be
    pose = film.pose.x[2], film.pose.y[2], film.pose.heading[2]
    x, y = 9.0 + 4.5 / 2 * np.cos(0.2), 1.5 + 4.5 / 2 * np.sin(0.2)  # the middle of its front
    wx = pose[0] + np.cos(pose[2]) * x - np.sin(pose[2]) * y
    wy = pose[1] + np.sin(pose[2]) * x + np.cos(pose[2]) * y
    origin = meta["network"]["origin"]
    script = f"""(() => {{ const c = document.getElementById('view'), d = document.body.dataset, s = +d.scale;
        const x = c.width / 2 + ({wx + origin[0]} - d.x) * s, y = c.height / 2 - ({wy + origin[1]} - d.y) * s;
        return [...c.getContext('2d').getImageData(x - 2, y - 2, 5, 5).data]; }})()"""
    for wanted in (True, False):
        patch = np.array(browser.run(script)).reshape(-1, 4)[:, :3]
        blue = (np.abs(patch - (0, 0x72, 0xB2)).max(-1) < 60).any()
        assert blue == wanted
        browser.run("document.querySelector('[data-layer=objects]').click()")
        browser.state()


def test_the_strip_can_be_put_away(page, browser):
    browser.open(page, "#t=2")
    high = "document.getElementById('view').getBoundingClientRect().height"
    before = browser.run(high)
    browser.click(*browser.middle("#sensing"))
    assert browser.run("document.getElementById('sense').hidden") and browser.run(high) > before + 50
    browser.key("c")
    assert not browser.run("document.getElementById('sense').hidden") and browser.run(high) == before
    assert problems(browser) == []


@pytest.mark.parametrize("size", [(1280, 800), (390, 780), (900, 420)])
def test_it_fits_into_windows_of_all_sizes(page, browser, size):
    browser.open(page, "#t=2", size=size)
    wide, high = browser.run("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert wide <= size[0] and high <= size[1]
    box = "(b => [b.left, b.right, b.height])(document.getElementById('{}').getBoundingClientRect())"
    left, right = browser.run(box.format("cameras"))[0], browser.run(box.format("bev"))[1]
    assert left >= 0 and right <= size[0] and browser.run(box.format("bev"))[2] > 60
    stage = browser.run("document.getElementById('stage').getBoundingClientRect().height")
    assert stage >= 120


@pytest.mark.parametrize(("names", "layers"), [((), (0.0,)), (("front",), ())])
def test_rigs_without_cameras_or_lidar_are_shown(world, tmp_path, browser, names, layers):
    film = film_of(TIME[FRAMES], world[2].box[FRAMES, SELF, :3], names=names, layers=layers)
    write_viewer(tmp_path / "a.html", *world, ego=SELF, sensors=film)
    state = browser.open(tmp_path / "a.html", "#t=2")
    assert problems(browser) == [] and state["shot"] == "2"
    for canvas, there in (("cameras", names), ("lidar", layers), ("bev", True)):
        assert browser.run(f"document.getElementById('{canvas}').hidden") == (not there)
