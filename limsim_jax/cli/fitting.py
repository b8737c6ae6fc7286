"""Commands that fit something to data: drivers to recordings, networks to rollouts."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from limsim_jax.files import check_writable


def add_commands(app: typer.Typer) -> None:
    """Add `calibrate` and `train`."""
    app.command()(calibrate)
    app.command()(train)


def calibrate(
    data: Annotated[list[Path], typer.Argument(metavar="DATA...", help="Recordings of vehicles.")],
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="FIELD=COLUMN,...",
            help="Of a CSV or Parquet table of one's own, such as time=t,x_lead=leader,x=follower. Fields: "
            "time; x, x_lead (positions) or gap; v, v_lead; length_lead; id, id_lead.",
        ),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(metavar="FIELD=UNIT,...", help="Of such a table, if not s, m, m/s: x=ft,v=km/h."),
    ] = None,
    length: Annotated[float | None, typer.Option(help="Of the leaders in such a table, m.")] = None,
    model: Annotated[Literal["idm", "iidm", "acc"], typer.Option(help="Car-following model.")] = "idm",
    objective: Annotated[
        Literal["gap", "speed", "mixed", "log", "relative", "absolute"],
        typer.Option(help="What to make least."),
    ] = "mixed",
    method: Annotated[
        Literal["lm", "lbfgs", "adam"], typer.Option(help="Optimiser; lm: Levenberg-Marquardt.")
    ] = "lm",
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="PARAMETER=LOW:HIGH,...",
            help="Of fitted parameters, such as v0=5:60,T=0.1:4; v0 in m/s, T in s, s0 in m, a and b in "
            "m/s^2. Default: v0=5:45,T=0.3:4,s0=0.5:8,a=0.3:4,b=0.5:5.",
        ),
    ] = None,
    shortest: Annotated[float, typer.Option(help="Leave out what is shorter, s.")] = 20.0,
    tolerated: Annotated[
        float, typer.Option(help="Share of the rows that may have a leader behind or an overlap.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(help="Of all that is random.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Write the population of drivers here, for [traffic] drivers = FILE.")
    ] = None,
    speed_limit: Annotated[
        float | None, typer.Option(help="Of the recorded road, m/s; relates desired speeds to limits.")
    ] = None,
    closed_loop: Annotated[
        bool,
        typer.Option(
            "--closed-loop",
            help="Then adjust the population until followers simulated behind one another are distributed "
            "as recorded.",
        ),
    ] = False,
    period: Annotated[float, typer.Option(help="Closed loop: s of recording simulated at a time.")] = 60.0,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.")
    ] = None,
) -> None:
    """Fit car following to recorded drivers: errors, uncertainty and their population.

    limsim-jax calibrate pairs.csv --columns time=t,x_lead=leader,x=follower --length 4.5
    """
    import json

    from limsim_jax.calibration.closed_loop import (
        SPEED_LIMIT,
        calibrate_closed_loop,
        hold_out,
        linked_recordings,
        single_fits,
    )
    from limsim_jax.calibration.fit import MODELS
    from limsim_jax.calibration.parameters import Box
    from limsim_jax.calibration.population import FEW
    from limsim_jax.calibration.report import calibrate as fit
    from limsim_jax.calibration.report import gather
    from limsim_jax.files import write_whole
    from limsim_jax.recordings import read_recordings
    from limsim_jax.xla import enable_compilation_cache

    check_writable(out, json_file)
    if not 10 <= period < float("inf"):
        raise typer.BadParameter(f"{period:g} s; at least 10", param_hint="--period")
    within = _ranges(bounds, "--bounds")
    Box.of(within)  # refuses what is impossible before the data are read
    enable_compilation_cache()
    recordings = read_recordings(
        data,
        columns=_pairs(columns, "--columns"),
        units=_pairs(units, "--units"),
        length=length,
        tolerated=tolerated,
    )
    linked = linked_recordings(recordings, period=period) if closed_loop else None
    if linked is not None:
        hold_out(linked)  # refuses what has one period only, before anything is fitted
    driven = MODELS[model]
    found = fit(
        recordings,
        model=driven,
        objective=objective,
        method=method,
        shortest=shortest,
        bounds=within,
        seed=seed,
        speed_limit=speed_limit,
    )
    print(found.text())
    result, content = found, found.as_json()
    if linked is not None:
        if len(found.fit.drivers) < FEW:  # before the rest is fitted
            raise ValueError(f"a population from {len(found.fit.drivers)} drivers; at least {FEW} are needed")
        result = calibrate_closed_loop(
            linked,
            gather(recordings, shortest=shortest)[0],
            population=partial(
                single_fits,
                model=driven,
                objective=objective,
                method=method,
                starts=None,
                bounds=within,
                seed=seed,
            ),
            model=driven,
            speed_limit=speed_limit or SPEED_LIMIT,
            seed=seed,
        )
        print(f"\n{result.text()}")
        content["closed_loop"] = result.as_json()
    if out is not None:
        result.write_population(out, speed_limit=speed_limit)
        print(f"wrote {out}")
    if json_file is not None:
        write_whole(json_file, (json.dumps(content, indent=1) + "\n").encode())


def _pairs(text: str | None, option: str) -> dict[str, str] | None:
    """Names and values of `name=value,name=value`."""
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    for name, sign, value in pairs:
        if not (name.strip() and sign and value.strip()):
            raise typer.BadParameter(f"'{name}{sign}{value}'; FIELD=VALUE is expected", param_hint=option)
    return {name.strip(): value.strip() for name, _, value in pairs}


def _ranges(text: str | None, option: str) -> dict[str, tuple[float, float]] | None:
    """Names and ranges of `name=low:high,name=low:high`."""
    found = {}
    for name, value in (_pairs(text, option) or {}).items():
        low, _, high = value.partition(":")
        try:
            found[name] = (float(low), float(high))
        except ValueError:
            reason = f"'{name}={value}'; PARAMETER=LOW:HIGH is expected, such as T=0.1:4"
            raise typer.BadParameter(reason, param_hint=option) from None
    return found or None


def train(
    what: Annotated[Literal["pdm-hybrid", "end-to-end"], typer.Argument(help="What to train.")],
    out: Annotated[
        Path | None, typer.Option(help="Write the weights here.  [default: its name with .npz]")
    ] = None,
    seeds: Annotated[int, typer.Option(help="pdm-hybrid: worlds of each scenario to learn from.")] = 48,
    epochs: Annotated[int, typer.Option(help="pdm-hybrid: passes through the data.")] = 60,
    policy: Annotated[
        str, typer.Option(help="pdm-hybrid: drives in the worlds to learn from.")
    ] = "like_traffic",
    rounds: Annotated[int, typer.Option(help="end-to-end: rounds of DAgger after cloning the expert.")] = 2,
    worlds: Annotated[int, typer.Option(help="end-to-end: worlds of a scenario that run at once.")] = 32,
    minutes: Annotated[float, typer.Option(help="end-to-end: all of it, compiling included.")] = 18.0,
    scenarios: Annotated[
        str | None, typer.Option(help="end-to-end: names or files, by commas.  [default: the five]")
    ] = None,
    design: Annotated[
        Literal["whole", "camera"],
        typer.Option(help="end-to-end: camera has no LiDAR and no route, for `serve chat`."),
    ] = "whole",
) -> None:
    """Train a policy's network on rollouts of the bundled scenarios.

    Ctrl-C ends the training of end-to-end early; it writes the best weights so far.
    """
    from limsim_jax.xla import enable_compilation_cache, use_all_cores

    out = Path(f"{what.replace('-', '_')}.npz") if out is None else out
    check_writable(out)
    if seeds < 1:
        raise typer.BadParameter(f"{seeds} seeds; at least 1", param_hint="--seeds")
    use_all_cores()
    enable_compilation_cache()
    if what == "end-to-end":
        from limsim_jax.policies.end_to_end import network
        from limsim_jax.training import end_to_end

        made = network.CAMERA if design == "camera" else network.WHOLE
        names = end_to_end.SCENARIOS if scenarios is None else [x for x in scenarios.split(",") if x]
        tell = partial(print, flush=True)
        report = end_to_end.train(
            out, scenarios=names, rounds=rounds, worlds=worlds, minutes=minutes, design=made, tell=tell
        )
        print(report)
    else:
        from limsim_jax.training import train as fit

        print(fit(out, seeds=seeds, epochs=epochs, policy=policy, tell=print))
    print(f"wrote {out}")
