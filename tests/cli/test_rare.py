"""Commands about rare events: what they refuse, and what triage prints."""

import json

import pytest

from limsim_jax import cli

FAULTS = [
    (("--method", "crude"), "--method: only with --estimate"),
    (("--budget", "3000"), "--budget: only with --estimate"),
    (("--estimate", "contact", "--shard", "0/2"), "an estimate is one run of its own, without --shard"),
    (("--estimate", "contact", "--until-ci", "0.1"), "without --until-ci"),
    (("--estimate", "contact", "--workers", "2"), "without --workers"),
    (("--estimate", "contact", "--seeds", "5"), "without --seeds"),
]


@pytest.mark.parametrize(("options", "said"), FAULTS, ids=[said for _, said in FAULTS])
def test_options_that_do_not_go_together_are_one_line(options, said, capsys, tmp_path):
    assert cli.main(["sweep", "roundabout", *options, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--estimate", "contact"), "--estimate: a .xosc has variants, no random numbers"),
        (("--budget", "3000"), "--budget: only with --estimate"),
    ],
)
def test_scenarios_have_no_estimate(options, said, capsys, tmp_path):
    (tmp_path / "one.xosc").touch()
    assert cli.main(["sweep", str(tmp_path / "one.xosc"), *options]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


ONE = [["sweep", "paper", "--estimate", "contact"], ["sensitivity", "paper"], ["adversary", "paper"]]


@pytest.mark.parametrize("command", ONE, ids=[command[0] for command in ONE])
def test_one_experiment_at_a_time(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(command) == 2
    err = capsys.readouterr().err
    assert "one experiment at a time, not highway, ramp" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--event", "crash"), "event: 'crash'; known are contact, fault, and conditions such as min_ttc<1"),
        (("--budget", "50"), "worlds: 50 are too few for 4 starts with 5,336 random numbers; at least 220"),
        (("--reference", "nope"), "reference: roundabout: ego.policy: unknown policy 'nope'; known are "),
        (("--reference", "like_traffic"), "reference: 'like_traffic' is the policy under test; name another"),
        (("--chunk", "0"), "--chunk: 0; at least 1"),
    ],
)
def test_an_adversary_refuses_in_one_line(options, said, capsys, tmp_path):
    command = ["adversary", "roundabout", "--policy", "like_traffic", *options]
    assert cli.main([*command, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_triage_of_no_results_is_one_line(capsys, tmp_path):
    assert cli.main(["triage", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_triage_of_a_sweep(capsys, tmp_path):
    from fake_episodes import FakeEpisodes

    from limsim_jax.sweeps.runner import sweep

    sweep([FakeEpisodes(failures=0.3)], range(40), tmp_path)
    report = tmp_path / "found.json"
    assert cli.main(["triage", str(tmp_path), "--no-change", "--json", str(report)]) == 0
    out = capsys.readouterr().out
    found = json.loads(report.read_text())
    assert sum(x["episodes"] for x in found) == len({seed for x in found for seed in x["seeds"]}) > 3
    assert "what happened" in out and "triage.html" in out
    assert (tmp_path / "triage.html").read_text().count("<tr>") == len(found) + 1
    assert cli.main(["triage", str(tmp_path), "--policy", "mine"]) == 2
    assert "'mine' is not there; there are still" in capsys.readouterr().err
