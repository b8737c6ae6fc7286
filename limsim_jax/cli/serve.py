"""Commands that keep running and answer other programs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

serve_app = typer.Typer(help="Answer other programs until Ctrl-C.", no_args_is_help=True)


@serve_app.callback()
def serve() -> None:
    """Answer other programs until Ctrl-C."""


@serve_app.command()
def traffic(
    maps: Annotated[
        list[str],
        typer.Option(
            metavar="PLACE",
            help="Folder of maps, map file, CommonRoad file, or name of a bundled map; may be repeated.",
        ),
    ],
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0: any free one.")] = 0,
    sessions: Annotated[int, typer.Option(help="Sessions open at once, at most.")] = 16,
    idle: Annotated[float, typer.Option(help="s without a call after which a session is closed.")] = 600.0,
) -> None:
    """Serve traffic that reacts to an ego in another simulator, by gRPC."""
    from limsim_jax.bridges.traffic_service.scenes import Scenes
    from limsim_jax.bridges.traffic_service.server import TrafficServer

    scenes = Scenes([Path(place) if Path(place).exists() else place for place in maps])
    with TrafficServer(scenes, host=host, port=port, sessions=sessions, idle=idle) as server:
        print(
            f"listening on {host}:{server.port}, {len(scenes.ids)} scenes: {', '.join(scenes.ids)[:200]}",
            flush=True,
        )
        server.wait()


@serve_app.command()
def chat(
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="rules: reads the description and answers by a table of rules; faults: every fault of real "
            "servers in turn; camera: a network that looks at the pictures; may be repeated.  "
            "[default: rules and faults]",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="camera: its network, of `train end-to-end --design camera`."),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0: any free one.")] = 8080,
    key_variable: Annotated[
        str | None, typer.Option(metavar="NAME", help="Environment variable with the key that requests need.")
    ] = None,
) -> None:
    """Serve models of our own as an OpenAI-compatible chat server.

    Language drivers can be tried on it."""
    from limsim_jax.bridges.chat.faults import Faults
    from limsim_jax.bridges.chat.rules import rules
    from limsim_jax.bridges.chat.server import ChatServer, Model

    key = ""
    if key_variable is not None:
        key = os.environ.get(key_variable, "")
        if not key:
            raise typer.BadParameter(f"${key_variable} is empty", param_hint="--key-variable")
    known: dict[str, Model] = {"rules": rules, "faults": Faults()}
    names = list(known) if model is None else model
    for name in names:
        if name not in (*known, "camera"):
            raise typer.BadParameter(f"'{name}'; known are {', '.join(known)}, camera", param_hint="--model")
    if "camera" in names and weights is None:
        raise typer.BadParameter("none; a file goes with --model camera", param_hint="--weights")
    if "camera" not in names and weights is not None:
        raise typer.BadParameter("only goes with --model camera", param_hint="--weights")
    if weights is not None:
        from limsim_jax.bridges.chat.camera import Camera

        known["camera"] = Camera(weights)
    server = ChatServer({name: known[name] for name in names}, host=host, port=port, key=key)
    print(f"listening on {server.url}, models: {', '.join(server.models)}", flush=True)
    server.wait()
