"""The command line: one line on stderr and exit code 2 for a user's error, a traceback for a bug."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from limsim_jax import __version__
from limsim_jax.cli import fitting, instructions, rare, results, scenarios
from limsim_jax.cli.bench import bench_app
from limsim_jax.cli.maps import map_app
from limsim_jax.cli.run import run
from limsim_jax.cli.serve import serve_app

# XLA logs an error for every program that it loads from its own cache on a CPU; nothing is wrong.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

app = typer.Typer(
    help="Road traffic for validating automated driving.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(map_app, name="map")
app.add_typer(bench_app, name="bench")
app.add_typer(serve_app, name="serve")
app.command()(run)
results.add_commands(app)
rare.add_commands(app)
fitting.add_commands(app)
scenarios.add_commands(app)
instructions.add_commands(app)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command (default: that of the process) and return its exit code."""
    from limsim_jax.maps.network import MapError

    # tracing and reading make many objects that stay: garbage among them is looked for less often
    gc.set_threshold(100_000, 50, 50)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            code = app(args=arguments, prog_name="limsim-jax", standalone_mode=False)
    except typer.TyperException as error:  # an unknown command, a missing argument, a bad option
        return _refuse(error.format_message())
    except MapError as error:
        return _refuse(str(error))
    except ValueError as error:
        if not _is_ours(error):
            raise
        return _refuse(str(error))
    except OSError as error:
        if error.filename is None:  # not about a file that the user named
            raise
        return _refuse(f"{error.filename}: {error.strerror}")
    except ModuleNotFoundError as error:
        if error.name is not None:  # not an extra that is missing: those come with advice, not a name
            raise
        return _refuse(str(error))
    except (typer.Abort, KeyboardInterrupt):
        return 130
    return code or 0


def _is_ours(error: ValueError) -> bool:
    """Whether our own code has raised it as a message."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__")).startswith("limsim_jax.")


def _show_warning(message: Warning | str, category: type[Warning], filename: str, *rest: Any) -> None:
    """Our own warnings as a line, others as Python writes them."""
    own = category is UserWarning and Path(__file__).parents[1] in Path(filename).parents
    text = f"limsim-jax: {message}\n" if own else warnings.formatwarning(message, category, filename, rest[0])
    sys.stderr.write(text)


def _refuse(reason: str) -> int:
    print("limsim-jax:", " ".join(reason.split()), file=sys.stderr)
    return 2


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"limsim-jax {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """Road traffic for validating automated driving."""
    del version
