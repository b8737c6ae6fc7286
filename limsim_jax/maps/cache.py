"""A cache on disk for networks and lane maps.

Entries lie in `files.cache_directory()`. The key of an entry covers the bytes of the map file and the
source code that turns them into the entry, so an entry never goes stale: a changed file or another version
of the package has another key.

An entry is a pickle behind a header with its length and checksum. A pickle is as fast as raw arrays here
and keeps the types. It is harmless, because `_Unpickler` builds only arrays, plain containers and the
records of `limsim_jax.maps`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import hashlib
import io
import logging
import os
import pickle
import platform
import struct
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from limsim_jax.files import cache_directory, no_garbage_collection

logger = logging.getLogger(__name__)

MAX_BYTES = 2 << 30
"""The directory is pruned to this size, least recently used entries first."""

MAX_AGE = 90 * 24 * 3600.0
"""Entries that were not used for this long (s) are removed."""

_HEADER = struct.Struct("<8sQI")  # magic, payload length, CRC-32 of the payload
_MAGIC = b"limsimjx"
_PACKAGE = Path(__file__).resolve().parents[1]


def key(kind: str, *parts: str) -> str:
    """File name of an entry.

    `parts` are hashes, names and options on which its content depends.
    """
    digest = hashlib.sha256(_fingerprint())
    for part in parts:
        digest.update(struct.pack("<Q", len(part.encode())) + part.encode())
    return f"{kind}-{digest.hexdigest()}"


def load(name: str) -> Any | None:
    """The entry, or None if there is none that can be used.

    A damaged one is logged and removed.
    """
    try:
        path = cache_directory() / name
        data = path.read_bytes()
    except (OSError, RuntimeError):  # Path.home() raises RuntimeError where there is no home
        return None
    try:
        value = _decode(data)
    except Exception as error:  # whatever a damaged pickle raises
        logger.warning("map cache: %s is damaged (%s); built anew", path, error)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # most recently used
    return value


def store(name: str, value: Any) -> None:
    """Write an entry whole. A failure is logged once and ignored."""
    try:
        folder = cache_directory()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, prefix=name, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_encode(value))
            os.replace(temporary, folder / name)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        _prune(folder)
    except (OSError, RuntimeError) as error:
        _warn_once(f"map cache: not kept, so maps load slowly every time ({error})")


def _encode(value: Any) -> bytes:
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=5).dump(value)
    payload = buffer.getvalue()
    return _HEADER.pack(_MAGIC, len(payload), zlib.crc32(payload)) + payload


def _decode(data: bytes) -> Any:
    if len(data) < _HEADER.size:
        raise ValueError("truncated header")
    magic, length, checksum = _HEADER.unpack_from(data)
    payload = memoryview(data)[_HEADER.size :]
    if magic != _MAGIC or length != len(payload) or checksum != zlib.crc32(payload):
        raise ValueError("truncated or changed")
    with no_garbage_collection():
        return _Unpickler(io.BytesIO(payload)).load()


class _Pickler(pickle.Pickler):
    """Writes members of enumerations by value.

    Python 3.11.0 to 3.11.3 would need `getattr` to load them otherwise.
    """

    def reducer_override(self, obj: Any, /) -> Any:
        if isinstance(obj, enum.Enum):
            return type(obj), (obj.value,)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    """Builds only arrays, plain containers and records of `limsim_jax.maps`."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if (module_name, global_name) in _PLAIN:
            return super().find_class(module_name, global_name)
        if module_name.startswith("numpy.") and global_name in _NUMPY:
            return super().find_class(module_name, global_name)
        if module_name.startswith("limsim_jax.maps."):
            found = super().find_class(module_name, global_name)
            if isinstance(found, type) and (dataclasses.is_dataclass(found) or issubclass(found, enum.Enum)):
                return found
        raise pickle.UnpicklingError(f"{module_name}.{global_name} has no place in a map cache")


_PLAIN = {("builtins", "frozenset"), ("collections", "Counter"), ("numpy", "dtype"), ("numpy", "ndarray")}
_NUMPY = {"_frombuffer", "_reconstruct", "scalar"}  # how NumPy pickles arrays and numbers


@functools.cache
def _fingerprint() -> bytes:
    """Hash of our source code and of the versions below it."""
    versions = (platform.python_version_tuple()[:2], np.__version__, shapely.__version__)
    digest = hashlib.sha256(repr(versions).encode())
    for path in sorted([*_PACKAGE.glob("maps/**/*.py"), *_PACKAGE.glob("*.py")]):
        digest.update(path.read_bytes())
    return digest.digest()


def _prune(folder: Path) -> None:
    """Remove old entries, those beyond `MAX_BYTES`, and leftovers of dead writers."""
    files = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process may prune, too
            stat = path.stat()
            files.append((stat.st_mtime, stat.st_size, path))
    now, total = time.time(), 0
    for used, size, path in sorted(files, reverse=True):
        total += size
        dead = path.suffix == ".tmp" and now - used > 3600
        if dead or now - used > MAX_AGE or total > MAX_BYTES:
            with contextlib.suppress(OSError):
                path.unlink()


@functools.cache
def _warn_once(message: str) -> None:
    logger.warning(message)
