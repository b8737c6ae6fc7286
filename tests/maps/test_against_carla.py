"""Our maps against CARLA's parser: `experiments/maps_against_carla.py` on a few maps, with its thresholds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import maps_against_carla as referee
import numpy as np
import pytest
from opendrive_formulas import OpenDriveFormulas
from paths import REPO, SHARED, needs_shared

from limsim_jax.maps.network import Network
from limsim_jax.maps.opendrive import read_opendrive

pytest.importorskip("carla", reason="no carla; install the dev extra to compare with its parser")

BUNDLED = sorted((REPO / "maps").glob("*.xodr"))


@cache
def read(source: Path) -> tuple[Network, referee.CarlaMap]:
    return read_opendrive(source), referee.ask_carla(source)


def compared(source: Path) -> referee.Comparison:
    return referee.compare(source, *read(source))


def check(row: referee.Comparison, junctions_as_carla: bool = True) -> None:
    """Requirements for every map."""
    figures = row.figures
    assert row.failure is None
    assert row.misses == []
    assert figures["waypoints"] > 0 and figures["outside"] == 0
    assert figures["host"]["max"] < 1.0 and figures["formulas"]["host"]["max"] < 1.0  # mm
    assert figures["device"]["max"] < 50.0 and figures["device"]["median"] < 10.0
    assert figures["heading_deg"] < 1.0 and figures["width"]["max"] < 10.0
    assert abs(figures["length_error"]) < 1e-3
    assert figures["settled"] == 0
    if junctions_as_carla:
        assert figures["junctions_equal"] == figures["junctions"]


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize(
    "name", ["carla_town01", "figure8_trafficlights", "crossing_complex_8_course", "road2_20"]
)
def test_maps_agree_with_carla(name: str) -> None:
    row = compared(SHARED / "opendrive" / f"{name}.xodr")
    check(row)
    if name == "carla_town01":
        assert row.exceptions == []
        assert row.figures["junctions_equal"] == 12 and row.figures["movements"] == 72
        assert row.figures["lights"] == {"ids": 36, "lanes": 72, "as_carla": 72}


@pytest.mark.engine
@needs_shared
def test_a_town_of_many_lanes(name: str = "carla_town03") -> None:
    row = compared(SHARED / "opendrive" / f"{name}.xodr")
    check(row)
    allowed = row.figures["permission"]
    assert allowed["of"] > 10_000 and allowed["agree"] == allowed["of"]
    # CARLA adds the lane offset of the road to the crosswalk's own: these 26 stand beside the road there.
    assert row.exceptions == ["26 crosswalks that CARLA shifts by the lane offset of their road"]


@needs_shared
def test_left_hand_traffic() -> None:
    """CARLA's topology ignores left-hand traffic: the links of the file decide."""
    row = compared(SHARED / "opendrive" / "simple_3way_lht.xodr")
    check(row, junctions_as_carla=False)
    assert row.figures["movements"] == 6


@pytest.mark.engine
@pytest.mark.parametrize("source", BUNDLED, ids=lambda p: p.stem)
def test_bundled_maps_agree_with_carla(source: Path) -> None:
    row = compared(source)
    check(row)
    assert row.said == (), "CARLA's parser warns"
    permission = row.figures.get("permission", {"agree": 0, "of": 0})
    assert permission["agree"] == permission["of"]


def test_bundled_maps_are_there() -> None:
    assert len(BUNDLED) >= 5


# --- The comparison itself can fail -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound() -> Path:
    return REPO / "maps" / "intersection.xodr"


@pytest.mark.engine
def test_a_shifted_lane_is_found(sound: Path) -> None:
    """One lane, 6 cm to the left: off on the host and on the device, whatever CARLA is blamed for."""
    network, carla_map = read(sound)
    lane = next(lane for lane in network.drivable_lanes() if lane.type == "driving")
    aside = np.stack([-np.sin(lane.heading), np.cos(lane.heading), np.zeros_like(lane.heading)], -1)
    shifted = replace(lane, xyz=lane.xyz + 0.06 * aside)
    row = referee.compare(sound, replace(network, lanes={**network.lanes, lane.id: shifted}), carla_map)
    assert row.verdict == "MISS"
    assert row.figures["host"]["max"] == pytest.approx(60.0, abs=1.0)
    assert row.figures["device"]["max"] == pytest.approx(60.0, abs=2.0)
    assert row.figures["settled"] == 0 and row.exceptions == []
    assert any("device lane off" in miss for miss in row.misses)
    assert any("formulas missed" in miss for miss in row.misses)


@pytest.mark.engine
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"width": 0.02}, "width off"),
        ({"heading": 0.03}, "heading off"),
        ({"number": 77}, "no lane of ours there"),
    ],
)
def test_other_faults_are_found(sound: Path, change: dict[str, float], expected: str) -> None:
    network, carla_map = read(sound)
    lane = next(lane for lane in network.drivable_lanes() if lane.type == "driving")
    ((name, by),) = change.items()
    value = by if name == "number" else getattr(lane, name) + by
    lanes = {**network.lanes, lane.id: replace(lane, **{name: value})}
    row = referee.compare(sound, replace(network, lanes=lanes), carla_map)
    assert any(expected in miss for miss in row.misses)


def test_a_missing_movement_is_found(sound: Path) -> None:
    network, carla_map = read(sound)
    row = referee.compare(sound, replace(network, movements=network.movements[1:]), carla_map)
    assert row.figures["junctions_equal"] == row.figures["junctions"] - 1
    assert any("missing 1" in miss for miss in row.misses)


def test_a_wrong_permission_is_found(sound: Path) -> None:
    network, carla_map = read(sound)
    lanes = {k: replace(v, may_change_left=not v.may_change_left) for k, v in network.lanes.items()}
    row = referee.compare(sound, replace(network, lanes=lanes), carla_map)
    assert row.figures["permission"]["agree"] < row.figures["permission"]["of"]


def test_a_moved_crosswalk_and_a_lost_light_are_found(sound: Path) -> None:
    network, carla_map = read(sound)
    assert network.crosswalks and network.traffic_lights
    walks = tuple(replace(walk, outline=walk.outline + 0.5) for walk in network.crosswalks)
    row = referee.compare(sound, replace(network, crosswalks=walks, traffic_lights=()), carla_map)
    assert any("crosswalks" in miss for miss in row.misses)
    assert any("lights on lanes" in miss and "missing" in miss for miss in row.misses)


def test_a_crash_of_the_parser_is_told(tmp_path: Path, sound: Path) -> None:
    hopeless = tmp_path / "hopeless.xodr"
    hopeless.write_text("<OpenDRIVE/>")
    answer = referee.ask_carla(hopeless, timeout=60.0)
    assert answer.failure is not None or not len(answer.waypoints if answer.waypoints is not None else ())
    slow = referee.ask_carla(sound, timeout=1e-3)
    assert slow.failure == "no answer within 0.001 s" and slow.waypoints is None


@needs_shared
def test_formulas_give_the_published_lengths() -> None:
    """The referee's own formulas against published figures."""
    published = referee.published_lengths()
    assert len(published) > 30
    for name in (
        "carla_town01",
        "crossing_complex_8_course",
        "e6mini",
        "poly3_urban",
        "parampoly3_normalized_lht",
    ):
        source = SHARED / "opendrive" / f"{name}.xodr"
        assert OpenDriveFormulas(source).driving_length() / 1e3 == pytest.approx(
            published[source], abs=0.0051
        )


def test_the_table_names_its_command(tmp_path: Path, sound: Path) -> None:
    out, table = tmp_path / "out.json", tmp_path / "out.md"
    assert referee.main(["--maps", str(sound), "--json", str(out), "--markdown", str(table)]) == 0
    assert f"`python experiments/maps_against_carla.py --maps {sound}" in table.read_text()
    assert f"| maps/{sound.stem} | pass |" in table.read_text()
