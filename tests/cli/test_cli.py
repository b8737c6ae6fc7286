"""The command line: what it prints, what it writes, and how it refuses."""

import gzip
import json
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

import limsim_jax as lj
from limsim_jax import cli
from limsim_jax.files import cache_directory
from limsim_jax.maps import bundled_map, bundled_maps, read_network
from limsim_jax.sweeps import runner

LANES = """
<lanes><laneSection s="0"><center><lane id="0" type="none"/></center><right>
  <lane id="-1" type="driving"><link><predecessor id="-1"/><successor id="-1"/></link>
    <width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
</right></laneSection></lanes>
"""


def two_roads(*, gap: float = 0.0, turn: float = 0.0, extra: str = "") -> str:
    """OpenDRIVE of two straight roads in a row; the second starts `gap` m late, turned by `turn` rad."""
    return f"""<?xml version="1.0"?>
<OpenDRIVE>
<header revMajor="1" revMinor="4" name="two roads"/>
<road name="" length="100" id="1" junction="-1">
  <link><successor elementType="road" elementId="2" contactPoint="start"/></link>
  <planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>{extra}{LANES}
</road>
<road name="" length="50" id="2" junction="-1">
  <link><predecessor elementType="road" elementId="1" contactPoint="end"/></link>
  <planView><geometry s="0" x="{100 + gap}" y="0" hdg="{turn}" length="50"><line/></geometry></planView>
  {LANES}
</road>
</OpenDRIVE>
"""


@pytest.fixture
def write(tmp_path):
    """A function that writes a map and returns its path."""

    def write(text: str, name: str = "map.xodr") -> str:
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


@pytest.fixture
def run(capsys):
    """A function that runs a command in this process and returns exit code, stdout and stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = cli.main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_version(run):
    assert run("--version") == (0, f"limsim-jax {lj.__version__}\n", "")


def test_help_names_every_command():
    result = CliRunner().invoke(cli.app, ["map", "--help"])
    assert result.exit_code == 0
    for command in ("info", "draw", "check"):
        assert command in result.output
    result = CliRunner().invoke(cli.app, ["bench", "--help"])
    assert "maps" in result.output and "traffic" in result.output


@pytest.mark.parametrize("name", sorted(bundled_maps()))
def test_info_on_bundled_maps(name, run, tmp_path):
    code, out, err = run("map", "info", name, "--json", tmp_path / "info.json")
    network = read_network(bundled_map(name))
    assert (code, err) == (0, "")
    facts = json.loads((tmp_path / "info.json").read_text())
    assert facts["lanes"] == len(network.lanes)
    assert facts["drivable_km"] == pytest.approx(
        sum(lane.length for lane in network.drivable_lanes()) / 1e3, abs=1e-3
    )
    assert facts["junctions"] == len(network.junctions)
    assert facts["traffic_lights"] == len(network.traffic_lights)
    assert facts["bounds_m"] == pytest.approx(network.bounds(), abs=0.01)
    assert facts["report"]["counts"]["lane"]["read"] > 0
    assert str(facts["drivable_km"]) in out and "approximated" in out


def test_info_is_right_about_a_known_map(run, write, tmp_path):
    code, out, _ = run("map", "info", write(two_roads()), "--json", tmp_path / "info.json")
    assert code == 0
    facts = json.loads((tmp_path / "info.json").read_text())
    assert (facts["roads"], facts["drivable_lanes"], facts["drivable_km"]) == (2, 2, 0.15)
    assert facts["bounds_m"] == [0, -1.75, 150, -1.75]
    assert facts["format"] == "OpenDRIVE 1.4"
    assert "0.15" in out


def test_check_of_a_clean_map(run, write):
    code, out, err = run("map", "check", write(two_roads()))
    assert (code, err) == (0, "")
    assert "no findings" in out and "seam" not in out


@pytest.mark.parametrize(
    ("fault", "jump"),
    [
        ({"gap": 0.02}, "gap 0.020 m, kink 0.00 deg"),
        ({"turn": 0.01}, "kink 0.57 deg"),
        ({"gap": 0.02, "turn": -0.01}, "kink -0.57 deg"),
    ],
)
def test_check_finds_seams(fault, jump, run, write, tmp_path):
    code, out, _ = run("map", "check", write(two_roads(**fault)), "--json", tmp_path / "check.json")
    assert code == 1
    assert jump in out and "1 finding\n" in out
    result = json.loads((tmp_path / "check.json").read_text())
    assert result["findings"] == len(result["seams"]) == 1


def test_check_lets_small_steps_pass(run, write):
    assert run("map", "check", write(two_roads(gap=0.008, turn=0.0002)))[0] == 0


def test_strict_check_counts_what_was_ignored(run, write):
    surface = (
        '<surface><CRG file="bumps.crg" sStart="0" sEnd="9" orientation="same" mode="genuine"/></surface>'
    )
    file = write(two_roads().replace(f"{LANES}\n</road>", f"{LANES}{surface}\n</road>", 1))
    lax, strict = run("map", "check", file), run("map", "check", file, "--strict")
    assert (lax[0], strict[0]) == (0, 1)
    assert "surface" in lax[1] and "surface" in strict[1]  # it is told in any case


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_draw(suffix, run, write, tmp_path):
    picture = tmp_path / f"map.{suffix}"
    code, out, err = run("map", "draw", write(two_roads()), "-o", picture, "--labels", "--conflicts")
    assert (code, err) == (0, "")
    assert str(picture) in out
    assert picture.read_bytes().startswith(b"\x89PNG" if suffix == "png" else b"<?xml")


def test_draw_of_a_window_differs(run, write, tmp_path):
    file = write(two_roads())
    run("map", "draw", file, "-o", tmp_path / "all.png")
    run("map", "draw", file, "-o", tmp_path / "part.png", "--bounds", "90,-10,110,10")
    assert (tmp_path / "all.png").read_bytes() != (tmp_path / "part.png").read_bytes()


def test_gzipped_maps_are_read(run, tmp_path):
    (tmp_path / "map.xodr.gz").write_bytes(gzip.compress(two_roads().encode()))
    code, out, _ = run("map", "info", tmp_path / "map.xodr.gz")
    assert code == 0 and "OpenDRIVE 1.4" in out


def test_no_cache_leaves_no_trace(run, write, tmp_path, monkeypatch):
    monkeypatch.setenv("LIMSIM_JAX_CACHE", str(tmp_path / "cache"))
    file = write(two_roads())
    run("map", "info", file, "--no-cache")
    assert not (tmp_path / "cache").exists()
    run("map", "info", file)
    assert (tmp_path / "cache").exists()


FILES = {
    "empty.xodr": b"",
    "noise.xodr": bytes(range(256)),
    "cut.xodr": two_roads()[:400].encode(),
    "routes.rou.xml": b"<routes/>",
    "nan.xodr": two_roads().replace('hdg="0"', 'hdg="nan"', 1).encode(),
    "ok.xodr": two_roads().encode(),
}

REFUSALS = {
    "missing file": ("map info none.xodr", "none.xodr"),
    "missing file in a folder": ("map info nowhere/none.xodr", "nowhere/none.xodr"),
    "unknown name": ("map info highwy", "bundled are"),
    "folder": ("map info folder", "folder"),
    "empty": ("map check empty.xodr", "empty"),
    "noise": ("map check noise.xodr", "not well-formed"),
    "cut": ("map check cut.xodr", "cut.xodr:"),
    "other XML": ("map info routes.rou.xml", "<routes>"),
    "not a number": ("map check nan.xodr", "hdg"),
    "no file": ("map info", "FILE"),
    "no output": ("map draw ok.xodr", "-o"),
    "unknown picture": ("map draw ok.xodr -o ok.doc", ".doc"),
    "output folder": ("map draw ok.xodr -o nowhere/ok.png", "nowhere"),
    "bad bounds": ("map draw ok.xodr -o ok.png --bounds 1,2,3", "--bounds"),
    "empty bounds": ("map draw ok.xodr -o ok.png --bounds 1,2,1,2", "bounds"),
    "JSON folder": ("map info ok.xodr --json nowhere/x.json", "nowhere/x.json"),
    "no such command": ("map explain ok.xodr", "explain"),
    "no such option": ("map info ok.xodr --jsn x", "--jsn"),
    "no runs": ("bench maps ok.xodr --repeats 0", "--repeats"),
    "bench of nothing": ("bench maps none.xodr", "none.xodr"),
    "bench of a cut file": ("bench maps cut.xodr --repeats 1", "cut.xodr:"),
    "run of nothing": ("run highwy", "bundled are"),
    "run of a cut file": ("run cut.xodr", "cut.xodr:"),
    "no time": ("run ok.xodr --seconds 0", "--seconds"),
    "time that is no number": ("run ok.xodr --seconds nan", "--seconds"),
    "negative rate": ("run ok.xodr --rate -1", "-1 veh/h"),
    "more vehicles than slots": ("run ok.xodr --vehicles 65", "65 do not fit into 64 slots"),
    "negative vehicles": ("run ok.xodr --vehicles -1", "--vehicles"),
    "more vehicles than road": ("run ok.xodr --vehicles 60", "places"),
    "no slots": ("run ok.xodr --slots 0 --vehicles 0", "--slots"),
    "negative seed": ("run ok.xodr --seed -1", "--seed"),
    "long steps": ("run ok.xodr --dt 2", "--dt"),
    "trace folder": ("run ok.xodr --trace nowhere/x.npz", "nowhere/x.npz"),
    "output is a folder": ("run ok.xodr --json folder", "folder"),
    "unknown trace": ("run ok.xodr --trace x.csv", ".parquet"),
    "unknown video": ("run ok.xodr --video x.avi", "x.avi"),
    "calibration of nothing": ("calibrate none.csv", "none.csv"),
    "calibration of a map": ("calibrate ok.xodr", "ok.xodr"),
    "calibration of noise": ("calibrate noise.xodr", "noise.xodr"),
    "unknown model": ("calibrate ok.xodr --model gipps", "--model"),
    "unknown objective": ("calibrate ok.xodr --objective beauty", "beauty"),
    "population in no folder": ("calibrate ok.xodr --out nowhere/x.json", "nowhere/x.json"),
    "training of nothing": ("train everything", "everything"),
    "training without worlds": ("train pdm-hybrid --seeds 0", "0 seeds"),
    "rounds below none": ("train end-to-end --rounds -1", "-1 rounds"),
    "no time to train": ("train end-to-end --minutes 0", "0 minutes"),
    "training in no scenario": ("train end-to-end --scenarios nowhere", "nowhere"),
    "weights in no folder": ("train pdm-hybrid --out nowhere/x.npz", "nowhere/x.npz"),
    "bench of no traffic": ("bench traffic none.xodr", "none.xodr"),
    "bench of no worlds": ("bench traffic ok.xodr --worlds 0", "--worlds"),
    "bench of no policy": ("bench policy ramp --policy no_such", "unknown policy 'no_such'"),
    "bench of many policies": ("bench policy paper", "'paper' is 5 experiments"),
    "bench with a bad rate": ("bench traffic ok.xodr --rate -2", "--rate"),
    "seeds beyond 32 bits": ("sweep paper --seeds 99999999999", "between 1 and 2^31"),
    "no seeds": ("sweep paper --seeds 0", "between 1 and 2^31"),
    "a part that is none": ("sweep paper --shard 3/2", "'3/2' is not I/N with I below N"),
    "module of a policy": ("sweep paper --policy none:Mine", "looked in the Python path and in"),
    "replay of nothing": ("replay folder --seed 0", "folder"),
    "bench JSON folder": ("bench traffic ok.xodr --json nowhere/x.json", "nowhere/x.json"),
}


@pytest.mark.engine
@pytest.mark.parametrize("case", REFUSALS)
def test_user_errors_are_one_line(case, run, tmp_path, monkeypatch):
    command, clue = REFUSALS[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    code, _, err = run(*command.split())
    assert code == 2
    assert err.startswith("limsim-jax: ") and err.count("\n") == 1
    assert clue in err


@pytest.mark.parametrize(
    "content", [b"<OpenDRIVE>\x00</OpenDRIVE>", b"<!-- nothing -->", b"\x00", b"\x1f\x8bgzip?", b"<a><b>"]
)
def test_load_map_refuses_with_one_line(content, tmp_path):
    (tmp_path / "map.xodr").write_bytes(content)
    with pytest.raises(lj.MapError) as caught:
        read_network(tmp_path / "map.xodr")
    assert "\n" not in str(caught.value) and "map.xodr" in str(caught.value)


def test_a_sweep_that_is_stopped_says_what_is_kept(run, tmp_path, monkeypatch):
    def stopped(episodes, seeds, out, *, progress, **_):
        for policy, done in (("like_traffic", 16), ("like_traffic", 48), ("mine", 5)):
            progress(runner.Progress("roundabout", policy, "running", done, 100, 0.0, 0.0, 1.0, 1.0))
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "sweep", stopped)
    code, out, err = run("sweep", "roundabout", "--out", tmp_path)
    assert code == 130 and err == ""
    assert out.splitlines()[-1] == f"stopped; 53 worlds are kept in {tmp_path}; the same command goes on"


def test_warm_compiles_every_scenario_of_the_file(run, monkeypatch):
    compiled = []

    class Waiting:
        policy = "like_traffic"

        def __init__(self, experiment):
            self.scenario = experiment.name

        def compile(self):
            compiled.append(self.scenario)

    monkeypatch.setattr("limsim_jax.cli.results.build", lambda read, chunk: [Waiting(x) for x in read])
    code, out, err = run("warm", "paper")
    assert (code, err) == (0, "")
    scenarios = ["highway", "intersection", "long_route", "ramp", "roundabout"]
    assert sorted(compiled) == scenarios
    *ready, folder = out.splitlines()
    assert sorted(line.partition(" / like_traffic: ready after ")[0] for line in ready) == scenarios
    assert folder == f"programs are kept in {cache_directory()}"
    assert run("warm", "paper", "--chunk", "0")[0] != 0


def test_bug_is_a_traceback(run, write, monkeypatch):
    def broken(network):
        raise RuntimeError("a bug")

    monkeypatch.setattr("limsim_jax.cli.maps._facts", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        run("map", "info", write(two_roads()))


@pytest.mark.slow
def test_bench(run, write, tmp_path):
    file, out = write(two_roads()), tmp_path / "bench.json"
    code, text, err = run("bench", "maps", file, "--repeats", "1", "--batch", "64", "--json", out)
    assert (code, err) == (0, "")
    result = json.loads(out.read_text())
    assert {row["function"] for row in result["look_ups"]} == {"pose", "to_frenet", "project"}
    assert all(row["look_ups_per_s"] > 0 and row["batch"] == 64 for row in result["look_ups"])
    assert 0 < result["cached"]["total_s"] and 0 < result["cold"]["total_s"] < result["cold"]["process_s"]
    assert result["machine"]["cores"] == 1
    assert "`pose`" in text


def script(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "limsim_jax.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"MPLBACKEND": "Agg"})


@pytest.mark.engine
def test_as_a_process(write):
    done = script("map", "check", write(two_roads(gap=1.0)))
    assert (done.returncode, done.stderr) == (1, "")
    refused = script("map", "check", write("<OpenDRIVE>", "cut.xodr"))
    assert refused.returncode == 2 and refused.stdout == ""
    assert refused.stderr.startswith("limsim-jax: ") and refused.stderr.count("\n") == 1
