"""Results of a sweep on disk: Parquet files that are whole or not there, checked when they are read.

    OUT/results.json                                          what the directory holds, and how it was made
    OUT/<scenario>/<policy>/moments-<first>-<last>.parquet    key moments of a chunk of seeds
    OUT/<scenario>/<policy>/episodes-<first>-<last>.parquet   its rows; once this is there, the chunk is done
    OUT/answers/<scenario>/<policy>/<seed>.jsonl              what a language model said, a line each

`<first>` and `<last>` are the least and the largest seed; a chunk with gaps between has a checksum of its
seeds behind them. Every file carries its provenance and a SHA-256 of all that it says, so a changed byte is
found. Any number of processes may write into a directory: a file appears at once under its name, and the
same chunk has the same content in every run.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import itertools
import json
import os
import re
import tempfile
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from limsim_jax.files import write_whole

if TYPE_CHECKING:  # results are read without JAX, which the room of policies loads
    from limsim_jax.policies.language.store import Answer

FORMAT = 2
"""Version of the layout of a results directory."""

NOT_COMPARED = frozenset({"device", "map_file", "memory", "python"})
"""Provenance that may differ within a directory: it does not change results. All else must agree."""

MOMENTS = pa.schema(
    [
        ("scenario", pa.string()),
        ("policy", pa.string()),
        ("seed", pa.int64()),
        ("ego", pa.int32()),  # number of the ego in its world
        ("rank", pa.int32()),  # 1: the worst of its episode
        ("kind", pa.string()),
        ("time", pa.float64()),  # s
        ("other", pa.int32()),  # slot of the other vehicle
        ("value", pa.float64()),  # its natural measure
        ("responsible", pa.string()),
        ("module", pa.string()),
        ("avoidable_by_ego", pa.bool_()),
        ("avoidable_by_other", pa.bool_()),
        ("reason", pa.string()),  # why the policy failed
    ]
)
"""Columns of the table of key moments; from `other` on they may be null."""

KEYS = pa.schema(
    [
        ("scenario", pa.string()),
        ("policy", pa.string()),
        ("seed", pa.int64()),
        ("ego", pa.int32()),  # number of the ego in its world; 0 in a world without one
        ("digest", pa.uint64()),  # of the world
    ]
)
"""First columns of the table of episodes; every metric follows as float64, null where not measured."""

_CHANGED = {
    r"source": "limsim_jax itself has changed since",
    r"policy_code\.program": "the program of the policy has changed since",
    r"policy_code\.values": "the numbers that the policy holds have changed since",
    r"policy_code\.sources\.": "the policy's code in {} has changed since",
    r"demand\.": "the demand in {} has changed since",
    r"policy_code": "it is not known with which code of the policy they were made",
}
"""Differences of provenance in words; what follows in the name goes into the braces."""

_ABANDONED = 3600.0  # s after which an unfinished file is abandoned: writing takes milliseconds
_NAME = re.compile(r"[A-Za-z0-9_-]+")


class ResultsError(ValueError):
    """A results directory that cannot be used, in one line: which file, what is wrong, what to do."""


class DamagedError(ResultsError):
    """A file that does not say any more what was written."""

    def __init__(self, path: Path, fault: str) -> None:
        super().__init__(f"{path}: damaged ({fault})")
        self.path = path


class Outcome(NamedTuple):
    """How worlds ended: `R` rows, one per world and ego, and `M` key moments."""

    seeds: NDArray[np.int64]  # [R], a row per world and ego
    egos: NDArray[np.int32]  # [R], number of the ego
    metrics: Mapping[str, NDArray[np.float64]]  # [R] each; NaN: not measured
    moments: Mapping[str, NDArray[Any]]
    """Columns of `MOMENTS` [M], without scenario and policy. None, NaN, "" or a negative `other`: null."""
    digest: NDArray[np.uint64]  # [R], of the rows and the final state of the world
    answers: Mapping[int, Sequence[Answer]] = MappingProxyType({})  # of a language model, by seed


@dataclass(frozen=True)
class Entry:
    """A scenario under a policy.

    Attributes:
      scenario, policy: names of letters, digits, `_` and `-`.
      provenance: how the rows come about; JSON.
      units: what each metric means.
    """

    scenario: str
    policy: str
    provenance: Mapping[str, Any]
    units: Mapping[str, str]

    def __post_init__(self) -> None:
        for what, name in (("scenario", self.scenario), ("policy", self.policy)):
            if not _NAME.fullmatch(name):
                raise ValueError(f"{what} '{name}': a name has letters, digits, '_' and '-' only")

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.scenario}/{self.policy}"

    def difference(self, other: Mapping[str, Any], ignore: frozenset[str] = NOT_COMPARED) -> str | None:
        """The first difference, as "chunk is 32 there and 64 here"."""
        here, there = _plain(self.provenance), _plain(other)
        found = _difference(
            {k: v for k, v in there.items() if k not in ignore},
            {k: v for k, v in here.items() if k not in ignore},
        )
        for name, words in _CHANGED.items():
            if found and (told := re.match(rf"'{name}(.*?)' is ", found)):
                return words.format(told[1])
        return found


@dataclass(frozen=True)
class Results:
    """All finished worlds of a results directory.

    Attributes:
      path: the directory.
      episodes: a row per world, in the order of scenario and policy in the directory, then of seeds.
      moments: a row per key moment, in the same order, then by rank.
      units: metric to what it means.
      provenance: (scenario, policy) to how the rows were made.
      damaged: files that were left out, each with its fault.
    """

    path: Path
    episodes: pa.Table
    moments: pa.Table
    units: dict[str, str]
    provenance: dict[tuple[str, str], dict[str, Any]]
    damaged: tuple[str, ...] = ()

    @property
    def digest(self) -> str:
        """One for all worlds: equal if and only if the same worlds ended in the same way."""
        found = hashlib.sha256()
        columns = (self.episodes.column(name).to_pylist() for name in KEYS.names)
        for row in sorted(zip(*columns, strict=True)):
            found.update(json.dumps(row).encode())
        return found.hexdigest()


def open_results(path: str | Path, *, skip_damaged: bool = False) -> Results:
    """Read all finished chunks.

    Args:
      path: results directory.
      skip_damaged: leave damaged files out and list them in `damaged`.

    Raises:
      ResultsError: no results there, none finished, a damaged file, a world with two different digests.
    """
    path = Path(path)
    entries = read_index(path)
    if not entries:
        raise ResultsError(f"{path}: no results of a sweep here ('{_INDEX}' is missing)")
    episodes: list[pa.Table] = []
    moments: list[pa.Table] = []
    damaged: list[str] = []
    for entry in entries:
        mine: list[Chunk] = []
        for chunk in Shards(path, entry).chunks():
            if isinstance(chunk, Chunk):
                mine.append(chunk)
            elif skip_damaged:
                damaged.append(str(chunk))
            else:
                raise ResultsError(f"{chunk}; the same sweep run again replaces it")
        if mine:
            rows = pa.concat_tables([chunk.episodes for chunk in mine])
            events = _joined([chunk.moments for chunk in mine])
            episodes.append(rows.sort_by([("seed", "ascending"), ("ego", "ascending")]))
            moments.append(
                events.sort_by([("seed", "ascending"), ("ego", "ascending"), ("rank", "ascending")])
            )
    if not episodes:
        raise ResultsError(
            f"{path}: no chunk of worlds is finished{' and whole' if damaged else ''} here yet"
        )
    units: dict[str, str] = {}
    for entry in entries:
        units |= entry.units
    return Results(
        path=path,
        episodes=_joined(episodes).combine_chunks(),
        moments=_joined([MOMENTS.empty_table(), *moments]).combine_chunks(),
        units=units,
        provenance={(entry.scenario, entry.policy): dict(entry.provenance) for entry in entries},
        damaged=tuple(damaged),
    )


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables one after the other; columns that one of them lacks are null there."""
    return pa.concat_tables(tables, promote_options="default")


# --- the index -----------------------------------------------------------------------------------------

_INDEX = "results.json"


def read_index(path: Path) -> list[Entry]:
    """What a directory holds; nothing where there is none.

    `results.json`, and what it misses because two sweeps wrote it at the same moment: every file
    carries its own entry.
    """
    entries = list(_listed(path))
    known = {(entry.scenario, entry.policy) for entry in entries}
    for folder in sorted(path.glob("*/*/")):
        if (folder.parent.name, folder.name) not in known:
            for file in sorted(folder.glob("episodes-*.parquet")):
                with contextlib.suppress(DamagedError):
                    about = _read(file)[1]
                    entries.append(_entry(about))
                    break
    return entries


def register(path: Path, entries: Sequence[Entry], *, fresh: bool = False) -> None:
    """Say in the index that the directory holds these; make the directory where there is none.

    Args:
      path: the directory.
      entries: what it holds from now on, beside what it held.
      fresh: remove what it holds of these before.

    Raises:
      ResultsError: `path` is a file, cannot be written, or holds one of the entries with another provenance.
    """
    if path.exists() and not path.is_dir():
        raise ResultsError(f"{path}: is a file; results need a directory")
    found = read_index(path) if path.is_dir() else []
    if fresh and found:
        names = {(entry.scenario, entry.policy) for entry in entries}
        _remove(path, [entry for entry in found if (entry.scenario, entry.policy) in names])
        found = [entry for entry in found if (entry.scenario, entry.policy) not in names]
        _write_index(path, found)
    by_name = {(entry.scenario, entry.policy): entry for entry in found}
    for entry in entries:
        other = by_name.get((entry.scenario, entry.policy))
        if other and (difference := entry.difference(other.provenance)):
            raise ResultsError(
                f"{path}: holds other results of {entry.label}: {difference}; use another directory, or "
                "start anew (--fresh, fresh=True)"
            )
    for entry in entries:
        folder = path / entry.scenario / entry.policy
        with _clear(folder):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()  # before hours of work, not after
    listed = {(entry.scenario, entry.policy) for entry in _listed(path)}
    new = [entry for entry in entries if (entry.scenario, entry.policy) not in listed]
    if new:
        _write_index(path, [*found, *(e for e in new if (e.scenario, e.policy) not in by_name)])


def _write_index(path: Path, entries: Sequence[Entry]) -> None:
    text = {
        "format": FORMAT,
        "what": "results of a sweep of limsim_jax",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "entries": [_about(entry) for entry in entries],
    }
    _write(path / _INDEX, json.dumps(text, indent=1).encode())


def _remove(path: Path, entries: Sequence[Entry]) -> None:
    """Remove all chunks of these; episodes first, without which moments do not count."""
    for entry in entries:
        for kind in ("episodes", "moments"):
            for file in sorted((path / entry.scenario / entry.policy).glob(f"{kind}-*.parquet")):
                with _clear(file), contextlib.suppress(FileNotFoundError):
                    file.unlink()
        for file in sorted(answers_file(path, entry.scenario, entry.policy, 0).parent.glob("*.jsonl")):
            with _clear(file), contextlib.suppress(FileNotFoundError):
                file.unlink()


def answers_file(path: Path, scenario: str, policy: str, seed: int) -> Path:
    """Where the answers in a world of results lie."""
    return path / "answers" / scenario / policy / f"{seed}.jsonl"


def _listed(path: Path) -> Iterator[Entry]:
    file = path / _INDEX
    try:
        text = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise ResultsError(f"{file}: cannot be read ({error.strerror})") from error
    try:
        index = json.loads(text)
        version, entries = index["format"], index["entries"]
        if version == FORMAT:
            yield from [_entry(about) for about in entries]
    except (ValueError, KeyError, TypeError) as error:
        raise ResultsError(
            f"{file}: damaged; remove it and run the sweep again: no results are lost"
        ) from error
    if version != FORMAT:
        raise ResultsError(
            f"{file}: has format {version}, this version reads {FORMAT}; use another directory"
        )


def _about(entry: Entry) -> dict[str, Any]:
    return {
        "scenario": entry.scenario,
        "policy": entry.policy,
        "provenance": _plain(entry.provenance),
        "units": dict(entry.units),
    }


def _entry(about: Mapping[str, Any]) -> Entry:
    return Entry(about["scenario"], about["policy"], about["provenance"], about["units"])


def _plain(value: Any) -> Any:
    """As JSON gives it back: lists for tuples, names for keys."""
    return json.loads(json.dumps(value))


def _difference(there: Any, here: Any, name: str = "") -> str | None:
    """First difference between two JSON values, in words."""
    if there == here:
        return None
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            inner = f"{name}.{key}" if name else key
            if key not in here or key not in there:
                return f"'{inner}' is {'missing here' if key not in here else 'missing there'}"
            if found := _difference(there[key], here[key], inner):
                return found
    if isinstance(there, str) and isinstance(here, str) and ("\n" in there or "\n" in here):
        for i, (a, b) in enumerate(itertools.zip_longest(there.splitlines(), here.splitlines()), 1):
            if a != b:
                return f"line {i} of '{name}' is {_short(a)} there and {_short(b)} here"
    return f"'{name}' is {_short(there)} there and {_short(here)} here"


def _short(value: Any) -> str:
    text = "missing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# --- chunks --------------------------------------------------------------------------------------------


class Chunk(NamedTuple):
    """A finished chunk: its file and both tables."""

    path: Path
    episodes: pa.Table
    moments: pa.Table

    def column(self, name: str) -> NDArray[np.float64]:
        """A metric per world, NaN where not measured or unknown."""
        if name not in self.episodes.column_names:
            return np.full(self.episodes.num_rows, np.nan)
        return self.episodes.column(name).to_numpy()


class Shards:
    """The files of one entry in a results directory."""

    def __init__(self, path: Path, entry: Entry) -> None:
        self.path = path
        self.entry = entry
        self.folder = path / entry.scenario / entry.policy

    def write(self, outcome: Outcome) -> Path:
        """Keep a chunk: episodes last, for their file says that all is there.

        Raises:
          ResultsError: it cannot be written (disk full, no permission). What was finished stays.
        """
        from limsim_jax.policies.language.store import lines_of

        name = _stem(np.unique(np.asarray(outcome.seeds, np.int64)))
        about = _about(self.entry)
        for seed, answers in outcome.answers.items():
            file = answers_file(self.path, self.entry.scenario, self.entry.policy, seed)
            with _clear(file):
                file.parent.mkdir(parents=True, exist_ok=True)
            _write(file, lines_of(answers).encode())
        _write(self.folder / f"moments-{name}.parquet", _encode(_moments(self.entry, outcome), about))
        path = self.folder / f"episodes-{name}.parquet"
        _write(path, _encode(_episodes(self.entry, outcome), about))
        return path

    def chunks(self) -> Iterator[Chunk | DamagedError]:
        """Finished chunks, and the faults of damaged ones. Every world once.

        Raises:
          ResultsError: a file of another provenance; a world that ended in two ways.
        """
        seen: dict[int, tuple[int, Path]] = {}
        for path in self._finished():
            try:
                chunk = self._read(path)
            except DamagedError as error:
                yield error
                continue
            if chunk is None:
                continue
            seeds, digests = (chunk.episodes.column(name).to_pylist() for name in ("seed", "digest"))
            fresh = np.array([seed not in seen for seed in seeds], bool)
            for seed, digest in zip(seeds, digests, strict=True):
                before = seen.setdefault(seed, (digest, path))
                if before[0] != digest:
                    raise ResultsError(
                        f"{path}: seed {seed} ended differently in {before[1].name}; remove one of the two"
                    )
            if not fresh.all():  # sweeps that ran at the same time and cut their seeds differently
                known = set(np.array(seeds)[~fresh].tolist())
                keep = [seed not in known for seed in chunk.moments.column("seed").to_pylist()]
                chunk = Chunk(
                    path,
                    chunk.episodes.filter(pa.array(fresh)),
                    chunk.moments.filter(pa.array(keep, pa.bool_())),
                )
            yield chunk

    def values(self, metric: str) -> dict[int, float]:
        """A metric by seed, the mean of its egos; NaN where not measured. Reads no other column."""
        found: dict[int, list[float]] = {}
        for path in self._finished():
            with _readable(path):
                table = pq.ParquetFile(path, page_checksum_verification=True).read(["seed", metric])
                seeds, numbers = table.column("seed").to_pylist(), table.column(metric).to_numpy().tolist()
            mine: dict[int, list[float]] = {}
            for seed, number in zip(seeds, numbers, strict=True):
                mine.setdefault(seed, []).append(number)
            found |= mine
        return {seed: float(np.mean(numbers)) for seed, numbers in found.items()}

    def set_aside(self, error: DamagedError) -> None:
        """Rename a damaged file and its companion.

        Their chunk then counts as missing."""
        stem = error.path.name.split("-", 1)[1]
        for kind in ("episodes", "moments"):  # in this order: a chunk without moments is never finished
            path = self.folder / f"{kind}-{stem}"
            with _clear(path), contextlib.suppress(FileNotFoundError):
                os.replace(path, path.with_suffix(".damaged"))

    def clean(self) -> None:
        """Remove what killed writers have left behind an hour ago or earlier."""
        moments = self.folder.glob("moments-*.parquet")
        lone = [p for p in moments if not p.with_name(p.name.replace("moments-", "episodes-", 1)).exists()]
        for path in [*self.path.glob("*.part"), *self.folder.glob("*.part"), *lone]:
            with contextlib.suppress(OSError):  # another process may clean, too
                if time.time() - path.stat().st_mtime > _ABANDONED:
                    path.unlink()

    def _finished(self) -> list[Path]:
        return sorted(self.folder.glob("episodes-*.parquet"))

    def _read(self, path: Path) -> Chunk | None:
        companion = path.with_name(path.name.replace("episodes-", "moments-", 1))
        try:
            episodes, about = _read(path)
        except FileNotFoundError:  # just set aside by another process
            return None
        try:
            moments = _read(companion)[0]
        except FileNotFoundError:
            raise DamagedError(path, f"its '{companion.name}' is missing") from None
        if difference := self.entry.difference(about["provenance"]):
            raise ResultsError(f"{path}: belongs to other results: {difference}; move it elsewhere")
        return Chunk(path, episodes, moments)


# --- files ---------------------------------------------------------------------------------------------

_ABOUT = b"limsim_jax"  # in the metadata of a file: its entry, as JSON, and a checksum of everything


def _stem(seeds: NDArray[np.int64]) -> str:
    first, last = int(seeds.min()), int(seeds.max())
    name = f"{first:08d}-{last:08d}"
    gaps = last - first + 1 != seeds.size
    return f"{name}-{zlib.crc32(seeds.astype('<i8').tobytes()):08x}" if gaps else name


def _episodes(entry: Entry, outcome: Outcome) -> pa.Table:
    n = len(outcome.seeds)
    columns = [
        pa.array([entry.scenario] * n, pa.string()),
        pa.array([entry.policy] * n, pa.string()),
        pa.array(np.asarray(outcome.seeds, np.int64)),
        pa.array(np.asarray(outcome.egos, np.int32)),
        pa.array(np.asarray(outcome.digest, np.uint64)),
    ]
    columns += [pa.array(np.asarray(x, np.float64), from_pandas=True) for x in outcome.metrics.values()]
    schema = pa.schema([*KEYS, *((name, pa.float64()) for name in outcome.metrics)])
    return pa.Table.from_arrays(columns, schema=schema)


def _moments(entry: Entry, outcome: Outcome) -> pa.Table:
    given = dict(outcome.moments)
    n = len(given.get("seed", ()))
    given |= {"scenario": [entry.scenario] * n, "policy": [entry.policy] * n}
    if unknown := given.keys() - set(MOMENTS.names):
        raise ValueError(f"moments have no column '{min(unknown)}'; they have {', '.join(MOMENTS.names)}")

    def column(field: pa.Field) -> pa.Array:
        values = list(given.get(field.name, [None] * n))
        if field.name == "other":
            values = [int(x) if x is not None and float(x) >= 0 else None for x in values]  # also NaN
        elif field.type == pa.string():
            values = [None if x is None or x == "" else str(x) for x in values]
        elif field.type == pa.bool_():
            values = [None if x is None else bool(x) for x in values]
        return pa.array(values, field.type, from_pandas=True)

    return pa.Table.from_arrays([column(field) for field in MOMENTS], schema=MOMENTS)


def _encode(table: pa.Table, about: Mapping[str, Any]) -> bytes:
    about = {"format": FORMAT, **about}
    text = json.dumps({**about, "sha256": _checksum(table, about)})
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(
        sink,
        table.schema,
        compression="zstd",
        use_dictionary=False,
        write_statistics=False,
        write_page_checksum=True,
        store_schema=False,
    ) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({_ABOUT: text})
    return sink.getvalue().to_pybytes()


def _read(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """A table and the entry that it carries; `DamagedError` unless both are as they were written."""
    with _readable(path):
        data = path.read_bytes()
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        about = json.loads(file.metadata.metadata[_ABOUT])
        version, checksum = about["format"], about.pop("sha256")
        if version != FORMAT:
            raise ResultsError(f"{path}: has format {version}, this version reads {FORMAT}")
        table = file.read(use_threads=False).replace_schema_metadata(None)
        if checksum != _checksum(table, about):
            raise DamagedError(path, "its content is not what was written")
    return table, about


def _checksum(table: pa.Table, about: Mapping[str, Any]) -> str:
    """Of names, types, values and the entry: of what is read, however it is stored."""
    found = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name, column in zip(table.column_names, table.columns, strict=True):
        found.update(f"{name}:{column.type}:{len(column)};".encode())
        if column.type == pa.float64():
            values = column.to_numpy()
            found.update(np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes())
        else:
            found.update(json.dumps(column.to_pylist()).encode())
    return found.hexdigest()


def _write(path: Path, data: bytes) -> None:
    with _clear(path):
        write_whole(path, data)


@contextlib.contextmanager
def _clear(path: Path) -> Iterator[None]:
    """Errors of writing in one line."""
    try:
        yield
    except OSError as error:
        kept = "what is finished is kept, and the same command goes on from there"
        raise ResultsError(f"{path}: cannot be written ({error.strerror}); {kept}") from error


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever a damaged file raises becomes a `DamagedError`."""
    try:
        yield
    except (ResultsError, FileNotFoundError):
        raise
    except PermissionError as error:
        raise ResultsError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:
        raise DamagedError(path, " ".join(str(error).split()) or type(error).__name__) from error
