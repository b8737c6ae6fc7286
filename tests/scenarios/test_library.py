"""The scenario library: what the catalogue says is in the files, and what they name happens."""

import json
import os
import re
import tomllib
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xosc
from lxml import etree
from osc_worlds import played
from paths import REPO
from shapely.geometry import Polygon

import limsim_jax as lj
from limsim_jax import cli
from limsim_jax.maps import bundled_maps
from limsim_jax.maps.map import load_map
from limsim_jax.maps.network import Action
from limsim_jax.scenarios.library import catalogue
from limsim_jax.scenarios.library.catalogue import FOLDER, LibraryError, entry, library, scenario_file
from limsim_jax.scenarios.openscenario.build import build
from limsim_jax.scenarios.openscenario.padding import Sizes
from limsim_jax.scenarios.openscenario.roads import Roads
from limsim_jax.sweeps.experiment import bundled_experiments

SCHEMA = Path(os.environ.get("LIMSIM_READERS", "/nowhere")) / "qc_openscenario/schema/1.3.0/OpenSCENARIO.xsd"
OWN = [one.name for one in library() if one.kind == "scenarios"]
DT = 0.1  # s
LANE = 3.75  # m, of the motorways
EGO_Y = {"motorway": -1.5 * LANE, "lane_end": -1.5 * LANE, "crossing": -1.625}
SAMPLE = 4
STARTS = 24
"""Variants of each scenario that are played, and whose start is looked at."""


# --- the catalogue


def test_every_file_is_in_the_catalogue_and_has_a_name_of_its_own():
    assert sorted(OWN) == sorted(path.stem for path in FOLDER.glob("*.xosc"))
    assert sorted(OWN) == sorted(path.stem for path in (FOLDER / "scenarios").glob("*.xosc"))
    names = [one.name for one in library()]
    assert len(set(names)) == len(names)
    assert not set(OWN) & ({*bundled_experiments()} | {*bundled_maps()})
    assert {x.name for x in library() if x.kind == "experiment"} == {*bundled_experiments()}


def test_tags_are_those_of_the_catalogue_and_all_are_used():
    known = {tag for some in catalogue.tags().values() for tag in some}
    assert {tag for one in library() for tag in one.tags} == known
    for one in library():
        for kind in ("road", "manoeuvre", "from"):
            assert set(one.tags) & set(catalogue.tags()[kind]), (one.name, kind)


@pytest.mark.parametrize("name", OWN)
def test_entry_is_what_its_files_say(name):
    one = entry(name)
    scenarios = one.scenarios
    assert scenarios is not None and one.map_file is not None
    assert one.path == scenarios.path == scenario_file(name)
    table = tomllib.loads((FOLDER / "catalogue.toml").read_text())
    told = next(x for x in table["scenario"] if x["name"] == name)["parameters"]
    assert list(told) == list(scenarios.variants.names) == [x.name for x in one.parameters]
    for parameter in one.parameters:
        unit = {"kph": "km/h", "mps": "m/s", "mps2": "m/s^2", "m": "m", "s": "s"}
        assert parameter.unit == unit.get(parameter.name.rpartition("_")[2], "")
        assert len(parameter.values) > 1 and parameter.meaning and parameter.source
    assert 50 <= len(scenarios) <= 500
    assert len(scenarios) == count(one.path, one.parameters)
    assert not scenarios.notes
    for path in (one.path, FOLDER / f"scenarios/{name}.xosc"):
        header: Any = etree.parse(str(path)).find("FileHeader")
        assert header.get("description") == one.title and re.fullmatch(r"[A-Z][^.]+\.", one.title)
        assert header.find("License").get("spdxId") == one.licence == "Apache-2.0"


def count(path, parameters):
    """Variants by a product of our own, with the constraints of the file as Python."""
    axes = {x.name: x.values for x in parameters}
    rows = [{}]
    for name, values in axes.items():
        rows = [row | {name: value} for row in rows for value in values]
    keeps = {
        "cut_out": lambda p: p["reveal_s"] >= 0.3 + 3.4 / p["lateral_mps"],
        "slower_leader": lambda p: p["leader_kph"] <= p["ego_kph"] - 20,
        "swerve": lambda p: p["gap_m"] >= 20 * p["offset_m"] - 36,
        "braking_queue": lambda p: p["delay_s"] <= p["front_headway_s"] - 0.2 + 1e-9,
    }
    return sum(map(keeps.get(path.stem, lambda p: True), rows))


@pytest.mark.parametrize("name", OWN)
def test_map_loads_and_has_no_findings(name):
    path = entry(name).map_file
    assert path is not None
    found = load_map(path, cache=False)
    assert found.network.report.total(Action.UNUSABLE) == 0
    assert found.name in EGO_Y


@pytest.mark.skipif(
    not SCHEMA.is_file(), reason="LIMSIM_READERS names no folder with asam-qc-openscenarioxml, see .ci/run"
)
def test_files_are_valid_by_the_schema_of_asam():
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    files = sorted(FOLDER.rglob("*.xosc"))
    assert len(files) == 2 * len(OWN) + 2
    for path in files:
        assert schema.validate(etree.parse(str(path))), (path.name, schema.error_log)


def test_outcomes_belong_to_the_files_and_to_the_published_table():
    found = json.loads(catalogue.OUTCOMES.read_text())["rows"]
    published = json.loads((REPO / "experiments/results/library.json").read_text())["rows"]
    assert found == [{key: row[key] for key in found[0]} for row in published]
    for row in found:
        assert row["hash"] == entry(row["scenario"]).hash, f"{row['scenario']}: run experiments/library.py"
        assert row["passed"] + row["collided"] <= row["variants"]
    assert {x.policy for x in entry("cut_in").outcomes} == {"r157_careful", "like_traffic"}
    assert {row["scenario"] for row in found} == set(OWN)


def test_others_say_what_to_fetch():
    others = [one for one in library() if one.kind == "others"]
    assert {one.name for one in others} == {"un_r157", "euro_ncap", "carla_scenario_runner"}
    for one in others:
        assert one.path is None and one.variants is None
        assert one.address.startswith("https://github.com/") and one.licence in ("MPL-2.0", "MIT")
        folder = one.address.rpartition("/")[2]
        assert f"sweep {folder}/" in one.command


# --- names


def test_choices_by_tag_and_words():
    assert {x.name for x in lj.library("cut-in", "own")} == {"cut_in", "overtaker_cuts_in"}
    assert [x.name for x in lj.library(search="PEDESTRIAN walks")] == ["pedestrian_crosses"]
    assert lj.library("ramp", search="zebra") == []
    assert "cut_in" in repr(lj.library("cut-in")).splitlines()[1]
    with pytest.raises(LibraryError, match="tag 'cutin': not known; close are cut-in"):
        lj.library("cutin")


def test_names_stand_for_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swerve").mkdir()  # as a folder of results may be named
    for name in ("cut_in", "library/cut_in", Path("cut_in.xosc"), "swerve"):
        assert lj.openscenario(name).name == Path(name).stem
    xosc.write(tmp_path, xosc.scenario(), "cut_in")  # a file of the user goes first
    assert lj.openscenario("cut_in").path == Path("cut_in")
    for name in ("other/cut_in", "cut_in.toml", "../cut_in", "library/../cut_in"):
        assert scenario_file(name) is None


def test_unknown_names_are_one_line(capsys):
    for command, said in (
        (["library", "cut_inn"], "cut_inn: not in the library; close are cut_in"),
        (["library", "zzz"], "zzz: not in the library; known are cut_in, cut_out"),
        (["library", "--tag", "bus"], "tag 'bus': not known"),
        (["check", "cut_oot"], "in the scenario library there is cut_out"),
        (["sweep", "cut_oot"], "in the scenario library there is cut_out"),
        (["exposure", "cut_oot"], "in the scenario library there is cut_out"),
        (["adversary", "cut_out"], "is a scenario of the library, and no experiment"),
    ):
        assert cli.main(command) == 2
        told = capsys.readouterr().err
        assert said in told and told.count("\n") == 1
    with pytest.raises(lj.ExperimentError, match="is a scenario of the library, and no experiment"):
        lj.sweep("cut_in")


def test_commands_show_the_library(tmp_path, capsys):
    out = tmp_path / "found.json"
    assert cli.main(["library", "--tag", "crossing", "--tag", "own", "--json", str(out)]) == 0
    told = capsys.readouterr().out
    assert "left_turn_across" in told and "cut_out" not in told
    found = {x["name"]: x for x in json.loads(out.read_text())}
    assert set(found) == {"left_turn_across", "crossing_vehicle", "town"}
    assert found["left_turn_across"]["variants"] == 162
    assert cli.main(["library", "left_turn_across"]) == 0
    told = capsys.readouterr().out
    assert "gap_s" in told and "2 to 6 by 0.5 s" in told and "limsim-jax sweep left_turn_across" in told
    assert cli.main(["check", "library/left_turn_across"]) == 0
    assert "162 variants of ego_kph, gap_s, turn_kph, kind" in capsys.readouterr().out


def test_a_wheel_has_all_files():
    wheel = tomllib.loads((REPO / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert "/limsim_jax" in wheel["include"] and "exclude" not in wheel
    ignored = (REPO / ".gitignore").read_text().split()
    for path in [x for x in FOLDER.rglob("*") if x.suffix in (".xosc", ".xodr", ".toml", ".json")]:
        assert not any(path.match(pattern.strip("/")) for pattern in ignored), path


# --- what happens


def some(name, most):
    scenarios = entry(name).scenarios
    assert scenarios is not None
    return [scenarios.scenario(k) for k in np.unique(np.linspace(0, len(scenarios) - 1, most).astype(int))]


@pytest.fixture(scope="module")
def roads():
    made = {}

    def of(scenario):
        path = scenario.path.parent / scenario.map_file
        return made.setdefault(path, Roads(load_map(path, cache=False)))

    return of


class Seen:
    """What entities do while the script drives the ego; arrays over time."""

    def __init__(self, scenario, roads):
        self.p = scenario.parameters
        self.boxes = {x.name: x.box for x in scenario.entities}
        self.play = played(scenario, roads, 24.0, DT, Sizes())
        over = np.asarray(self.play.memory.over)
        self.steps = int(np.argmax(over)) if over.any() else len(over)
        self.t = self.play.time[: self.steps]
        self.ego_y = EGO_Y[Path(scenario.map_file).stem]

    def __getitem__(self, name):
        return {key: value[: self.steps] for key, value in self.play[name].items()}

    def gap(self, name):
        """m from the front of the ego to the rear of an entity, along the road to the east."""
        box, ego = self.boxes[name], self.boxes["Ego"]
        return self[name]["x"] + box.x - box.length / 2 - (self["Ego"]["x"] + ego.x + ego.length / 2)

    def body(self, name, k):
        one, box = self[name], self.boxes[name]
        return outline(one["x"][k], one["y"][k], one["h"][k], box)

    def moves(self, name):
        """The step at which an entity begins to move sideways."""
        y = self[name]["y"]
        return int(np.argmax(np.abs(y - y[0]) > 0.001))


def outline(x, y, h, box):
    along, aside = np.array([np.cos(h), np.sin(h)]), np.array([-np.sin(h), np.cos(h)])
    middle = np.array([x, y]) + box.x * along
    return Polygon(
        [
            middle + i * box.length / 2 * along + j * box.width / 2 * aside
            for i, j in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
    )


def cut_in(w):
    other, k = w["Other"], w.moves("Other")
    assert other["y"][0] == pytest.approx(w.ego_y + w.p["side"] * LANE, abs=0.01)
    closing = w.p["slower_kph"] / 3.6
    assert w.gap("Other")[k] == pytest.approx(w.p["gap_m"], abs=0.15 + 2.2 * DT * closing)
    assert other["y"][-1] == pytest.approx(w.ego_y, abs=0.01)
    assert np.abs(np.diff(other["y"])).max() / DT == pytest.approx(w.p["lateral_mps"], rel=0.03)


def cut_out(w):
    leader, stopped, k = w["Leader"], w["Stopped"], w.moves("Leader")
    v = w.p["ego_kph"] / 3.6
    assert w.gap("Leader")[0] == pytest.approx(w.p["headway_s"] * v, abs=0.01)
    assert leader["y"][-1] == pytest.approx(w.ego_y + w.p["side"] * LANE, abs=0.01)
    ahead = (stopped["x"] - leader["x"] - 4.6)[k]
    assert ahead == pytest.approx(w.p["reveal_s"] * v, abs=0.2 + 4 * DT * v)
    assert np.ptp(stopped["x"]) < 0.01 and stopped["y"][0] == pytest.approx(w.ego_y, abs=0.01)


def leader_brakes(w):
    v = w["Leader"]["v"]
    assert -np.diff(v).min() / DT == pytest.approx(w.p["deceleration_mps2"], rel=0.02)
    assert v[0] == pytest.approx(w.p["ego_kph"] / 3.6, abs=0.01)
    end = max(w.p["keeps"] * v[0], v[0] - w.p["deceleration_mps2"] * (w.t[-1] - 1))
    assert v[-1] == pytest.approx(end, abs=0.5)


def stopped_vehicle(w):
    stopped = w["Stopped"]
    assert np.all(stopped["v"] == 0)
    assert stopped["y"][0] - w.ego_y == pytest.approx(w.p["offset_m"], abs=0.01)
    assert w.gap("Stopped")[0] == pytest.approx(w.p["ahead_s"] * w.p["ego_kph"] / 3.6, abs=0.01)


def slower_leader(w):
    reached = w.t[int(np.argmax(w.gap("Leader") <= 0))]
    assert reached == pytest.approx(w.p["ttc_s"], abs=1.5 * DT)
    assert w["Leader"]["v"][0] == pytest.approx(w.p["leader_kph"] / 3.6, abs=0.01)


def swerve(w):
    y = w["Other"]["y"] - w.ego_y
    assert y[0] == pytest.approx(w.p["side"] * LANE, abs=0.01)
    assert np.abs(y).min() == pytest.approx(LANE - w.p["offset_m"], abs=0.01)
    assert y[-1] == pytest.approx(y[0], abs=0.01)
    assert w.gap("Other")[w.moves("Other")] == pytest.approx(w.p["gap_m"], abs=2.5)


def braking_queue(w):
    first, leader = w["First"]["v"], w["Leader"]["v"]
    begin = [w.t[int(np.argmax(v < v[0] - 0.01))] for v in (first, leader)]
    assert begin[1] - begin[0] == pytest.approx(w.p["delay_s"], abs=1.5 * DT)
    assert first[-1] == leader[-1] == 0


def overtaker_cuts_in(w):
    y, x = w["Overtaker"]["y"] - w.ego_y, w.gap("Overtaker")
    assert y[0] == pytest.approx(0, abs=0.01) and x[0] < -9
    assert y.max() == pytest.approx(LANE, abs=0.01)
    back = int(np.flatnonzero(y > LANE - 0.01)[-1])
    assert x[back] == pytest.approx(w.p["gap_m"], abs=3.5)
    assert y[-1] == pytest.approx(0, abs=0.01)
    v = w["Overtaker"]["v"]
    assert v[-1] == pytest.approx(w.p["keeps"] * v.max(), abs=0.01)


def lane_end_merge(w):
    one = w["Merger"]
    assert one["y"][0] == pytest.approx(w.ego_y - LANE, abs=0.01)
    assert one["y"][-1] == pytest.approx(w.ego_y, abs=0.01)
    k = w.moves("Merger")
    assert one["x"][k] == pytest.approx(450 - w.p["room_m"], abs=6)
    assert w.gap("Merger")[k] == pytest.approx(w.p["gap_m"], abs=2)
    near = one["x"] > 520  # where its lane is no lane any more
    assert np.abs(one["y"][near] - w.ego_y).max(initial=0) < 0.5


def left_turn_across(w):
    one, x = w["Turner"], w["Ego"]["x"]
    assert np.degrees(one["h"][-1] - one["h"][0]) % 360 == pytest.approx(90, abs=1)
    begins = int(np.argmax(one["v"] > 0))
    front = x + w.boxes["Ego"].x + w.boxes["Ego"].length / 2
    assert (2.1 - front[begins]) / (w.p["ego_kph"] / 3.6) == pytest.approx(w.p["gap_s"], abs=0.2)
    assert one["y"][-1] < -12 and one["v"][-1] == pytest.approx(w.p["turn_kph"] / 3.6, abs=0.01)


def crossing_vehicle(w):
    one = w["Other"]
    middle = one["y"] + 1.4 * np.sin(one["h"][0])
    times = [
        w.t[int(np.argmin(np.abs(away)))]
        for away in (middle - w.ego_y, w["Ego"]["x"] + 1.4 - one["x"])
    ]  # fmt: skip
    assert times[0] - times[1] == pytest.approx(w.p["later_s"], abs=1.5 * DT)
    assert np.sign(one["y"][0]) == w.p["side"]


def pedestrian_crosses(w):
    one = w["Pedestrian"]
    assert np.sign(one["y"][0]) == np.sign(-one["y"][-1]) == w.p["side"]
    k = int(np.argmax(w.gap("Pedestrian") <= 0))
    share = (one["y"][k] - w.ego_y) / 1.9 + 0.5
    assert share == pytest.approx(w.p["hit_share"], abs=(0.15 + 2 * DT * w.p["walk_kph"] / 3.6) / 1.9)


EVENTS = {
    x.__name__: x
    for x in (
        cut_in, cut_out, leader_brakes, stopped_vehicle, slower_leader, swerve, braking_queue,
        overtaker_cuts_in, lane_end_merge, left_turn_across, crossing_vehicle, pedestrian_crosses,
    )
}  # fmt: skip


@pytest.mark.engine
@pytest.mark.parametrize("name", OWN)
def test_what_is_named_happens(name, roads):
    """The script drives the ego, too: straight on, at its first speed."""
    for scenario in some(name, SAMPLE):
        w = Seen(scenario, roads(scenario))
        EVENTS[name](w)
        ego = w["Ego"]
        assert np.allclose(ego["v"], w.p["ego_kph"] / 3.6, atol=1e-3) and np.ptp(ego["y"]) < 0.01
        for entity in w.boxes:  # bodies do not jump
            one = w[entity]
            moved = np.hypot(np.diff(one["x"]), np.diff(one["y"]))
            assert (moved <= DT * np.maximum(one["v"][1:], one["v"][:-1]) * 1.05 + 0.05).all(), entity
        for a, b in combinations([x for x in w.boxes if x != "Ego"], 2):
            for k in range(0, w.steps, 3):
                assert not w.body(a, k).intersects(w.body(b, k)), (a, b, w.t[k])


@pytest.mark.engine
@pytest.mark.parametrize("name", OWN)
def test_starts_are_free_of_contact_and_share_a_program(name, roads):
    for scenario in some(name, STARTS):
        built = build(scenario, roads(scenario), DT, sizes=Sizes())
        assert built.sizes == Sizes()
        boxes = {x.name: x.box for x in scenario.entities}
        bodies = [outline(x.pose.x, x.pose.y, x.pose.h, boxes[x.name]) for x in built.starts]
        for a, b in combinations(bodies, 2):
            assert a.distance(b) > 0.5
        assert not built.memory.held[0]  # the policy drives from the start
