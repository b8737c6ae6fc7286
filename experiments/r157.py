"""The public scenarios of UN R157 with their variations: passed, collided, preventable, by policy.

    python experiments/r157.py [--variants 20] [--policies r157_careful,pdm_closed] [--files cut_in,cut_out]
    python experiments/r157.py --full --out DIR

Each file has so many of its variants, evenly spread; `--full`: all of them. `--files`: those with one of
these words in their names. A collision is preventable if the careful driver of the regulation has none in the
same variant; it is always run. `--out DIR` keeps the worlds, and the same command goes on where it was
stopped; `limsim-jax report DIR` draws where variants pass. Rows of other files and policies stay. Writes
experiments/results/r157.json and .md. Needs shared data.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from limsim_jax.files import write_whole
from limsim_jax.scenarios.openscenario.episodes import ScenarioEpisodes, episodes_of
from limsim_jax.scenarios.openscenario.outcome import CAREFUL, outcome
from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.sweeps import runner
from limsim_jax.sweeps.store import Results, open_results
from limsim_jax.xla import use_all_cores

RESULTS = Path(__file__).parent / "results"
DATA = Path(os.environ.get("LIMSIM_SHARED_DATA", "shared/data")) / "openscenario/alks/logical_scenarios"
POLICIES = ("r157_aeb", "r157_regulation", "r157_fsm", "r157_rss", "pdm_closed")
VARIANTS = 20
CHUNK = 50
"""Worlds per call; with few variants, those of a map in many files."""
TIMES = "times.json"

HEAD = (
    "| scenario | policy | variants | passed | collided | preventable | CPU ms per variant "
    "| in all | CPU h for all |",
    "|---|---|---:|---:|---:|---:|---:|---:|---:|",
)


def title(file: Path) -> str:
    """`alks_scenario_4_4_1_cut_in_no_collision_variation` as "4.4.1 cut in no collision"."""
    found = re.fullmatch(r"(?:alks_scenario_)?(\d)_(\d)_(\d)_(.*)", file.stem)
    if found is None:
        return file.stem
    words = found[4].replace("_variation", "").replace("_", " ")
    return f"{found[1]}.{found[2]}.{found[3]} {words}"


def run(one: ScenarioEpisodes, folder: Path) -> dict[str, float]:
    """Run those variants of a file on one map that are missing.

    Returns:
      Processor time to compile and to run, s, and how many worlds; empty if all are on disk.
    """
    marks: dict[str, float] = {}

    def tell(now: runner.Progress) -> None:
        marks.setdefault(now.stage, time.process_time())

    summary = runner.sweep([one], range(len(one.which)), folder, progress=tell)
    worlds = sum(x.ran for x in summary.parts)
    if not worlds:
        return {}
    compiled, end = marks["running"], marks["finished"]
    return {"compile": compiled - marks["compiling"], "run": end - compiled, "worlds": worlds}


def rows(results: Results, times: dict[str, dict[str, float]], files: Sequence[Path]) -> list[dict[str, Any]]:
    """A row for each file and policy."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    totals = {str(x.absolute()): len(openscenario(x)) for x in files}
    for tally in outcome(results):
        about = results.provenance[tally.scenario, tally.policy]
        file = about["openscenario_file"]
        if file not in totals:
            continue
        row = found.setdefault(
            (file, tally.policy),
            {"scenario": title(Path(file)), "policy": tally.policy, "all": totals[file]}
            | dict.fromkeys(("variants", "passed", "collided", "preventable"), 0)
            | {"seconds": 0.0, "worlds": 0, "compile": 0.0},
        )
        for name in ("variants", "passed", "collided", "preventable"):
            row[name] += getattr(tally, name) or 0
        spent = times.get(f"{tally.scenario}/{tally.policy}", {})
        row["seconds"] += spent.get("run", 0.0)
        row["worlds"] += int(spent.get("worlds", 0))
        row["compile"] += spent.get("compile", 0.0)
    return list(found.values())


def hours(row: dict[str, Any]) -> float:
    """Processor time for all variants of a file, h, compiling included."""
    each = row["seconds"] / row["worlds"] if row["worlds"] else 0.0
    return (each * row["all"] + row["compile"]) / 3600


def markdown(table: dict[str, Any]) -> str:
    """The table, and what it adds up to."""
    lines = [f"Regenerate: `{table['command']}`. {table['machine']}.", "", *HEAD]
    for row in table["rows"]:
        each = f"{1e3 * row['seconds'] / row['worlds']:,.0f}" if row["worlds"] else ""
        lines.append(
            f"| {row['scenario']} | {row['policy']} | {row['variants']:,} | {row['passed']:,} "
            f"| {row['collided']:,} | {row['preventable']:,} | {each} | {row['all']:,} "
            f"| {f'{hours(row):.2f}' if row['worlds'] else ''} |"
        )
    lines.append("")
    for policy in dict.fromkeys(row["policy"] for row in table["rows"]):
        mine = [row for row in table["rows"] if row["policy"] == policy]
        count, passed, collided, prevented = (
            sum(row[x] for row in mine) for x in ("variants", "passed", "collided", "preventable")
        )
        every = f"all {sum(row['all'] for row in mine):,} in {sum(map(hours, mine)):.1f} CPU h"
        lines.append(
            f"- {policy}: files {len(mine)}, {passed:,} of {count:,} variants passed, {collided:,} collided, "
            f"{prevented:,} of these preventable"
            + (f"; {every}" if all(row["worlds"] for row in mine) else "")
        )
    return "\n".join(lines) + "\n"


def written(new: list[dict[str, Any]], command: str) -> None:
    """Write the table; rows of other files and policies stay."""
    path = RESULTS / "r157.json"
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    kept = {(row["scenario"], row["policy"]): row for row in [*old, *new]}
    order = {name: k for k, name in enumerate((CAREFUL, *POLICIES))}
    table = {
        "command": command,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "rows": sorted(kept.values(), key=lambda x: (x["scenario"], order.get(x["policy"], 99))),
    }
    write_whole(path, json.dumps(table, indent=1) + "\n")
    write_whole(RESULTS / "r157.md", markdown(table))


def main() -> None:
    """Run all files with all policies, and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=DATA, help="of the files of distributions")
    parser.add_argument("--variants", type=int, default=VARIANTS, help="of each file")
    parser.add_argument("--full", action="store_true", help="all variants")
    parser.add_argument("--policies", default=",".join(POLICIES))
    parser.add_argument("--files", default="", help="words, with commas between")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    use_all_cores()
    words = options.files.split(",")
    files = [x for x in sorted(options.folder.glob("*.xosc")) if any(word in x.stem for word in words)]
    if not files:
        raise SystemExit(f"{options.folder}: no .xosc with {options.files or 'any name'}")
    out = Path(tempfile.mkdtemp()) if options.out is None else options.out
    variants = None if options.full else options.variants
    told = "--full" if options.full else f"--variants {variants}"
    chunk = CHUNK if variants is None else min(CHUNK, max(1, variants // 5))
    policies = [CAREFUL, *(x for x in options.policies.split(",") if x and x != CAREFUL)]
    out.mkdir(parents=True, exist_ok=True)
    times = json.loads((out / TIMES).read_text()) if (out / TIMES).exists() else {}
    for file in files:
        for policy in policies:
            for one in episodes_of(openscenario(file), policy, variants=variants, chunk=chunk):
                spent = run(one, out)
                if spent:
                    times[f"{one.scenario}/{policy}"] = spent
                    write_whole(out / TIMES, json.dumps(times, indent=1) + "\n")
                print(f"{one.scenario} {policy}: {spent}", flush=True)
            written(rows(open_results(out), times, files), f"python experiments/r157.py {told}")
    print((RESULTS / "r157.md").read_text())


if __name__ == "__main__":
    main()
