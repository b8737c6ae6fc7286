"""Weights of learned policies as .npz, in half precision."""

from __future__ import annotations

import functools
import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

Layers = Mapping[str, Mapping[str, Any]]
"""Arrays by layer and name."""


def pack(layers: Layers, **texts: str) -> bytes:
    """The content of a file, with texts beside the weights."""
    flat = {
        f"{layer}/{name}": np.asarray(value, np.float16)
        for layer, values in layers.items()
        for name, value in values.items()
    }
    told = {name: np.array(text) for name, text in texts.items()}
    file = io.BytesIO()
    np.savez_compressed(file, **flat, **told)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


@functools.lru_cache(maxsize=8)
def unpack(content: bytes) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, str]]:
    """What `pack` put into a file: layers and texts.

    It takes the content, not the name, since a file may be trained again.

    Raises:
      ValueError: the file is damaged or another one.
    """
    layers: dict[str, dict[str, np.ndarray]] = {}
    texts: dict[str, str] = {}
    try:
        with np.load(io.BytesIO(content)) as file:
            for name in file.files:
                value = file[name]
                if value.dtype.kind == "U":
                    texts[name] = str(value)
                    continue
                layer, _, part = name.partition("/")
                layers.setdefault(layer, {})[part] = np.asarray(value, np.float32)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(str(error)) from None
    return layers, texts


def digest(layers: Layers, about: str = "") -> str:
    """A hash of weights: results of other weights are other results.

    Weights within a function that is being traced have none.
    """
    leaves = jax.tree.leaves(layers)
    if any(isinstance(x, Tracer) for x in leaves):
        return ""
    told = hashlib.sha256(about.encode())
    for x in leaves:
        told.update(np.asarray(x, np.float32).tobytes())
    return told.hexdigest()[:16]
