"""Damaged and hostile map files: a whole `Network` or one `MapError`.

Every file here is made from a sound one by seeded damage, so that a failure names what to repeat.
"""

from __future__ import annotations

import contextlib
import copy
import gzip
import itertools
import math
import os
import signal
import subprocess
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xodr_writer as w
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from paths import REPO, SHARED

from limsim_jax.maps.network import Lane, MapError, Network
from limsim_jax.maps.opendrive import read_opendrive
from limsim_jax.maps.sumo import read_sumo

pytestmark = pytest.mark.engine

LIMIT = 10.0  # s for one file
Reader = Callable[[Path], Network]
READERS: dict[str, Reader] = {".xodr": read_opendrive, ".net.xml": read_sumo}


# --- What a network must be ---------------------------------------------------------------------------------


def faults(network: Network) -> Iterator[str]:
    """All inconsistencies of a network."""
    if not network.lanes:
        yield "no lanes"
    for key, lane in network.lanes.items():
        for fault in lane_faults(network, key, lane):
            yield f"lane {key}: {fault}"
    yield from movement_faults(network)
    for junction in network.junctions.values():
        for i in junction.movements:
            if not 0 <= i < len(network.movements) or network.movements[i].junction != junction.id:
                yield f"junction {junction.id}: movement {i}"
        for connector in junction.connectors:
            if connector not in network.lanes or network.lanes[connector].junction != junction.id:
                yield f"junction {junction.id}: connector {connector}"
        if not np.isfinite(junction.center).all():
            yield f"junction {junction.id}: centre {junction.center}"
    yield from program_faults(network)
    spots = [
        (f"{type(thing).__name__} {thing.id}", spot)
        for things in (network.traffic_lights, network.signs)
        for thing in things
        for spot in thing.spots
    ] + [(f"StopLine {line.id}", line.spot) for line in network.stop_lines]
    for what, spot in spots:
        if spot.lane not in network.lanes:
            yield f"{what}: lane {spot.lane} does not exist"
        elif not -1e-6 <= spot.s <= network.lanes[spot.lane].length + 1e-6:
            yield f"{what}: s {spot.s} is not on lane {spot.lane}"
    for thing in (*network.traffic_lights, *network.signs):
        if not np.isfinite([*thing.position, thing.heading]).all():
            yield f"{type(thing).__name__} {thing.id}: not finite"
    for walk in network.crosswalks:
        if len(walk.outline) < 3 or not np.isfinite(walk.outline).all():
            yield f"crosswalk {walk.id}: outline {walk.outline}"
        for key, s_in, s_out in walk.spans:
            if key not in network.lanes or not -1e-6 <= s_in <= s_out <= network.lanes[key].length + 1e-6:
                yield f"crosswalk {walk.id}: span {key} {s_in} {s_out}"
    for road in network.roads.values():
        if not math.isfinite(road.length) or road.length < 0:
            yield f"road {road.id}: length {road.length}"
    if not np.isfinite(network.bounds()).all():
        yield "bounds are not finite"
    if "\x00" in str(network.report) or not all(str(note) for note in network.report.notes):
        yield "the report is not text"


def lane_faults(network: Network, key: str, lane: Lane) -> Iterator[str]:
    """Faults of one lane."""
    count = len(lane.s)
    if lane.id != key:
        yield f"has the id {lane.id}"
    if count < 2:
        yield f"has {count} samples"
        return
    for name, shape in (
        ("s", (count,)),
        ("xyz", (count, 3)),
        ("heading", (count,)),
        ("curvature", (count,)),
        ("width", (count,)),
        ("road_s", (count,)),
    ):
        array = getattr(lane, name)
        if array.shape != shape or array.dtype != np.float64:
            yield f"{name} has shape {array.shape} and type {array.dtype}"
            return
        if not np.isfinite(array).all():
            yield f"{name} is not finite"
            return
    if lane.s[0] != 0.0 or not (np.diff(lane.s) > 0).all():
        yield "s does not ascend from 0"
    if (lane.width < 0).any():
        yield "width is negative"
    if (np.abs(np.diff(lane.heading)) > math.pi + 1e-9).any():
        yield "heading is not unwrapped"
    along = np.diff(lane.road_s)
    if not ((along >= 0).all() or (along <= 0).all()):
        yield "road_s turns back"
    if not (math.isfinite(lane.speed_limit) and lane.speed_limit > 0):
        yield f"speed limit {lane.speed_limit}"
    if lane.road not in network.roads:
        yield f"road {lane.road} does not exist"
    if lane.junction is not None and lane.junction not in network.junctions:
        yield f"junction {lane.junction} does not exist"
    for forth, back in (("successors", "predecessors"), ("predecessors", "successors")):
        others = getattr(lane, forth)
        if len(set(others)) != len(others):
            yield f"{forth} repeat: {others}"
        for other in others:
            if other not in network.lanes:
                yield f"{forth}: {other} does not exist"
            elif key not in getattr(network.lanes[other], back):
                yield f"{forth}: {other} does not know of it"
    for side, back in (("left", "right"), ("right", "left"), ("opposite", "opposite")):
        other = getattr(lane, side)
        if other is None:
            if getattr(lane, f"may_change_{side}", False):
                yield f"may change {side} to nowhere"
        elif other not in network.lanes or other == key:
            yield f"{side}: {other} does not exist"
        elif side != "opposite" and getattr(network.lanes[other], back) != key:
            yield f"{side}: {other} has {back} {getattr(network.lanes[other], back)}"
        elif side != "opposite" and network.lanes[other].road != lane.road:
            yield f"{side}: {other} is of another road"


def movement_faults(network: Network) -> Iterator[str]:
    """Faults of movements."""
    indices = range(len(network.movements))
    for i, movement in enumerate(network.movements):
        what = f"movement {i}"
        chain = [movement.incoming, *movement.via, movement.outgoing]
        if movement.index != i:
            yield f"{what}: index {movement.index}"
        if movement.junction not in network.junctions:
            yield f"{what}: junction {movement.junction} does not exist"
        elif i not in network.junctions[movement.junction].movements:
            yield f"{what}: junction {movement.junction} does not know of it"
        if any(key not in network.lanes for key in chain):
            yield f"{what}: lanes {chain}"
            continue
        for a, b in itertools.pairwise(chain):
            if b not in network.lanes[a].successors:
                yield f"{what}: {b} does not follow {a}"
        for name in ("foes", "yields_to"):
            if any(f not in indices or f == i for f in getattr(movement, name)):
                yield f"{what}: {name} {getattr(movement, name)}"
        if movement.program is not None:
            program = network.programs.get(movement.program)
            if program is None:
                yield f"{what}: program {movement.program} does not exist"
            elif movement.link is None or not 0 <= movement.link < len(program.phases[0].state):
                yield f"{what}: link {movement.link} of program {movement.program}"


def program_faults(network: Network) -> Iterator[str]:
    """Faults of the signal programs."""
    for program in network.programs.values():
        what = f"program {program.id}"
        if not program.phases:
            yield f"{what}: no phases"
            continue
        if len({len(phase.state) for phase in program.phases}) != 1:
            yield f"{what}: states of different lengths"
        if not math.isfinite(program.offset):
            yield f"{what}: offset {program.offset}"
        for phase in program.phases:
            if not math.isfinite(phase.duration) or phase.duration < 0:
                yield f"{what}: duration {phase.duration}"
            if not set(phase.state) <= set("rRyYgGuUsSoO"):
                yield f"{what}: state {phase.state}"
            if any(not 0 <= i < len(program.phases) for i in phase.next):
                yield f"{what}: next {phase.next}"
        for movements in program.movements:
            if any(not 0 <= i < len(network.movements) for i in movements):
                yield f"{what}: movements {movements}"


def verdict(reader: Reader, path: Path) -> str | None:
    """The fault of a reader with this file; None if there is none."""
    start = time.process_time()  # of this process alone, so that a busy machine fails no test
    try:
        with alarm(int(6 * LIMIT)):
            network = reader(path)
    except MapError as error:
        text = str(error)
        if len(text.splitlines()) != 1:
            return f"MapError of several lines: {text!r}"
        if os.fsdecode(path.name) not in text and len(path.name) < 100 and path.name.isprintable():
            return f"MapError without the file: {text}"
        if not error.reason.strip() or len(text) > 2000:
            return f"MapError without a readable reason: {text[:300]!r}"
        if error.element is not None and error.line is None:
            return f"MapError with an element but no line: {text}"
    except Exception:
        return "".join(traceback.format_exc().splitlines(keepends=True)[-7:]).strip()
    else:
        if found := list(faults(network)):
            return f"{len(found)} faults in the network: {'; '.join(found[:3])}"
    took = time.process_time() - start
    return f"took {took:.1f} s" if took > LIMIT else None


@contextlib.contextmanager
def alarm(seconds: int) -> Iterator[None]:
    """Ends a reader that takes too long."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


# --- Seeds --------------------------------------------------------------------------------------------------


def drawn(strategy: st.SearchStrategy[Any], count: int) -> list[Any]:
    """The same few examples of a strategy every time."""
    found: list[Any] = []
    calm = settings(
        max_examples=count,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )

    @calm
    @given(strategy)
    def collect(example: Any) -> None:
        found.append(example)

    collect()
    return found


SMALL = (
    "fabriksgatan", "simple_3way_lht", "crossing_complex_8_course", "two_plus_one", "soderleden",
    "figure8_trafficlights", "asam_entry_exit", "intersection_crosswalk", "parampoly3_normalized_lht",
)  # fmt: skip


@cache
def seeds(suffix: str) -> dict[str, bytes]:
    """Sound map files by name."""
    found: dict[str, bytes] = {}
    if suffix == ".xodr":
        found |= {f"road {i}": w.opendrive(road) for i, road in enumerate(drawn(w.road(), 12)[4:])}
        found |= {f"chain {i}": chain.xml for i, chain in enumerate(drawn(w.chains(), 12)[4:])}
        maps = [REPO / "maps" / "intersection.xodr", REPO / "maps" / "ramp.xodr"]
        maps += [SHARED / "opendrive" / f"{name}.xodr" for name in SMALL]
        found |= {path.name: path.read_bytes() for path in maps if path.is_file()}
    else:
        found |= generated_nets()
        for folder in ("ingolstadt1", "ngsim_us101", "limsim_roundabout"):
            for path in sorted((SHARED / "sumo" / folder).glob("*.net.xml")):
                found[path.name] = path.read_bytes()
    return found


def generated_nets() -> dict[str, bytes]:
    """Small nets of SUMO's own generator, where it is installed."""
    try:
        from sumo import SUMO_HOME
    except ImportError:
        return {}
    program = Path(SUMO_HOME) / "bin" / "netgenerate"
    found = {}
    for name, options in {
        "grid": ["--grid", "--grid.number", "2", "--tls.guess", "-L", "2", "--tls.default-type", "actuated"],
        "spider": ["--spider", "--spider.arm-number", "4", "--spider.circle-number", "1", "--lefthand"],
    }.items():
        run = subprocess.run(
            [str(program), *options, "-o", "/dev/stdout"], capture_output=True, check=False, timeout=60
        )
        if run.returncode == 0:
            found[f"{name}.net.xml"] = run.stdout[run.stdout.index(b"<?xml") : run.stdout.rindex(b">") + 1]
    return found


# --- Damage -------------------------------------------------------------------------------------------------

VALUES = (
    "", " ", "nan", "NaN", "inf", "-inf", "1e308", "-1e308", "1e400", "1e12", "-1e12", "1e6", "-1", "0", "1",
    "-0.0", "1e-300", "0.5", "99999999999999999999", "-99999999999999999999", "abc", "0x10", "1_000",
    "\u0661\u0662", "1,5", "true", "no-such-id", "x" * 5000, "start", "end", "LHT", "1e3", "100000",
    "junction", "\t\n", "a b c", "1 2 3", "0,0 1,1", "nan,nan", "0,0", "1e309,0 5,5", "rGyZ", "-2147483649",
    "9007199254740993", "\u00e9\u4e2d\U0001f600",
)  # fmt: skip


class Damage:
    """Seeded ways to spoil a file."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.did: list[str] = []

    def spoil(self, data: bytes) -> bytes:
        """One to three kinds of damage to the elements, sometimes to the bytes after that."""
        kind = self.rng.integers(10)
        if kind == 0:
            return self.bytes_(data)
        root = etree.fromstring(data, etree.XMLParser(huge_tree=True))
        for _ in range(1 + int(self.rng.integers(3))):
            damage = (
                self.attribute, self.attribute, self.attribute, self.remove, self.duplicate, self.shuffle,
                self.move, self.rename, self.swap, self.multiply, self.lose,
            )  # fmt: skip
            damage[self.rng.integers(len(damage))](root)
        data = etree.tostring(root)
        return self.bytes_(data) if kind == 1 else data

    def pick(self, root: w.Element) -> w.Element:
        """A random element; rare tags are as likely as common ones."""
        by_tag: dict[str, list[w.Element]] = {}
        for element in root.iter("*"):
            by_tag.setdefault(str(element.tag), []).append(element)
        tags = sorted(by_tag)
        elements = by_tag[tags[self.rng.integers(len(tags))]]
        return elements[self.rng.integers(len(elements))]

    def note(self, what: str, element: w.Element) -> None:
        """Remember for the failure's message."""
        self.did.append(f"{what} <{element.tag} {dict(list(element.attrib.items())[:3])}>")

    def attribute(self, root: w.Element) -> None:
        """Overwrite an attribute."""
        element = self.pick(root)
        names = sorted(element.attrib)
        if names:
            name = names[self.rng.integers(len(names))]
            value = VALUES[self.rng.integers(len(VALUES))]
            self.note(f"set {name}={value[:30]!r} in", element)
            element.set(name, value)

    def lose(self, root: w.Element) -> None:
        """Drop an attribute."""
        element = self.pick(root)
        names = sorted(element.attrib)
        if names:
            name = names[self.rng.integers(len(names))]
            self.note(f"drop {name} from", element)
            del element.attrib[name]

    def remove(self, root: w.Element) -> None:
        """Drop an element."""
        element = self.pick(root)
        if element.getparent() is not None:
            self.note("remove", element)
            element.getparent().remove(element)

    def duplicate(self, root: w.Element) -> None:
        """Say something twice."""
        element = self.pick(root)
        if element.getparent() is not None:
            self.note("duplicate", element)
            element.addnext(copy.deepcopy(element))

    def multiply(self, root: w.Element) -> None:
        """Say something very often."""
        element = self.pick(root)
        if element.getparent() is not None and len(etree.tostring(element)) < 2000:
            self.note("repeat 300 times", element)
            for _ in range(300):
                element.addnext(copy.deepcopy(element))

    def shuffle(self, root: w.Element) -> None:
        """Another order of children."""
        element = self.pick(root)
        self.note("shuffle children of", element)
        children = list(element)
        self.rng.shuffle(children)  # type: ignore[arg-type]
        element[:] = children

    def move(self, root: w.Element) -> None:
        """An element in the wrong place."""
        element, target = self.pick(root), self.pick(root)
        if element is not root and element not in target.iterancestors() and element is not target:
            self.note(f"move into <{target.tag}>", element)
            target.append(element)

    def rename(self, root: w.Element) -> None:
        """An element under another element's name."""
        element, other = self.pick(root), self.pick(root)
        if element is not root:
            self.note(f"rename to {other.tag}", element)
            element.tag = other.tag

    def swap(self, root: w.Element) -> None:
        """Attributes of another element of the same name: dangling links, wrong ids, cycles."""
        element = self.pick(root)
        others = [e for e in root.iter(element.tag) if e is not element]
        if others:
            other = others[self.rng.integers(len(others))]
            self.note("take attributes of a namesake in", element)
            for name, value in other.attrib.items():
                if self.rng.integers(2):
                    element.set(name, value)

    def bytes_(self, data: bytes) -> bytes:
        """Cut, or overwrite some bytes."""
        if self.rng.integers(2):
            cut = int(self.rng.integers(len(data)))
            self.did.append(f"cut at byte {cut}")
            return data[:cut]
        spoiled = bytearray(data)
        for _ in range(int(self.rng.integers(1, 20))):
            spoiled[self.rng.integers(len(spoiled))] = int(self.rng.integers(256))
        self.did.append("overwrite bytes")
        return bytes(spoiled)


def fuzz(folder: Path, suffix: str, cases: range, seconds: float = math.inf) -> list[str]:
    """Failures of a reader over these cases, told so that they can be repeated."""
    found, start = [], time.perf_counter()
    names = list(seeds(suffix))
    path = folder / f"fuzz{suffix}"
    for case in cases:
        if time.perf_counter() - start > seconds:
            break
        rng = np.random.default_rng([case, len(suffix)])
        name = names[case % len(names)]
        damage = Damage(rng)
        path.write_bytes(damage.spoil(seeds(suffix)[name]))
        if (wrong := verdict(READERS[suffix], path)) is not None:
            found.append(f"{suffix} case {case}, seed {name}: {'; '.join(damage.did)}\n{wrong}\n")
    return found


@pytest.mark.parametrize("suffix", READERS)
def test_seeds_are_sound(tmp_path: Path, suffix: str) -> None:
    if not seeds(suffix):
        pytest.skip("no SUMO generator and no shared data to make files from")
    for name, data in seeds(suffix).items():
        path = tmp_path / f"seed{suffix}"
        path.write_bytes(data)
        assert list(faults(READERS[suffix](path))) == [], name


@pytest.mark.parametrize("suffix", READERS)
def test_damaged_files(tmp_path: Path, suffix: str) -> None:
    if not seeds(suffix):
        pytest.skip("no SUMO generator and no shared data to make files from")
    found = fuzz(tmp_path, suffix, range(200))
    assert not found, "\n".join(found)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", READERS)
def test_damaged_files_for_long(tmp_path: Path, suffix: str) -> None:
    if not seeds(suffix):
        pytest.skip("no SUMO generator and no shared data to make files from")
    found = fuzz(tmp_path, suffix, range(10_000, 40_000), seconds=600.0)
    assert not found, f"{len(found)} failures\n" + "\n".join(found[:20])


# --- Hostile files, one by one ------------------------------------------------------------------------------


def xodr_road(
    length: str = "50", curvature: str | None = None, lane: str = "-1", links: str = "", width: str = "3.5",
    x: str = "0", sections: int = 1, lanes: int = 1, geometries: int = 1,
) -> str:  # fmt: skip
    """One road, of which anything may be wrong."""
    shape = "<line/>" if curvature is None else f'<arc curvature="{curvature}"/>'
    step = 50.0 / geometries
    geometry = "".join(
        f'<geometry s="{i * step}" x="{x if geometries == 1 else i * step}" y="0" hdg="0" '
        f'length="{length if geometries == 1 else step}">{shape}</geometry>'
        for i in range(geometries)
    )
    numbers = [lane] if lanes == 1 else [str(-i - 1) for i in range(lanes)]
    inner = "".join(
        f'<lane id="{n}" type="driving"><link>{links}</link>'
        f'<width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane>'
        for n in numbers
    )
    section = "".join(
        f'<laneSection s="{i * 50 / sections}"><center><lane id="0" type="none"/></center>'
        f"<right>{inner}</right></laneSection>"
        for i in range(sections)
    )
    return (
        f'<road id="1" length="{length}" junction="-1"><link>'
        '<predecessor elementType="road" elementId="1" contactPoint="end"/>'
        '<successor elementType="road" elementId="1" contactPoint="start"/></link>'
        f"<planView>{geometry}</planView><lanes>{section}</lanes></road>"
    )


def xodr(*content: str, head: str = "") -> bytes:
    """An OpenDRIVE file of this content."""
    header = '<header revMajor="1" revMinor="6"/>'
    return f'<?xml version="1.0"?>{head}<OpenDRIVE>{header}{"".join(content)}</OpenDRIVE>'.encode()


def net(*content: str) -> bytes:
    """A SUMO network of this content."""
    return f'<net version="1.16">{"".join(content)}</net>'.encode()


def edge(name: str = "a", index: str = "0", length: str = "9", shape: str = "0,0 9,0") -> str:
    """An edge of one lane, of which anything may be wrong."""
    lane = f'<lane id="{name}_0" index="{index}" speed="9" length="{length}" shape="{shape}"/>'
    return f'<edge id="{name}" from="x" to="y">{lane}</edge>'


LAUGHS = (
    "<!DOCTYPE {root} [<!ENTITY a0 'ha'>"
    + "".join(f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 12))
    + "]>"
)
OUTSIDE = '<!DOCTYPE {root} [<!ENTITY x SYSTEM "file:///etc/hostname">]>'
PARAMETER = '<!DOCTYPE {root} [<!ENTITY % x SYSTEM "http://127.0.0.1:9/x.dtd"> %x;]>'
DTD = '<!DOCTYPE {root} SYSTEM "http://127.0.0.1:9/map.dtd">'

HOSTILE: dict[str, bytes] = {
    "empty": b"",
    "blank": b" \n\t ",
    "binary": bytes(range(256)) * 64,
    "zeros": bytes(100_000),
    "text": b"this is not a map",
    "only a declaration": b'<?xml version="1.0"?>',
    "other root": b"<html><body/></html>",
    "root in a namespace": b'<OpenDRIVE xmlns="urn:x"/>',
    "empty root": b"<OpenDRIVE/>",
    "two roots": b"<OpenDRIVE/><OpenDRIVE/>",
    "not closed": b"<OpenDRIVE><road>",
    "png": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "zip": b"PK\x03\x04" + bytes(100),
    "gzip head": b"\x1f\x8b",
    "gzip garbage": b"\x1f\x8b\x08\x00" + bytes(range(200)),
    "gzip cut": gzip.compress(b"<OpenDRIVE/>" * 1000)[:-20],
    "gzip of nothing": gzip.compress(b""),
    "gzip of zeros": gzip.compress(bytes(50_000_000)),
    "gzip twice": gzip.compress(gzip.compress(b"<OpenDRIVE/>")),
    "UTF-16 declared, UTF-8 written": b'<?xml version="1.0" encoding="UTF-16"?><OpenDRIVE/>',
    "unknown encoding": b'<?xml version="1.0" encoding="klingon"?><OpenDRIVE/>',
    "Latin-1 bytes in UTF-8": b'<OpenDRIVE><road name="\xe9\xff"/></OpenDRIVE>',
    "UTF-16": '<?xml version="1.0" encoding="UTF-16"?><OpenDRIVE/>'.encode("utf-16"),
    "UTF-32": "<OpenDRIVE/>".encode("utf-32"),
    "null in the middle": b"<OpenDRIVE>\x00</OpenDRIVE>",
    "nested deeply": b"<OpenDRIVE>" + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</OpenDRIVE>",
    "not closed, deeply": b"<OpenDRIVE>" + b"<road>" * 100_000,
    "attribute of 20 MB": xodr(f'<road id="{"x" * 20_000_000}"/>'),
    "text of 20 MB": xodr("<road>" + "x" * 20_000_000 + "</road>"),
    "100000 attributes": xodr("<road " + " ".join(f'a{i}="0"' for i in range(100_000)) + "/>"),
    "100000 empty roads": xodr("<road/>" * 100_000),
    "billion laughs": xodr("<road>&a11;</road>", head=LAUGHS.format(root="OpenDRIVE")),
    "billion laughs in an attribute": xodr('<road id="&a11;"/>', head=LAUGHS.format(root="OpenDRIVE")),
    "laughs that are not used": xodr(xodr_road(), head=LAUGHS.format(root="OpenDRIVE")),
    "external entity": xodr("<road>&x;</road>", head=OUTSIDE.format(root="OpenDRIVE")),
    "external entity in the header": xodr('<header name="&x;"/>', head=OUTSIDE.format(root="OpenDRIVE")),
    "parameter entity": xodr(xodr_road(), head=PARAMETER.format(root="OpenDRIVE")),
    "external DTD": xodr(xodr_road(), head=DTD.format(root="OpenDRIVE")),
    "undeclared entity": xodr("<road>&nothing;</road>"),
    "XInclude": xodr('<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="file:///etc/hostname"/>'),
    "road of no length": xodr(xodr_road(length="0")),
    "road of 1e-300 m": xodr(xodr_road(length="1e-300")),
    "road of 1e-6 m": xodr(xodr_road(length="1e-6")),
    "road of 1e12 m": xodr(xodr_road(length="1e12")),
    "road of 1e300 m": xodr(xodr_road(length="1e300")),
    "arc of 1e12 m": xodr(xodr_road(length="1e12", curvature="1e-3")),
    "road of 999 km, tightly wound": xodr(xodr_road(length="999000", curvature="0.001")),
    "curvature 1e9": xodr(xodr_road(curvature="1e9")),
    "curvature 1e-300": xodr(xodr_road(curvature="1e-300")),
    "curvature 19.9": xodr(xodr_road(curvature="19.9")),
    "lane 1000000": xodr(xodr_road(lane="-1000000")),
    "lane 1e300": xodr(xodr_road(lane="-1e300")),
    "1000 lanes": xodr(xodr_road(lanes=1000)),
    "2000 lane sections": xodr(xodr_road(sections=2000)),
    "10000 geometry records": xodr(xodr_road(geometries=10_000)),
    "width 1e9": xodr(xodr_road(width="1e9")),
    "width 1e300": xodr(xodr_road(width="1e300")),
    "width -5": xodr(xodr_road(width="-5")),
    "x 1e300": xodr(xodr_road(x="1e300")),
    "x 1e16": xodr(xodr_road(x="1e16")),
    "road that follows itself": xodr(xodr_road(links='<predecessor id="-1"/><successor id="-1"/>')),
    "same road twice": xodr(xodr_road(), xodr_road()),
    "road in no junction": xodr(xodr_road().replace('junction="-1"', 'junction="7"')),
    "junction without roads": xodr(
        '<junction id="7"><connection id="0" incomingRoad="1" connectingRoad="2"/></junction>'
    ),
    "junction with itself": xodr(
        xodr_road(links='<successor id="-1"/>').replace('junction="-1"', 'junction="7"'),
        '<junction id="7"><connection id="0" incomingRoad="1" connectingRoad="1" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection></junction>',
    ),
    "net: empty root": b"<net/>",
    "net: connection to nowhere": net(
        edge(), '<connection from="a" to="b" fromLane="0" toLane="7" dir="s" state="M"/>'
    ),
    "net: lane of one point": net(edge(shape="0,0")),
    "net: lane of equal points": net(edge(shape="1,1 1,1")),
    "net: lane index 1000000": net(edge(index="1000000")),
    "net: same lane twice": net(edge().replace("</edge>", edge()[len('<edge id="a" from="x" to="y">') :])),
    "net: same edge twice": net(edge(), edge()),
    "net: length 1e12": net(edge(length="1e12", shape="0,0 1e12,0")),
    "net: via itself": net(
        edge(name=":j_0"),
        '<connection from=":j_0" to=":j_0" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="M"/>',
    ),
    "net: billion laughs": f"{LAUGHS.format(root='net')}<net><edge id='&a11;'/></net>".encode(),
    "net: external entity": f"{OUTSIDE.format(root='net')}<net>&x;</net>".encode(),
    "net: external DTD": f"{DTD.format(root='net')}<net/>".encode(),
    "net: 100000 edges": b"<net>" + b"<edge/>" * 100_000 + b"</net>",
    "net: shape of 200000 points": net(edge(shape=" ".join(f"{i},0" for i in range(200_000)))),
}


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(HOSTILE[name])
    assert verdict(READERS[suffix], path) is None


REFUSED = (
    "empty", "binary", "text", "other root", "not closed", "gzip garbage", "gzip cut", "billion laughs",
    "laughs that are not used", "external entity", "undeclared entity", "road of no length",
    "road of 1e12 m", "curvature 1e9", "same road twice", "net: billion laughs", "net: external entity",
)  # fmt: skip


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("name", REFUSED)
def test_refused_files(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(HOSTILE[name])
    with pytest.raises(MapError, match=str(path)):
        READERS[suffix](path)


@pytest.mark.parametrize("suffix", READERS)
def test_paths_that_are_no_file(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "two\nlines").write_bytes(b"")
    for path in (
        tmp_path,
        tmp_path / "missing",
        tmp_path / "loop",
        tmp_path / "two\nlines",
        tmp_path / ("long" * 200),
        tmp_path / "null\x00byte",
        Path(""),
    ):
        assert verdict(READERS[suffix], path) is None, repr(path)
        with pytest.raises(MapError):
            READERS[suffix](path)


def test_message_names_file_line_element_and_reason(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    path.write_bytes(
        b"<OpenDRIVE>\n" + xodr_road(width="nan").replace("<lanes>", "\n<lanes>").encode() + b"\n</OpenDRIVE>"
    )
    with pytest.raises(MapError) as caught:
        read_opendrive(path)
    assert (caught.value.file, caught.value.line) == (path, 3)
    assert "width" in str(caught.value.element) and "'nan'" in caught.value.reason
    assert str(caught.value).startswith(f"{path}:3: ")


def test_the_checker_finds_faults(tmp_path: Path) -> None:
    """Each kind of damage to a sound network is found."""
    path = tmp_path / "seed.xodr"
    path.write_bytes(next(c.xml for c in drawn(w.chains(), 40) if any(p.junction for p in c.pieces)))
    network = read_opendrive(path)
    assert not list(faults(network))
    movement = network.movements[0]
    key = movement.incoming
    lane = network.lanes[key]

    def with_lane(**changes: Any) -> Network:
        return replace(network, lanes={**network.lanes, key: replace(lane, **changes)})

    broken = {
        "nan": with_lane(xyz=lane.xyz * np.nan),
        "shape": with_lane(width=lane.width[:-1]),
        "order": with_lane(s=lane.s[::-1].copy()),
        "dangling": with_lane(successors=("nowhere",)),
        "one-sided": with_lane(successors=()),
        "neighbour": with_lane(left="nowhere"),
        "permission": with_lane(left=None, may_change_left=True),
        "road": with_lane(road="nowhere"),
        "speed": with_lane(speed_limit=0.0),
        "movement": replace(
            network, movements=(replace(movement, outgoing="nowhere"), *network.movements[1:])
        ),
        "index": replace(network, movements=(replace(movement, index=5), *network.movements[1:])),
        "lanes": replace(network, lanes={}, movements=(), junctions={}),
    }
    for name, network_ in broken.items():
        with contextlib.suppress(ValueError, IndexError):  # bounds of no lanes
            assert next(iter(faults(network_)), None) is not None, name
