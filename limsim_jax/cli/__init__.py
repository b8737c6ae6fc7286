"""The command line: `main` runs a command; `maps`, `run`, `results`, `fitting` and `bench` hold them."""

from limsim_jax.cli.main import app, main

__all__ = ["app", "main"]
