"""Commands that keep running and answer other programs."""

from __future__ import annotations

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
