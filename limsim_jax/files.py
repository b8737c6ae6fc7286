"""Host-side basics: files that are written whole, the cache folder, a pause of the garbage collector."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

import platformdirs


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
