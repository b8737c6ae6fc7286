"""Tables of the parameters of vehicles, drivers and behaviour.

With units and sources.

    python experiments/vehicle_table.py

Writes experiments/results/vehicle_parameters.md and behaviour_parameters.md.
"""

from __future__ import annotations

import math
from pathlib import Path

from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.traffic.parameters import PARAMETERS
from limsim_jax.traffic.vehicles import CUT, DEFAULTS, HIGHWAY, NORMAL, URBAN, Parameter

RESULTS = Path(__file__).parent / "results"

HEAD = f"""# Vehicles and drivers

Written by `python experiments/vehicle_table.py` from `limsim_jax/traffic/vehicles.py`.

Every class of vehicle stands with its median and, in brackets, the spread: the standard deviation of the
logarithm of a log-normal distribution ({" and ".join(f"`{name}`" for name in NORMAL)}: of a normal one).
Distributions end {CUT:g} standard deviations from the median and at the bounds. The correlation is that
of the parameter's normal score with the aggressiveness of the driver (sizes: with the size of the
vehicle). Parameters without a spread are the same for all. Where a source has one number, or one for cars
and one for trucks, the other classes, all spreads and all correlations are choices of this project.
`vType` names the attribute of a SUMO vehicle type that replaces the default.
"""


BEHAVIOUR = """# Behaviour

Written by `python experiments/vehicle_table.py` from `limsim_jax/traffic/parameters.py`.

These numbers are the same for all vehicles. Those of drivers and bodies are in `vehicle_parameters.md`.
"Chosen" marks a choice of this project.
"""

GROUPS = {"JUNCTIONS": "Junctions", "LANE_CHANGES": "Lane changes", "DRIVING": "Driving"}


def table() -> str:
    """The page, as Markdown."""
    columns = ["parameter", "meaning", "unit", *VEHICLE_CLASSES, "correlation", "bounds", "vType", "source"]
    rows = [columns, ["---"] * len(columns)]
    for label, shares in (("urban", URBAN), ("highway", HIGHWAY)):
        cells = [f"{shares[name]:g}" for name in VEHICLE_CLASSES]
        source = "choice of this project"
        rows.append([f"share, {label}", "of all vehicles", "1", *cells, "", "", "`probability`", source])
    rows += [_row(name, parameter) for name, parameter in DEFAULTS.items()]
    return "\n".join([HEAD, *("| " + " | ".join(row) + " |" for row in rows), ""])


def _row(name: str, parameter: Parameter) -> list[str]:
    spreads = parameter.spread
    if not isinstance(spreads, tuple):
        spreads = (spreads,) * len(VEHICLE_CLASSES)
    cells = [
        f"{median:g}" + (f" ({spread:g})" if spread else "")
        for median, spread in zip(parameter.median, spreads, strict=True)
    ]
    low, high = parameter.bounds
    bounds = "" if math.isinf(high) else f"{low:g} to {high:g}"
    correlation = f"{parameter.loading:+g}" if parameter.loading else ""
    attribute = ", ".join(f"`{word}`" for word in parameter.vtype.split(", ") if word)
    unit = parameter.unit.replace("^2", "²")
    return [f"`{name}`", parameter.meaning, unit, *cells, correlation, bounds, attribute, parameter.source]


def behaviour_table() -> str:
    """The page of the behaviour model, as Markdown."""
    lines = [BEHAVIOUR]
    for group, title in GROUPS.items():
        lines += [f"## {title}", "", "| parameter | meaning | value | unit | range | source |"]
        lines.append("|---|---|---:|---|---|---|")
        for x in PARAMETERS:
            if x.group == group:
                low, high = x.bounds
                unit = x.unit.replace("^2", "²")
                cells = f"`{x.name}`", x.meaning, f"{x.value:g}", unit, f"{low:g} to {high:g}", x.source
                lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def pages() -> dict[str, str]:
    """All pages by the names of their files."""
    return {"vehicle_parameters": table(), "behaviour_parameters": behaviour_table()}


if __name__ == "__main__":
    RESULTS.mkdir(exist_ok=True)
    for name, page in pages().items():
        (RESULTS / f"{name}.md").write_text(page, encoding="utf-8")
        print(f"wrote {RESULTS / name}.md")
