"""Results on disk: whole or not there, found damaged when they are."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_episodes import FakeEpisodes, both
from paths import REPO

from limsim_jax import files
from limsim_jax.sweeps import store
from limsim_jax.sweeps.store import DamagedError, Entry, Outcome, ResultsError, Shards, open_results, register


def entry(fake: FakeEpisodes) -> Entry:
    return Entry(fake.scenario, fake.policy, fake.provenance(), fake.units)


def filled(path: Path, *fakes: FakeEpisodes, seeds=((0, 1, 2, 3, 4, 5, 6, 7),)) -> list[Shards]:
    """A directory with chunks of these seeds."""
    register(path, [entry(fake) for fake in fakes])
    found = []
    for fake in fakes:
        found.append(Shards(path, entry(fake)))
        for some in seeds:
            found[-1].write(fake.run(some))
    return found


def one_line(error: pytest.ExceptionInfo[ResultsError]) -> str:
    text = str(error.value)
    assert "\n" not in text and len(text) < 400
    return text


def test_what_is_written_comes_back(tmp_path):
    fake = FakeEpisodes(failures=0.5)
    filled(tmp_path, fake, seeds=([10, 11, 12], [3, 1, 2]))
    results = open_results(tmp_path)
    outcome = fake.run([1, 2, 3, 10, 11, 12])
    rows = results.episodes
    assert rows.column_names == ["scenario", "policy", "seed", "ego", "digest", *outcome.metrics]
    assert rows.column("seed").to_pylist() == [1, 2, 3, 10, 11, 12]
    assert set(rows.column("scenario").to_pylist()) == {"flat"}
    np.testing.assert_array_equal(rows.column("digest").to_numpy(), outcome.digest)
    assert rows.column("digest").type == "uint64" and int(outcome.digest.max()) >= 2**63
    for name, values in outcome.metrics.items():
        expected = [None if np.isnan(x) else x for x in values]
        assert rows.column(name).to_pylist() == expected, name
    assert None in rows.column("min_ttc").to_pylist()
    assert results.moments.schema.equals(store.MOMENTS)
    moments = results.moments.to_pylist()
    assert [m["seed"] for m in moments] == outcome.moments["seed"].tolist()
    assert [m["rank"] for m in moments] == outcome.moments["rank"].tolist()
    assert [m["other"] for m in moments] == [None if x < 0 else x for x in outcome.moments["other"]]
    assert moments[0]["responsible"] == "ego" and moments[1]["responsible"] is None
    assert moments[0]["avoidable_by_ego"] is True and moments[0]["avoidable_by_other"] is None
    assert moments[0]["kind"] == "contact" and moments[0]["module"] is None
    assert results.units == fake.units
    assert results.provenance == {("flat", "still"): fake.provenance()}


def test_an_infinite_value_is_kept_and_is_not_null(tmp_path):
    fake = FakeEpisodes()
    outcome = fake.run([0, 1])
    outcome.metrics["min_ttc"][:] = [np.inf, np.nan]  # pyright: ignore[reportIndexIssue]
    (shards,) = filled(tmp_path, fake, seeds=())
    shards.write(outcome)
    assert open_results(tmp_path).episodes.column("min_ttc").to_pylist() == [np.inf, None]


def test_scenarios_keep_their_order_and_their_own_metrics(tmp_path):
    flat, hilly = FakeEpisodes("zeta", columns=1), FakeEpisodes("alpha", columns=2)
    filled(tmp_path, flat, hilly)
    results = open_results(tmp_path)
    assert results.episodes.column("scenario").to_pylist() == ["zeta"] * 8 + ["alpha"] * 8
    assert results.episodes.column("metric_1").to_pylist()[:8] == [None] * 8
    assert None not in results.episodes.column("metric_1").to_pylist()[8:]
    assert set(results.units) == set(hilly.units)


def test_every_file_says_what_it_is(tmp_path):
    filled(tmp_path, FakeEpisodes())
    path = tmp_path / "flat" / "still" / "episodes-00000000-00000007.parquet"
    file = pq.ParquetFile(path)
    assert file.metadata.row_group(0).column(4).compression == "ZSTD"
    about = json.loads(file.metadata.metadata[b"limsim_jax"])
    assert about["provenance"] == FakeEpisodes().provenance() and about["units"] == FakeEpisodes().units
    index = json.loads((tmp_path / "results.json").read_text())
    assert index["format"] == 2
    assert index["entries"][0]["provenance"] == FakeEpisodes().provenance()
    assert sorted(p.name for p in path.parent.iterdir()) == [
        path.name,
        path.name.replace("episodes", "moments"),
    ]


def test_the_same_chunk_is_the_same_bytes_on_every_device(tmp_path):
    files = [
        {p.name: p.read_bytes() for p in shards.folder.iterdir()}
        for name in ("a", "b")
        for shards in filled(tmp_path / name, FakeEpisodes())
    ]
    assert files[0] == files[1]


def test_names_of_chunks_with_gaps_tell_them_apart(tmp_path):
    filled(tmp_path, FakeEpisodes(), seeds=([0, 2, 5], [1, 3, 4]))
    filled(tmp_path, FakeEpisodes("other"), seeds=([0, 2, 5], [0, 3, 5]))
    names = [p.name for p in tmp_path.glob("other/still/episodes-*")]
    assert len(names) == 2 and all(name.startswith("episodes-00000000-00000005-") for name in names)


def test_a_world_in_two_files_counts_once(tmp_path):
    fake = FakeEpisodes(failures=0.5)
    filled(tmp_path / "a", fake, seeds=([0, 1, 2, 3], [2, 3, 4, 5], [4, 5, 6, 7]))
    filled(tmp_path / "b", fake)
    a, b = open_results(tmp_path / "a"), open_results(tmp_path / "b")
    assert a.episodes.equals(b.episodes) and a.moments.equals(b.moments)
    assert a.digest == b.digest
    assert a.moments.num_rows >= 4


def test_a_world_that_ended_in_two_ways_is_an_error(tmp_path):
    fake = FakeEpisodes()
    (shards,) = filled(tmp_path, fake, seeds=([0, 1, 2, 3],))
    outcome = fake.run([3, 4])
    outcome.digest[0] += np.uint64(1)
    shards.write(outcome)
    with pytest.raises(ResultsError, match="seed 3 ended differently in episodes-00000000-00000003") as error:
        open_results(tmp_path)
    one_line(error)


def test_the_digest_is_of_worlds_not_of_files(tmp_path):
    fake = FakeEpisodes()
    filled(tmp_path / "a", fake, seeds=([0, 1, 2, 3], [4, 5]))
    filled(tmp_path / "b", fake, seeds=([4, 5, 0, 1], [3, 2]))
    filled(tmp_path / "c", fake, seeds=([0, 1, 2, 3], [4, 6]))
    a, b, c = (open_results(tmp_path / name).digest for name in "abc")
    assert a == b != c


# --- damage --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["episodes", "moments"])
def test_a_changed_byte_is_found_or_changes_nothing(tmp_path, kind):
    """Wherever it is: within pages, in their headers, in the footer."""
    fake = FakeEpisodes(failures=0.5)
    filled(tmp_path, fake)
    path = tmp_path / "flat" / "still" / f"{kind}-00000000-00000007.parquet"
    whole = path.read_bytes()
    before = open_results(tmp_path)
    rng = np.random.default_rng(0)
    positions = rng.permutation(len(whole))[:250].tolist()
    found = 0
    for position in positions:
        data = bytearray(whole)
        data[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            after = open_results(tmp_path)
        except ResultsError as error:
            assert "\n" not in str(error) and path.name in str(error)
            found += 1
        else:
            assert after.episodes.equals(before.episodes) and after.moments.equals(before.moments)
            assert after.provenance == before.provenance
    assert found > 0.7 * len(positions)


@pytest.mark.parametrize("kind", ["episodes", "moments"])
def test_a_truncated_file_is_found_and_named(tmp_path, kind):
    filled(tmp_path, FakeEpisodes(), seeds=([0, 1, 2, 3], [4, 5, 6, 7]))
    path = tmp_path / "flat" / "still" / f"{kind}-00000000-00000003.parquet"
    whole = path.read_bytes()
    for length in (0, 3, 4, 11, 12, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ResultsError, match=f"{path.name}: damaged") as error:
            open_results(tmp_path)
        one_line(error)
        results = open_results(tmp_path, skip_damaged=True)
        assert results.episodes.column("seed").to_pylist() == [4, 5, 6, 7]
        (damaged,) = results.damaged
        assert path.name in damaged


def test_a_tampered_value_is_found(tmp_path):
    """A file that is valid Parquet but not what was written."""
    filled(tmp_path, FakeEpisodes())
    path = tmp_path / "flat" / "still" / "episodes-00000000-00000007.parquet"
    file = pq.ParquetFile(path)
    table = file.read()
    values = table.column("contacts").to_numpy().copy()
    values[3] += 1
    index = table.column_names.index("contacts")
    changed = table.set_column(index, "contacts", [values])
    with pq.ParquetWriter(path, changed.schema, store_schema=False) as writer:
        writer.write_table(changed)
        writer.add_key_value_metadata({b"limsim_jax": file.metadata.metadata[b"limsim_jax"]})
    with pytest.raises(ResultsError, match=r"damaged .its content is not what was written"):
        open_results(tmp_path)


def test_rows_without_their_moments_are_damaged(tmp_path):
    filled(tmp_path, FakeEpisodes())
    (tmp_path / "flat" / "still" / "moments-00000000-00000007.parquet").unlink()
    with pytest.raises(ResultsError, match=r"'moments-00000000-00000007\.parquet' is missing"):
        open_results(tmp_path)


def test_setting_aside_leaves_no_half_chunk(tmp_path):
    (shards,) = filled(tmp_path, FakeEpisodes(), seeds=([0, 1], [2, 3]))
    path = shards.folder / "moments-00000000-00000001.parquet"
    path.write_bytes(b"PAR1")
    errors = [chunk for chunk in shards.chunks() if isinstance(chunk, DamagedError)]
    assert [error.path for error in errors] == [path]
    shards.set_aside(errors[0])
    assert open_results(tmp_path).episodes.column("seed").to_pylist() == [2, 3]
    assert len(list(shards.folder.glob("*.damaged"))) == 2
    shards.set_aside(errors[0])  # as when another process has just done so


def test_leftovers_of_killed_writers_are_ignored_and_removed_when_old(tmp_path):
    (shards,) = filled(tmp_path, FakeEpisodes())
    names = ("episodes-00000008-00000015.parquet.0123.part", "moments-00000008-00000015.parquet")
    old, young = [], []
    for folder, name in [(tmp_path, "results.json.4567.part"), *((shards.folder, name) for name in names)]:
        for age, group in ((7200, old), (60, young)):
            group.append(folder / name.replace("00000008", f"{age:08d}").replace("4567", f"{age}"))
            group[-1].write_bytes(b"half")
            os.utime(group[-1], (time.time() - age, time.time() - age))
    done = shards.folder / "moments-00000000-00000007.parquet"
    os.utime(done, (0, 0))
    assert open_results(tmp_path).episodes.num_rows == 8
    shards.clean()
    assert not any(path.exists() for path in old)
    assert all(path.exists() for path in young) and done.exists()
    assert open_results(tmp_path).episodes.num_rows == 8


# --- where nothing can be written ----------------------------------------------------------------------


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path, monkeypatch):
    fake = FakeEpisodes()
    (shards,) = filled(tmp_path, fake)
    monkeypatch.setattr(files, "open", lambda path, mode: open("/dev/full", "wb"), raising=False)
    with pytest.raises(
        ResultsError, match=r"moments-00000008-00000009.*cannot be written \(No space"
    ) as error:
        shards.write(fake.run([8, 9]))
    one_line(error)
    monkeypatch.undo()
    assert open_results(tmp_path).episodes.num_rows == 8
    shards.write(fake.run([8, 9]))
    assert open_results(tmp_path).episodes.num_rows == 10


def python(code: str) -> subprocess.CompletedProcess[str]:
    head = f"import sys; sys.path[:0] = [{str(REPO / 'tests' / 'support')!r}, {str(REPO)!r}]\n"
    return subprocess.run(
        [sys.executable, "-B", "-c", head + code], capture_output=True, text=True, timeout=120
    )


def test_a_file_that_hits_a_limit_leaves_no_part_behind(tmp_path):
    """The system itself refuses in the middle of a file."""
    pytest.importorskip("resource")
    filled(tmp_path, FakeEpisodes())
    done = python(f"""
import resource
from fake_episodes import FakeEpisodes
from limsim_jax.sweeps.runner import sweep
resource.setrlimit(resource.RLIMIT_FSIZE, (7000, 7000))
try:
    sweep([FakeEpisodes(chunk=64, columns=80)], range(64), {str(tmp_path / "new")!r})
except ValueError as error:
    print(error)
""")
    assert re.search(r"episodes-\S+: cannot be written \(File too large\)", done.stdout), done
    assert done.stdout.count("\n") == 1
    assert not list(tmp_path.glob("new/*/*/*.part"))
    assert not list(tmp_path.glob("new/*/*/episodes*"))


def test_an_unwritable_folder_is_one_line_before_anything_runs(tmp_path):
    out = tmp_path / "out"
    fake = FakeEpisodes()
    filled(out, fake)
    folder = out / "flat" / "still"
    folder.chmod(0o555)
    for path in (tmp_path, *tmp_path.parents[:-2]):
        path.chmod(path.stat().st_mode | 0o055)
    done = python(f"""
import os
from fake_episodes import FakeEpisodes
from limsim_jax.sweeps.runner import sweep
if os.geteuid() == 0:  # to whom nothing is forbidden
    os.seteuid(65534)
fake = FakeEpisodes()
try:
    sweep([fake], range(16), {str(out)!r})
except ValueError as error:
    print(error, fake.compiled, fake.ran)
""")
    folder.chmod(0o755)
    assert re.fullmatch(r".*flat/still: cannot be written \(Permission denied\).* 0 \[\]\n", done.stdout), (
        done
    )
    assert open_results(out).episodes.num_rows == 8


# --- what the directory is -----------------------------------------------------------------------------


def refused(path: Path, fake: FakeEpisodes) -> str:
    with pytest.raises(ResultsError) as error:
        register(path, [entry(fake)])
    return one_line(error)


def test_another_experiment_or_version_is_refused_and_the_difference_named(tmp_path):
    filled(tmp_path, FakeEpisodes())
    assert "'code' is '1' there and '2' here" in refused(tmp_path, FakeEpisodes(version="2"))
    text = refused(tmp_path, FakeEpisodes(failures=0.2))
    assert "line 2 of 'experiment' is 'failures = 0.1' there and 'failures = 0.2' here" in text
    assert "flat/still" in text and str(tmp_path) in text
    register(tmp_path, [entry(FakeEpisodes(device="another"))])  # does not matter
    register(tmp_path, [entry(FakeEpisodes("hilly", version="2"))])  # another entry
    assert len(open_results(tmp_path).provenance) == 2


@pytest.mark.parametrize(
    ("there", "here", "text"),
    [
        ({"a": {"b": [1, 2]}}, {"a": {"b": (1, 3)}}, "'a.b' is [1, 2] there and [1, 3] here"),
        ({"a": 1}, {"a": 1, "b": 2}, "'b' is missing there"),
        ({"a": 1, "b": 2}, {"a": 1}, "'b' is missing here"),
        ({"t": "x\ny"}, {"t": "x\ny\nz"}, "line 3 of 't' is missing there and 'z' here"),
        ({"device": 1, "memory": 3}, {"device": 2}, None),
        ({1: "x"}, {"1": "x"}, None),
        ({"t": "x\ny"}, {"t": "x\ny\n"}, "'t' is 'x\\ny' there and 'x\\ny\\n' here"),
    ],
)
def test_differences_in_words(there, here, text):
    assert Entry("a", "b", here, {}).difference(there) == text


def test_a_chunk_of_other_results_is_refused(tmp_path):
    filled(tmp_path / "a", FakeEpisodes(), seeds=([0, 1],))
    filled(tmp_path / "b", FakeEpisodes(version="2"), seeds=([2, 3],))
    for path in tmp_path.glob("b/flat/still/*"):
        path.rename(tmp_path / "a" / "flat" / "still" / path.name)
    with pytest.raises(
        ResultsError, match="belongs to other results: 'code' is '2' there and '1' here"
    ) as error:
        open_results(tmp_path / "a")
    one_line(error)


def test_another_format_is_refused(tmp_path):
    filled(tmp_path, FakeEpisodes())
    index = tmp_path / "results.json"
    index.write_text(index.read_text().replace('"format": 2', '"format": 3'))
    assert "has format 3, this version reads 2" in refused(tmp_path, FakeEpisodes())
    with pytest.raises(ResultsError, match="has format 3"):
        open_results(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 2}', '{"format": 2, "entries": [{}]}', "\x00" * 20]
)
def test_a_damaged_index_can_be_removed_and_is_made_again(tmp_path, text):
    filled(tmp_path, *both())
    before = open_results(tmp_path)
    index = tmp_path / "results.json"
    index.write_text(text)
    with pytest.raises(ResultsError, match=r"results.json: damaged; remove it") as error:
        open_results(tmp_path)
    one_line(error)
    index.unlink()
    register(tmp_path, [entry(fake) for fake in both()])
    after = open_results(tmp_path)
    assert after.digest == before.digest and after.provenance == before.provenance


def test_an_entry_that_the_index_lost_is_read_from_its_files(tmp_path):
    """Two sweeps may write the index at the same moment: the later one wins."""
    filled(tmp_path, FakeEpisodes())
    index = (tmp_path / "results.json").read_text()
    filled(tmp_path, FakeEpisodes("hilly"))
    (tmp_path / "results.json").write_text(index)
    results = open_results(tmp_path)
    assert set(results.provenance) == {("flat", "still"), ("hilly", "still")}
    assert results.episodes.num_rows == 16
    assert "'code'" in refused(tmp_path, FakeEpisodes("hilly", version="2"))
    register(tmp_path, [entry(FakeEpisodes("hilly"))])
    assert len(json.loads((tmp_path / "results.json").read_text())["entries"]) == 2


def test_nothing_there(tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(ResultsError, match="no results of a sweep here") as error:
            open_results(path)
        one_line(error)
    register(tmp_path, [entry(FakeEpisodes())])
    with pytest.raises(ResultsError, match="no chunk of worlds is finished here yet"):
        open_results(tmp_path)


def test_out_is_a_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("mine")
    assert "is a file; results need a directory" in refused(path, FakeEpisodes())
    assert "cannot be written" in refused(path / "below", FakeEpisodes())
    assert path.read_text() == "mine"


@pytest.mark.parametrize("name", ["", "a b", "../up", "a/b", "ä", "x.y"])
def test_names_are_plain(name):
    with pytest.raises(ValueError, match="letters, digits"):
        Entry(name, "still", {}, {})
    with pytest.raises(ValueError, match="letters, digits"):
        Entry("flat", name, {}, {})


def test_unknown_columns_of_moments_are_an_error(tmp_path):
    (shards,) = filled(tmp_path, FakeEpisodes(), seeds=())
    outcome = FakeEpisodes().run([0])
    with pytest.raises(ValueError, match="no column 'when'"):
        shards.write(
            Outcome(
                outcome.seeds,
                outcome.egos,
                outcome.metrics,
                {"seed": np.array([0]), "when": np.array([1])},
                outcome.digest,
            )
        )


def test_a_chunk_without_moments_is_whole(tmp_path):
    fake = FakeEpisodes(failures=0.0)
    filled(tmp_path, fake)
    assert open_results(tmp_path).moments.num_rows == 0
