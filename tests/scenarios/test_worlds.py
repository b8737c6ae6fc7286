"""Scenarios in the engine: entities beside an ego that a policy drives, and variants in a sweep."""

import json
import shutil

import numpy as np
import pytest
import xosc
from osc_worlds import play, road

from limsim_jax import cli
from limsim_jax.api import results as stored
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.map import load_map
from limsim_jax.maps.network import Turn
from limsim_jax.policies.base import LikeTraffic
from limsim_jax.scenarios.openscenario.episodes import episodes_of, rebuild
from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.scenarios.openscenario.source import OpenScenarioError
from limsim_jax.sweeps import runner
from limsim_jax.sweeps.experiment import ExperimentError
from limsim_jax.sweeps.store import ResultsError, open_results

ACTIVATE = (
    '<PrivateAction><ControllerAction><ActivateControllerAction longitudinal="true" lateral="true"/>'
    "</ControllerAction></PrivateAction>"
)
CHANGE = (
    "<PrivateAction><LateralAction><LaneChangeAction>"
    '<LaneChangeActionDynamics dynamicsShape="sinusoidal" dynamicsDimension="time" value="3"/>'
    '<LaneChangeTarget><AbsoluteTargetLane value="-1"/></LaneChangeTarget>'
    "</LaneChangeAction></LateralAction></PrivateAction>"
)


def cut_in(folder):
    """B drives 12 m/s in the lane beside and changes into that of the ego at 2 s; the end is at 8 s."""
    (folder / "road.xodr").write_text(road())
    parameters = '<ParameterDeclaration name="gap" parameterType="double" value="40"/>'
    story = xosc.act(
        xosc.event("on", ACTIVATE, xosc.trigger(xosc.time_condition(1))), name="activates"
    ) + xosc.act(xosc.event("cut", CHANGE, xosc.trigger(xosc.time_condition(2))), ("B",), name="cutsIn")
    text = xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"),
        xosc.start("Ego", xosc.lane(-1, 50), 20) + xosc.start("B", xosc.lane(-2, "${50 + $gap}"), 12),
        story,
        xosc.trigger(xosc.time_condition(8), tag="StopTrigger"),
        parameters=parameters,
    )
    xosc.write(folder, text, "cut.xosc")
    axis = "".join(f'<Element value="{x}"/>' for x in (8, 40, 500))
    axis = (
        '<DeterministicSingleParameterDistribution parameterName="gap"><DistributionSet>'
        f"{axis}</DistributionSet></DeterministicSingleParameterDistribution>"
    )
    many = xosc.distribution("cut.xosc", f"<Deterministic>{axis}</Deterministic>")
    return text, xosc.write(folder, many, "cuts.xosc")


@pytest.mark.engine
def test_variants_are_worlds_of_a_sweep(tmp_path):
    text, path = cut_in(tmp_path)
    (episodes,) = episodes_of(openscenario(path), LikeTraffic(), horizon=10.0, dt=0.05, decision_every=10)
    out = tmp_path / "results"
    summary = runner.sweep([episodes], range(3), out)
    assert summary.parts[0].ran == 3
    assert runner.sweep([episodes], range(3), out).parts[0].ran == 0  # they are on disk
    results = open_results(out)
    rows = results.episodes.to_pydict()
    assert rows["parameter_gap"] == [8, 40, 500]
    assert rows["scenario_ended"] == [1, 1, 1]
    assert rows["passed"][1:] == [1, 1] and rows["success"] == rows["passed"]
    with pytest.raises(ResultsError, match="was made with policy from Python"):
        stored.rebuild(results, *next(iter(results.provenance)))

    # B is where it is without traffic, and the ego is held until its controller is active
    trace = episodes.worlds.replay(episodes.worlds.start([1])).trace
    alone = play(tmp_path, text, 10.0)
    b, h = alone["B"], alone["B"]["h"]
    x0 = float(np.asarray(episodes.lane_map.origin)[0])
    box, steps = np.asarray(trace.box)[0], np.arange(140)
    middle = b["x"][1 + steps] + 1.4 * np.cos(h[1 + steps])
    np.testing.assert_allclose(box[steps, 1, 0] + x0, middle, atol=0.01)
    v = np.asarray(trace.v)[0, :, 0]
    np.testing.assert_allclose(v[:19], 20, atol=1e-4)
    assert v[120] < 15  # it brakes for B, which is slower


@pytest.mark.engine
def test_a_sweep_tells_what_is_preventable(tmp_path, capsys):
    path = cut_in(tmp_path)[1]
    path.write_text(path.read_text().replace('"40"', '"50"'))
    options = "--policy constant_speed --preventable --horizon 10 --at-once --chunk 3".split()
    assert cli.main(["sweep", str(path), *options, "--out", str(tmp_path / "found")]) == 0
    lines = [x.split() for x in capsys.readouterr().out.splitlines()]
    rows = open_results(tmp_path / "found").episodes.to_pylist()
    hit = {(x["policy"], x["parameter_gap"]): x["contacts"] > 0 for x in rows}
    assert hit["constant_speed", 50] and not hit["r157_careful", 50]
    assert not hit["constant_speed", 500] and not hit["r157_careful", 500]
    prevented = 1 + (hit["constant_speed", 8] and not hit["r157_careful", 8])
    for policy, preventable in (("constant_speed", prevented), ("r157_careful", 0)):
        collided = sum(hit[policy, gap] for gap in (8, 50, 500))
        assert ["cuts", policy, "3", str(3 - collided), str(collided), str(preventable)] in lines
    made = episodes_of(openscenario(path), "r157_careful", dt=0.05)[0]
    assert made.rollout.config.decision_every == made.experiment.decision_every == 2


@pytest.mark.parametrize(("policy", "name"), [(None, "script"), ("pdm_closed", "pdm_closed")])
def test_worlds_are_made_again_from_their_provenance(tmp_path, policy, name):
    path = cut_in(tmp_path)[1]
    path = path.rename(tmp_path / f"{'cuts 1.' * 12}xosc")  # too long for a name, which has no points
    (made,) = episodes_of(openscenario(path), policy, variants=2, horizon=10.0, dt=0.05, chunk=2)
    assert made.policy == name
    assert len(made.scenario) == 60
    assert made.which == [0, 2]
    about = json.loads(json.dumps(made.provenance()))
    again = rebuild(about, made.policy)
    assert (again.scenario, again.policy, again.which) == (made.scenario, name, [0, 2])
    assert json.loads(json.dumps(again.provenance())) == about
    with pytest.raises(ExperimentError, match="has variants, no random numbers"):
        _ = again.layout


def test_a_policy_goes_where_the_script_goes(tmp_path):
    """At a junction straight on, also where another way out is nearer."""
    town = load_map("long_route")
    shutil.copy(town.source, tmp_path / "road.xodr")
    rows, lanes = lane_rows(town.network), town.network.lanes
    next_lane = np.asarray(town.lanes.routes.next_lane)
    nearer = 0
    for straight in town.network.movements:
        lane = lanes[straight.incoming]
        ways = {x.turn for x in town.network.movements if x.incoming == lane.id}
        if straight.turn is not Turn.STRAIGHT or len(ways) < 2 or lane.length < 40:
            continue
        place = xosc.lane(lane.number, float(np.interp(lane.length - 30, lane.s, lane.road_s)), lane.road)
        begin = xosc.start("Ego", place, 8)
        end = xosc.trigger(xosc.time_condition(5), tag="StopTrigger")
        path = xosc.write(tmp_path, xosc.scenario(xosc.entity("Ego"), begin, "", end))
        (made,) = episodes_of(openscenario(path), "pdm_closed", chunk=1)
        goal = int(made.worlds_of([0]).start.goal[0, 0])
        assert next_lane[rows[lane.id], goal] == rows[straight.via[0]], straight
        routes = town.lanes.routes
        nearest = int(np.argmin(np.where(next_lane[rows[lane.id]] >= 0, routes.distance[rows[lane.id]], 1e9)))
        nearer += next_lane[rows[lane.id], nearest] != rows[straight.via[0]]
    assert nearer > 0


def test_maps_are_found(tmp_path):
    (tmp_path / "road.xodr").write_text(road())
    lost = xosc.write(tmp_path, xosc.scenario(road="nowhere.xodr"), "lost.xosc")
    with pytest.raises(OpenScenarioError, match=r"map 'nowhere.xodr' is not found; .* with --map"):
        episodes_of(openscenario(lost), None)
    from limsim_jax.scenarios.openscenario.episodes import map_of

    named = openscenario(xosc.write(tmp_path, xosc.scenario(road="Road"), "named.xosc")).scenario()
    assert map_of(named, tmp_path).name == "road"


def test_places_that_are_not_there(tmp_path):
    (tmp_path / "road.xodr").write_text(road())
    for place, said in (
        (xosc.lane(-5, 50), "road '1' has no lane -5; lanes are -2, -1, 1, 2"),
        (xosc.lane(-1, 5000), "s = 5000 is not on lane -1 of road '1', from 0 to 2000"),
        (xosc.lane(-1, 50, road=7), "there is no road '7'; roads are 1"),
    ):
        path = xosc.write(tmp_path, xosc.scenario(init=xosc.start("Ego", place)))
        with pytest.raises(OpenScenarioError, match=said) as raised:
            episodes_of(openscenario(path), None)
        assert "\n" not in str(raised.value)
