"""Scenarios from instructions: the command `scenario`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(scenario)


def scenario(
    text: Annotated[
        str, typer.Argument(metavar="TEXT", help='What happens, as "a truck cuts in ahead of the ego".')
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Experiment to write.  [default: NAME.toml]")
    ] = None,
    map_file: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Where.  [default: a bundled map that fits]")
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=0, help="Worlds in which it is tried; 0: it is written without a trial.")
    ] = 10,
    severe: Annotated[
        bool,
        typer.Option(
            "--severity", help="Try it with other distances, and write the hardest without contacts."
        ),
    ] = False,
    server: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Ask a language model there, up to /v1.  [default: a fixed grammar]"
        ),
    ] = None,
    model: Annotated[str, typer.Option(metavar="NAME", help="The model that is asked.")] = "",
    key: Annotated[
        str,
        typer.Option("--key", metavar="VARIABLE", help="Environment variable with the key of the server."),
    ] = "OPENAI_API_KEY",
) -> None:
    """Write an experiment from an instruction, after a trial.

    A place for it is searched on a map. It is tried in some worlds, and the placement is changed until
    everything happens that was asked for; otherwise it is refused with the reason."""
    from limsim_jax.policies.language.chat import Server
    from limsim_jax.scenarios.instructions.grammar import parse
    from limsim_jax.scenarios.instructions.intent import InstructionError
    from limsim_jax.scenarios.instructions.model import LanguageModel
    from limsim_jax.scenarios.instructions.scenario import scenario as make
    from limsim_jax.scenarios.instructions.scenario import severity, slug

    path = Path(f"{slug(text)}.toml") if out is None else out
    if path.exists():
        raise InstructionError(f"{path}: is there already; name another file with --out")
    if model and server is None:
        raise typer.BadParameter("only with --server", param_hint="--model")
    path.parent.mkdir(parents=True, exist_ok=True)  # before minutes of trials, in case it cannot be made
    understand = parse if server is None else LanguageModel(Server(server, model, key))
    found = make(
        text, map=map_file, folder=path.parent, seeds=seeds, understand=understand,
        tell=lambda line: print(line, flush=True),
    )  # fmt: skip
    if severe:
        if not seeds:
            raise typer.BadParameter("it is tried; leave --seeds 0 out", param_hint="--severity")
        rows = severity(found, seeds)
        for factor, one in rows:
            assert one.trial is not None
            shown, contact = one.trial.all_shown, one.trial.contact
            print(f"distances x {factor:<5g} shown in {shown:4.0%}, contacts in {contact:4.0%} of the worlds")
        found = next((x for _, x in reversed(rows) if x.trial is not None and x.trial.good), found)
    found.save(path)
    print(found.description)
    print(f"wrote {path}; run it: limsim-jax sweep {path} --policy pdm_closed")
