"""Distributions of parameters as variants."""

import numpy as np
import pytest
import xosc
from paths import SHARED, needs_shared

from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.scenarios.openscenario.source import OpenScenarioError

ALKS = SHARED / "openscenario" / "alks" / "logical_scenarios"

PARAMETERS = """<ParameterDeclaration name="v" parameterType="double" value="20"/>
<ParameterDeclaration name="n" parameterType="int" value="1"/>
<ParameterDeclaration name="kind" parameterType="string" value="car"/>
<ParameterDeclaration name="half" parameterType="double" value="${$v / 2}"/>
<ParameterDeclaration name="gap" parameterType="double" value="10"><ConstraintGroup>
<ValueConstraint rule="lessOrEqual" value="$half"/></ConstraintGroup></ParameterDeclaration>"""


def variants(tmp_path, body):
    xosc.write(tmp_path, xosc.scenario(parameters=PARAMETERS), "template.xosc")
    return openscenario(xosc.write(tmp_path, xosc.distribution("template.xosc", body), "variation.xosc"))


def refuse(tmp_path, body, said):
    with pytest.raises(OpenScenarioError, match=said) as raised:
        variants(tmp_path, body)
    assert "\n" not in str(raised.value)


def single(name, inside):
    return (
        f'<DeterministicSingleParameterDistribution parameterName="{name}">{inside}'
        "</DeterministicSingleParameterDistribution>"
    )


def values(*given):
    inside = "".join(f'<Element value="{x}"/>' for x in given)
    return f"<DistributionSet>{inside}</DistributionSet>"


def span(low, high, step):
    return (
        f'<DistributionRange stepWidth="{step}"><Range lowerLimit="{low}" upperLimit="{high}"/>'
        "</DistributionRange>"
    )


def deterministic(*parts):
    return f"<Deterministic>{''.join(parts)}</Deterministic>"


def test_product(tmp_path):
    found = variants(
        tmp_path, deterministic(single("kind", values("car", "bus")), single("n", values(1, 2, 3)))
    )
    assert (len(found), found.variants.product) == (6, 6)
    assert found.values() == {"kind": ["car"] * 3 + ["bus"] * 3, "n": ["1", "2", "3"] * 2}
    assert found.scenario(4).parameters | {"kind": "bus", "n": 2} == found.scenario(4).parameters
    with pytest.raises(OpenScenarioError, match="no variant 6; 0 to 5"):
        found.scenario(6)
    assert "6 variants of kind, n" in repr(found)


def test_ranges(tmp_path):
    found = variants(tmp_path, deterministic(single("v", span(20, 21, 0.1))))
    np.testing.assert_allclose(np.asarray(found.values()["v"], float), np.linspace(20, 21, 11), atol=1e-9)
    assert variants(tmp_path, deterministic(single("v", span(20, 25, 2)))).values()["v"] == [20, 22, 24]
    assert len(variants(tmp_path, deterministic(single("v", span(20, 20, 1))))) == 1
    refuse(tmp_path, deterministic(single("v", span(20, 10, 1))), "upperLimit 10 is below lowerLimit 20")
    refuse(tmp_path, deterministic(single("v", span(0, 10, 0))), "above 0 is expected")
    refuse(tmp_path, deterministic(single("v", span(0, 1e9, 1))), "1000000001 values; at most")


def test_value_sets(tmp_path):
    def assigned(**given):
        inside = "".join(
            f'<ParameterAssignment parameterRef="{name}" value="{x}"/>' for name, x in given.items()
        )
        return f"<ParameterValueSet>{inside}</ParameterValueSet>"

    sets = assigned(v=20, n=1) + assigned(v=30, n=2) + assigned(v=40)
    multi = (
        "<DeterministicMultiParameterDistribution><ValueSetDistribution>"
        f"{sets}</ValueSetDistribution></DeterministicMultiParameterDistribution>"
    )
    found = variants(tmp_path, deterministic(multi, single("kind", values("car", "bus"))))
    assert len(found) == 6
    assert [found.scenario(k).parameters["n"] for k in (0, 2, 4)] == [1, 2, 1]  # as declared where not given
    assert found.scenario(3).parameters["v"] == 30


def test_constraints_filter_the_product(tmp_path):
    """Also through parameters that are declared as expressions of those that vary."""
    found = variants(
        tmp_path,
        deterministic(
            single("v", values(10, 20, 40)), single("gap", values(4, 10, 15, 30)), single("n", values(1))
        ),
    )
    kept = [(float(a), float(b)) for a, b in zip(found.values()["v"], found.values()["gap"], strict=True)]
    assert kept == [(v, g) for v in (10, 20, 40) for g in (4, 10, 15, 30) if g <= v / 2]
    assert found.variants.product == 12
    refuse(tmp_path, deterministic(single("gap", values(99))), "none of its 1 combinations keeps")


def test_wrong_names(tmp_path):
    refuse(tmp_path, deterministic(single("w", values(1))), "parameter 'w' is not declared by the scenario")
    twice = deterministic(single("v", values(1)), single("v", values(2)))
    refuse(tmp_path, twice, "parameter 'v' has two distributions")
    refuse(tmp_path, deterministic(single("v", "<DistributionSet/>")), "has no value")
    many = deterministic(*(single(x, span(0, 9999, 1)) for x in ("v", "gap")))
    refuse(tmp_path, many, "combinations; at most")
    user = single("v", '<UserDefinedDistribution type="x">y</UserDefinedDistribution>')
    refuse(tmp_path, deterministic(user), "<UserDefinedDistribution>: not supported")


def stochastic(name, inside, runs=4000, seed=7):
    return (
        f'<Stochastic numberOfTestRuns="{runs}" randomSeed="{seed}">'
        f'<StochasticDistribution parameterName="{name}">{inside}</StochasticDistribution></Stochastic>'
    )


def drawn(tmp_path, inside, name="v", runs=4000):
    found = variants(tmp_path, stochastic(name, inside, runs))
    return np.asarray([found.variants[k][name] for k in range(runs)])


@pytest.mark.parametrize(
    ("inside", "mean", "deviation"),
    [
        ('<NormalDistribution expectedValue="40" variance="9"/>', 40, 3),
        ('<LogNormalDistribution expectedValue="40" variance="16"/>', 40, 4),
        ('<UniformDistribution><Range lowerLimit="30" upperLimit="60"/></UniformDistribution>', 45, 75**0.5),
        ('<PoissonDistribution expectedValue="36"/>', 36, 6),
        (
            '<Histogram><Bin weight="1"><Range lowerLimit="30" upperLimit="40"/></Bin><Bin weight="3">'
            '<Range lowerLimit="40" upperLimit="50"/></Bin></Histogram>',
            42.5,
            (100 / 12 + 0.25 * 0.75 * 100) ** 0.5,
        ),
    ],
)
def test_stochastic(tmp_path, inside, mean, deviation):
    runs = 1000
    found = drawn(tmp_path, inside, runs=runs)
    assert abs(found.mean() - mean) < 4 * deviation / runs**0.5
    assert abs(found.std() / deviation - 1) < 0.08


def test_draws(tmp_path):
    inside = '<NormalDistribution expectedValue="20" variance="100"><Range lowerLimit="20" upperLimit="30"/>'
    inside += "</NormalDistribution>"
    first, again = drawn(tmp_path, inside, runs=300), drawn(tmp_path, inside, runs=300)
    assert (first == again).all()  # a run depends on the seed and its number alone
    assert first.min() >= 20  # the constraint of gap needs as much
    assert first.max() <= 30
    assert first.std() > 2
    sets = '<ProbabilityDistributionSet><Element value="car" weight="1"/><Element value="bus" weight="3"/>'
    sets += "</ProbabilityDistributionSet>"
    kinds = drawn(tmp_path, sets, "kind", 1000)
    assert 0.69 < (kinds == "bus").mean() < 0.81
    below = '<UniformDistribution><Range lowerLimit="1" upperLimit="2"/></UniformDistribution>'
    refuse_draw = variants_of(tmp_path, stochastic("half", below))
    with pytest.raises(OpenScenarioError, match="1000 draws of run 0 break the constraints"):
        refuse_draw()
    refuse(tmp_path, stochastic("v", '<NormalDistribution expectedValue="1" variance="0"/>'), "above 0")
    user = '<UserDefinedDistribution type="x">y</UserDefinedDistribution>'
    refuse(tmp_path, stochastic("v", user), "<UserDefinedDistribution>: not supported")


def variants_of(tmp_path, body):
    return lambda: variants(tmp_path, body)


@needs_shared
def test_all_of_r157():
    """The 15 files of UN R157: 121,060 combinations, of which the constraints leave 93,935."""
    files = sorted(ALKS.glob("*.xosc"))
    found = {path.name: openscenario(path) for path in files}
    assert len(found) == 15
    assert sum(x.variants.product for x in found.values()) == 121_060
    assert sum(len(x) for x in found.values()) == 93_935
    cut_in = found["alks_scenario_4_4_1_cut_in_no_collision_variation.xosc"]
    # the product of the sizes that the file says: 5 speeds, 5 bodies, 2 sides, 5 differences, 7 gaps, 6, 5
    assert cut_in.variants.product == 5 * 5 * 2 * 5 * 7 * 6 * 5
    kept = set()
    for k in range(0, len(cut_in), 997):
        one = cut_in.variants[k]
        v, dv = float(one["Ego_InitSpeed_Ve0_kph"]), float(one["CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph"])
        assert float(one["CutInVehicle_LaneChange_MaxLateralVelocity_Vy_mps"]) < (v + dv) / 3.6
        kept.add(cut_in.scenario(k).entity("CutInVehicle").category)
    assert kept == {"car", "truck", "bus", "motorbike"}  # the van is a car in the catalog
