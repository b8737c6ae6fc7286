"""Rare events: what samplers find, how far one run errs, what it costs.

    python experiments/rare_events.py                    events with a closed form: a minute
    python experiments/rare_events.py --quick            fewer repetitions
    python experiments/rare_events.py --worlds [--full]  contacts in worlds, sampled and counted

Writes experiments/results/rare_events.json and .md, or rare_worlds.json and .md; without `--full`
rare_worlds_work. Worlds that ran lie in results/rare_worlds, and the command goes on from there.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from limsim_jax.rare_events import rare_event

RESULTS = Path(__file__).parent / "results"
REPEATS = 30
"""Runs of a row."""

COVERAGE = 400
"""Intervals of which the share that holds the truth is counted."""

Limit = Callable[[Any], Any]


def linear(p: float) -> Limit:
    """A half-space of probability `p`."""
    beta = -float(norm.ppf(p))
    return lambda z: beta - z.sum(-1) / math.sqrt(z.shape[-1])


def two_regions(z: Any) -> Any:
    """Two opposite half-spaces, four standard deviations away."""
    return 4 - np.abs(z.sum(-1)) / math.sqrt(z.shape[-1])


def braking_leader(p: float) -> Limit:
    """Least gap (m) behind a leader that brakes at a log-normal rate.

    Both drive 25 m/s, 22 m apart; the follower brakes at 8 m/s^2 from half a second on. They touch where the
    leader brakes harder than `25^2 / (2 (25 * 0.5 + 25^2 / 16 - 22))` m/s^2, which has probability `p`.
    """
    v, delay, brake, gap = 25.0, 0.5, 8.0, 22.0
    worst = v * v / (2 * (v * delay + v * v / (2 * brake) - gap))
    median = worst * math.exp(0.3 * float(norm.ppf(p)))

    def way(t: float, rate: Any) -> Any:
        """m driven after `t` s of braking."""
        braked = np.clip(t, 0, v / rate)
        return v * braked - rate * braked**2 / 2

    def least_gap(z: Any) -> Any:
        rate = median * np.exp(0.3 * z[:, 0])
        times = np.arange(0, 12, 0.05)
        own = [v * min(t, delay) + way(t - delay, brake) for t in times]
        return np.min([gap + way(t, rate) - x for t, x in zip(times, own, strict=True)], 0)

    return least_gap


def rows() -> list[tuple[str, Limit, int, float, str, int]]:
    """Name, limit state, dimensions, exact probability, method, points per level."""
    found: list[tuple[str, Limit, int, float, str, int]] = []
    for p in (1e-2, 1e-4, 1e-6):
        found += [("one region", linear(p), dim, p, "subset", 1000) for dim in (2, 100)]
    found += [("braking leader", braking_leader(p), 5, p, "subset", 1000) for p in (1e-2, 1e-4, 1e-6)]
    found += [("two opposite regions", two_regions, 100, 2 * float(norm.cdf(-4)), "subset", 1000)]
    found += [("one region", linear(1e-6), 100, 1e-6, "subset", 4000)]
    return found + [("one region", linear(p), 10, p, "cross-entropy", 1000) for p in (1e-4, 1e-6)]


def measure(
    name: str, f: Limit, dim: int, p: float, method: Any, samples: int, repeats: int
) -> dict[str, Any]:
    """Mean and spread of single runs, and the price of plain counting."""
    found = rare_event(f, dim, method=method, samples=samples, runs=repeats)
    mean, spread = float(found.runs.mean()), float(found.runs.std(ddof=1))
    variation = spread / mean
    return {
        "event": name,
        "method": method,
        "dimensions": dim,
        "samples": samples,
        "exact": p,
        "mean": mean,
        "variation": variation,
        "calls": found.calls / repeats,
        "crude_calls": (1 - p) / (p * variation**2),
        "interval": [found.probability.low, found.probability.high],
    }


def coverage(method: Any, p: float, dim: int, repeats: int) -> dict[str, Any]:
    """How often a 95 % interval of ten runs holds the truth."""
    held = 0
    for seed in range(repeats):
        found = rare_event(linear(p), dim, method=method, samples=500, seed=seed).probability
        held += found.low <= p <= found.high
    return {"method": method, "exact": p, "dimensions": dim, "intervals": repeats, "held": held / repeats}


def text(result: dict[str, Any]) -> str:
    """The tables in Markdown."""
    lines = [
        "# Rare events",
        "",
        "Regenerate: `python experiments/rare_events.py`",
        "",
        f"{result['repeats']} runs per row. Variation is the standard deviation of one run over its mean. "
        "The last column is what plain counting needs for the same variation.",
        "",
        "| event | method | dimensions | points per level | exact | mean | variation of a run "
        "| calls of a run | calls of plain counting |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in result["rows"]:
        lines.append(
            f"| {row['event']} | {row['method']} | {row['dimensions']} | {row['samples']:,} "
            f"| {row['exact']:.2e} | {row['mean']:.2e} | {row['variation']:.2f} "
            f"| {row['calls']:,.0f} | {row['crude_calls']:.1e} |"
        )
    lines += [
        "",
        "## Intervals",
        "",
        "How often a 95 % interval of ten runs, with 500 points per level, holds the truth:",
        "",
        "| method | probability | dimensions | intervals | held |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in result["coverage"]:
        lines.append(
            f"| {row['method']} | {row['exact']:.0e} | {row['dimensions']} | {row['intervals']} "
            f"| {100 * row['held']:.1f} % |"
        )
    return "\n".join(lines) + "\n"


WORLDS = (
    ("ramp", "end_to_end", "fault", 1_500, 2_000),
    ("roundabout", "pdm_closed", "contact", 4_000, 10_000),
    ("highway", "pdm_closed", "fault", 1_500, 1_500),
    ("highway", "limsim_tm", "fault", 1_100, 400),
)
"""Scenario, policy, event, worlds for subset simulation, and for counting.

Without `--full` it is a tenth of them; subset simulation has at least `LEAST`."""


LEAST = 1_100
"""Worlds that subset simulation needs down to 1e-4."""


def worlds(full: bool) -> None:
    """Write probabilities in worlds, as they are done.

    By subset simulation, and by counting other worlds.
    """
    import limsim_jax as lj

    found, name = [], "rare_worlds" if full else "rare_worlds_work"
    for scenario, policy, event, sampled, counted in WORLDS:
        methods: tuple[tuple[Any, int, int], ...] = (("subset", sampled, 0), ("crude", counted, 1))
        for method, budget, seed in methods:
            budget = budget if full else max(budget // 10, LEAST if method == "subset" else 100)
            out = Path("results") / "rare_worlds" / f"{scenario}-{policy}-{event}-{method}-{budget}"
            one = lj.estimate(
                scenario, event, policy=policy, method=method, worlds=budget, seed=seed, out=out
            )  # fmt: skip
            found.append(one.as_json())
            write(name, {"rows": found}, worlds_text({"rows": found}))


def _round(x: float) -> str:
    return f"{x:,.0f}" if x >= 100 else f"{x:.2g}"


def worlds_text(result: dict[str, Any]) -> str:
    """The table of worlds in Markdown."""
    lines = [
        "# Rare events in worlds",
        "",
        "Regenerate: `python experiments/rare_events.py --worlds --full`",
        "",
        "| scenario | policy | event | method | worlds | per episode | per hour | per million km |",
        "|---|---|---|---|---:|---:|---:|---:|",
    ]
    for row in result["rows"]:
        cells = []
        for name in ("per_episode", "per_hour", "per_million_km"):
            x = row[name]
            best, low, high = (_round(x[k]) for k in ("estimate", "low", "high"))
            cells.append(f"{best} [{low}, {high}]" if x["estimate"] else f"below {high}")
        lines.append(
            f"| {row['scenario']} | {row['policy']} | {row['event']} | {row['method']} | {row['worlds']:,} "
            f"| {' | '.join(cells)} |"
        )
    return "\n".join(lines) + "\n"


def write(name: str, result: dict[str, Any], said: str) -> None:
    """Write figures and their table."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (RESULTS / f"{name}.md").write_text(said, encoding="utf-8")
    print(said)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--worlds", action="store_true", help="contacts in worlds")
    parser.add_argument("--full", action="store_true", help="as many worlds as the published table")
    options = parser.parse_args()
    if options.worlds:
        return worlds(options.full)
    quick = options.quick
    repeats, intervals = (10, 20) if quick else (REPEATS, COVERAGE)
    result = {
        "repeats": repeats,
        "rows": [measure(*row, repeats) for row in rows()],
        "coverage": [
            coverage(method, p, dim, intervals)
            for method, p, dim in (
                ("auto", 1e-2, 2),
                ("subset", 1e-3, 2),
                ("subset", 1e-3, 20),
                ("subset", 1e-5, 2),
                ("cross-entropy", 1e-3, 10),
            )
        ],
    }
    write("rare_events", result, text(result))


if __name__ == "__main__":
    main()
