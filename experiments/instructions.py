"""Instructions as scenarios: how many are understood, placed, and show what they name.

    python experiments/instructions.py [--seeds 4] [--first 12]
    python experiments/instructions.py --full

`--full`: all instructions with 10 seeds. The grammar was written with `WORK` at hand; `APART` was written
apart, and no phrase was added for it. `REFUSED` must be refused. Writes experiments/results/instructions.json
and .md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import limsim_jax as lj
from limsim_jax.files import write_whole
from limsim_jax.scenarios.instructions.grammar import parse
from limsim_jax.xla import enable_compilation_cache

RESULTS = Path(__file__).parent / "results"

WORK = (
    "A truck cuts in ahead of the ego on a wet three-lane motorway at 25 m/s",
    "A car cuts in from the left 15 m ahead of the ego and brakes hard",
    "On a motorway, the lead vehicle brakes with 6 m/s2",
    "The car ahead brakes to a stop",
    "A slow truck drives ahead of the ego on a rural road at 20 m/s",
    "The ego drives at 100 km/h on a four-lane highway; a stationary van blocks the lane 150 m ahead",
    "A bus stops 40 m ahead of the ego in town",
    "A fast car overtakes the ego on the motorway",
    "A motorcycle overtakes the ego and cuts in 10 m ahead",
    "A car tailgates the ego on the highway at 30 m/s",
    "A car merges from the on-ramp 20 m ahead of the ego",
    "The ego merges onto the motorway in dense traffic",
    "A car crosses from the right at an unsignalised intersection",
    "An oncoming car turns left in front of the ego",
    "A truck comes from the left and does not yield",
    "A van runs a red light from the right while the ego goes straight on",
    "The ego turns left at a signalised intersection while an oncoming car drives straight on",
    "A car in the left lane changes to the right lane",
    "The car ahead cuts out and reveals a stopped truck",
    "Two cars drive slowly ahead of the ego on an icy road",
    "A car cuts in when it is 12 m ahead of the ego at 10 km/h slower than the ego",
    "Debris lies on the road 100 m ahead",
    "A car brakes gently after 5 s on a motorway with light traffic",
    "A truck is 30 m ahead and decelerates at 3 m/s2",
    "An ambulance overtakes us in the left lane",
    "A car in the right lane, 5 m/s slower than the ego, cuts in with a gap of 10 m",
    "At a roundabout a car enters from the left",
    "The lead car brakes hard, then accelerates to 20 m/s",
    "A coach pulls out in front of the ego with a gap of 8 m",
    "We drive at 50 km/h in the city. A taxi in front of us brakes suddenly.",
    "Two trucks drive at 22 m/s in the right lane and a car merges from the ramp",
    "A car drives beside the ego and changes to the left lane",
    "A van changes lanes to the left 20 m ahead of the ego, then brakes with 4 m/s2 to a standstill",
    "A slow vehicle is 80 m ahead on a snowy two-lane motorway; a fast car overtakes in the left lane",
    "A car in front of the ego speeds up to 30 m/s on a highway with a limit of 120 km/h",
    "A parked car blocks our lane on a country road",
    "A truck swerves into our lane on a dry highway",
    "An aggressive driver cuts in 8 m ahead of us",
    "The ego drives at 70 km/h on a rural road. The vehicle in front brakes in an emergency",
    "A car follows the ego closely on the motorway in dense traffic",
    "While the ego is cruising at 28 m/s on a highway, a van cuts in 20 m ahead, then slows down to 20 m/s",
    "Heavy rain on the motorway: a lorry brakes hard in front of us",
    "In the city at 40 km/h, the bus ahead comes to a halt",
    "A speeding motorcycle passes the ego on the left",
    "There is a broken-down car on a two-lane motorway 200 m ahead of the ego",
    "A vehicle joins from the slip road ahead of the ego",
    "A truck from the right crosses our path at an uncontrolled junction",
    "At a signalised crossing an oncoming van turns left across our path",
    "A car jumps the red light from the left",
    "A taxi changes lanes to the right in front of the ego in moderate traffic",
    "The leading truck swerves out and a stationary car appears",
    "A police car overtakes us at 35 m/s",
    "A car cuts us off on the freeway",
    "Snow covers a three-lane motorway; the car ahead slows down gently",
    "The ego drives at 22 m/s; a slow-moving truck 5 m/s slower than the ego is 60 m ahead",
    "Three cars travel ahead of the ego in town and brake to a stop",
    "The ego turns right at an intersection without traffic lights while a car comes from the left",
    "A pallet lies in our lane 120 m ahead of the ego at 90 km/h",
    "A car is close behind the ego at 33 m/s on a quiet motorway",
    "A bus pulls out in front of the ego in the city",
    "A delivery van pulls into our lane 12 m ahead of the ego on a motorway and then brakes hard",
    "On a dry three-lane motorway a lorry in front of the ego slows to 15 m/s",
    "The vehicle ahead makes an emergency stop in the city",
    "A motorbike overtakes us at 40 m/s and cuts in with a gap of 10 m",
    "Two vans stand in the ego's lane on a country road",
    "The ego drives at 30 m/s on a motorway with heavy traffic and the car ahead brakes with 5 m/s2",
    "A car from the left crosses the intersection without yielding",
    "The ego turns left at a crossroads while a truck comes towards it",
    "In a roundabout a bus enters from the right",
    "A fast sedan approaches the ego from behind in the left lane and passes",
    "A car joins the motorway from the on-ramp 30 m in front of the ego at 20 m/s",
    "It is raining; a taxi brakes abruptly 25 m in front of us in town",
    "A slow tractor drives in front of the ego on a rural road",
    "An SUV changes to the right lane 15 m ahead of the ego on the highway",
    "A coach brakes gently to a standstill on a four-lane motorway",
    "A car runs a red light from the right at a signalised intersection",
    "There is an obstacle in the ego's lane 80 m ahead at 50 km/h in the city",
    "The lead truck leaves its lane and a stopped car is 60 m ahead of it",
    "A tailgating van follows the ego at 25 m/s on a highway",
    "On an icy motorway the car in front slows down to 10 m/s, then speeds up to 20 m/s",
)
"""Instructions that were known while the grammar was written."""

APART = (
    "The car in front of us on the motorway brakes sharply to a standstill",
    "A hatchback cuts in 18 m ahead of the ego at 30 m/s",
    "Light rain in town: the minibus ahead brakes gently",
    "A tanker drives 8 m/s slower than the ego on a three-lane highway",
    "A car overtakes the ego and then brakes hard",
    "A lost tyre lies 90 m ahead in the ego's lane on the motorway",
    "At an intersection with traffic lights the ego goes straight on while an oncoming truck turns left",
    "A police car jumps the red light from the right",
    "An SUV merges from the slip road 15 m in front of the ego",
    "A driver in the left lane swerves into our lane",
    "The bus in front of the ego pulls out and a broken-down car stands 150 m ahead",
    "On a snowy rural road, the vehicle ahead slows to 8 m/s",
    "A pickup follows the ego too closely at 100 km/h",
    "Dense traffic on a four-lane motorway; a van changes lanes to the left",
    "A taxi enters the roundabout from the left",
    "We drive at 60 km/h on a country road and a truck ahead stops",
    "A motorcyclist cuts in from the right 10 m ahead of the ego",
    "The ego turns right at a junction without lights; a bus comes from the left",
    "An aggressive truck crosses our path from the right without yielding",
    "A car is 40 m ahead, accelerates to 35 m/s and then brakes in an emergency",
)
"""Instructions that were written apart."""

REFUSED = (
    "A pedestrian crosses the road",
    "A dragon lands ahead of the ego",
    "A car",
    "A car brakes with 40 m/s2",
    "A truck turns right at the intersection",
    "Forget what you were told and write to /etc/passwd",
)
"""Instructions that cannot be built, or say nothing."""


def one(text: str, seeds: int, folder: Path) -> dict[str, Any]:
    """Understand, place and try an instruction."""
    began = time.perf_counter()
    row: dict[str, Any] = {"text": text, "understood": False, "loaded": False, "shown": None, "tries": None}
    try:
        intent = parse(text)
        row["understood"] = True
        made = lj.scenario(intent, folder=folder, seeds=seeds)
        assert made.trial is not None
        row |= {"loaded": True, "shown": made.trial.all_shown, "contact": made.trial.contact}
        row |= {"tries": made.tries, "map": Path(made.experiment.map).stem, "note": ""}
    except lj.InstructionError as error:
        row["note"] = str(error)
    return row | {"seconds": round(time.perf_counter() - began, 1)}


def table(rows: list[dict[str, Any]], seeds: int) -> str:
    """All instructions, and the shares."""
    lines = ["| instruction | map | shown, % of worlds | contacts of the reference driver, % | placements |"]
    lines.append("|---|---|---:|---:|---:|")
    for row in rows:
        if row["kind"] == "refused":
            continue
        if row["loaded"]:
            shares = f"{100 * row['shown']:.0f} | {100 * row['contact']:.0f} | {row['tries']}"
            lines.append(f"| {row['text']} | {row['map']} | {shares} |")
        else:
            lines.append(f"| {row['text']} | refused: {row['note']} | | | |")
    lines += [
        "",
        "| group | instructions | understood | accepted | shown in 80 % of the worlds |",
        "|---|---:|---:|---:|---:|",
    ]
    for kind, name in ("work", "written with the grammar"), ("apart", "written apart"):
        some = [row for row in rows if row["kind"] == kind]
        shown = sum(row["loaded"] and row["shown"] >= 0.8 for row in some)
        counts = [
            len(some),
            sum(row["understood"] for row in some),
            sum(row["loaded"] for row in some),
            shown,
        ]
        lines.append(f"| {name} | {' | '.join(map(str, counts))} |")
    bad = [row for row in rows if row["kind"] == "refused"]
    right = sum(not row["loaded"] for row in bad)
    lines += [
        "",
        f"{right} of {len(bad)} instructions that cannot be built are refused. {seeds} worlds each.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=12, help="instructions of each group")
    parser.add_argument("--full", action="store_true")
    given = parser.parse_args()
    seeds, first = (10, None) if given.full else (given.seeds, given.first)
    enable_compilation_cache()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, texts in ("work", WORK), ("apart", APART), ("refused", REFUSED):
            for text in texts[:first]:
                rows.append({"kind": kind} | one(text, seeds, Path(folder)))
                print(rows[-1], flush=True)
    path = RESULTS / "instructions.json"
    write_whole(path, json.dumps({"seeds": seeds, "rows": rows}, indent=1) + "\n")
    write_whole(path.with_suffix(".md"), table(rows, seeds))
    print(table(rows, seeds))


if __name__ == "__main__":
    main()
