"""Host-side basics: whole files, the cache folder, values kept there, a pause of the garbage collector."""

from __future__ import annotations

import contextlib
import errno
import gc
import hashlib
import os
import pickle
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import platformdirs

Value = TypeVar("Value")

VALUES = 1000
"""Small values that are kept on disk."""


def write_whole(path: str | Path, data: bytes | str) -> None:
    """Put `data` (text as UTF-8) under this name: all of it or nothing, safe from a power cut on return.

    Whatever was there before stays until then. Raises `OSError`.
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex[:12]}.part")
    try:
        with open(part, "xb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    if hasattr(os, "O_DIRECTORY"):  # there, a new name is safe only once the directory is
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def check_writable(*paths: Path | None) -> None:
    """Raise `OSError` about the first file that could not be written; `None` is passed over."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            code = errno.EISDIR
        elif not path.parent.is_dir():
            code = errno.ENOTDIR if path.parent.exists() else errno.ENOENT
        elif not os.access(path if path.exists() else path.parent, os.W_OK):
            code = errno.EACCES
        else:
            continue
        raise OSError(code, os.strerror(code), str(path))


def cache_directory() -> Path:
    """The folder of cached maps and programs; it need not exist yet.

    It is `$LIMSIM_JAX_CACHE`, otherwise `limsim_jax` in the user's cache folder of the platform
    (`$XDG_CACHE_HOME` or `~/.cache` on Linux).
    """
    if own := os.environ.get("LIMSIM_JAX_CACHE"):
        return Path(own)
    return platformdirs.user_cache_path("limsim_jax", appauthor=False)


def remembered(name: str | None, make: Callable[[], Value]) -> Value:
    """What `make` returns, or has returned before.

    Args:
      name: all that the value depends on, versions of code included; None: it is made anew.
      make: takes long; what it returns is small and can be pickled.
    """
    if name is None:
        return make()
    path = cache_directory() / "values" / hashlib.sha256(name.encode()).hexdigest()[:32]
    with contextlib.suppress(Exception):  # not there, or damaged
        return pickle.loads(path.read_bytes())
    value = make()
    with contextlib.suppress(OSError):  # a full disk
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, pickle.dumps(value))
        forget_oldest(path.parent, VALUES)
    return value


def forget_oldest(folder: Path, most: int) -> None:
    """Remove all but the files of a folder that were used last."""
    paths = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in paths[most:]:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector: it takes a third of the time where many objects stay."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
