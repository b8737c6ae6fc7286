"""The XML reader of all map and scenario files.

Files may come from any source. The parser resolves no entities and opens no other file and no network.
libxml2 bounds depth, attribute size and entity expansion. Every fault is a `MapError`.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import math
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, overload

from lxml import etree

from limsim_jax.maps.network import ImportReport, MapError

MAX_BYTES = 2**31  # of XML after unpacking: far above any real map, far below a gzip bomb

Element = Any  # lxml's element type has no stubs
T = TypeVar("T")

_OPTIONS: dict[str, Any] = dict(
    resolve_entities=False,
    no_network=True,
    load_dtd=False,
    huge_tree=False,
    remove_comments=True,
    remove_pis=True,
)
_REQUIRED: Any = object()  # in place of a default


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


def root_name(data: bytes, path: str | Path) -> str:
    """Local name of the root element.

    Nothing after its start tag is parsed. Raises `MapError` for a file without one.
    """
    try:
        start = etree.iterparse(_Source(data), events=("start",), **_OPTIONS)  # type: ignore[arg-type]
        return etree.QName(next(iter(start))[1]).localname
    except (etree.XMLSyntaxError, StopIteration) as error:
        line = getattr(error, "lineno", None)
        reason = getattr(error, "msg", None) or "it has no root element"
        raise MapError(f"not well-formed XML: {reason}", file=path, line=line) from None


def describe(element: Element) -> str:
    """Tag and id of an element and of its ancestors with ids."""
    chain = [element, *element.iterancestors()]
    parts = [
        f"{e.tag} {e.get('id')}" if e.get("id") is not None else str(e.tag)
        for e in chain
        if e is element or e.get("id") is not None
    ]
    return " in ".join(f"<{part}>" for part in parts)


class Ignored:
    """What a reader leaves out: a count and the first place per kind."""

    def __init__(self) -> None:
        self._count: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], tuple[str, int | None]] = {}

    def add(self, kind: str, reason: str, where: str, line: int | None) -> None:
        """Count one thing of a kind; `where` names its place for people."""
        self._count[kind, reason] += 1
        self._first.setdefault((kind, reason), (where, line))

    def summarise(self, report: ImportReport) -> None:
        """Write one line of the report per kind and reason."""
        for (kind, reason), count in sorted(self._count.items()):
            where, line = self._first[kind, reason]
            message = f"{reason}; {count} in the file, the first here"
            report.ignored(kind, where, message, line, count=count)


class _Source:
    """Bytes as a stream, for a parser that holds one top-level element."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = memoryview(data), 0

    def read(self, size: int) -> bytes:
        chunk = self._data[self._at : self._at + size]
        self._at += len(chunk)
        return bytes(chunk)


class XmlReader:
    """Typed access to the elements and attributes of one file.

    All methods that read an attribute take its name, strip white space around its value and raise
    `MapError` if it is missing and there is no default.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.ignored = Ignored()
        self._asked: defaultdict[str, set[str]] = defaultdict(set)

    # --- elements -------------------------------------------------------------------------------

    def parse(self, data: bytes, *roots: str) -> Element:
        """The root element of the whole file.

        Namespaces are removed from tags. Raises `MapError` for anything that is not well-formed XML with
        one of these root elements, and for files that declare or use entities.
        """
        try:
            root = etree.parse(io.BytesIO(data), etree.XMLParser(**_OPTIONS)).getroot()
        except etree.XMLSyntaxError as error:
            raise self._syntax_error(error) from None
        self._check_root(root, roots)
        self._clean(root)
        return root

    def children(self, data: bytes, *roots: str) -> Iterator[tuple[Element, Element]]:
        """Yield `(root, child)` for every child of the root element.

        A child is dropped after use. For files of any size. Raises `MapError` where `parse` does.
        """
        try:
            events = etree.iterparse(
                _Source(data),  # type: ignore[arg-type]
                events=("start", "end"),
                **_OPTIONS,
            )
            root: Element = None
            for event, element in events:
                if root is None:
                    root = element
                    self._check_root(root, roots)
                elif event == "end" and element.getparent() is root:
                    self._clean(element)
                    yield root, element
                    element.clear()
                    while element.getprevious() is not None:
                        del root[0]
        except etree.XMLSyntaxError as error:
            raise self._syntax_error(error) from None

    def _check_root(self, root: Element, names: tuple[str, ...]) -> None:
        info = root.getroottree().docinfo
        if info.internalDTD is not None and next(info.internalDTD.iterentities(), None) is not None:
            reason = "declares XML entities: these are not allowed; delete the <!DOCTYPE ...>"
            raise MapError(reason, file=self.path, line=1)
        tag = etree.QName(root).localname
        if tag not in names:
            wanted = " or ".join(f"<{name}>" for name in names)
            raise MapError(f"the root element is <{tag}>, not {wanted}", file=self.path, line=root.sourceline)
        root.tag = tag

    def _clean(self, top: Element) -> None:
        """Remove namespaces from tags, and refuse entities."""
        for inner in top.iter(etree.Entity):
            reason = f"entity reference '&{inner.name};': entities are not allowed"
            raise self.error(inner.getparent(), reason)
        for element in top.iter("{*}*"):
            if "}" in element.tag:
                element.tag = element.tag.rpartition("}")[2]

    def _syntax_error(self, error: etree.XMLSyntaxError) -> MapError:
        return MapError(f"not well-formed XML: {error.msg}", file=self.path, line=error.lineno or None)

    # --- attributes -----------------------------------------------------------------------------

    def error(self, element: Element, reason: str) -> MapError:
        """`MapError` that names the place of an element."""
        return MapError(reason, file=self.path, line=element.sourceline, element=describe(element))

    @overload
    def text(self, element: Element, name: str) -> str: ...
    @overload
    def text(self, element: Element, name: str, default: T) -> str | T: ...
    def text(self, element: Element, name: str, default: Any = _REQUIRED) -> Any:
        """A string."""
        self._asked[element.tag].add(name)
        value = element.get(name)
        if value is not None:
            return value.strip()
        if default is _REQUIRED:
            raise self.error(element, f"attribute '{name}' is missing")
        return default

    @overload
    def number(self, element: Element, name: str, *, minimum: float = ...) -> float: ...
    @overload
    def number(self, element: Element, name: str, default: T, *, minimum: float = ...) -> float | T: ...
    def number(
        self, element: Element, name: str, default: Any = _REQUIRED, *, minimum: float = -math.inf
    ) -> Any:
        """A finite number not below `minimum`; an empty attribute counts as missing."""
        value = self.text(element, name, "")
        if value:
            return self.parse_number(element, name, value, minimum)
        if default is _REQUIRED:
            raise self.error(element, f"attribute '{name}' is missing")
        return default

    def parse_number(self, element: Element, name: str, value: str, minimum: float = -math.inf) -> float:
        """`value`, a part of attribute `name`, as a finite number.

        Raises `MapError` if it is none or below `minimum`.
        """
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self.error(element, f"attribute '{name}' is '{value[:40]}', not a finite number")
        if number < minimum:
            raise self.error(element, f"attribute '{name}' is '{value[:40]}', below {minimum:g}")
        return number

    @overload
    def integer(self, element: Element, name: str) -> int: ...
    @overload
    def integer(self, element: Element, name: str, default: T) -> int | T: ...
    def integer(self, element: Element, name: str, default: Any = _REQUIRED) -> Any:
        """A whole number; an empty attribute counts as missing."""
        number = self.number(element, name, default)
        if not isinstance(number, float):
            return number
        if number != int(number):
            raise self.error(element, f"attribute '{name}' is '{element.get(name)}', not a whole number")
        return int(number)

    def flag(self, element: Element, name: str, default: bool = False) -> bool:
        """A truth value in any of SUMO's spellings."""
        value = self.text(element, name, None)
        if value is None:
            return default
        lower = value.lower()
        if lower in {"1", "true", "yes", "on", "x", "t"}:
            return True
        if lower in {"0", "false", "no", "off", "-", "f"}:
            return False
        raise self.error(element, f"attribute '{name}' is '{value[:40]}', not a truth value")

    def choice(self, element: Element, name: str, choices: Mapping[str, T]) -> T:
        """The value of `choices` for an attribute."""
        value = self.text(element, name)
        if value not in choices:
            raise self.error(element, f"attribute '{name}' is '{value[:40]}', none of {' '.join(choices)}")
        return choices[value]

    def content(self, element: Element, path: str) -> float:
        """The text of the child at `path` (`"position/point/x"`) as a finite number."""
        text = element.findtext(path)
        if text is None:
            raise self.error(element, f"<{path}> is missing")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(element, f"<{path}> is '{text.strip()[:40]}', not a finite number")
        return value

    # --- elements and attributes that are left out ----------------------------------------------

    def unasked(self, element: Element) -> dict[str, str]:
        """Attributes of an element that were not read so far, unchanged."""
        asked = self._asked[element.tag]
        return {name: value for name, value in element.attrib.items() if name not in asked}

    def ignore(self, element: Element, reason: str) -> None:
        """Count an element, with all that is in it, as left out."""
        kind = f"{element.getparent().tag}/{element.tag}"
        self.ignored.add(kind, reason, describe(element), element.sourceline)

    def ignore_children(self, element: Element, *used: str) -> None:
        """Count all children as left out whose tags are not `used`."""
        for child in element:
            if child.tag not in used:
                self.ignore(child, f"not used within <{element.tag}>")

    def ignore_unasked(self, element: Element) -> None:
        """Count the attributes that were not read. Call it after reading."""
        for name in self.unasked(element):
            if not name.startswith("{"):
                kind, where = f"{element.tag}@{name}", describe(element)
                self.ignored.add(kind, "attribute not used", where, element.sourceline)
