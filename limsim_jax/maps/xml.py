"""Reading XML that strangers wrote: no entities, no network, no DTD, every fault a `MapError`."""

from __future__ import annotations

import gzip
import hashlib
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from lxml import etree

from limsim_jax.maps.network import MapError

MAX_BYTES = 2**31  # of XML after unpacking: far above any real map, far below a gzip bomb

Element = Any  # lxml's element type has no stubs


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a file, unpacked if it is gzip. Raises `MapError` if it cannot be read."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            packed = stream.read(2) == b"\x1f\x8b"
            stream.seek(0)
            if packed:
                with gzip.open(stream) as unpacked:
                    data = unpacked.read(MAX_BYTES + 1)
            else:
                data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise MapError("no such file", file=path) from None
    except IsADirectoryError:
        raise MapError("is a folder, not a map file", file=path) from None
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise MapError(f"damaged gzip data ({error})", file=path) from None
    except OSError as error:
        raise MapError(f"cannot be read ({error.strerror or error})", file=path) from None
    except ValueError as error:  # a path with a null byte
        raise MapError(f"cannot be read ({error})", file=path) from None
    if len(data) > MAX_BYTES:
        raise MapError("larger than 2 GiB", file=path)
    if not data.strip():
        raise MapError("the file is empty", file=path)
    return data


def file_hash(data: bytes) -> str:
    """SHA-256 of a file's (unpacked) bytes, in hex."""
    return hashlib.sha256(data).hexdigest()


class _Source:
    """Bytes as a stream, so that the parser never holds more than one top-level element."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = memoryview(data), 0

    def read(self, size: int) -> bytes:
        chunk = self._data[self._at : self._at + size]
        self._at += len(chunk)
        return bytes(chunk)


def top_level(data: bytes, path: str | Path, root: str) -> Iterator[tuple[Element, Element]]:
    """Yield `(root, child)` for every child of the root element, then drop the child.

    Namespaces are removed from tags. Raises `MapError` for anything that is not well-formed XML with
    this root element, and for files that declare entities.
    """
    try:
        events = etree.iterparse(
            _Source(data),  # type: ignore[arg-type]
            events=("start", "end"),
            resolve_entities=False,
            no_network=True,
            load_dtd=False,
            huge_tree=False,
            remove_comments=True,
            remove_pis=True,
        )
        top: Element = None
        depth = 0
        for event, element in events:
            if event == "start":
                depth += 1
                if top is None:
                    top = element
                    _check_root(top, path, root)
                continue
            depth -= 1
            if "}" in element.tag:
                element.tag = element.tag.rpartition("}")[2]
            if depth == 1:
                for inner in element.iter(etree.Entity):
                    raise MapError(
                        f"entity reference '&{inner.name};': entities are not allowed",
                        file=path,
                        line=inner.sourceline,
                        element=f"<{element.tag}>",
                    )
                yield top, element
                element.clear()
                while element.getprevious() is not None:
                    del top[0]
    except etree.XMLSyntaxError as error:
        raise MapError(f"not well-formed XML: {error.msg}", file=path, line=error.lineno) from None


def _check_root(top: Element, path: str | Path, root: str) -> None:
    info = top.getroottree().docinfo
    if info.internalDTD is not None and next(info.internalDTD.iterentities(), None) is not None:
        raise MapError("declares XML entities: these are not allowed", file=path, line=1)
    tag = etree.QName(top).localname
    if tag != root:
        raise MapError(f"the root element is <{tag}>, not <{root}>", file=path, line=top.sourceline)
    top.tag = tag


class Reader:
    """Typed access to the attributes of elements of one file."""

    def __init__(self, path: str | Path) -> None:
        self.path = path

    def fail(self, element: Element, reason: str) -> NoReturn:
        """Raise a `MapError` at this element."""
        raise MapError(reason, file=self.path, line=element.sourceline, element=describe(element))

    def text(self, element: Element, name: str, default: str | None = None) -> str:
        """A string attribute; without a default a missing one is an error."""
        value = element.get(name)
        if value is not None:
            return value.strip()
        if default is None:
            self.fail(element, f"attribute '{name}' is missing")
        return default

    def number(self, element: Element, name: str, default: float | None = None) -> float:
        """A finite number; an empty attribute counts as missing."""
        value = element.get(name)
        if value is None or not value.strip():
            if default is None:
                self.fail(element, f"attribute '{name}' is missing")
            return default
        try:
            number = float(value)
        except ValueError:
            self.fail(element, f"attribute '{name}' is '{value[:40]}', not a number")
        if not math.isfinite(number):
            self.fail(element, f"attribute '{name}' is '{value}', not a finite number")
        return number

    def integer(self, element: Element, name: str) -> int:
        """A whole number."""
        number = self.number(element, name)
        if number != int(number):
            self.fail(element, f"attribute '{name}' is '{element.get(name)}', not a whole number")
        return int(number)


def describe(element: Element) -> str:
    """The element as a person would name it: its tag and id, after those of its ancestors with ids."""
    chain = [element, *element.iterancestors()]
    parts = [
        f"{e.tag} {e.get('id')}" if e.get("id") is not None else str(e.tag)
        for e in chain
        if e is element or e.get("id") is not None
    ]
    return " in ".join(f"<{part}>" for part in parts)
