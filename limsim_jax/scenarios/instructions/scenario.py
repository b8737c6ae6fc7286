"""From an instruction to a scenario that has been tried: understand, place, run, repair or refuse."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from limsim_jax.files import write_whole
from limsim_jax.maps import bundled_maps
from limsim_jax.maps.map import Map, load_map
from limsim_jax.scenarios.instructions.draft import UNITS
from limsim_jax.scenarios.instructions.events import happened
from limsim_jax.scenarios.instructions.grammar import parse
from limsim_jax.scenarios.instructions.intent import Act, InstructionError, Intent, RoadKind
from limsim_jax.scenarios.instructions.place import (
    DENSITY,
    HORIZON,
    LONGER,
    NO_TUNING,
    NoPlace,
    Placed,
    place,
)
from limsim_jax.scenarios.instructions.plans import STEADY, Tuning
from limsim_jax.scenarios.instructions.straight import write_straight
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile

SEEDS = 10
"""Worlds in which a scenario is tried."""

SHOWN, AVOIDED = 0.8, 0.8
"""Least share of them in which everything happens that was asked for, and in which the reference driver has
no contact."""

SLIPPERY = 0.2
"""Friction below which an episode lasts `LONGER`."""

GRIP = 0.9
"""Share of the grip of a road with which vehicles brake on it at most."""

REFERENCE = "like_traffic"
"""Policy that drives the ego while a scenario is tried."""

KEEPS_LANE = {"speed_factor": 1.0, "threshold": 1000.0, "keep_right": 0.0}
"""Parameters of the ego's driver: it drives at the limit and changes lanes only where its route needs it."""

FACTORS = (2.0, 1.5, 1.0, 0.75, 0.5, 0.35, 0.25, 0.15)
"""On distances to the ego, from harmless to hard."""

SLOTS = 32
"""Vehicles at once, doubled until those at the start fit in twice."""

MAPS: dict[RoadKind, tuple[str, ...]] = {
    "motorway": ("highway", "ramp", "long_route"),
    "rural": ("long_route",),
    "town": ("intersection", "long_route", "roundabout"),
    "ramp": ("ramp", "long_route"),
    "crossing": ("long_route", "intersection"),
    "roundabout": ("roundabout", "long_route"),
}
"""Bundled maps for each kind of road, in the order in which they are tried."""

TRIES = (
    NO_TUNING, Tuning(earlier=1.0), Tuning(earlier=-1.0), Tuning(which=1), Tuning(nearer=0.8, later=1.0),
    Tuning(nearer=1.4), Tuning(earlier=2.0, which=1), Tuning(nearer=1.8, which=1),
)  # fmt: skip
"""Repairs, in the order in which they are tried."""


@dataclass(frozen=True)
class Trial:
    """What happened where a scenario was tried.

    Attributes:
      shown: per event, share of the worlds in which it happened.
      all_shown: share in which everything happened.
      contact: share in which the reference driver had a contact.
      times: per event, median time, s.
    """

    shown: tuple[float, ...]
    all_shown: float
    contact: float
    times: tuple[float, ...]

    @property
    def good(self) -> bool:
        """Whether the scenario shows what it should, and can be survived."""
        return self.all_shown >= SHOWN and self.contact <= 1 - AVOIDED


@dataclass(frozen=True)
class Scenario:
    """A scenario made from an instruction.

    Attributes:
      text: the instruction.
      intent: what was understood.
      experiment: as a file has it.
      trial: what happened where it was tried; None: it was not.
      tries: how many placements were tried.
      tuning: what was changed in the last one.
    """

    text: str
    intent: Intent
    experiment: ExperimentFile
    trial: Trial | None = None
    tries: int = 1
    tuning: Tuning = NO_TUNING

    def save(self, path: str | Path) -> Path:
        """Write the experiment as .toml."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, to_toml(self, path.parent))
        return path

    @property
    def description(self) -> str:
        """What was understood, and what the trial showed, in lines."""
        lines = [f"map {Path(self.experiment.map).name}, {self.experiment.horizon:g} s"]
        lines += [f"note: {note}" for note in self.intent.notes]
        for k, (_, act) in enumerate(self.intent.events):
            line = f"{act.kind.replace('_', ' ')}"
            if self.trial is not None:
                line += f": in {self.trial.shown[k]:.0%} of the worlds, median {self.trial.times[k]:.1f} s"
            lines.append(line)
        if self.trial is not None:
            lines.append(f"{REFERENCE} has a contact in {self.trial.contact:.0%} of the worlds")
        return "\n".join(lines)


def scenario(
    text: str | Intent,
    *,
    map: str | Path | Map | None = None,
    folder: str | Path = ".",
    seeds: int = SEEDS,
    understand: Callable[[str], Intent] = parse,
    tell: Callable[[str], None] = lambda _: None,
) -> Scenario:
    """Make a scenario from an instruction, and try it.

        lj.scenario("a truck cuts in ahead of the ego on a three-lane motorway at 25 m/s").save("cut_in.toml")

    A place is searched on the map, or on the bundled ones; where none has as many lanes, a straight road is
    written. The scenario then runs with `seeds` seeds, the ego driven by `REFERENCE`: everything that was
    named must happen in `SHOWN` of them, and the ego must get by without a contact in `AVOIDED`. Otherwise
    the placement is changed, and after the last change the scenario is refused.

    Args:
      text: the instruction, or an intent.
      map: where it takes place; None: a bundled map that fits.
      folder: where a straight road is written, should one be needed.
      seeds: worlds in which it is tried; 0: it is not tried.
      understand: text to intent: the grammar, or a language model behind `LanguageModel`.
      tell: told what is being done.

    Raises:
      InstructionError: not understood, no place, or it does not happen; one line with the reason.
    """
    intent = understand(text) if isinstance(text, str) else text
    said = text if isinstance(text, str) else intent.model_dump_json(exclude_defaults=True)
    intent = _within_grip(intent)
    maps = _maps(intent, map, Path(folder))
    worst: list[str] = []
    for number, tuning in enumerate(TRIES):
        try:
            placed = place(intent, maps, tuning)
        except InstructionError:
            if number:
                continue
            raise
        file = _file(said, intent, placed)
        if not seeds:
            return Scenario(said, intent, file)
        tell(f"tries it on {placed.map.name}, {seeds} worlds")
        try:
            found = try_out(file, intent, placed, seeds)
        except ExperimentError as error:
            worst.append(str(error).partition(": ")[2])
            continue
        if found.good:
            return Scenario(said, intent, file, found, number + 1, tuning)
        worst.append(_why(intent, found))
    raise InstructionError(f"it does not come out, after {len(TRIES)} placements: {worst[0]}")


def _within_grip(intent: Intent) -> Intent:
    """The same; no vehicle brakes harder than the road allows."""
    if intent.friction is None:
        return intent
    most = round(GRIP * intent.friction * UNITS["g"], 2)

    def slower(act: Act) -> Act:
        rate = min(STEADY if act.rate is None else act.rate, most)
        return act.model_copy(update={"rate": rate}) if act.kind == "brake" else act

    actors = tuple(x.model_copy(update={"acts": tuple(map(slower, x.acts))}) for x in intent.actors)
    return intent.model_copy(update={"actors": actors})


def severity(made: Scenario, seeds: int = SEEDS) -> list[tuple[float, Scenario]]:
    """The same scenario with distances to the ego scaled by `FACTORS`.

    It finds out from where on the reference driver has contacts; it gives no probability.

    Args:
      made: of `scenario`.
      seeds: worlds of each.

    Raises:
      InstructionError: nothing in it has a distance to the ego; one line.
    """
    town, found, seen = load_map(made.experiment.map), [], set[str]()
    for factor in FACTORS:
        tuning = replace(made.tuning, severe=factor)
        try:
            placed = place(made.intent, [town], tuning)
            file = _file(made.text, made.intent, placed)
            seen.add(str(file.vehicle) + str(file.obstacle))
            trial = try_out(file, made.intent, placed, seeds)
        except (InstructionError, ExperimentError):
            continue  # bodies overlap, or nothing stands far enough away
        found.append((factor, replace(made, experiment=file, trial=trial, tuning=tuning)))
    if len(seen) < 2:
        raise InstructionError("nothing in it has a distance to the ego that could be less")
    return found


def try_out(file: ExperimentFile, intent: Intent, placed: Placed, seeds: int) -> Trial:
    """Run a scenario with `seeds` seeds and look for its events."""
    episodes = Episodes(_as_others(file), chunk=seeds)
    replays = episodes.replays([(seed, 0) for seed in range(seeds)], explain=False)
    events, rows = intent.events, []
    for replay in replays:
        first = len(placed.vehicles)
        slots = [1 + n + (first if kind == "obstacle" else 0) for kind, n in placed.actors]
        rows.append([happened(replay.trace, replay.lane_map, act, slots[k], replay.ego) for k, act in events])
    times = np.asarray(rows, float).reshape(seeds, len(events))
    contact = np.mean([replay.metrics["contacts"] > 0 for replay in replays])
    with np.errstate(all="ignore"):
        median = [float(np.median(x[np.isfinite(x)])) if np.isfinite(x).any() else np.nan for x in times.T]
    return Trial(
        shown=tuple(np.isfinite(times).mean(0).tolist()), all_shown=float(np.isfinite(times).all(1).mean()),
        contact=float(contact), times=tuple(median),
    )  # fmt: skip


def _as_others(file: ExperimentFile) -> ExperimentFile:
    """The same experiment; all scenarios share programs with it."""
    table = file.model_dump()
    if not file.zone:
        table["zone"] = [{"friction": 2.0}]  # more than any driver asks for
    if not any(x.action for x in file.vehicle) and not file.obstacle and file.vehicle:
        table["vehicle"][0]["action"] = [{"at": 2 * file.horizon, "leave": True}]
    return ExperimentFile.model_validate(table)


def _slots(town: Map, density: float, named: int) -> int:
    """Slots of a world."""
    km = sum(lane.length for lane in town.network.drivable_lanes()) / 1000
    need, slots = 2 * (density * km + named + 1), SLOTS
    while slots < need:
        slots *= 2
    return slots


def _why(intent: Intent, found: Trial) -> str:
    events = [act.kind.replace("_", " ") for _, act in intent.events]
    missing = [f"'{name}' in {x:.0%} of the worlds" for name, x in zip(events, found.shown, strict=True)]
    if found.all_shown < SHOWN:
        return ", ".join(missing)
    return f"{REFERENCE} has a contact in {found.contact:.0%} of the worlds"


def _maps(intent: Intent, given: str | Path | Map | None, folder: Path) -> list[Map]:
    kind = intent.kind_of_road
    if given is not None:
        return [load_map(given)]
    maps = [load_map(name) for name in MAPS[kind]]
    if kind in ("motorway", "rural", "town") and not _fits(intent, maps):
        lanes = intent.lanes or (2 if kind == "motorway" else 1)
        maps = [load_map(write_straight(folder, kind, lanes))]
    return maps


def _fits(intent: Intent, maps: Sequence[Map]) -> bool:
    try:
        place(intent, maps)
    except NoPlace:
        return False
    return True


def _file(text: str, intent: Intent, placed: Placed) -> ExperimentFile:
    """The scenario as an experiment."""
    zones: list[dict[str, Any]] = []
    limits = {lane.speed_limit for lane in placed.map.network.drivable_lanes()}
    limit = intent.limit if intent.limit is not None else placed.speed
    if limit < max(limits) - 0.5:
        zones.append({"speed_limit": round(limit, 2)})
    if intent.friction is not None:
        zones.append({"friction": intent.friction})
    slow = placed.signalled or (intent.friction is not None and intent.friction < SLIPPERY)
    density = DENSITY[intent.traffic or "none"]
    named = len(placed.vehicles) + len(placed.obstacles)
    return ExperimentFile.model_validate(
        {
            "name": slug(text), "map": _name_of(placed.map), "description": text.strip(),
            "horizon": LONGER if slow else HORIZON,
            "slots": _slots(placed.map, density, named),
            "traffic": {"density": density}, "zone": zones,
            "ego": placed.ego | {"policy": REFERENCE, "driver": KEEPS_LANE},
            "vehicle": placed.vehicles, "obstacle": placed.obstacles,
        }
    )  # fmt: skip


def _name_of(town: Map) -> str:
    """A bundled map by its name, others by their path."""
    bundled = {str(path): name for name, path in bundled_maps().items()}
    return bundled.get(str(town.source), str(Path(town.source).resolve()))


def slug(text: str) -> str:
    """A name for files from an instruction."""
    words = re.findall(r"[a-z0-9]+", text.lower())
    few = [word for word in words if word not in ("a", "an", "the", "of", "in", "on", "at", "and", "ego")]
    return "_".join(few)[:60].strip("_") or "scenario"


def to_toml(made: Scenario, folder: Path) -> str:
    """The experiment as a TOML file in a folder; what was understood is a comment."""
    file = made.experiment.model_dump(mode="json", exclude_defaults=True)
    if Path(file["map"]).parent.resolve() == folder.resolve():
        file["map"] = Path(file["map"]).name
    lines = [f"# {line}" for line in [made.text.strip(), *made.description.splitlines()]]
    plain = {k: x for k, x in file.items() if not isinstance(x, dict | list) and x is not None}
    lines += [f"{k} = {_value(x)}" for k, x in plain.items()]
    for name, found in file.items():
        for table in [found] if isinstance(found, dict) else found if isinstance(found, list) else []:
            lines += _table(name, table, isinstance(found, list))
    return "\n".join(lines) + "\n"


def _table(name: str, table: dict[str, Any], listed: bool) -> Iterator[str]:
    yield ""
    yield f"[[{name}]]" if listed else f"[{name}]"
    table = {key: value for key, value in table.items() if value not in (None, [], {})}
    for key, value in table.items():
        if not (isinstance(value, list) and value and isinstance(value[0], dict)):
            yield f"{key} = {_value(value)}"
    for key, value in table.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            for one in value:
                yield from _table(f"{name}.{key}", one, True)


def _value(x: Any) -> str:
    if isinstance(x, bool):
        return "true" if x else "false"
    if isinstance(x, dict):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in x.items()) + " }"
    if isinstance(x, str):
        return '"' + x.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ") + '"'
    return f"[{', '.join(map(_value, x))}]" if isinstance(x, list) else repr(x)
