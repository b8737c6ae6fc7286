"""Recorded worlds in the formats of other tools: one module per format."""

from limsim_jax.bridges.formats.export import FORMATS, export, format_of

__all__ = ["FORMATS", "export", "format_of"]
