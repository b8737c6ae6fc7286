"""Worlds that are shared with a real SUMO: seats, ways, lights, and the whole of it in one small program."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import limsim_jax as lj
from limsim_jax.bridges.sumo import episodes as episodes_module
from limsim_jax.bridges.sumo.messages import Orders, Reading, Start, SumoError
from limsim_jax.bridges.sumo.process import SumoProcess
from limsim_jax.bridges.sumo.seats import Places, Seats
from limsim_jax.bridges.sumo.ways import LETTERS, Lights, Ways
from limsim_jax.bridges.sumo.world import SumoWorld, rebuild
from limsim_jax.cli.main import main
from limsim_jax.maps.map import Map, load_map
from limsim_jax.sweeps.store import Outcome
from limsim_jax.xla import run_once

sumo = pytest.importorskip("sumo", reason="needs eclipse-sumo")

ROUTES = """<routes>
  <vType id="car" sigma="0.3"/>
  <route id="east" edges="A1B1 B1C1"/>
  <route id="north" edges="A1B1 B1B2"/>
  <route id="west" edges="C1B1 B1A1"/>
  <flow id="e" type="car" route="east" begin="0" end="180" period="4"/>
  <flow id="n" type="car" route="north" begin="1" end="180" period="9"/>
  <flow id="w" type="car" route="west" begin="2" end="180" period="5"/>
</routes>"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossing of roads with one lane and a light; traffic on three ways."""
    folder = tmp_path_factory.mktemp("cross")
    program = Path(sumo.__file__).parent / "bin" / "netgenerate"
    command = [program, "--grid", "--grid.number", "3", "--grid.length", "200", "--no-turnarounds", "true"]
    command += ["--default-junction-type", "traffic_light", "-o", folder / "cross.net.xml"]
    subprocess.run(list(map(str, command)), check=True, capture_output=True)
    (folder / "cross.rou.xml").write_text(ROUTES)
    path = folder / "cross.sumocfg"
    path.write_text(
        '<configuration><net-file value="cross.net.xml"/><route-files value="cross.rou.xml"/>'
        '<end value="400"/></configuration>'
    )
    return path


@pytest.fixture(scope="module")
def town(config: Path) -> Map:
    return load_map(config.parent / "cross.net.xml")


# --- seats


def test_every_vehicle_has_one_seat_or_is_counted(config: Path, town: Map) -> None:
    """200 s with fewer slots than vehicles: owners sum to all vehicles in every step."""
    ways = Ways(town.network, town.lanes, 40)
    with SumoProcess(Start(arguments=("-c", str(config)), seed=1, dt=0.1)) as process:
        lights = Lights(town.network, town.lanes, process.there.lights)
        seats = Seats(Places(town.network, town.lanes, process.there), ways, lights, 12)
        reading = process.step(Orders())
        seats.meet(reading)
        for _ in range(300):
            reading = process.step(Orders())
            seats.meet(reading)
        ego = int(reading.handle[-1])
        before = seats.start(reading, (ego,))
        claimed: dict[int, int] = {}
        arrived = 0
        for _ in range(2000):
            reading = process.step(Orders())
            seats.meet(reading)
            seen = seats.see(reading)
            there = reading.handle.tolist()
            assert int(seen.present.sum()) + int(seen.lost) == len(there)
            assert not (seen.fresh & before.present).any(), "a seat is free for a moment before it is taken"
            assert not (seen.arrived & seen.present).any()
            arrived += int(seen.arrived.sum())
            for handle, slot in seats.slot.items():
                if handle in there:
                    assert seen.present[slot]
                    x = reading.x[there.index(handle)] - seats.places.origin[0]
                    assert seen.x[slot] == pytest.approx(x, abs=1e-3)
            claimed |= dict.fromkeys(seats.slot, 1)
            before = seen
        assert seats.lost > 0 and arrived > 2 and len(claimed) > 15
        assert seats.elsewhere == seats.pathless == 0
        seats.close()


def test_a_route_is_a_column_until_nobody_drives_it(town: Map) -> None:
    ways = Ways(town.network, town.lanes, 4)
    first = ways.take(("A1B1", "B1C1"), "car")
    assert ways.edges(first) == ("A1B1", "B1C1")
    assert ways.take(("B1C1",), "car") == first, "the rest of a route is served by its column"
    rows = {lane.id: k for k, lane in enumerate(town.network.drivable_lanes())}
    table = ways.table()
    after = int(table.next_lane[rows["A1B1_0"], first])
    assert town.lane_ids[after].startswith(":B1")
    assert town.network.lanes[town.lane_ids[after]].successors == ("B1C1_0",)
    assert ways.take(("A1B1", "C1C2"), "car") != 0, "roads that do not join: the nearest way to the last"
    ways.give_back(first)
    ways.give_back(first)
    others = [ways.take(edges, "car") for edges in (("C1B1", "B1A1"), ("A1B1", "B1B2"))]
    assert first in others, "its place is used again"
    with pytest.raises(ValueError, match="routes at the same time"):
        for edges in (("A1A2",), ("A0A1",), ("C1C2",)):
            ways.take(edges, "car")


# --- the whole


class Watched(SumoProcess):
    """Keeps what SUMO has said."""

    said: ClassVar[list[list[Reading]]] = []

    def __init__(self, start: Start) -> None:
        super().__init__(start)
        self.kept: list[Reading] = []
        Watched.said.append(self.kept)

    def answer(self) -> Reading:
        self.kept.append(super().answer())
        return self.kept[-1]


def unbraked(config: Path) -> SumoWorld:
    """Egos that never brake: they run into queues."""
    return SumoWorld(
        config, policy=lj.ConstantSpeed(), takeover=(30, 60), horizon=30.0, slots=40, chunk=2,
        success={"sumo_collisions": 0.0},
    )  # fmt: skip


@pytest.fixture(scope="module")
def world(config: Path) -> Any:
    patch = pytest.MonkeyPatch()
    patch.setattr(episodes_module, "SumoProcess", Watched)
    patch.setattr(episodes_module, "run_often", run_once)  # it compiles in a fraction of the time
    yield unbraked(config)
    patch.undo()


@pytest.fixture(scope="module")
def outcome(world: SumoWorld) -> Outcome:
    return world.episodes.run([0, 3])


@pytest.fixture(scope="module")
def replayed(world: SumoWorld, outcome: Outcome) -> tuple[Any, list[Reading]]:
    """A world with a contact, and what SUMO has said."""
    Watched.said.clear()
    seed = int(outcome.seeds[np.flatnonzero(outcome.metrics["contacts"] > 0)[0]])
    return world.run(seed), Watched.said[0]


@pytest.mark.engine
def test_equal_seeds_are_equal_worlds_with_metrics_of_both_sides(world: SumoWorld, outcome: Outcome) -> None:
    again = world.episodes.run([0, 3])
    assert outcome.digest.tolist() == again.digest.tolist()
    assert outcome.digest[0] != outcome.digest[1]
    assert set(outcome.metrics) == set(world.episodes.units)
    metrics = outcome.metrics
    assert (metrics["sumo_echo"] < 0.01).all()
    assert (metrics["traffic_entered"] > 5).all()
    hit = metrics["contacts"] > 0
    assert hit.any(), "the egos do not brake"
    for k in np.flatnonzero(hit):
        assert metrics["sumo_collisions"][k] > 0 and metrics["success"][k] == 0
        assert metrics["contact_time"][k] == pytest.approx(metrics["sumo_collision_time"][k], abs=0.11)


@pytest.mark.engine
def test_a_world_does_not_depend_on_the_others_of_its_call(
    world: SumoWorld, outcome: Outcome, config: Path
) -> None:
    """Columns of routes are shared among worlds; their numbers are no part of a digest."""
    other: Any = unbraked(config).episodes
    other._compiled = world.episodes._compiled
    assert other.run([3]).digest[0] == outcome.digest[1]


@pytest.mark.engine
def test_a_replay_shows_what_sumo_said(
    world: SumoWorld, outcome: Outcome, replayed: tuple[Any, list[Reading]], town: Map, tmp_path: Path
) -> None:
    shown, readings = replayed
    row = outcome.seeds.tolist().index(shown.seed)
    stored = {name: x[row] for name, x in outcome.metrics.items()}
    assert shown.metrics == pytest.approx(stored, nan_ok=True, rel=0, abs=0)
    steps = len(shown.trace.time)
    assert steps > 50
    signals = shown.map.lanes.signals
    programs = list(town.network.programs)
    rows = [programs.index(name) for name in world.episodes.lights]
    origin = np.asarray(shown.map.lanes.origin)
    ego = shown.ego
    for t in range(0, steps, 7):
        reading = readings[-steps + t]
        angle = np.radians(90 - reading.angle)
        x = reading.x - 2.5 * np.cos(angle) - origin[0]
        y = reading.y - 2.5 * np.sin(angle) - origin[1]
        box = shown.trace.box[t][shown.trace.active[t]]
        away = np.hypot(box[:, None, 0] - x, box[:, None, 1] - y).min(1)
        assert away.max() < 0.3  # m: on curved lanes SUMO's bodies are chords of other polylines
        assert shown.trace.active[t].sum() == len(reading.handle)
        for row, state in zip(rows, reading.lights, strict=True):
            letters = np.asarray(signals.state)[row, shown.trace.phase[t, row], : len(state)]
            assert letters.tolist() == [LETTERS[x] for x in state]
    assert ego == 0
    path = shown.save(tmp_path / "world.parquet")
    assert path.stat().st_size > 1000


@pytest.mark.engine
def test_sumo_watches_a_world_that_we_have_driven(
    replayed: tuple[Any, list[Reading]], tmp_path: Path
) -> None:
    shown = replayed[0]
    fcd = tmp_path / "fcd.xml"
    verdict = lj.referee(shown, fcd=fcd)
    assert verdict.steps == len(shown.trace.time)
    assert verdict.vehicles > 20 and verdict.echo < 0.01
    ours = [c.time for c in verdict.collisions if shown.ego in c.slots]
    assert min(ours) == pytest.approx(shown.metrics["contact_time"], abs=0.11)
    assert fcd.read_text().count("<timestep") >= verdict.steps


class Red(Watched):
    """All lights are red, which no program of the map shows."""

    def ask(self, orders: Orders) -> None:
        lights = self.kept[-1].lights if self.kept else ()
        shown = {name: "r" * len(x) for name, x in zip(self.there.lights, lights, strict=False)}
        super().ask(replace(orders, lights=shown))


@pytest.mark.engine
def test_our_drivers_stop_at_the_red_of_sumo(
    world: SumoWorld, config: Path, town: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    """We drive all vehicles; SUMO inserts them and owns the signals."""
    monkeypatch.setattr(episodes_module, "SumoProcess", Red)
    ours = SumoWorld(
        config, policy=lj.ConstantSpeed(), takeover=(20, 25), horizon=25.0, slots=40, chunk=2, drivers="ours"
    )
    ours.episodes._compiled = world.episodes._compiled  # one program for all
    Watched.said.clear()
    shown = ours.run(1)
    readings = Watched.said[0][-len(shown.trace.time) :]
    ways = {"A1B1", "C1B1"}, {"B1C1", "B1B2", "B1A1"}
    before, behind = ({k for k, x in enumerate(town.lane_ids) if x[:-2] in some} for some in ways)
    trace = shown.trace
    first, last = (trace.active[t] & (np.arange(40) > 0) for t in (0, -1))
    assert last.sum() > first.sum() + 5, "vehicles have come"
    assert set(trace.lane[-1, last].tolist()) <= before
    assert not {k for t in range(len(trace.time)) for k in trace.lane[t, 1:].tolist()} & behind
    newcomers = last & ~first
    assert (trace.v[-1, newcomers] < 0.1).sum() >= 2, "some of them have come to stand"
    assert (trace.v[:, 1:].max(0)[newcomers[1:]] > 5).any()
    for t, reading in enumerate(readings):
        there = set(reading.handle.tolist())
        fresh = {one.handle for one in reading.new}
        assert there - fresh <= reading.owned | fresh if t else True
        angle = np.radians(90 - reading.angle)
        origin = np.asarray(shown.map.lanes.origin)
        x, y = reading.x - 2.5 * np.cos(angle) - origin[0], reading.y - 2.5 * np.sin(angle) - origin[1]
        box = trace.box[t][trace.active[t]]
        assert np.hypot(box[:, None, 0] - x, box[:, None, 1] - y).min(1).max() < 0.02  # m
        assert trace.active[t].sum() == len(there)
    with pytest.raises(lj.ExperimentError, match="drivers: 'idm'; known are sumo, ours"):
        SumoWorld(config, drivers="idm")  # pyright: ignore[reportArgumentType]


class Dying(SumoProcess):
    """Is killed while it warms up, with seed 1."""

    made: ClassVar[list[SumoProcess]] = []

    def __init__(self, start: Start) -> None:
        super().__init__(start)
        Dying.made.append(self)

    def step(self, orders: Orders) -> Reading:
        if self.start.seed == 1 and self.time > 3.0:
            self.child.kill()
            self.child.wait()
        return super().step(orders)


def test_a_simulation_that_dies_ends_all_of_them(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes_module, "SumoProcess", Dying)
    episodes = SumoWorld(config, policy="like_traffic", takeover=(5, 5), chunk=2).episodes
    with pytest.raises(SumoError, match=r"^the process of SUMO has ended \(seed 1, 3\.1 s, signal 9\)$"):
        episodes.run([0, 1])
    assert len(Dying.made) == 2 and all(x.child.poll() is not None for x in Dying.made)
    with pytest.raises(SumoError, match="vehicle 'ghost' is never on the road"):
        SumoWorld(config, ego="ghost", policy="like_traffic").episodes.run([0])


def test_stored_worlds_are_built_again_as_they_were(config: Path) -> None:
    one = SumoWorld(config, ego="e.3", policy="like_traffic", horizon=40.0, chunk=3).episodes
    about = json.loads(json.dumps(one.provenance()))
    again = rebuild(about)
    assert (again.scenario, again.policy, again.chunk) == ("cross", "like_traffic", 3)
    assert again.takeover == one.takeover and again.takeover.vehicles == ("e.3",)
    assert json.loads(json.dumps(again.provenance())) == about
    assert about["engine"]["version"].startswith("SUMO ")
    assert str(config.parent / "cross.rou.xml") in about["demand"]


# --- the command


def test_what_does_not_fit_is_one_line(
    config: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = ["--out", str(tmp_path / "out")]
    for arguments, message in (
        (["highway", "--engine", "sumo"], "SUMO runs a .sumocfg"),
        ([str(config), "--engine", "sumo", "--map", "highway"], "not with --engine sumo"),
        (["highway", "--ego", "e.3"], "only with --engine sumo"),
        ([str(config), "--engine", "sumo", "--policy", "none"], "unknown policy 'none'"),
        ([str(tmp_path / "none.sumocfg"), "--engine", "sumo"], "none.sumocfg"),
    ):
        assert main(["sweep", *arguments, *out]) == 2
        said = capsys.readouterr().err.strip()
        assert message in said and "\n" not in said, said
    assert not (tmp_path / "out").exists()
