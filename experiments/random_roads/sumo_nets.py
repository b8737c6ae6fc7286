"""Networks of SUMO's netgenerate, and conversions by its netconvert."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
from lxml import etree

from random_roads.junctions import Unfit

Rng = np.random.Generator
OVERLAP = 8.0
"""m^2, by which two roads may overlap; where they meet at a sharp angle they do so a little."""

PATIENCE = 60.0
"""s, for one run of a program."""


def run(program: str, *options: str) -> None:
    """Run one of the programs of Eclipse SUMO; `Unfit` if it refuses."""
    import sumo

    home = Path(sumo.SUMO_HOME)
    done = subprocess.run(
        [str(home / "bin" / program), *options, "--no-warnings"],
        check=False,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"SUMO_HOME": str(home)},
    )
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if "Error" in line]
        raise Unfit(f"{program}: {said[0] if said else done.returncode}")


def _common(rng: Rng) -> list[str]:
    """Options of any network."""
    options = ["--default.speed", f"{rng.choice([8.33, 13.89, 13.89, 16.67, 22.22])}"]
    options += ["--default.lanenumber", str(rng.choice([1, 1, 2, 2, 3]))]
    options += ["--default.lanewidth", f"{rng.uniform(2.9, 3.6):.2f}"]
    kind = str(
        rng.choice(
            ["priority", "priority", "right_before_left", "allway_stop", "traffic_light", "traffic_light"]
        )
    )
    options += ["--default-junction-type", kind]
    if kind == "traffic_light":
        options += ["--tls.default-type", str(rng.choice(["static", "static", "actuated"]))]
        options += ["--tls.layout", str(rng.choice(["opposites", "incoming"]))]
    if rng.random() < 0.3:
        options.append("--random-lanenumber")
    if rng.random() < 0.3:
        options.append("--random-priority")
    if rng.random() < 0.2:
        options.append("--lefthand")
    if rng.random() < 0.85:
        options += ["--no-turnarounds", "true"]
    if rng.random() < 0.12:
        options += ["--sidewalks.guess", "--crossings.guess"]
    if rng.random() < 0.08:
        options.append("--bikelanes.guess")
    if rng.random() < 0.3:
        options += ["--turn-lanes", "1", "--turn-lanes.length", f"{rng.uniform(15, 50):.0f}"]
    if rng.random() < 0.4:
        options += ["--default.junctions.radius", f"{rng.uniform(1.5, 10):.1f}"]
    if rng.random() < 0.3:
        options += ["--junctions.corner-detail", "5"]
    if rng.random() < 0.3:
        options += ["--roundabouts.guess"]
    return [*options, "--seed", str(rng.integers(1, 10**6))]


def refuse_overlaps(path: Path) -> None:
    """`Unfit` if two roads of a network lie over one another.

    netgenerate draws some of the roads that lead out of a spider over its spokes.
    """
    from shapely import STRtree, union_all
    from shapely.geometry import LineString

    edges = []
    for edge in etree.parse(path).getroot().iterfind("edge"):
        if edge.get("function"):
            continue
        bands = []
        for lane in edge.iterfind("lane"):
            points = [tuple(map(float, p.split(",")[:2])) for p in lane.get("shape", "").split()]
            bands.append(LineString(points).buffer(float(lane.get("width", "3.2")) / 2, cap_style="flat"))
        edges.append(union_all(bands))
    for a, b in zip(*STRtree(edges).query(edges), strict=True):
        if a < b and edges[a].intersection(edges[b]).area > OVERLAP:
            raise Unfit("roads that overlap")


def grid(rng: Rng, path: Path) -> None:
    """A grid of streets, often with streets that lead out."""
    options = [
        "--grid",
        "--grid.x-number",
        str(rng.integers(1, 5)),
        "--grid.y-number",
        str(rng.integers(2, 4)),
    ]
    options += ["--grid.x-length", f"{_block(rng):.0f}", "--grid.y-length", f"{_block(rng):.0f}"]
    options += ["--grid.attach-length", f"{rng.uniform(60, 180):.0f}"] if rng.random() < 0.85 else []
    if rng.random() < 0.4:
        options += ["--perturb-x", "normc(0,6,-12,12)", "--perturb-y", "normc(0,6,-12,12)"]
    run("netgenerate", *options, *_common(rng), "-o", str(path))


def spider(rng: Rng, path: Path) -> None:
    """Rings and spokes."""
    options = ["--spider", "--spider.arm-number", str(rng.integers(3, 7))]
    options += ["--spider.circle-number", str(rng.integers(1, 4))]
    options += ["--spider.space-radius", f"{rng.uniform(35, 120):.0f}"]
    options += ["--spider.attach-length", f"{rng.uniform(60, 160):.0f}"] if rng.random() < 0.85 else []
    options += ["--spider.omit-center"] if rng.random() < 0.5 else []
    run("netgenerate", *options, *_common(rng), "-o", str(path))


def random_net(rng: Rng, path: Path) -> None:
    """A random network of streets."""
    least = rng.uniform(25, 90)
    options = ["--rand", "--rand.iterations", str(rng.integers(6, 26))]
    options += [
        "--rand.min-distance",
        f"{least:.0f}",
        "--rand.max-distance",
        f"{least * rng.uniform(1.3, 3):.0f}",
    ]
    options += ["--rand.min-angle", f"{rng.uniform(30, 70):.0f}"]
    options += ["--rand.connectivity", f"{rng.uniform(0.6, 0.99):.2f}"]
    options += ["--rand.grid"] if rng.random() < 0.2 else []
    run("netgenerate", *options, *_common(rng), "-o", str(path))


def _block(rng: Rng) -> float:
    return float(rng.uniform(30, 70) if rng.random() < 0.25 else rng.uniform(70, 200))


def as_opendrive(source: Path, path: Path) -> None:
    """Write a SUMO network as OpenDRIVE; `Unfit` for left-hand traffic.

    For that netconvert writes no rule, and negative lane numbers on the left.
    """
    if ' lefthand="true"' in source.read_text():
        raise Unfit("netconvert cannot export left-hand traffic")
    run("netconvert", "-s", str(source), "--opendrive-output", str(path))


def as_sumo(source: Path, path: Path) -> None:
    """Write an OpenDRIVE map as a SUMO network."""
    run("netconvert", "--opendrive-files", str(source), "-o", str(path))
