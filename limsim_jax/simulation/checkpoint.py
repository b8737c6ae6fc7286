"""Worlds that are forked, saved and resumed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.files import write_whole


def fork(tree: Any, n: int) -> Any:
    """`n` copies of a pytree along a new first axis."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), tree)


def save(path: str | Path, tree: Any) -> None:
    """Write a pytree of arrays as .npz; never half a file."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    leaves: dict[str, Any] = {jax.tree_util.keystr(where): np.asarray(x) for where, x in found}
    file = io.BytesIO()
    np.savez(file, **leaves)
    write_whole(path, file.getvalue())


def load(path: str | Path, like: Any) -> Any:
    """Read what `save` wrote into the structure of `like`.

    Raises:
      ValueError: an array that is missing or of another shape or type.
    """
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}

    def read(where: Any, x: Any) -> Any:
        name = jax.tree_util.keystr(where)
        if name not in stored:
            raise ValueError(f"{path}: no array '{name}'")
        found = stored[name]
        if found.shape != jnp.shape(x) or found.dtype != jnp.result_type(x):
            raise ValueError(
                f"{path}: '{name}' is {found.dtype}{list(found.shape)}, "
                f"not {jnp.result_type(x)}{list(jnp.shape(x))}"
            )
        return jnp.asarray(found)

    return jax.tree_util.tree_map_with_path(read, like)
