"""Experiments as values: what they are made of, and one line for everything that is wrong."""

import pytest

import limsim_jax as lj
from limsim_jax.sweeps.build import traffic_of
from limsim_jax.sweeps.identity import describe


def test_keywords_replace_fields_of_a_file():
    drive = lj.Experiment("roundabout", horizon=20, slots=32, vehicles=5, name="short")
    assert (drive.name, drive.file.horizon, drive.file.slots, drive.file.traffic.vehicles) == (
        "short",
        20.0,
        32,
        5,
    )
    assert drive.file.traffic.flow == lj.Experiment("roundabout").file.traffic.flow


def test_human_drivers_are_asked_for_in_a_word_or_by_their_numbers():
    calm = lj.HumanDriver(reaction=0.4, vehicles_ahead=3)
    for given, expected in (
        (None, None), (False, None), (True, lj.HumanDriver()), (calm, calm),
    ):  # fmt: skip
        assert traffic_of(lj.Experiment("roundabout", human=given).file).human == expected
    keeps = lj.Experiment(lj.Experiment("roundabout", human=calm).file, horizon=9)
    assert traffic_of(keeps.file).human == calm


def test_plain_traffic_has_no_ego():
    traffic = lj.Experiment(map="roundabout", ego=None, flows=[lj.Flow(rate=400)], horizon=30, density=10)
    assert traffic.file.ego == () and traffic.name == "roundabout"
    assert traffic.file.traffic.density == 10.0 and traffic.file.policy == "traffic"
    assert "no ego" in repr(traffic)


def test_an_ego_may_be_given_as_one_or_several():
    ego = lj.Ego(start="1-", goal="3+", s=30.0)
    one = lj.Experiment(map="roundabout", horizon=10, ego=ego)
    two = lj.Experiment(map="roundabout", horizon=10, ego=[ego, lj.Ego(start="2-", goal="4+")])
    assert one.file.ego == (ego,) and len(two.file.ego) == 2
    assert "2 egos" in repr(two)


def test_a_map_is_one_object():
    town = lj.load_map("roundabout")
    assert town.name == "roundabout" and set(town.origins) == {"1-", "2-", "3-", "4-"}
    assert list(town.goals) == ["1+", "2+", "3+", "4+"]
    assert len(town.lane_ids) <= town.lanes.length.shape[0]
    assert lj.load_map(town) is town and "48 drivable lanes" in repr(town)
    longer = town.with_goals([town.lane_ids[0], "1+", "nowhere"])
    assert list(longer.goals) == [*town.goals, town.lane_ids[0]]
    assert longer.lanes.routes.reachable.shape[1] >= town.lanes.routes.reachable.shape[1]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(horizon=-1), "roundabout: horizon: .*greater than 0"),
        (dict(vehicles=3, density=2.0), "roundabout: traffic: vehicles or density, not both"),
        (dict(map="nix"), "map: nix: .*bundled are highway"),
        (dict(name="a b"), "a b: name: "),
        (dict(model="gipps"), "roundabout: traffic.model: "),
        (dict(human="slow"), "traffic.human: true, or a table of numbers such as reaction = 0.7; not 'slow'"),
        (dict(mix={"car": -1.0}), "roundabout: traffic.mix.car: "),
        (dict(zones=[{"where": "1"}]), "zone.0: a zone needs closed, speed_limit or friction"),
        (dict(placed=[lj.Ego()]), "vehicle.0"),
        (dict(ego=5), "roundabout: ego: "),
        (dict(ego=None, policy="pdm_closed"), "ego: there is none"),
        (dict(ego=None, policy=lj.LikeTraffic()), "policy: there is no ego"),
    ],
)  # fmt: skip
def test_wrong_fields_are_one_line(fields, message):
    with pytest.raises(lj.ExperimentError, match=message) as error:
        lj.Experiment("roundabout", **fields)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (dict(policy="nope"), "ego.policy: unknown policy 'nope'; known are like_traffic"),
        (dict(success={"speeed": 1}), "success.speeed: no such metric"),
        (dict(slots=3, vehicles=5), "slots: 3, but 6 vehicles"),
        (dict(ego=lj.Ego(start="9", goal="3+")), "ego.start: no origin, road or lane '9'"),
        (dict(ego=[lj.Ego(start="1-", goal="3+"), lj.Ego()]), "2 egos need a start each"),
        (dict(ego=[lj.Ego()] * 3, vehicles=2), "3 random starts need at least 3 vehicles"),
        (dict(ego=None, flows=[lj.Flow(rate=9, origin="9")]), "traffic: .*'9'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_map_is_one_line(fields, message):
    with pytest.raises(lj.ExperimentError, match=message) as error:
        lj.Experiment("roundabout", **fields).episodes(chunk=1)
    assert "\n" not in str(error.value)


def test_fields_of_flows_and_egos_are_checked_where_they_are_written():
    with pytest.raises(lj.ExperimentError, match=r"Flow: rate: .*greater than or equal to 0"):
        lj.Flow(rate=-1)
    with pytest.raises(lj.ExperimentError, match="Ego: a goal is missing"):
        lj.Ego(start="1-")
    with pytest.raises(lj.ExperimentError, match="Ego: speed: no such field"):
        lj.Ego(speed=3.0)  # pyright: ignore[reportCallIssue]


def test_several_experiments_are_swept_not_run():
    with pytest.raises(lj.ExperimentError, match="paper: is 5 experiments"):
        lj.Experiment("paper")
    assert [one.name for one in lj.load_experiments("paper")] == [
        "highway", "ramp", "intersection", "roundabout", "long_route",
    ]  # fmt: skip


@pytest.mark.engine
def test_names_of_policies_must_differ_before_anything_runs(tmp_path):
    twice = [lj.ConstantSpeed(speed=3.0), lj.ConstantSpeed(speed=6.0)]
    with pytest.raises(ValueError, match="'constant_speed' stands twice in roundabout"):
        lj.sweep("roundabout", policies=twice, seeds=1, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seeds", [0, -3, 99_999_999_999])
def test_numbers_of_seeds_out_of_range_are_refused_at_once(seeds, tmp_path):
    with pytest.raises(ValueError, match="seeds: "):
        lj.sweep("roundabout", seeds=seeds, out=tmp_path / "out")


def test_values_are_described_by_their_numbers():
    """Rows of another setting, or of an edited policy, are other rows."""
    slow, fast = describe(lj.ConstantSpeed(speed=3.0)), describe(lj.ConstantSpeed(speed=4.0))
    assert slow != fast and slow["speed"] == 3.0 and "source" not in slow

    class Mine(lj.Policy):
        def __call__(self, config, lane_map, state, memory, key):
            return lj.Command(), memory

    assert "source" in describe(Mine())
    population = lj.default_population()
    assert describe(population) == describe(lj.default_population())
