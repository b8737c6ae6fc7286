"""The page of a sweep: what it says, what it shows, and that it is one safe file."""

import base64
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from fake_results import NAN, broken_policies, crashes, made
from fake_traces import small_trace

from limsim_jax.report import tables
from limsim_jax.report.formats import number_text
from limsim_jax.report.page import charts, content, write_report
from limsim_jax.report.page.page import LISTED
from limsim_jax.report.pictures import OTHER, pictures
from limsim_jax.sweeps.store import Results

GROUP = ("highway", "like_traffic")


class Checker(HTMLParser):
    """Collects what a page loads and links, and that every tag is closed in turn."""

    VOID = ("meta", "br", "img", "link", "input", "line", "circle", "!doctype")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        found = dict(attrs)
        self.tags.append(tag)
        self.loads += [found["src"]] if "src" in found else []
        self.links += [found["href"]] if "href" in found else []
        self.ids += [found["id"]] if "id" in found else []
        assert not any(name.startswith("on") for name in found), tag
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data


def read(path) -> Checker:
    checker = Checker()
    checker.feed(path.read_text(encoding="utf-8"))
    assert not checker.open
    assert len(checker.ids) == len(set(checker.ids))
    for link in checker.links:
        assert not link.startswith("#") or link[1:] in checker.ids, link
    return checker


def thousand(n: int, seed: int = 0) -> Results:
    """Two scenarios with all that the page draws."""
    rng = np.random.default_rng(seed)
    worlds = {}
    for name in ("highway", "ramp"):
        hit = rng.random(n) < 0.03
        worlds[name, "like_traffic"] = {
            "success": ~hit * 1,
            "contacts": hit * 1,
            "at_fault_contacts": hit * (rng.random(n) < 0.5),
            "max_delta_v": np.where(hit, rng.gamma(2, 3, n), NAN),
            "contact_responsibility": np.where(hit, rng.integers(1, 5, n), NAN),
            "min_ttc": rng.gamma(3, 1, n),
            "nuplan_score": rng.beta(8, 2, n),
            "distance": rng.normal(900, 50, n),
        }
    return made(worlds)


def test_the_page_says_what_the_tables_say(tmp_path):
    results = crashes()
    path = write_report(results, tmp_path / "deep" / "report.html")
    assert sorted(x.name for x in path.parent.iterdir()) == ["report.html"]
    checker = read(path)
    text = " ".join(checker.text.split())
    assert "4 of 8 episodes had a contact, 1 by the ego's fault (nuPlan's rules)." in text
    assert "Worst crash: highway, seed 5" in text  # by delta-v, though it ranks behind the ego's fault
    assert "delta-v 9.0 m/s" in text
    assert "limsim-jax replay results --seed 6" in text
    assert "A reference planning module would have avoided it" in text
    assert "Avoidable by the ego: yes; by the other vehicle: no" in text
    row = tables.lookup(tables.summary(results))[*GROUP, "had_contact"]
    assert number_text(row["estimate"], row["lower"], row["upper"], 100).partition(" ")[2] in text
    assert checker.loads == []
    order = re.findall(r'<article class="card" id="highway-like_traffic-(\d)">', path.read_text())
    assert order == ["6", "7", "5", "4", "3", "2"]


def test_the_hardest_crash_is_always_shown(tmp_path):
    path = write_report(crashes(), tmp_path / "report.html", worst=2)
    order = re.findall(r'<article class="card" id="highway-like_traffic-(\d)">', path.read_text())
    assert order == ["6", "5"]


def test_without_contacts_the_bound_is_told(tmp_path):
    path = write_report(made({GROUP: {"contacts": [0] * 59, "success": [1] * 59}}), tmp_path / "r.html")
    text = " ".join(read(path).text.split())
    assert "No contact in 59 episodes: with 95 % confidence it happens in less than 5.0 %." in text
    assert "Worst crash" not in text


def test_success_comes_first_and_colours_the_verdict(tmp_path):
    cases = (
        ("good", dict(contacts=[0] * 40, success=[1] * 40), "Success: 100 % of 40 episodes."),
        ("mixed", dict(contacts=[0] * 40, success=[0] * 4 + [1] * 36), "Success: 90 % of 40 episodes."),
        ("bad", dict(contacts=[0] * 40, success=[0] * 40), "Success: 0 % of 40 episodes."),
        ("mixed", dict(contacts=[1] + [0] * 39, at_fault_contacts=[0] * 40, success=[1] * 40), "Success"),
        ("bad", dict(contacts=[1] + [0] * 39, at_fault_contacts=[1] + [0] * 39, success=[1] * 40), "Success"),
        ("mixed", dict(contacts=[0] * 40), "No contact in 40 episodes"),
    )
    for mood, columns, said in cases:
        path = write_report(made({GROUP: columns}), tmp_path / "r.html", worst=0)
        body = path.read_text().partition('<div class="verdict ')[2]
        assert body.startswith(f'{mood}">'), columns
        words = " ".join(re.sub("<[^>]*>", "", body.partition("</div>")[0].partition(">")[2]).split())
        assert words.startswith(said)
    two = {(GROUP[0], name): {"success": [share] * 3} for name, share in (("fast", 1), ("slow", 0))}
    text = " ".join(read(write_report(made(two), tmp_path / "r.html")).text.split())
    assert "Success: fast 100 %, slow 0 % of 6 episodes in all." in text
    assert "highway: fast, slow" in text  # the title


def test_a_broken_policy_comes_before_everything_else(tmp_path):
    path = write_report(broken_policies(), tmp_path / "r.html", worst=2)
    body = path.read_text().partition('<div class="verdict ')[2]
    assert body.startswith('bad">')
    text = " ".join(read(path).text.split())
    first = (
        "Broken policy: policy like_traffic failed in 2 of 40 episodes of highway: mine.py:7 in plan: "
        "ValueError: no path (seeds 3, 30)."
    )
    second = "failed in 1 of 40 episodes of highway: a command that is not finite (seed 17)."
    assert text.index(first) < text.index(second) < text.index("Success: 90 % of 40 episodes.")
    assert "Policy failed at 2.5 s: mine.py:7 in plan: ValueError: no path" in text  # the card
    assert "POLICY FAILED" in text and "POLICY FAILED" not in read(write_report(thousand(20), path)).text


def test_failures_are_grouped_by_cause_and_link_their_replays(tmp_path):
    late = np.arange(40) >= 30
    columns = {
        "success": ~late * 1.0,
        "arrived": ~late * 1.0,
        "out_of_time": late * 1.0,
        "contacts": [0] * 40,
    }
    path = write_report(made({GROUP: columns}), tmp_path / "r.html", worst=0)
    text = " ".join(read(path).text.split())
    assert "Why episodes fail" in text and "failures" in read(path).ids
    assert "out of time1025 %30, 31, 32, 33, 34, 35" in text
    rows = content.failures(tables.groups(made({GROUP: columns})), {(*GROUP, 38): "replays/38.html"})
    assert rows[0]["cells"][0]["seeds"][:2] == [(38, "replays/38.html"), (30, None)]
    good = write_report(made({GROUP: {"success": [1.0], "arrived": [1.0]}}), path, worst=0)
    assert "Why episodes fail" not in read(good).text


def test_demand_that_finds_no_room_is_told(tmp_path):
    columns = {"traffic_waiting": [70, 30], "traffic_entered": [100, 100], "success": [1, 1]}
    text = " ".join(read(write_report(made({GROUP: columns}), tmp_path / "r.html")).text.split())
    assert "Demand beyond capacity: highway: 100 of 300 vehicles never found room to enter." in text


def test_scenarios_are_compared_only_where_there_are_several(tmp_path):
    one = made({GROUP: {"min_ttc": [6.0, 7.0], "mean_speed": [3.0, 4.0]}})
    page = read(write_report(one, tmp_path / "r.html"))
    assert "scenarios" not in page.ids and "None: no contact" in page.text
    assert "mean_speed mean speed" in page.text or "mean_speed " in page.text
    assert "scenarios" in read(write_report(thousand(20), tmp_path / "r.html")).ids


def test_little_is_enough(tmp_path):
    """One seed, one metric, no moments."""
    path = write_report(made({GROUP: {"min_ttc": [NAN], "mean_speed": [3.0]}}), tmp_path / "r.html", worst=0)
    assert "never measured" in read(path).text
    with pytest.raises(ValueError, match="no finished episodes"):
        write_report(Results(path, crashes().episodes.slice(0, 0), crashes().moments, {}, {}), path)


def test_what_files_say_is_text(tmp_path):
    """Names, provenance and labels cannot become markup, nor lead out of the folder."""
    evil = "../<script>alert(1)</script>&\"'"
    group = (f"s{evil}", f"p{evil}")
    row = dict(scenario=group[0], policy=group[1], seed=1, rank=1, kind=evil, time=1.0, value=1.0,
               responsible=evil, module=evil)  # fmt: skip
    columns = {"contacts": [0, 1], "mean_speed": [1, 2], evil: [3, 4], "max_delta_v": [NAN, 3]}
    facts: Any = {group: {evil: {evil: evil}, "x": evil}}
    results = made({group: columns, GROUP: columns}, [row], provenance=facts, path=f"/tmp/{evil}")
    results.units[evil] = evil
    asked = []

    def replayer(*key):
        asked.append(key)
        raise ValueError(evil)

    path = write_report(results, tmp_path / "report.html", replayer=replayer, worst=2)
    checker = read(path)
    assert checker.tags.count("script") == 1
    assert "<script>alert" not in path.read_text()
    assert checker.text.count("No picture: ../<script>alert(1)</script>") == 2
    assert (*group, [1]) in asked
    assert [x.name for x in tmp_path.iterdir()] == ["report.html"]
    assert not content.file_name(group[0]).strip("abcdefghijklmnopqrstuvwxyz0123456789_")


@pytest.mark.engine
def test_the_page_does_not_grow_with_the_seeds(tmp_path):
    few, many = (write_report(thousand(n), tmp_path / f"{n}.html") for n in (400, 4000))
    assert "limsim-jax replay results --scenario ramp --seed" in many.read_text()
    assert many.stat().st_size < 1.1 * few.stat().st_size < 300_000


def points_of(svg: str, color: str) -> np.ndarray:
    """Corners of the path of a color, `[K, 2]`, y upward."""
    found = re.search(rf'<path d="([^"]*)" style="[^"]*stroke:{re.escape(color)}', svg)
    assert found is not None
    return np.array(re.findall(r"[ML] (\S+) (\S+)", found[1]), float) * (1, -1)


def test_curves_are_the_distribution():
    """At every share the curve is at that order statistic."""
    x = np.sort(np.random.default_rng(1).normal(5, 1, 1000))
    points = points_of(charts.distributions([x], ["a"], "s", "TTC"), "var(--c0)")
    share = (points[:, 1] - points[0, 1]) / (points[-1, 1] - points[0, 1])
    low, high = np.quantile(x, [0.002, 0.998])
    value = low + (points[:, 0] - points[0, 0]) / np.ptp(points[:, 0]) * (high - low)
    for side in (-0.001, 0.001):
        expected = np.quantile(x, (share + side).clip(0, 1), method="inverted_cdf").clip(low, high)
        assert (np.sign(side) * (expected - value) > -1e-3).all()
    assert (np.diff(points, axis=0) >= 0).all()


def test_intervals_are_drawn_to_scale_and_names_are_text():
    evil = "$a</title><script>&"
    drawn = charts.intervals(
        [charts.Point(evil, 2.0, 1.0, 4.0), charts.Point("b", 6.0, None, None)], "%, more is better", evil
    )
    a, b = points_of(drawn, "var(--c0)")
    dots = [float(x) for x in re.findall(r"translate\((\S+) ", drawn)]
    assert (dots[0] - a[0]) / (b[0] - a[0]) == pytest.approx(1 / 3, abs=1e-3)
    assert (dots[1] - a[0]) / (b[0] - a[0]) == pytest.approx(5 / 3, abs=1e-3)
    assert "<script" not in drawn and "id=" not in drawn and drawn.count("<title>") == 3
    assert "%, more is better</text>" in drawn and "currentColor" in drawn and "#0" not in drawn


# --- with pictures


@pytest.mark.engine
def test_key_moments_are_pictured_and_replays_written(tmp_path):
    """The ego's outline and the other one's ring are in both pictures, and links lead to files."""
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    from limsim_jax.report.frames import EGO

    network, lane_map, trace = small_trace("roundabout")
    moments = [
        dict(scenario=GROUP[0], policy=GROUP[1], seed=1, rank=1, kind="contact", time=0.9, other=3, value=4.0)
    ]
    columns = {
        "contacts": [0, 1],
        "max_delta_v": [NAN, 4.0],
        "min_ttc": [2.0, 0.0],
        "min_ttc_time": [77.0, 0.9],
    }
    results = made({GROUP: columns}, moments)
    said, asked = [], []

    def replayer(*key):
        asked.append(key)
        return [(network, lane_map, trace, 1, [], "more") for _ in key[2]]

    path = write_report(results, tmp_path / "report.html", replayer=replayer, say=said.append)
    checker = read(path)
    assert asked == [(*GROUP, [1, 0])]
    assert said == ["replays of highway, like_traffic: seeds 1, 0"]
    links = {link for link in checker.links if not link.startswith("#")}
    files = {"replays/highway-like_traffic-1.html", "replays/highway-like_traffic-0.html"}
    assert links == {f"{file}#t={t}" for file, t in zip(sorted(files), ("74.0", "0.0"), strict=True)}
    assert all((tmp_path / file).stat().st_size > 1000 for file in files)
    assert "0.8 s before" in path.read_text() and "at 0.9 s" in path.read_text()
    images = [imread(BytesIO(base64.b64decode(x.partition(",")[2]))) for x in checker.loads]
    assert len(images) == 4 and all(x.startswith("data:image/png;base64,") for x in checker.loads)

    def height(image, color: str) -> int:
        """Of what has the color, in pixels."""
        rgb = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        rows = np.argwhere(np.abs(image[..., :3] - rgb).max(-1) < 0.02)[:, 0]
        return int(np.ptp(rows)) if rows.size else 0

    assert all(height(image, EGO) > 10 for image in images)
    # a ring of 61 pixels, and a name below it
    assert [height(image, OTHER) > 60 for image in images] == [True, True, False, False]


@pytest.mark.engine
def test_a_replay_that_cannot_be_written_is_an_error(tmp_path):
    network, lane_map, trace = small_trace("roundabout")

    def replayer(*key):
        return [(network, lane_map, trace, 1, [{"kind": "contact"}], "more") for _ in key[2]]

    with pytest.raises(ValueError, match="time"):
        write_report(crashes(), tmp_path / "report.html", replayer=replayer, worst=1)


def test_get_ready_imports_all_that_a_report_needs():
    """Modules that exist, and none of them left to import later."""
    code = "import sys; from limsim_jax.report.page import get_ready; get_ready(); print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    wanted = {"limsim_jax.report.pictures", "limsim_jax.report.viewer.viewer", "matplotlib.figure"}
    assert wanted <= set(found.stdout.split())


def test_replays_stop_when_the_time_is_up(tmp_path):
    asked = []

    def replayer(*key):
        asked.append(key)
        raise ValueError("gone")

    write_report(crashes(), tmp_path / "report.html", replayer=replayer, seconds=0)
    assert len(asked) == 1


def test_the_view_holds_both_and_times_outside_the_trace_are_its_ends():
    pytest.importorskip("matplotlib")

    network, lane_map, trace = small_trace("roundabout")
    views = pictures(network, lane_map, trace, ego=1, time=1e3, other=99)
    assert [caption for caption, _ in views] == ["1.1 s before", "at 1.2 s"]
    with pytest.raises(ValueError, match="slot 9"):
        pictures(network, lane_map, trace, ego=9, time=0.5)
    gone = trace._replace(active=trace.active & (np.arange(12)[:, None] < 7))
    views = pictures(network, lane_map, gone, ego=1, time=1.1)
    assert views[-1][0] == "at 0.7 s"  # when the ego was there last


def test_in_a_browser(tmp_path):
    """The script runs, tables can be sorted, and nothing is wider than a phone but what scrolls."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("needs Chromium")
    path = write_report(thousand(200), tmp_path / "report.html")
    probe = """<script>
    const page = document.querySelector("iframe");
    page.onload = () => {
      const inner = page.contentDocument, table = inner.querySelector("table.sortable");
      const seeds = () => [...table.tBodies[0].rows].map(row => +row.cells[2].textContent);
      const heads = table.tHead.rows[0].cells;
      heads[2].querySelector("button").click(); const up = seeds().join();
      heads[2].querySelector("button").click(); const down = seeds().join();
      heads[6].querySelector("button").click();
      document.title = JSON.stringify({width: inner.documentElement.scrollWidth, up, down,
        ttc: [...table.tBodies[0].rows].map(row => row.cells[6].dataset.value).join()});
    };</script>"""
    source = path.read_text().replace("&", "&amp;").replace('"', "&quot;")
    frame = f'<iframe srcdoc="{source}" style="width: 390px; height: 800px; border: 0"></iframe>'
    (tmp_path / "phone.html").write_text(f"<!doctype html><title></title>{frame}{probe}", encoding="utf-8")
    dumped = subprocess.run(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
         "--virtual-time-budget=3000", "--dump-dom", (tmp_path / "phone.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    found = re.search(r"<title>(\{.*?\})</title>", dumped, re.S)
    assert found is not None, dumped[:500]
    told = json.loads(found[1])
    seeds = [int(x) for x in told["up"].split(",")]
    assert seeds == sorted(seeds) and told["down"].split(",") == [str(x) for x in sorted(seeds, reverse=True)]
    ttc = [float(x) for x in told["ttc"].split(",")]
    assert ttc == sorted(ttc) and len(ttc) == LISTED
    assert told["width"] <= 390
