"""Car-following models on recorded followers, beside the literature and other optimisers.

    python experiments/calibration.py [--data NAME ...] [--models idm ...]
        [--folder ../shared/data/trajectories]

Writes experiments/results/calibration.json and .md; with `--data` or `--models` only these rows are measured
anew (ngsim, tgsim, openacc-human, openacc-acc, us101, synthetic, methods).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from differential_evolution import fit_by_evolution
from scipy.optimize import differential_evolution

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.fit import METHODS, MODELS, errors, fit, stack
from limsim_jax.calibration.parameters import BOX, PARAMETERS
from limsim_jax.calibration.report import PUBLISHED, calibrate, gather
from limsim_jax.calibration.synthetic import drivers, follow
from limsim_jax.calibration.uncertainty import uncertainty
from limsim_jax.files import write_whole
from limsim_jax.xla import enable_compilation_cache

RESULTS = Path(__file__).parent / "results"
SOURCES = {
    "ngsim": ("ngsim_i80_*_pairs.csv.gz", "NGSIM I-80, human", 20.0),
    "tgsim": ("tgsim_pairs_*.csv.gz", "TGSIM, human", 20.0),
    "openacc-human": ("openacc_*_no_ACC_*.csv.gz", "OpenACC, human", 20.0),
    "openacc-acc": ("openacc_*.csv.gz", "OpenACC, ACC", 20.0),
    "us101": ("commonroad/USA_US101-*.xml.gz", "CommonRoad scenes of US-101, human", 6.0),
}
COMPARED = 24  # drivers of the first data set that all methods are compared on
SAMPLED = 3  # drivers that SciPy's differential evolution is timed on


def files(folder: Path, name: str) -> list[Path]:
    """Recordings of a data set."""
    found = sorted(folder.glob(SOURCES[name][0]))
    # Of the ACC recordings one is twelve minutes of three cars: all others would be padded to it.
    human_or_long = ("no_ACC", "part10")
    return [p for p in found if name != "openacc-acc" or not any(word in p.name for word in human_or_long)]


def timed(segments: list[Segment], model: str, method: str) -> tuple[Any, float]:
    """A fit and its seconds without compilation: the second of two, the first of one generation if long."""
    if method == "de":
        fit_by_evolution(segments, MODELS[model], generations=1)
        found = fit_by_evolution(segments, MODELS[model])
    else:
        fit(segments, MODELS[model], method=method)
        found = fit(segments, MODELS[model], method=method)
    return found, found.seconds


def scipy_de(segments: list[Segment], model: str, count: int) -> tuple[np.ndarray, float]:
    """Errors and seconds per driver of SciPy's differential evolution."""
    _, data, dt = stack(segments)
    one = jax.tree.map(lambda x: jnp.asarray(x[0]), data)

    @jax.jit
    def costs(parameters: jax.Array, data: Any) -> jax.Array:
        same = jax.tree.map(lambda x: jnp.broadcast_to(x, (parameters.shape[0], *x.shape)), data)
        return errors(MODELS[model], parameters, same, dt)["mixed"]

    costs(jnp.zeros((15 * len(PARAMETERS), len(PARAMETERS))) + 1, one).block_until_ready()
    found, begin = [], time.perf_counter()
    for i in range(count):
        data_i = jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), data)

        def cost(x: np.ndarray, data: Any = data_i) -> np.ndarray:
            return np.asarray(costs(jnp.asarray(x.T, jnp.float32), data), float)

        result = differential_evolution(
            cost,
            list(zip(*BOX, strict=True)),
            maxiter=100,
            vectorized=True,
            updating="deferred",
            polish=False,
            rng=i,
        )
        found.append(result.fun)
    return np.asarray(found), (time.perf_counter() - begin) / count


def data_set(folder: Path, name: str, models: Sequence[str], before: dict[str, Any]) -> dict[str, Any]:
    """Some models on one data set; others as they were measured before."""
    paths, shortest = files(folder, name), SOURCES[name][2]
    if not paths:
        raise SystemExit(f"{folder}: no file {SOURCES[name][0]}; --folder names the folder of the recordings")
    segments, quality = gather(paths, shortest=shortest)
    rows = dict(before.get("models", {}))
    for model in models:
        result = calibrate(paths, model=MODELS[model], shortest=shortest)
        lm, lm_seconds = timed(segments, model, "lm")
        de, de_seconds = timed(segments, model, "de")
        few, each = scipy_de(segments, model, SAMPLED)
        ratio = lm.error / de.error
        summary = result.as_json()
        rows[model] = {
            "errors": summary["errors"],
            "collisions": summary["collisions"],
            "population": summary["population"],
            "gap_rmse": float(np.median(errors_of(lm, segments)["gap"])),
            "lm_seconds": lm_seconds,
            "de_seconds": de_seconds,
            "scipy_seconds_per_driver": each,
            "worst_ratio": float(ratio.max()),
            "lm_worse": int((ratio > 1.01).sum()),
            "de_worse": int((ratio < 0.99).sum()),
            "scipy_worst_ratio": float((lm.error[:SAMPLED] / few).max()),
        }
        print(
            name, model, json.dumps({k: v for k, v in rows[model].items() if k != "population"}), flush=True
        )
    return {
        "title": SOURCES[name][1],
        "drivers": len({segment.driver for segment in segments}),
        "seconds": sum(segment.duration for segment in segments),
        "files": [q.as_json() | {"source": Path(q.source).name} for q in quality],
        "models": {model: rows[model] for model in MODELS if model in rows},
    }


def errors_of(found: Any, segments: list[Segment]) -> dict[str, np.ndarray]:
    """Objectives of a fit."""
    _, data, dt = stack(segments)
    result = errors(found.model, jnp.asarray(found.parameters, jnp.float32), data, dt)
    return {name: np.asarray(values, float) for name, values in result.items()}


def synthetic(count: int = 200) -> dict[str, Any]:
    """Drivers that are known: how near the estimates come, and how often intervals hold them."""
    rng = np.random.default_rng(0)
    truth = drivers(count, 0.12, rng)
    segments = follow(truth, rng)
    found = fit(segments, objective="gap")
    known = uncertainty(found, segments)
    off = np.abs(found.parameters / truth - 1)
    inside = (known.interval[:, 0] <= truth) & (truth <= known.interval[:, 1])
    row = {
        name: {
            "median_error": float(np.median(off[:, k])),
            "bias": float(np.median(found.parameters[:, k] / truth[:, k] - 1)),
            "standard_error": float(np.median(known.standard_error[:, k] / truth[:, k])),
            "coverage": float(inside[:, k].mean()),
        }
        for k, name in enumerate(PARAMETERS)
    }
    print("synthetic", json.dumps(row), flush=True)
    return {"drivers": count, "parameters": row}


def methods(folder: Path) -> dict[str, Any]:
    """All methods on one data set, IDM."""
    segments = gather(files(folder, "ngsim"))[0][:COMPARED]
    rows, best = {}, None
    for method in (*METHODS, "de"):
        found, seconds = timed(segments, "idm", method)
        best = found.error if best is None else np.minimum(best, found.error)
        rows[method] = {"seconds": seconds, "errors": found.error.tolist()}
        print(method, seconds, float(np.median(found.error)), flush=True)
    for row in rows.values():
        ratio = np.asarray(row.pop("errors")) / best
        row |= {"within_1_percent": int((ratio <= 1.01).sum()), "worst": float(ratio.max())}
    return {"drivers": len(best) if best is not None else 0, "methods": rows}


def table(found: dict[str, Any]) -> str:
    """Markdown."""
    low, high = PUBLISHED
    lines = [
        f"Errors are of the mixed objective, median over drivers; published for calibrated models: {low:.0%} "
        f"to {high:.0%} (Kesting, Treiber 2008). Calibration: fit to the first 60 % of every driver's time; "
        "validation: in the rest; shrunk: posterior mode under the population of all drivers, in the rest; "
        "others: median driver of the other half of the drivers, all the time.",
        "",
        "| data | model | drivers | s | calibration | validation | shrunk | others | gap RMSE, all data, m |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    sets = [found[name] for name in SOURCES if name in found]
    for one in sets:
        for model, row in one["models"].items():
            middle = {name: part["mixed"]["median"] for name, part in row["errors"].items()}
            lines.append(
                f"| {one['title']} | {model} | {one['drivers']} | {one['seconds']:.0f} "
                f"| {middle['calibration']:.1%} | {middle['validation']:.1%} "
                f"| {middle['validation_shrunk']:.1%} "
                f"| {middle['median_of_others']:.1%} | {row['gap_rmse']:.2f} |"
            )
    lines += [
        "",
        "Levenberg-Marquardt (lm) beside differential evolution (de; 75 members, 100 generations) on the "
        f"same data and objective, without compilation; SciPy's, vectorized, on {SAMPLED} drivers.",
        "",
        "| data | model | drivers | lm, s | de, s | de / lm | SciPy de, s per driver | all drivers / lm "
        "| lm worse by > 1 % | de worse by > 1 % | worst lm / de |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for one in sets:
        for model, row in one["models"].items():
            scipy_all = row["scipy_seconds_per_driver"] * one["drivers"] / row["lm_seconds"]
            lines.append(
                f"| {one['title']} | {model} | {one['drivers']} | {row['lm_seconds']:.2f} "
                f"| {row['de_seconds']:.1f} | {row['de_seconds'] / row['lm_seconds']:.1f} "
                f"| {row['scipy_seconds_per_driver']:.2f} "
                f"| {scipy_all:.0f} | {row['lm_worse']} | {row['de_worse']} | {row['worst_ratio']:.4f} |"
            )
    if "methods" in found:
        lines += [
            "",
            f"Methods on {SOURCES['ngsim'][1]}, IDM, {found['methods']['drivers']} drivers, without "
            "compilation.",
            "",
            "| method | s | drivers within 1 % of the best | worst |",
            "|---|---:|---:|---:|",
        ]
        for name, row in found["methods"]["methods"].items():
            lines.append(
                f"| {name} | {row['seconds']:.1f} | {row['within_1_percent']} | {row['worst']:.3f} |"
            )
    if "synthetic" in found:
        lines += [
            "",
            f"{found['synthetic']['drivers']} made-up IDM drivers, 90 s each with a stop, error of the gap "
            "0.3 m, AR(1) with 0.95 per sample.",
            "",
            "| parameter | median error | bias | standard error | coverage of 95 % intervals |",
            "|---|---:|---:|---:|---:|",
        ]
        for name, row in found["synthetic"]["parameters"].items():
            lines.append(
                f"| {name} | {row['median_error']:.1%} | {row['bias']:+.1%} | {row['standard_error']:.1%} "
                f"| {row['coverage']:.0%} |"
            )
    lines += ["", "Population of all data: median, and factor of one standard deviation.", ""]
    lines += [
        "| data | model | v0, m/s | T, s | s0, m | a, m/s^2 | b, m/s^2 | residual acceleration, m/s^2, s "
        "| gaps within predicted 50 %, 90 % |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for one in sets:
        for model, row in one["models"].items():
            law = row["population"]
            values = " | ".join(
                f"{law['median'][name]:.2f} x/ {np.exp(law['spread'][name]):.2f}" for name in PARAMETERS
            )
            noise, check = law["residual_acceleration"], law["predictive_check"]
            lines.append(
                f"| {one['title']} | {model} | {values} | {noise['sigma']:.2f}, {noise['tau']:.1f} "
                f"| {check['inside_50']:.0%}, {check['inside_90']:.0%} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", nargs="*", choices=[*SOURCES, "synthetic", "methods"])
    parser.add_argument("--models", nargs="*", choices=[*MODELS], default=[*MODELS])
    parser.add_argument("--folder", type=Path, default=Path("../shared/data/trajectories"))
    options = parser.parse_args()
    enable_compilation_cache()
    path = RESULTS / "calibration.json"
    partly = options.data or options.models != [*MODELS]
    found = json.loads(path.read_text()) if partly and path.exists() else {}
    for name in options.data or [*SOURCES, "synthetic", "methods"]:
        if name == "synthetic":
            found[name] = synthetic()
        elif name == "methods":
            found[name] = methods(options.folder)
        else:
            found[name] = data_set(options.folder, name, options.models, found.get(name, {}))
        RESULTS.mkdir(exist_ok=True)
        head = "Regenerate: `python experiments/calibration.py`\n\n"
        write_whole(path, json.dumps(found, indent=1) + "\n")
        write_whole(RESULTS / "calibration.md", head + table(found) + "\n")


if __name__ == "__main__":
    main()
