"""What a user sees when something is wrong: mistakes, broken policies, interrupted and stale results.

    python experiments/mistakes.py [--only WORD] [--quick]

Every case is a folder of small files and a command that a user would type. What the command says last, its
exit code, and whether that is a single line that names the culprit are kept. Cases that run a policy take
half a minute each the first time; `--quick` leaves them out. Writes experiments/results/mistakes.json and
.md; a case that does not say what it should is marked.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from limsim_jax.files import write_whole

RESULTS = Path(__file__).parent / "results"

SMALL = """\
map = "highway"
horizon = 3.0
slots = 12

[traffic]
vehicles = 8

[ego]
start = "1-"
s = 200.0
goal = "2-"
policy = "mine:Mine"
"""
"""A small experiment: three seconds on the motorway."""

MINE = """\
from dataclasses import dataclass
import jax.numpy as jnp
import numpy as np
import limsim_jax as lj

@dataclass(frozen=True)
class Mine(lj.Policy):
    def __call__(self, config, lane_map, state, memory, key):
        n = state.egos.slot.shape[0]
        a = jnp.where(config.time(state.step) >= 1.0, {late}, 0.5)
        return {found}, memory

def host():
    return lj.HostPolicy(plan, name="host")

def plan(seen):
    a = 0.5 * np.ones_like(seen.v)
    late = seen.time >= 1.0
    some = late & (np.rint(1000 * seen.other_v[:, 0, 0]) % 3 == 0)
    {body}
    return {{"acceleration": a, "steering": 0 * a}}
"""
CONTROL = "lj.Command(control=lj.Control(acceleration=jnp.full(n, a), steering=jnp.zeros(n)))"


def mine(late: str = "0.5", found: str = CONTROL, body: str = "pass") -> str:
    """The module `mine`: a policy in JAX and a planner on the host."""
    return MINE.format(late=late, found=found, body=body)


def small(*changes: tuple[str, str]) -> str:
    """The small experiment with some lines changed."""
    text = SMALL
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


@dataclass(frozen=True)
class Case:
    """A mistake.

    Attributes:
      group: part of the table.
      what: the mistake, in words.
      command: what the user types after `limsim-jax`; several are joined by " && ".
      says: pattern that a line has to match, the last one if there are several.
      code: exit code.
      files: names and contents.
      runs: it drives worlds, and takes half a minute.
      edit: file and text that replaces it before the last command.
    """

    group: str
    what: str
    command: str
    says: str
    code: int = 2
    files: dict[str, str] = field(default_factory=dict)
    runs: bool = False
    edit: tuple[str, str] | None = None


def experiment(what: str, says: str, *changes: tuple[str, str]) -> Case:
    """A mistake in an experiment file."""
    files = {"a.toml": small(*changes), "mine.py": mine()}
    return Case("Experiment files", what, "sweep a.toml --seeds 4 --no-report", says, files=files)


def policy(what: str, says: str, text: str = SMALL, **changes: str) -> Case:
    """A policy that is wrong from the start; with `HOST` a planner."""
    files = {"a.toml": text, "mine.py": mine(**changes)}
    group = "Policies, before anything is compiled"
    return Case(group, what, "sweep a.toml --seeds 4 --no-report", says, files=files)


def recording(
    what: str,
    says: str,
    change: tuple[str, str] = ("", ""),
    options: str = "",
    *,
    code: int = 2,
    runs: bool = False,
) -> Case:
    """A mistake in a recording, or in how it is calibrated."""
    command = " ".join(filter(None, ["calibrate a.csv --length 4.5", options]))
    return Case("Recordings", what, command, says, code, {"a.csv": GPS.replace(*change, 1)}, runs)


GPS = "time,x,v,x_lead,v_lead\n" + "\n".join(f"{0.1 * k:.1f},{k},10,{k + 30},10" for k in range(400))
BEHIND = ("5.0,50,10,80,", "5.0,50,10,20,")
HOST = small(("mine:Mine", "mine:host"))
SWEEP = "sweep a.toml --seeds 6 --no-report"

CASES = (
    experiment("a field that does not exist", "horizn: no such field", ("horizon = 3.0", "horizn = 3.0")),
    experiment("a view with a negative range", "view.range: -3 m", ("[ego]", "[ego]\nview = { range = -3 }")),
    experiment(
        "a view with an unknown field",
        "ego.view: rnge: no such field",
        ("[ego]", "[ego]\nview = { rnge = 3 }"),
    ),
    experiment(
        "a share of misses above 1",
        "view.misses: 1.5; .*0 and 1",
        ("[ego]", "[ego]\nview = { misses = 1.5 }"),
    ),
    experiment(
        "a latency between two decisions",
        "ego.view: view.latency: 0.7 s; expected a multiple of 0.5 s",
        ("[ego]", "[ego]\nview = { latency = 0.7 }"),
    ),
    experiment("no map", "map: Field required", ('map = "highway"\n', "")),
    experiment("a map that does not exist", "bundled maps are", ('"highway"', '"higway"')),
    experiment(
        "a negative speed", r"ego.v: .*greater than or equal to 0, not -5", ("[ego]", "[ego]\nv = -5.0")
    ),
    experiment("a speed that is not a number", r"ego.v: .*finite", ("[ego]", "[ego]\nv = nan")),
    experiment("text for a number", "horizon: .*number, not '3 s'", ("horizon = 3.0", 'horizon = "3 s"')),
    experiment("a horizon of 0", "horizon: .*greater than 0", ("horizon = 3.0", "horizon = 0.0")),
    experiment("a time step of 1 s", "dt: .*less than or equal to 0.5", ("slots", "dt = 1.0\nslots")),
    experiment("no slots", "slots: .*greater than or equal to 1", ("slots = 12", "slots = 0")),
    experiment("more vehicles than slots", "slots: 4, but 9 vehicles", ("slots = 12", "slots = 4")),
    experiment(
        "more vehicles than the roads hold",
        "there are only 1518 places",
        ("slots = 12", "slots = 4000"),
        ("vehicles = 8", "vehicles = 3900"),
    ),
    experiment("an origin that does not exist", "ego.start: no origin, road or lane '9-'", ('"1-"', '"9-"')),
    experiment("a goal that does not exist", "ego.goal: no goal or lane '7'", ('"2-"', '"7"')),
    experiment(
        "a vehicle on top of the ego",
        "vehicle.0: overlaps ego.0 at the start",
        ("[ego]", '[[vehicle]]\nstart = "1-"\ns = 201.0\n\n[ego]'),
    ),
    experiment(
        "a vehicle that drives backwards",
        "vehicle.0.v: .*greater than or equal to 0, not -9",
        ("[ego]", '[[vehicle]]\nstart = "1-"\nv = -9.0\n\n[ego]'),
    ),
    experiment(
        "an action with two orders",
        "vehicle.0.action.0: an action is one of .*; here is brake and leave",
        ("[ego]", '[[vehicle]]\nstart = "1-"\naction = [{ brake = 3.0, leave = true }]\n\n[ego]'),
    ),
    experiment(
        "an action of another simulator",
        "vehicle.0.action.0.teleport: no such field; known are at, ",
        ("[ego]", '[[vehicle]]\nstart = "1-"\naction = [{ teleport = 3.0 }]\n\n[ego]'),
    ),
    experiment(
        "an obstacle beyond the lane",
        "obstacle.s: 9999 m, but lane .* is only",
        ("[ego]", '[[obstacle]]\nstart = "1-"\ns = 9999.0\n\n[ego]'),
    ),
    experiment(
        "a work zone on no road",
        "zone.0.where: no road or lane '77'; roads are",
        ("[ego]", '[[zone]]\nwhere = "77"\nclosed = true\n\n[ego]'),
    ),
    experiment(
        "a work zone that opens later",
        "zone.0: a closed lane is closed for the whole episode",
        ("[ego]", '[[zone]]\nwhere = "1"\nclosed = true\nend = 2.0\n\n[ego]'),
    ),
    experiment(
        "a zone without effect",
        "zone.0: a zone needs closed, speed_limit or friction",
        ("[ego]", '[[zone]]\nwhere = "1"\n\n[ego]'),
    ),
    experiment("a start without a goal", "ego: a goal is missing", ('goal = "2-"\n', "")),
    experiment("a start beyond the lane", "ego.s: 99999 m, but lane", ("s = 200.0", "s = 99999.0")),
    experiment("a lane that is not there", "ego.lane: 9, but", ("s = 200.0", "s = 200.0\nlane = 9")),
    experiment("an unknown vehicle", "ego: .*hovercraft", ("[ego]", '[ego]\nvehicle = "hovercraft"')),
    experiment(
        "an unknown driver parameter", "ego: .*patience", ("[ego]", "[ego]\ndriver = { patience = 3.0 }")
    ),
    experiment(
        "an unknown car-following model",
        "traffic.model: .*'idm', 'iidm' or 'acc'",
        ("vehicles = 8", 'vehicles = 8\nmodel = "gipps"'),
    ),
    experiment(
        "a flow with a negative rate",
        "traffic.flow.0.rate: .*not -400",
        ("[ego]", "[[traffic.flow]]\nrate = -400\n\n[ego]"),
    ),
    experiment(
        "a flow from nowhere",
        "traffic: .*'x'",
        ("[ego]", '[[traffic.flow]]\norigin = "x"\nrate = 400\n\n[ego]'),
    ),
    experiment(
        "number and density of vehicles",
        "traffic: vehicles or density, not both",
        ("vehicles = 8", "vehicles = 8\ndensity = 5.0"),
    ),
    experiment(
        "shares of unknown classes", "traffic: .*tram", ("vehicles = 8", "vehicles = 8\nmix = { tram = 1.0 }")
    ),
    experiment(
        "a criterion of success that does not exist",
        "success.mean_spead: no such metric; did you mean 'mean_speed'",
        ("[traffic]", "[success]\nmean_spead = 1.0\n\n[traffic]"),
    ),
    experiment("a policy that does not exist", "ego.policy: unknown policy 'pdm'", ('"mine:Mine"', '"pdm"')),
    experiment(
        "a module that does not exist",
        "ego.policy: 'yours:Mine' cannot be loaded",
        ("mine:Mine", "yours:Mine"),
    ),
    experiment(
        "an option that does not exist",
        "ego.options: speed: no such option",
        ('"mine:Mine"', '"mine:Mine"\noptions = { speed = 3.0 }'),
    ),
    experiment("a file that is not TOML", "not valid TOML", ("[ego]", "[ego")),
    policy("a policy that returns None", r"Mine: a policy returns \(Command, memory\), not", found="None"),
    policy(
        "one row for two egos",
        r"control.steering is float32\[2\]; expected \[1 egos\]",
        found="lj.Command(control=lj.Control(acceleration=jnp.full(n, a), steering=jnp.zeros(2)))",
    ),
    policy("a planner that returns a list", "returns list, not a mapping", HOST, body="return [1, 2]"),
    policy(
        "a planner with one number for all worlds", r"acceleration has shape \[\], not", HOST, body="a = 0.5"
    ),
    policy("a planner that raises at once", r"mine.py:\d+ in plan: ZeroDivisionError", HOST, body="1 / 0"),
    Case(
        "Policies that break while they drive",
        "NaN from 1 s on, in JAX",
        SWEEP,
        r"policy Mine failed in 6 of 6 episodes of a: a command that is not finite",
        1,
        {"a.toml": SMALL, "mine.py": mine(late="jnp.nan")},
        True,
    ),
    Case(
        "Policies that break while they drive",
        "NaN in some worlds, on the host",
        SWEEP,
        r"policy host failed in \d of 6 episodes of a: a command that is not finite",
        1,
        {"a.toml": HOST, "mine.py": mine(body="a[some] = np.nan")},
        True,
    ),
    Case(
        "Policies that break while they drive",
        "an exception in some worlds",
        SWEEP,
        r"policy host failed in \d of 6 episodes of a: mine.py:\d+ in plan: ValueError: no path",
        1,
        {"a.toml": HOST, "mine.py": mine(body="if some.any(): raise ValueError('no path')")},
        True,
    ),
    Case(
        "Policies that break while they drive",
        "the same with `--on-error stop`",
        f"{SWEEP} --on-error stop",
        r"a/host: the policy failed in seed \d at 1.1 s: mine.py:\d+ in plan: ValueError: no path",
        2,
        {"a.toml": HOST, "mine.py": mine(body="if some.any(): raise ValueError('no path')")},
        True,
    ),
    Case(
        "Stale results",
        "a policy in JAX is edited",
        f"{SWEEP} && {SWEEP}",
        "holds other results of a/Mine: the program of the policy has changed since",
        2,
        {"a.toml": SMALL, "mine.py": mine()},
        True,
        ("mine.py", mine(late="0.6")),
    ),
    Case(
        "Stale results",
        "a module that a planner imports is edited",
        f"{SWEEP} && {SWEEP}",
        "holds other results of a/host: the policy's code in gains.py has changed since",
        2,
        {"a.toml": HOST, "mine.py": mine(body="import gains; a = a * gains.G"), "gains.py": "G = 1.0\n"},
        True,
        ("gains.py", "G = 0.9\n"),
    ),
    Case(
        "Stale results",
        "the same, then `--fresh`",
        f"{SWEEP} && {SWEEP} --fresh",
        "exact for rates and medians|bounds",
        0,
        {"a.toml": HOST, "mine.py": mine(body="import gains; a = a * gains.G"), "gains.py": "G = 1.0\n"},
        True,
        ("gains.py", "G = 0.9\n"),
    ),
    Case(
        "Stale results",
        "`verify` after an edit",
        f"{SWEEP} && verify results/a",
        r"worlds run again, [1-6] differ",
        1,
        {"a.toml": SMALL, "mine.py": mine()},
        True,
        ("mine.py", mine(late="0.6")),
    ),
    Case(
        "Commands", "too many seeds", "sweep highway --seeds 99999999999", "99999999999; between 1 and 2.31"
    ),
    Case("Commands", "no seeds", "sweep highway --seeds 0", "0; between 1 and 2.31"),
    Case("Commands", "a shard that is none", "sweep highway --shard 3/2", "is not I/N with I below N"),
    Case(
        "Experiment files",
        "a speed in km/h: it runs, and is said",
        "sweep a.toml --seeds 4 --no-report",
        "ego.v: 120 m/s, but the highest limit of the map is 33.3 m/s; 120 km/h are 33.3 m/s",
        code=0,
        files={
            "a.toml": small(("[ego]", "[ego]\nv = 120.0"), ("mine:Mine", "like_traffic")),
            "mine.py": mine(),
        },
        runs=True,
    ),
    Case(
        "Experiment files",
        "a demand that the roads do not take",
        "sweep a.toml --seeds 4 --no-report",
        "vehicles per episode were still outside at the end; the roads took no more",
        code=0,
        files={
            "a.toml": small(
                ("vehicles = 8", "vehicles = 8\nflow = [{ rate = 90000 }]"),
                ("mine:Mine", "like_traffic"),
                ("slots = 12", "slots = 128"),
            )
        },
        runs=True,
    ),
    Case(
        "Commands",
        "`--fresh` for one shard of several",
        "sweep highway --shard 0/2 --fresh",
        "results of other shards",
    ),
    Case(
        "Commands",
        "an experiment that does not exist",
        "sweep higway",
        "no such file, and no bundled experiment",
    ),
    Case(
        "Commands",
        "a folder that is a file",
        "sweep highway --out a.txt",
        "a.txt: is a file",
        files={"a.txt": ""},
    ),
    Case("Commands", "a folder without results", "report nothing", "no results of a sweep here"),
    Case(
        "Commands",
        "a metric for `--until-ci` that does not exist",
        "sweep highway --until-ci 0.1:sucess",
        "no metric 'sucess'; did you mean 'success'",
    ),
    recording(
        "a leader behind its follower in one row: the stretch is lost",
        "line 52, column x_lead: leader leader is 30.0 m behind its follower",
        BEHIND,
        code=0,
        runs=True,
    ),
    recording(
        "the same with `--tolerated 0`",
        "so are 1 of 400 rows, and at most 0 % are tolerated",
        BEHIND,
        "--tolerated 0",
    ),
    recording(
        "leader and follower mixed up",
        "so are 400 of 400 rows",
        options="--columns x=x_lead,x_lead=x",
    ),
    Case(
        "Recordings",
        "a column that is missing",
        "calibrate a.csv",
        "a.csv: .*(column|kind)",
        files={"a.csv": "time,x\n0,1\n"},
    ),
    recording("a value that is not a number", "a.csv: line 4, column v", ("0.2,2,10", "0.2,2,nan")),
    recording(
        "a time that is mistyped: the stretch is lost",
        "line 5, column time: 0.2 s are missing before this row",
        ("0.2,2,", "0.05,2,"),
        code=0,
        runs=True,
    ),
    recording("bounds the wrong way round", "bounds: T within .*0 < low < high", options="--bounds T=3:0.3"),
    recording("bounds of an unknown parameter", "bounds: no parameter 'tau'", options="--bounds tau=1:2"),
    recording(
        "an impossible speed with `--tolerated 0`",
        "line 52, column v: -20 m/s; 0 to 70 m/s are expected; so are 1 of 400 rows",
        ("5.0,50,10,", "5.0,50,-20,"),
        "--tolerated 0",
    ),
    recording("a recording that is too short", "a.csv.*--shortest", (GPS, "\n".join(GPS.splitlines()[:50]))),
    Case("Maps", "a file that is no map", "map info a.xodr", "a.xodr", files={"a.xodr": "<OpenDRIVE"}),
    Case(
        "Maps",
        "a map without roads",
        "map info a.xodr",
        "a.xodr.*road",
        files={"a.xodr": "<OpenDRIVE><header revMajor='1' revMinor='6'/></OpenDRIVE>"},
    ),
)
"""In the order of the table."""


def typed(case: Case) -> tuple[int, str, list[str]]:
    """Type the commands of a case: the last exit code, what it says, and all lines of standard error."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in case.files.items():
            Path(folder, name).write_text(text)
        commands = case.command.split(" && ")
        done = subprocess.CompletedProcess([], 0, "", "")
        for k, command in enumerate(commands):
            if case.edit and k == len(commands) - 1 and k:
                Path(folder, case.edit[0]).write_text(case.edit[1])
            words = [sys.executable, "-B", "-m", "limsim_jax.cli", *command.split()]
            environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "400"}
            done = subprocess.run(
                words, cwd=folder, capture_output=True, text=True, env=environment, check=False
            )
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    errors = [line for line in done.stderr.splitlines() if line.strip()]
    told = [line for line in lines if re.search(case.says, line)] or lines or [""]
    return done.returncode, told[-1].replace(folder, "FOLDER"), errors


def main() -> None:
    """Run the cases and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="cases with this in their words; others keep their rows")
    parser.add_argument("--quick", action="store_true", help="no cases that drive worlds")
    options = parser.parse_args()
    rows = []
    for case in CASES:
        if options.only not in f"{case.group}: {case.what}" or (options.quick and case.runs):
            continue
        code, last, errors = typed(case)
        traces = any("Traceback" in line for line in errors)
        one = len([line for line in errors if line.startswith("limsim-jax")]) <= 1 and not traces
        good = code == case.code and one and re.search(case.says, last) is not None
        rows.append(
            {
                "group": case.group,
                "what": case.what,
                "command": case.command,
                "code": code,
                "says": last,
                "as_it_should": good,
            }
        )
        print(f"{'ok  ' if good else 'BAD '} {case.group}: {case.what}: {code}: {last}", flush=True)
    file = RESULTS / "mistakes.json"
    if options.only or options.quick:  # the others keep their rows
        told = {(row["group"], row["what"]): row for row in [*json.loads(file.read_text()), *rows]}
        rows = [told[case.group, case.what] for case in CASES if (case.group, case.what) in told]
    write_whole(file, json.dumps(rows, indent=1) + "\n")
    text = []
    for group in dict.fromkeys(row["group"] for row in rows):
        text += [f"**{group}**", "", "| mistake | command | what it says | exit code |", "|---|---|---|---|"]
        for row in rows:
            if row["group"] == group:
                says = row["says"].removeprefix("limsim-jax: ").replace("|", "\\|")
                mark = "" if row["as_it_should"] else " (not as it should)"
                text.append(f"| {row['what']} | `{row['command']}` | {says}{mark} | {row['code']} |")
        text.append("")
    good = sum(row["as_it_should"] for row in rows)
    text.append(f"{good} of {len(rows)} cases say what they should, in one line.")
    write_whole(RESULTS / "mistakes.md", "\n".join(text) + "\n")


if __name__ == "__main__":
    main()
