"""What reference drivers make of the scenario library: passed, collided, preventable, by driver.

    python experiments/library.py [--variants 20] [--policies r157_careful,like_traffic] [--names cut_in]

Each scenario has so many of its variants, evenly spread. `--names`: these only; rows of others stay. The
careful driver of UN R157 is always run: a collision is preventable if it has none in the same variant.
Writes experiments/results/library.json and .md, and limsim_jax/scenarios/library/outcomes.json, from which
`limsim-jax library` has its figures.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from limsim_jax.files import write_whole
from limsim_jax.scenarios.library.catalogue import OUTCOMES, Entry, entry, library
from limsim_jax.scenarios.openscenario.episodes import episodes_of
from limsim_jax.scenarios.openscenario.outcome import CAREFUL, outcome
from limsim_jax.sweeps import runner
from limsim_jax.sweeps.store import open_results
from limsim_jax.xla import use_all_cores

RESULTS = Path(__file__).parent / "results"
POLICIES = (CAREFUL, "like_traffic")
VARIANTS = 20
COUNTS = ("variants", "passed", "collided", "preventable")
SHORT = ("scenario", "policy", *COUNTS, "hash")
"""What the package has of a row."""

HEAD = (
    "| scenario | driver | variants | passed | collided | preventable | of |",
    "|---|---|---:|---:|---:|---:|---:|",
)


def run(one: Entry, policies: list[str], variants: int, folder: Path) -> list[dict[str, Any]]:
    """Rows of a scenario, one per driver."""
    scenarios = one.scenarios
    assert scenarios is not None
    for policy in policies:
        for episodes in episodes_of(scenarios, policy, variants=variants, chunk=variants):
            runner.sweep([episodes], range(len(episodes.which)), folder)
        print(f"{one.name} {policy}", flush=True)
    tallies = [x for x in outcome(open_results(folder)) if x.scenario == one.name]
    return [
        {"scenario": x.scenario, "policy": x.policy}
        | {name: getattr(x, name) or 0 for name in COUNTS}
        | {"of": len(scenarios), "hash": one.hash}
        for x in sorted(tallies, key=lambda x: policies.index(x.policy))
    ]


def markdown(table: dict[str, Any]) -> str:
    """The table, and what it adds up to."""
    lines = [f"Regenerate: `{table['command']}`.", "", *HEAD]
    for row in table["rows"]:
        counts = " | ".join(f"{row[name]:,}" for name in (*COUNTS, "of"))
        lines.append(f"| `{row['scenario']}` | `{row['policy']}` | {counts} |")
    lines.append("")
    for policy in dict.fromkeys(row["policy"] for row in table["rows"]):
        mine = [row for row in table["rows"] if row["policy"] == policy]
        count, passed, collided, prevented = (sum(row[x] for row in mine) for x in COUNTS)
        lines.append(
            f"- `{policy}`: {len(mine)} scenarios, {passed:,} of {count:,} variants passed, "
            f"{collided:,} collided, {prevented:,} of these preventable"
        )
    return "\n".join(lines) + "\n"


def written(new: list[dict[str, Any]], command: str) -> None:
    """Write the tables; rows of other scenarios and drivers stay."""
    path = RESULTS / "library.json"
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    kept = {(row["scenario"], row["policy"]): row for row in [*old, *new]}
    order = [one.name for one in library()]
    table = {
        "command": command,
        "rows": sorted(kept.values(), key=lambda x: (order.index(x["scenario"]), x["policy"] != CAREFUL)),
    }
    write_whole(path, json.dumps(table, indent=1) + "\n")
    write_whole(RESULTS / "library.md", markdown(table))
    short = [{name: row[name] for name in SHORT} for row in table["rows"]]
    write_whole(OUTCOMES, json.dumps({"command": command, "rows": short}, indent=1) + "\n")


def main() -> None:
    """Run all scenarios with all drivers, and write the tables after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--variants", type=int, default=VARIANTS, help="of each scenario")
    parser.add_argument("--policies", default=",".join(POLICIES))
    parser.add_argument("--names", default="", help="of scenarios, with commas between")
    options = parser.parse_args()
    use_all_cores()
    policies = [CAREFUL, *(x for x in options.policies.split(",") if x and x != CAREFUL)]
    names = [entry(x) for x in options.names.split(",")] if options.names else library()
    command = f"python experiments/library.py --variants {options.variants}"
    with tempfile.TemporaryDirectory() as folder:
        for one in names:
            if one.kind == "scenarios":
                written(run(one, policies, options.variants, Path(folder)), command)
    print((RESULTS / "library.md").read_text())


if __name__ == "__main__":
    main()
