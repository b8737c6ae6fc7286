"""The command `check`."""

import json

import xosc

from limsim_jax import cli


def test_check(tmp_path, capsys):
    parameters = '<ParameterDeclaration name="v" parameterType="double" value="20"/>'
    xosc.write(tmp_path, xosc.scenario(parameters=parameters), "one.xosc")
    axis = '<DistributionSet><Element value="1"/><Element value="2"/></DistributionSet>'
    axis = (
        f'<DeterministicSingleParameterDistribution parameterName="v">{axis}'
        "</DeterministicSingleParameterDistribution>"
    )
    many = xosc.distribution("one.xosc", f"<Deterministic>{axis}</Deterministic>")
    path = xosc.write(tmp_path, many, "many.xosc")
    out = tmp_path / "found.json"
    assert cli.main(["check", str(path), "--json", str(out)]) == 0
    assert "2 variants of v" in capsys.readouterr().out
    found = json.loads(out.read_text())
    assert (found["variants"], found["varies"], found["ego"]) == (2, ["v"], "Ego")


def test_refusals_are_one_line(tmp_path, capsys):
    path = xosc.write(tmp_path, xosc.scenario(extra="<Surprise/>"))
    assert cli.main(["check", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert cli.main(["check", str(path), "--lenient"]) == 0
    assert "<Surprise>: unknown element" in capsys.readouterr().out
