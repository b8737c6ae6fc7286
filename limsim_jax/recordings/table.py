"""Files of comma-separated values, with errors that name line and column."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from limsim_jax.maps import xml
from limsim_jax.maps.network import MapError
from limsim_jax.recordings.recording import Floats, Ints, RecordingError


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a file, unpacked if it is gzip.

    Raises:
      RecordingError: it cannot be read, is damaged, or is empty.
    """
    if Path(path).is_dir():
        raise RecordingError(f"{path}: is a folder; a file of recorded vehicles is expected")
    try:
        return xml.read_bytes(path)
    except MapError as error:
        raise RecordingError(str(error)) from None


def header_of(data: bytes, line: int = 0) -> list[str]:
    """Names of the columns in a line, counted from 0."""
    head = data.split(b"\n", line + 1)[line] if data.count(b"\n") >= line else b""
    text = head.decode("utf-8", "replace").lstrip("\ufeff").rstrip("\r")
    return [name.strip().strip('"') for name in text.split(",")]


class Table:
    """Columns by name, whatever their case; every error names line and column."""

    def __init__(self, source: str | Path, columns: pa.Table, header: int | None = 1) -> None:
        """The columns of a file.

        Args:
          source: name of the file, for errors.
          columns: as text or numbers.
          header: number of the line of the header; rows begin in the next. None: a table without lines,
            whose rows count from 0.
        """
        self.source, self.header = str(source), -1 if header is None else header
        self.row = "row" if header is None else "line"
        self._columns = columns
        self._names = {name.lower(): name for name in columns.column_names}

    @classmethod
    def read(cls, path: str | Path, data: bytes, header: int = 1) -> Table:
        """Parse the bytes of a file whose header is in line `header`.

        Raises:
          RecordingError: no rows, or a row has more or fewer values than the header.
        """
        names = header_of(data, header - 1)
        rest = data.split(b"\n", header)
        if len(rest) <= header or not rest[header].strip():
            raise RecordingError(f"{path}: line {header + 1}: no rows; the file ends after its header")
        try:
            columns = pacsv.read_csv(
                io.BytesIO(data),
                pacsv.ReadOptions(column_names=names, skip_rows=header, use_threads=False),
                convert_options=pacsv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=True, null_values=[""]
                ),
            )
        except (pa.ArrowInvalid, UnicodeDecodeError) as error:
            found = re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", str(error))
            what = (
                f"line {found[1]}: {found[3]} values; {found[2]} are expected, as in the header"
                if found
                else str(error).splitlines()[0]
            )
            raise RecordingError(f"{path}: {what}") from None
        return cls(path, columns, header)

    def __len__(self) -> int:
        return self._columns.num_rows

    def __contains__(self, column: str) -> bool:
        return column.lower() in self._names

    @property
    def columns(self) -> list[str]:
        """Names as the file has them."""
        return list(self._names.values())

    @property
    def lines(self) -> Ints:
        """Line of each row in the file, `[R]`."""
        return np.arange(len(self), dtype=np.int64) + self.header + 1

    def name(self, column: str) -> str:
        """As the file has it. Raises `RecordingError` if the column is missing."""
        if column not in self:
            raise RecordingError(
                f"{self._place}: column {column} is missing; found are {', '.join(self.columns)[:200]}"
            )
        return self._names[column.lower()]

    @property
    def _place(self) -> str:
        return self.source if self.header < 0 else f"{self.source}: line {self.header}"

    def require(self, *columns: str) -> None:
        """Raise `RecordingError` for the first of the columns that is missing."""
        for column in columns:
            self.name(column)

    def text(self, column: str) -> NDArray[np.str_]:
        """Values as text, `[R]`; "" where there are none."""
        values = self._columns[self.name(column)].cast(pa.string()).combine_chunks().fill_null("")
        return np.asarray(values.to_numpy(zero_copy_only=False), dtype=str)

    def numbers(self, column: str, *, missing: bool = False) -> Floats:
        """Finite numbers, `[R]`.

        Args:
          column: name.
          missing: allow empty values, as NaN.

        Raises:
          RecordingError: a value is no finite number.
        """
        values = self._columns[self.name(column)].combine_chunks()
        try:
            numbers = np.asarray(values.cast(pa.float64()).to_numpy(zero_copy_only=False))
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            numbers = np.full(len(self), np.nan)
            for k, value in enumerate(values.to_pylist()):
                try:
                    numbers[k] = math.nan if value is None or not str(value).strip() else float(value)
                except (TypeError, ValueError):
                    self.refuse(column, k, f"'{str(value)[:30]}'; a finite number is expected")
        bad = np.isinf(numbers) | (np.isnan(numbers) if not missing else False)
        if bad.any():
            k = int(np.argmax(bad))
            value = values[k].as_py()
            found = "no value" if value is None or value == "" else f"'{value}'"
            self.refuse(column, k, f"{found}; a finite number is expected")
        return numbers

    def refuse(self, column: str, row: int, message: str) -> NoReturn:
        """Raise `RecordingError` at a row, counted from 0."""
        raise RecordingError(
            f"{self.source}: {self.row} {row + self.header + 1}, column {self.name(column)}: {message}"
        )


def numbered(*columns: NDArray[np.str_]) -> tuple[tuple[str, ...], list[Ints]]:
    """All names in the columns, sorted, and the index of each value."""
    names, index = np.unique(np.concatenate(columns), return_inverse=True)
    parts = np.split(index.astype(np.int64), len(columns))
    return tuple(names.tolist()), parts


__all__ = ["Table", "header_of", "numbered", "read_bytes"]
