"""Pages of the reference, made from the package as it is."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import inspect
import itertools
import os
import re
import sys
import textwrap
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType, UnionType
from typing import Any

NAMES = {
    "Maps": ["load_map", "bundled_maps", "Map", "pose", "to_frenet", "Network", "LaneMap", "MapError"],
    "Experiments": [
        *("Experiment", "Flow", "Ego", "bundled_experiments", "load_experiments", "World", "Futures"),
        "ExperimentError",
    ],
    "Scenarios of other tools": ["openscenario", "OpenScenarioError"],
    "Scenario library": ["library", "LibraryError"],
    "Sweeps": ["sweep", "Results", "Row", "open_results", "Metric", "ResultsError"],
    "Rare events": [
        *("estimate", "Estimate", "adversary", "Adversary", "triage", "sensitivity"),
        *("rare_event", "RareEvent"),
    ],
    "Coverage": ["exposure", "Exposure"],
    "Policies": [
        *("LikeTraffic", "ConstantSpeed", "FollowLane", "PDMClosed", "PDMHybrid", "LimSimTM"),
        *("EndToEnd", "AreaOfInterest", "named", "language", "RuleTable"),
    ],
    "Policies of one's own": [
        *("Policy", "HostPolicy", "Observation", "ObserveSensors", "Command", "Control", "Trajectory"),
        *("reference_path", "to_cartesian"),
    ],
    "Sensors": [
        "Camera",
        "Lidar",
        "Rig",
        "six_cameras",
        "Detector",
        "Faults",
        "Sensed",
        "Film",
        "Perception",
    ],
    "Step by step": ["Env", "ObserveVector", "ObserveScaled", "RouteReward"],
    "Calibration": ["calibrate", "IDM", "IIDM", "ACC", "HumanDriver", "Population", "default_population"],
    "Log replay": ["load_scene", "Scene"],
    "Beside other tools": [
        "carla",
        "export",
        "TrafficServer",
        "TrafficClient",
        "DriverServer",
        "remote_driver",
        "ChatServer",
    ],
    "Beside SUMO": ["SumoWorld", "referee", "SumoError"],
}
"""Public names in the order of the page; all others follow as parts of the engine."""

UNITS = re.compile(
    r"^(km/h|m/s\^[23]|m/s²|m/s|rad/s\^2|rad/s|rad|vehicles per hour|vehicles per km of lane|veh/h|veh/km|"
    r"degrees|steps|vehicles|times|share|km|mm|ms|m|s|0 to 100|0 to 1|1)(?=$|[\s,.;:])"
)
"""Units with which descriptions begin."""


WORDS = {
    "name": "of the experiment in results; the file's name unless told",
    "description": "a sentence for reports",
    "traffic": "all vehicles but the egos",
    "ego": "the vehicle under test",
    "flow": "a table for each stream of vehicles that come in",
    "goal": "where they go: a way out of the map, or shares of several; absent: shares by the map",
    "pattern": "random arrivals, equal gaps, or groups",
    "speed": "m/s; speed at which they come in, as fast as road and leader allow unless told",
    "classes": "shares of vehicle classes; those of the traffic unless told",
    "platoon": "vehicles in a group",
    "headway": "s; time gap within a group",
    "begin": "s; no vehicle comes in before",
    "end": "s; no vehicle comes in from then on",
    "model": "car following of the traffic",
    "lane_changes": "whether the traffic changes lanes",
    "after_collision": "what vehicles do after a contact: stop there, drive on, or end the episode",
    "vehicle": "class of the ego",
    "horizon": "s; length of an episode",
    "min": "least value of the metric",
    "max": "greatest value of the metric",
    "metrics": "metrics of your own, by module and class",
}
"""Descriptions of fields that have none in the code."""

FIELD_UNITS = {"rate": "veh/h", "density": "veh/km"}
"""Units that descriptions do not begin with."""


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    header = list(header)
    lines = [header, ["---"] * len(header), *([_cell(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    text = re.sub(r"(?<!\\)\|", r"\\|", " ".join(text.split()))
    return text.replace("^2", "²").replace("^3", "³")


# --- Python ------------------------------------------------------------------------------------------


def api() -> str:
    """A section per group of public names."""
    lj = importlib.import_module("limsim_jax")
    public = [name for name in lj.__all__ if not name.startswith("__")]
    groups = {title: [name for name in names if name in public] for title, names in NAMES.items()}
    known = {name for names in groups.values() for name in names}
    groups["The engine"] = [name for name in public if name not in known]
    text = [
        "# Python API",
        "",
        "All public names are in `limsim_jax`, which this site imports as `lj`. A name loads when it is "
        "first used, and importing starts no JAX backend. Other modules are for contributors and may change.",
        "",
        *(
            f"- {title}: " + ", ".join(f"[`{name}`](#{_home(lj, name)})" for name in names)
            for title, names in groups.items()
            if names
        ),
    ]
    for title, names in groups.items():
        if names:
            text += ["", f"## {title}"]
            for name in names:
                text += ["", f"::: {_home(lj, name)}"]
                if name in ("Flow", "Ego"):
                    text += ["", f"The fields of `{name}` are those of the [experiment file](experiment.md)."]
    return "\n".join(text) + "\n"


def _home(package: ModuleType, name: str) -> str:
    """The dotted path at which a public name is defined."""
    value = inspect.unwrap(getattr(package, name))
    if inspect.ismodule(value):
        return value.__name__
    module, own = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if module and own and own.isidentifier() and own in vars(importlib.import_module(module)):
        return f"{module}.{own}"
    return f"limsim_jax.{name}"


# --- experiments -------------------------------------------------------------------------------------


def experiment() -> str:
    """Every field of an experiment file."""
    module = importlib.import_module("limsim_jax.sweeps.experiment")
    text = [
        "# Experiment file",
        "",
        "An experiment is a TOML file, or the same in Python: [`lj.Experiment`](api.md). It says which map, "
        "which traffic, which egos and for how long. An unknown field is refused with a list of known ones.",
        "",
        "```toml",
        *_bundled("ramp"),
        "```",
        "",
        "The files that come along: " + ", ".join(f"`{name}`" for name in module.bundled_experiments()) + ".",
        'A file can also name others: `experiments = ["highway.toml", "ramp.toml"]`.',
    ]
    seen: set[type] = set()
    waiting: list[tuple[str, type]] = [("", module.ExperimentFile)]
    titles = {"": "The file"}
    while waiting:
        path, model = waiting.pop(0)
        if model in seen:
            continue
        seen.add(model)
        text += ["", f"## {titles.get(path, f'`{path}`')}", ""]
        first = (inspect.getdoc(model) or "").split("\n\n")[0]
        text += [first, ""] if path and first else []
        rows = []
        for name, kind, default, bounds, words in fields(model):
            if not words or words in ("s", "m/s"):
                words = WORDS.get(name, words)
            unit, words = split_unit(words)
            unit, words = unit or FIELD_UNITS.get(name, ""), _sentence(words)
            rows.append([f"`{name}`", kind_in_words(kind), default, bounds, unit, words])
            for inner, many in _tables_in(kind):
                brackets = ("[[", "]]") if many else ("[", "]")
                below = ".".join(filter(None, [path.strip("[]"), name]))
                waiting.append((f"{brackets[0]}{below}{brackets[1]}", inner))
        text.append(table(["field", "type", "default", "bounds", "unit", "meaning"], rows))
    return "\n".join(text) + "\n"


def _bundled(name: str) -> list[str]:
    from limsim_jax.sweeps.experiment import bundled_experiments

    return bundled_experiments()[name].read_text(encoding="utf-8").rstrip().split("\n")


def fields(model: type) -> Iterator[tuple[str, Any, str, str, str]]:
    """Name, type, default, bounds and description of every field."""
    words = descriptions(model)
    hints = typing.get_type_hints(model, include_extras=True)
    if hasattr(model, "model_fields"):
        for name, field in model.model_fields.items():  # pyright: ignore[reportAttributeAccessIssue]
            default = (
                "required" if field.is_required() else _default(field.get_default(call_default_factory=True))
            )
            bounds = _bounds([*field.metadata, *_metadata(hints.get(name))])
            yield name, field.annotation, default, bounds, field.description or words.get(name, "")
    else:
        for field in dataclasses.fields(model):
            if field.default is not dataclasses.MISSING:
                default = _default(field.default)
            elif field.default_factory is not dataclasses.MISSING:
                default = _default(field.default_factory())
            else:
                default = "required"
            kind = hints[field.name]
            yield field.name, kind, default, _bounds(_metadata(kind)), words.get(field.name, "")


def descriptions(model: type) -> dict[str, str]:
    """Descriptions at the fields of a class, and in its docstring."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not base.__module__.startswith("limsim_jax"):
            continue
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        except (OSError, TypeError):
            continue
        body = tree.body[0].body  # pyright: ignore[reportAttributeAccessIssue]
        for one, following in itertools.pairwise(body):
            if isinstance(one, ast.AnnAssign) and isinstance(following, ast.Expr):
                if isinstance(following.value, ast.Constant) and isinstance(following.value.value, str):
                    found[ast.unparse(one.target)] = " ".join(following.value.value.split())
        listed = re.search(r"(?:Attributes|Args):\n(.*?)(?:\n\n|\Z)", inspect.getdoc(base) or "", re.S)
        if listed:
            for name, words in re.findall(r"^\s+(\w+): (.*?)(?=^\s+\w+: |\Z)", listed[1], re.S | re.M):
                found.setdefault(name, " ".join(words.split()))
    return found


def split_unit(words: str) -> tuple[str, str]:
    """The unit with which a description begins, and the rest."""
    unit = UNITS.match(words)
    if not unit:
        return "", words
    rest = words[unit.end() :]
    if rest.startswith(" if"):
        return "0 or 1", words
    return unit[0], rest.lstrip(" ,.;:") if rest[:1] != " " else words


def kind_in_words(kind: Any) -> str:
    """A type as users say it."""
    if kind is None or kind is type(None):
        return ""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return kind_in_words(inside[0])
    if origin in (typing.Union, UnionType):
        return " or ".join(dict.fromkeys(filter(None, map(kind_in_words, inside))))
    if origin is typing.Literal:
        return " or ".join(f'`"{value}"`' for value in inside)
    if origin in (list, tuple) or getattr(origin, "__name__", "") in ("Sequence", "Mapping", "dict"):
        values = [kind_in_words(one) for one in inside if one is not Ellipsis]
        if len(values) == 2:
            return f"table of {values[1]}"
        return f"list of {values[0]}" if values else "list"
    if isinstance(kind, typing.TypeAliasType) if sys.version_info >= (3, 12) else False:
        return kind_in_words(kind.__value__)
    names = {"str": "text", "int": "whole number", "float": "number", "bool": "true or false"}
    name = getattr(kind, "__name__", str(kind))
    return names.get(name, "table" if isinstance(kind, type) else name)


def _tables_in(kind: Any, many: bool = False) -> Iterator[tuple[type, bool]]:
    """Models within a type, and whether there can be several."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if inside and origin is not typing.Literal:
        for one in inside:
            yield from _tables_in(one, many or origin in (list, tuple))
    elif isinstance(kind, type) and kind.__module__.startswith("limsim_jax"):
        if hasattr(kind, "model_fields") or dataclasses.is_dataclass(kind):
            yield kind, many


def _metadata(kind: Any) -> list[Any]:
    found = []
    for one in getattr(kind, "__metadata__", ()):
        found += getattr(one, "metadata", None) or [one]
    for one in typing.get_args(kind):
        found += _metadata(one)
    return found


def _bounds(metadata: Iterable[Any]) -> str:
    signs = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most", "pattern": "like"}
    words: dict[str, None] = {}
    for one in metadata:
        for name, sign in signs.items():
            value = getattr(one, name, None)
            if value is not None and not callable(value):
                words[f"{sign} `{value}`" if name == "pattern" else f"{sign} {value:g}"] = None
    return ", ".join(words)


def _default(value: Any) -> str:
    if value is None or value in ("", [], {}, ()):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, int | float):
        return f"`{value:g}`"
    return ""


# --- command line ------------------------------------------------------------------------------------


def command_line() -> str:
    """The help of every command."""
    import typer

    from limsim_jax import cli

    app = getattr(cli, "app", None) or importlib.import_module("limsim_jax.cli.main").app
    os.environ["COLUMNS"] = "100"
    text = [
        "# Command line",
        "",
        "A user's error is one line on standard error and exit code 2. Commands that print a table write "
        "JSON with `--json FILE`. `limsim-jax COMMAND --help` prints what stands here.",
    ]

    def add(command: Any, name: str) -> None:
        below = getattr(command, "commands", {})
        if not below:
            context = command.make_context(name, [], resilient_parsing=True)
            context.info_name = name
            shown = command.get_help(context).strip()
            text.extend(["", f"## {name}", "", "```text", shown, "```"])
        for key, one in below.items():
            add(one, f"{name} {key}")

    add(typer.main.get_command(app), "limsim-jax")
    return "\n".join(text) + "\n"


# --- metrics and vehicles ----------------------------------------------------------------------------


def metrics() -> str:
    """Every column of results, by the sections of the report."""
    from limsim_jax.metrics.catalog import DERIVED, catalog
    from limsim_jax.metrics.description import SECTIONS

    text = [
        "# Metrics",
        "",
        "A row of results has all of these, one row for each ego of an episode. A value that does not exist "
        "is missing: an ego without a leader has no time headway. Means and intervals leave such episodes "
        "out and say how many. A metric has no value either if its ego was never on the road.",
        "",
        "A metric without a source is this project's own.",
    ]
    for section in SECTIONS:
        rows = [
            [f"`{x.name}`", split_unit(x.meaning)[0], x.better, _definition(x)]
            for x in catalog()
            if x.section == section
        ]
        if rows:
            header = ["metric", "unit", "better", "definition"]
            text += ["", f"## {section}", "", table(header, rows)]
    rows = [[f"`{x.name}`", f"`{x.of}`", _sentence(x.meaning), _formula(x.formula)] for x in DERIVED]
    text += [
        "",
        "## Derived",
        "",
        "Tables and comparisons also have these. They follow from a column.",
        "",
        table(["metric", "from", "meaning", "formula"], rows),
    ]
    return "\n".join(text) + "\n"


def _definition(metric: Any) -> str:
    """Meaning, formula, source and when it is missing, a line each."""
    meaning = split_unit(metric.meaning)[1] or metric.name.replace("_", " ")
    lines = [f"**{_sentence(meaning).rstrip('.')}.**", _formula(metric.formula)]
    lines += [f"*Source:* {metric.source.rstrip('.')}." if metric.source else ""]
    lines += [f"*Missing:* {metric.missing}" if metric.missing else ""]
    return "<br>".join(line for line in lines if line)


def _sentence(words: str) -> str:
    if UNITS.match(words):  # a symbol stays as it is
        return words
    return words[:1].upper() + words[1:]


def _formula(text: str) -> str:
    return f"`{text.rstrip('.')}`" if re.fullmatch(r"[\w\s.,()<>=/*+-]+", text) and "_" in text else text


def parameters() -> str:
    """Every number of the behaviour model."""
    from limsim_jax.traffic import parameters as module

    titles = {"JUNCTIONS": "Junctions", "LANE_CHANGES": "Lane changes", "DRIVING": "Driving"}
    text = [
        "# Behaviour parameters",
        "",
        "The numbers of the traffic model that are the same for all vehicles. Those that differ from vehicle "
        "to vehicle are in [vehicles and drivers](vehicles.md). *Chosen* means that no source has the "
        "number; the reason follows. Names such as `jmTimegapMinor` are SUMO's for the same thing.",
    ]
    for group in dict.fromkeys(x.group for x in module.PARAMETERS):
        rows = [
            [f"`{x.name}`", f"{x.value:g}", x.unit, _sentence(x.meaning), _range(x.bounds), x.source]
            for x in module.PARAMETERS
            if x.group == group
        ]
        header = ["parameter", "value", "unit", "meaning", "sensible", "source"]
        text += ["", f"## {titles.get(group, group)}", "", table(header, rows)]
    return "\n".join(text) + "\n"


def _range(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:g} to {bounds[1]:g}"


def vehicles() -> str:
    """The table of vehicle classes and drivers."""
    path = Path(__file__).resolve().parents[2] / "experiments" / "vehicle_table.py"
    spec = importlib.util.spec_from_file_location("vehicle_table", path)
    assert spec is not None and spec.loader is not None
    vehicle_table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(vehicle_table)
    return re.sub(r"^Written by .*\n+", "", vehicle_table.table(), flags=re.M)


# --- questions ---------------------------------------------------------------------------------------


def questions(folder: Path) -> str:
    """All questions, each a link to its page."""
    text = ["# Questions", ""]
    for path in sorted(folder.glob("*.md")):
        title = path.read_text(encoding="utf-8").split("\n")[0].removeprefix("# ")
        text.append(f"- [{title}]({path.name})")
    return "\n".join(text) + "\n"
