"""Sweeps: resumed, extended, sharded, killed, stopped early, verified."""

import itertools
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest
from fake_episodes import FakeEpisodes, both
from paths import REPO

from limsim_jax import files
from limsim_jax.statistics import bootstrap, wilson
from limsim_jax.sweeps import runner
from limsim_jax.sweeps.runner import PolicyFailedError, Progress, run_here, sweep, verify
from limsim_jax.sweeps.store import Entry, Results, ResultsError, open_results

FAKE = [sys.executable, "-B", str(REPO / "tests" / "support" / "fake_episodes.py")]


def seeds_of(results: Results, scenario: str = "flat") -> list[int]:
    rows = results.episodes.to_pylist()
    return [row["seed"] for row in rows if row["scenario"] == scenario]


def digest_of(path: Path, seeds: int, **options) -> str:
    """Of a sweep that nothing disturbs."""
    sweep(both(**options), range(seeds), path)
    return open_results(path).digest


def test_a_sweep_runs_every_world_once(tmp_path):
    fakes = both()
    summary = sweep(fakes, range(20), tmp_path / "out")
    for fake, part in zip(fakes, summary.parts, strict=True):
        assert fake.ran == list(range(20)) and fake.compiled == 1
        assert part[:5] == (fake.scenario, fake.policy, 20, 20, 20)
    assert not summary.damaged
    results = open_results(tmp_path / "out")
    expected = fakes[1].run([17]).digest[0]
    (row,) = (r for r in results.episodes.to_pylist() if r["scenario"] == "hilly" and r["seed"] == 17)
    assert row["digest"] == expected
    assert results.episodes.num_rows == 40


def test_what_is_there_is_not_run_again(tmp_path):
    sweep(both(), range(20), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    fakes = both()
    summary = sweep(fakes, range(20), tmp_path)
    assert all(fake.ran == [] and fake.compiled == 0 for fake in fakes)
    assert [(part.done, part.ran) for part in summary.parts] == [(20, 0)] * 2
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


def test_more_seeds_are_added(tmp_path):
    whole = digest_of(tmp_path / "whole", 41)
    sweep(both(), range(13), tmp_path / "out")
    fakes = both()
    sweep(fakes, range(41), tmp_path / "out")
    assert fakes[0].ran == list(range(13, 41))
    assert open_results(tmp_path / "out").digest == whole


def test_a_policy_that_fails_is_recorded_or_stops_the_sweep(tmp_path):
    sweep([FakeEpisodes(breaks=(9, 30))], range(40), tmp_path / "all")
    rows = [
        row for row in open_results(tmp_path / "all").moments.to_pylist() if row["kind"] == "policy_failed"
    ]
    assert [(row["seed"], row["reason"]) for row in rows] == [
        (9, "my.py:3 in f: boom"),
        (30, "my.py:3 in f: boom"),
    ]
    said = "^flat/still: the policy failed in seed 9 at 2.5 s: my.py:3 in f: boom; finished chunks are kept$"
    with pytest.raises(PolicyFailedError, match=said):
        sweep([FakeEpisodes(breaks=(9, 30))], range(40), tmp_path / "stop", on_error="stop")
    assert seeds_of(open_results(tmp_path / "stop")) == list(range(8))
    fake = FakeEpisodes(breaks=(9, 30))
    sweep([fake], range(40), tmp_path / "stop")
    assert fake.ran == list(range(8, 40))
    with pytest.raises(ValueError, match="on_error: 'ignore'; known are record, stop"):
        sweep([fake], range(2), tmp_path / "x", on_error="ignore")  # pyright: ignore[reportArgumentType]
    assert not (tmp_path / "x").exists()


def test_fresh_starts_anew_and_leaves_other_policies(tmp_path):
    sweep(both(), range(20), tmp_path)
    with pytest.raises(
        ResultsError, match="'code' is '1' there and '2' here; use another directory, or start anew"
    ):
        sweep([FakeEpisodes(version="2")], range(10), tmp_path)
    fake = FakeEpisodes(version="2")
    sweep([fake], range(10), tmp_path, fresh=True)
    assert fake.ran == list(range(10))
    results = open_results(tmp_path)
    assert seeds_of(results) == list(range(10)) and seeds_of(results, "hilly") == list(range(20))
    assert results.provenance["flat", "still"]["code"] == "2"
    with pytest.raises(ValueError, match="fresh would remove the results of other shards"):
        sweep([fake], range(10), tmp_path, fresh=True, shard=(0, 2))
    again = FakeEpisodes(version="2")
    sweep([again], range(10), tmp_path / "new", fresh=True)  # there is nothing to remove
    assert len(again.ran) == 10


@pytest.mark.parametrize(
    ("there", "here", "said"),
    [
        ({"source": "a"}, {"source": "b"}, "limsim_jax itself has changed since"),
        (
            {"policy_code": {"program": "a"}},
            {"policy_code": {"program": "b"}},
            "the program of the policy has changed",
        ),
        (
            {"policy_code": {"sources": {"my.py": "a", "x.py": "c"}}},
            {"policy_code": {"sources": {"my.py": "b", "x.py": "c"}}},
            "the policy's code in my.py has changed since",
        ),
        (
            {"policy_code": {"values": "a"}},
            {"policy_code": {"values": "b"}},
            "the numbers that the policy holds",
        ),
        (
            {"demand": {"cars.rou.xml": "a"}},
            {"demand": {"cars.rou.xml": "b"}},
            "the demand in cars.rou.xml has changed since",
        ),
        ({}, {"policy_code": {"program": "a"}}, "not known with which code of the policy they were made"),
    ],
)
def test_what_has_changed_is_said_in_words(there, here, said):
    found = Entry("a", "b", here, {}).difference(there)
    assert found is not None and said in found and "'" not in found.replace("policy's", "")


def test_seeds_may_have_gaps_and_any_order(tmp_path):
    seeds = [900, 3, 4, 77, 5, 2**31 - 1, 0, 12, 13, 14, 15, 1]
    sweep([FakeEpisodes()], seeds, tmp_path)
    fake = FakeEpisodes()
    sweep([fake], range(20), tmp_path)
    assert sorted(fake.ran) == [2, 6, 7, 8, 9, 10, 11, 16, 17, 18, 19]
    assert seeds_of(open_results(tmp_path)) == sorted({*range(20), *seeds})


def test_a_damaged_shard_is_found_named_and_run_again(tmp_path):
    whole = digest_of(tmp_path, 40)
    path = tmp_path / "hilly" / "bold" / "episodes-00000016-00000023.parquet"
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 8
    path.write_bytes(data)
    other = tmp_path / "flat" / "still" / "moments-00000000-00000007.parquet"
    other.write_bytes(other.read_bytes()[:-9])
    fakes = both()
    summary = sweep(fakes, range(40), tmp_path)
    assert len(summary.damaged) == 2
    assert other.name in summary.damaged[0] and path.name in summary.damaged[1]
    assert fakes[0].ran == list(range(8)) and fakes[1].ran == list(range(16, 24))
    results = open_results(tmp_path)
    assert results.digest == whole and not results.damaged
    assert not sweep(both(), range(40), tmp_path).damaged


def test_a_damaged_shard_does_not_stay_when_its_seeds_are_cut_otherwise(tmp_path):
    whole = digest_of(tmp_path / "whole", 12)
    out = tmp_path / "out"
    sweep(both(), range(8), out)
    path = out / "flat" / "still" / "episodes-00000000-00000007.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    (flat, _) = sweep(both(), range(4, 12), out).parts
    assert flat.ran == flat.done == 8
    assert seeds_of(open_results(out)) == list(range(4, 12))
    assert path.with_suffix(".damaged").exists()
    assert not sweep(both(), range(12), out).damaged
    assert open_results(out).digest == whole


def test_a_lost_chunk_of_moments_is_run_again(tmp_path):
    whole = digest_of(tmp_path, 24)
    (tmp_path / "flat" / "still" / "moments-00000008-00000015.parquet").unlink()
    fakes = both()
    assert len(sweep(fakes, range(24), tmp_path).damaged) == 1
    assert fakes[0].ran == list(range(8, 16))
    assert open_results(tmp_path).digest == whole


# --- shards --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_shards_are_the_whole(tmp_path, n):
    whole = digest_of(tmp_path / "whole", 45)
    ran = []
    for i in reversed(range(n)):
        fakes = both()
        summary = sweep(fakes, range(45), tmp_path / "out", shard=(i, n))
        assert summary.parts[0].wanted == summary.parts[0].done == len(fakes[0].ran)
        ran += fakes[0].ran
    assert sorted(ran) == list(range(45))
    assert open_results(tmp_path / "out").digest == whole


def test_shards_have_the_same_files_as_the_whole(tmp_path):
    """Whole chunks: the shapes of a single sweep, and the same again after an extension."""
    sweep(both(), range(45), tmp_path / "whole")
    for i in range(2):
        sweep(both(), range(45), tmp_path / "out", shard=(i, 2))
    names = [{p.name for p in (tmp_path / x / "flat" / "still").iterdir()} for x in ("whole", "out")]
    assert names[0] == names[1]


@pytest.mark.engine
def test_shards_by_processes_at_the_same_time(tmp_path):
    whole = digest_of(tmp_path / "whole", 160)
    out = tmp_path / "out"
    jobs = [subprocess.Popen([*FAKE, out, "160", "--shard", f"{i}/2", "--delay", "0.01"]) for i in range(2)]
    assert [job.wait(60) for job in jobs] == [0, 0]
    results = open_results(out)
    assert results.digest == whole and results.episodes.num_rows == 320
    assert len(results.provenance) == 2


@pytest.mark.engine
def test_the_same_shard_by_processes_at_the_same_time(tmp_path):
    """Also on unlike devices: what they write is the same."""
    whole = digest_of(tmp_path / "whole", 80)
    out = tmp_path / "out"
    jobs = [subprocess.Popen([*FAKE, out, "80", "--device", name, "--delay", "0.01"]) for name in "abc"]
    assert [job.wait(60) for job in jobs] == [0, 0, 0]
    assert open_results(out).digest == whole
    assert not list(out.rglob("*.part")) and not list(out.rglob("*.damaged"))


# --- killed --------------------------------------------------------------------------------------------


@pytest.mark.engine
def test_killed_at_random_moments(tmp_path):
    """Nothing lost, nothing twice, the same digests in the end."""
    whole = digest_of(tmp_path / "whole", 240)
    reference = {
        (r["scenario"], r["seed"]): r["digest"] for r in open_results(tmp_path / "whole").episodes.to_pylist()
    }
    out, rng, done, kills = tmp_path / "out", random.Random(4711), 0, 0
    for _ in range(6):
        job = subprocess.Popen([*FAKE, out, "240", "--delay", "0.02"])
        started = len(list(out.rglob("episodes-*.parquet")))
        until = time.monotonic() + 30
        while (
            job.poll() is None
            and len(list(out.rglob("episodes-*.parquet"))) == started
            and time.monotonic() < until
        ):
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.2))
        job.send_signal(signal.SIGKILL)
        kills += job.wait(30) == -signal.SIGKILL
        rows = open_results(out).episodes.to_pylist()
        found = {(row["scenario"], row["seed"]): row["digest"] for row in rows}
        assert len(found) == len(rows) >= done, "twice, or lost"
        assert found.items() <= reference.items()
        done = len(rows)
    assert kills >= 3
    assert subprocess.run([*FAKE, out, "240"], timeout=60).returncode == 0
    results = open_results(out)
    assert results.digest == whole and results.episodes.num_rows == 480
    assert results.moments.equals(open_results(tmp_path / "whole").moments)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("call", ["open", "fsync", "replace"])
def test_killed_at_every_step_of_every_write(tmp_path, monkeypatch, call):
    """As SIGKILL would: before the call, and nothing is tidied up after it."""
    whole = digest_of(tmp_path / "whole", 16)
    true = {"open": open, "fsync": os.fsync, "replace": os.replace}[call]
    left, points = 0, 0

    def dying(*args, **options):
        nonlocal left
        left -= 1
        if left < 0:
            monkeypatch.setattr(Path, "unlink", lambda *_: None)
            raise Killed
        return true(*args, **options)

    while True:
        out = tmp_path / f"{points}"
        left = points
        with monkeypatch.context() as patch:
            if call == "open":
                patch.setattr(files, "open", dying, raising=False)
            else:
                patch.setattr(os, call, dying)
            try:
                sweep(both(), range(16), out)
                break
            except Killed:
                points += 1
        monkeypatch.undo()
        fakes = both()
        sweep(fakes, range(16), out)
        assert open_results(out).digest == whole
        shutil.rmtree(out)
    # the index, and moments and episodes of 2 chunks of 2 scenarios; fsync twice each
    assert points == {"open": 9, "fsync": 18, "replace": 9}[call]


# --- progress ------------------------------------------------------------------------------------------


def test_progress(tmp_path):
    sweep([FakeEpisodes(failures=0.3)], range(8), tmp_path)
    heard: list[Progress] = []
    sweep(both(delay=0.01, failures=0.3), range(30), tmp_path, progress=heard.append)
    flat = [p for p in heard if p.scenario == "flat"]
    assert [p.stage for p in flat] == ["compiling", "running", "running", "running", "running", "finished"]
    assert [p.done for p in flat] == [8, 8, 16, 24, 30, 30]
    assert {p.wanted for p in heard} == {30}
    outcome = FakeEpisodes(chunk=30, failures=0.3).run(range(30))
    assert flat[-1].km == pytest.approx(outcome.metrics["distance"].sum() / 1000)
    assert flat[-1].contacts == outcome.metrics["contacts"].sum() > 0
    assert math.isnan(flat[1].eta) and flat[4].eta == flat[5].eta == 0
    assert 0.25 < flat[3].eta / (6 / 16 * (flat[3].elapsed - flat[1].elapsed)) < 4
    assert all(a.elapsed <= b.elapsed for a, b in itertools.pairwise(flat))
    assert [p.done for p in heard if p.scenario == "hilly"] == [0, 0, 8, 16, 24, 30, 30]


def test_worlds_beyond_the_wanted_do_not_count_as_done(tmp_path):
    sweep([FakeEpisodes()], range(30), tmp_path)
    heard: list[Progress] = []
    (part,) = sweep([FakeEpisodes()], range(20), tmp_path, progress=heard.append).parts
    assert part.wanted == part.done == 20
    assert [(p.stage, p.done) for p in heard] == [("finished", 20)]
    assert heard[0].km == pytest.approx(
        sum(FakeEpisodes().run(range(i, i + 4)).metrics["distance"].sum() for i in range(0, 20, 4)) / 1000
    )


# --- stopping early ------------------------------------------------------------------------------------


def test_looks_double_in_whole_chunks():
    assert runner._looks(10_000, 64) == [128, 256, 512, 1024, 2048, 4096, 8192, 10_000]
    assert runner._looks(1000, 50) == [150, 300, 600, 1000]
    assert runner._looks(1000, 256) == [256, 512, 1000]
    assert runner._looks(128, 64) == [128]
    assert runner._looks(5, 64) == [5]


def test_a_scenario_is_not_charged_for_those_before_it(tmp_path):
    slow, quick = FakeEpisodes(delay=0.2), FakeEpisodes("hilly")
    first, second = sweep([slow, quick], range(16), tmp_path).parts
    assert first.elapsed > 0.4 > second.elapsed


def test_a_goal_that_is_reached_on_disk_compiles_nothing(tmp_path):
    goal = (0.05, "success")
    before = sweep([FakeEpisodes(chunk=32)], range(4000), tmp_path, until_ci=goal).parts
    fake = FakeEpisodes(chunk=32)
    after = sweep([fake], range(4000), tmp_path, until_ci=goal).parts
    assert fake.compiled == 0 and fake.ran == []
    assert after[0].interval == before[0].interval and after[0].reached


def test_a_sweep_stops_once_the_interval_is_narrow(tmp_path):
    fake = FakeEpisodes(chunk=32)
    (part,) = sweep([fake], range(4000), tmp_path, until_ci=(0.05, "success")).parts
    looks = runner._looks(4000, 32)
    assert looks == [128, 256, 512, 1024, 2048, 4000]
    intervals = []
    for n in looks:
        successes = sum(FakeEpisodes(chunk=n).run(range(n)).metrics["success"])
        intervals.append(wilson(int(successes), n, 1 - 0.05 / 6))
    narrow = [(i.high - i.low) / 2 <= 0.05 for i in intervals]
    stop = narrow.index(True)
    assert 0 < stop < 5  # neither at once nor at the end
    assert fake.ran == list(range(looks[stop]))
    assert part.reached and part.interval == intervals[stop]
    assert (part.wanted, part.done) == (4000, looks[stop])


def test_a_sweep_that_never_gets_there_runs_all(tmp_path):
    (part,) = sweep([FakeEpisodes(chunk=64)], range(300), tmp_path, until_ci=(0.001, "success")).parts
    assert not part.reached and part.done == 300 and part.interval is not None
    assert part.interval.estimate == pytest.approx(0.9, abs=0.06)


def test_means_are_bootstrapped_and_nulls_left_out(tmp_path):
    fake = FakeEpisodes(chunk=64)
    (part,) = sweep([fake], range(1000), tmp_path, until_ci=(0.2, "min_ttc")).parts
    assert part.reached and part.done == 256
    values = FakeEpisodes(chunk=256).run(range(256)).metrics["min_ttc"]
    finite = values[np.isfinite(values)]
    assert finite.size < 200
    assert part.interval == bootstrap(finite, level=1 - 0.05 / 4)


def test_a_metric_that_was_never_measured_does_not_stop_a_sweep(tmp_path):
    class Silent(FakeEpisodes):
        def run(self, seeds):
            outcome = super().run(seeds)
            outcome.metrics["min_ttc"][:] = np.nan  # pyright: ignore[reportIndexIssue]
            return outcome

    (part,) = sweep([Silent(chunk=64)], range(300), tmp_path, until_ci=(1e6, "min_ttc")).parts
    assert not part.reached and part.done == 300


@pytest.mark.engine
def test_kills_do_not_move_the_end(tmp_path):
    """Nor does what was on disk before."""
    goal = 0.05, "success"
    (whole,) = sweep([FakeEpisodes(chunk=32)], range(4000), tmp_path / "whole", until_ci=goal).parts

    def dying(after: int):
        count = itertools.count()

        def run(episodes, chunks: Iterable[Sequence[int]]):
            for outcome in run_here(episodes, chunks):
                if next(count) == after:
                    raise Killed
                yield outcome

        return run

    out = tmp_path / "out"
    sweep([FakeEpisodes(chunk=32)], range(100, 3000, 3), out)
    for after in (0, 1, 3, 2):
        with pytest.raises(Killed):
            sweep([FakeEpisodes(chunk=32)], range(4000), out, run_chunks=dying(after), until_ci=goal)
    (part,) = sweep([FakeEpisodes(chunk=32)], range(4000), out, until_ci=goal).parts
    assert part.interval == whole.interval and part.reached
    assert set(seeds_of(open_results(out))) >= set(range(whole.done))
    assert set(seeds_of(open_results(out))) == {*range(whole.done), *range(100, 3000, 3)}


@pytest.mark.engine
@pytest.mark.parametrize("p", [0.03, 0.1, 0.5])
def test_stopping_early_keeps_the_level(p):
    """The share of sweeps whose last interval misses the truth, with looks as in a sweep."""
    rng = np.random.default_rng(1)
    looks = runner._looks(8192, 64)
    level = 1 - 0.05 / len(looks)
    missed = 0
    for _ in range(1500):
        values = rng.random(looks[-1]) < p
        intervals = (runner._interval(values[:n].astype(float).tolist(), True, level) for n in looks)
        narrow = next(i for i in intervals if (i.high - i.low) / 2 <= 0.03)
        missed += not narrow.low <= p <= narrow.high
    assert missed / 1500 < 0.05


# --- bad input -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"seeds": []}, "no seeds"),
        ({"seeds": [3, -1]}, r"seeds from -1 to 3; they must be within 0 and 2\^31 - 1"),
        ({"seeds": [2**31]}, "seeds from 2147483648"),
        ({"seeds": [5, 1, 4, 5]}, "seed 5 is there twice"),
        ({"shard": (2, 2)}, "shard 2/2: the first must be from 0 to the second less 1"),
        ({"shard": (-1, 2)}, "shard -1/2"),
        ({"shard": (0, 0)}, "shard 0/0"),
        ({"until_ci": (0.0, "success")}, "a half-width of 0.0 for 'success'.*between 0 and 0.5"),
        ({"until_ci": (0.5, "success")}, "a half-width of 0.5"),
        ({"until_ci": (math.nan, "min_ttc")}, "a half-width of nan for 'min_ttc'.*above 0"),
        ({"until_ci": (-1, "min_ttc")}, "above 0"),
        ({"until_ci": (0.1, "sucess")}, "flat/still: no metric 'sucess'; did you mean 'success'?"),
        ({"until_ci": (0.1, "success"), "shard": (0, 2)}, "one of the two"),
        ({"episodes": []}, "no scenario"),
        ({"episodes": [FakeEpisodes(), FakeEpisodes()]}, "flat/still is there twice"),
        ({"episodes": [FakeEpisodes("a b")]}, "scenario 'a b'"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_compiled(tmp_path, options, text):
    fake = FakeEpisodes()
    options = {"episodes": [fake], "seeds": range(16)} | options
    with pytest.raises(ValueError, match=text) as error:
        sweep(out=tmp_path / "out", **options)
    assert "\n" not in str(error.value)
    assert not fake.compiled and not (tmp_path / "out").exists()


def test_another_experiment_is_refused_before_anything_is_compiled(tmp_path):
    sweep([FakeEpisodes()], range(8), tmp_path)
    fake = FakeEpisodes(chunk=16)
    with pytest.raises(ResultsError, match="'chunk' is 8 there and 16 here"):
        sweep([fake], range(16), tmp_path)
    assert not fake.compiled
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(ResultsError, match="is a file"):
        sweep([fake], range(16), path)


def test_a_full_disk_stops_the_sweep_and_it_goes_on_later(tmp_path, monkeypatch):
    whole = digest_of(tmp_path / "whole", 40)
    out, writes = tmp_path / "out", 0

    def full(path, mode):
        nonlocal writes
        writes += 1
        return open("/dev/full" if writes > 6 else path, "wb")

    monkeypatch.setattr(files, "open", full, raising=False)
    with pytest.raises(ResultsError, match=r"No space left on device.*what is finished is kept"):
        sweep(both(), range(40), out)
    monkeypatch.undo()
    assert seeds_of(open_results(out)) == list(range(16))
    sweep(both(), range(40), out)
    assert open_results(out).digest == whole


def test_a_back_end_that_loses_a_chunk_is_found_out(tmp_path):
    def forgetful(episodes, chunks):
        return (outcome for i, outcome in enumerate(run_here(episodes, chunks)) if i != 1)

    with pytest.raises(RuntimeError, match="seed 8 was asked for and never came back"):
        sweep([FakeEpisodes()], range(24), tmp_path, run_chunks=forgetful)


# --- verification --------------------------------------------------------------------------------------


def test_verify_runs_a_sample_again(tmp_path):
    sweep(both(), range(50), tmp_path)
    fakes = both()
    report = verify(open_results(tmp_path), fakes, sample=20)
    assert report.ok and report.checked == 40 and report.differences == ()
    assert len(set(fakes[0].ran)) == 20 and set(fakes[0].ran) <= set(range(50))
    assert fakes[0].ran != list(range(20))
    again, other = both(), both()
    verify(open_results(tmp_path), again, sample=20)
    verify(open_results(tmp_path), other, sample=20, seed=1)
    assert again[0].ran == fakes[0].ran != other[0].ran
    assert verify(open_results(tmp_path), fakes[:1], sample=1000).checked == 50


class Drifted(FakeEpisodes):
    """Ends differently in two worlds, and measures one other metric differently in a third."""

    def run(self, seeds):
        outcome = super().run(seeds)
        for i, seed in enumerate(seeds):
            if seed in (7, 31):
                outcome.digest[i] ^= np.uint64(1)
            if seed == 20:
                outcome.metrics["contacts"][i] += 1  # pyright: ignore[reportIndexIssue]
            if seed == 26:
                outcome.metrics["min_ttc"][i] = np.nan  # pyright: ignore[reportIndexIssue]
        return outcome


def test_verify_names_the_worlds_that_changed(tmp_path):
    sweep([Drifted()], range(50), tmp_path)
    assert np.isfinite(FakeEpisodes().run([26]).metrics["min_ttc"][0])
    report = verify(open_results(tmp_path), [FakeEpisodes(version="2", device="slide rule")], sample=50)
    assert not report.ok and report.checked == 50
    assert [(m.seed, m.what) for m in report.mismatches] == [
        (7, "digest"),
        (20, "contacts"),
        (26, "min_ttc"),
        (31, "digest"),
    ]
    assert report.mismatches[0][:2] == ("flat", "still")
    assert report.differences == ("flat/still: 'code' is '1' there and '2' here",)


def test_verify_tells_another_device(tmp_path):
    sweep([FakeEpisodes()], range(8), tmp_path)
    report = verify(open_results(tmp_path), [FakeEpisodes(device="slide rule")])
    assert report.ok and report.checked == 8
    assert report.differences == ("flat/still: 'device' is 'abacus' there and 'slide rule' here",)


def test_verify_of_nothing(tmp_path):
    sweep([FakeEpisodes()], range(8), tmp_path)
    results = open_results(tmp_path)
    with pytest.raises(ResultsError, match="holds no worlds of hilly/still; it has flat/still"):
        verify(results, [FakeEpisodes("hilly")])
    with pytest.raises(ValueError, match="sample of 0"):
        verify(results, [FakeEpisodes()], sample=0)
    with pytest.raises(ValueError, match="no scenario"):
        verify(results, [])


# --- memory --------------------------------------------------------------------------------------------


@pytest.mark.engine
def test_memory_does_not_grow_with_the_seeds(tmp_path):
    pytest.importorskip("resource")
    code = """
import resource, sys
sys.path[:0] = sys.argv[3:]
from fake_episodes import FakeEpisodes
from limsim_jax.sweeps.runner import sweep
fake = FakeEpisodes(chunk=64, columns=60)
for seeds in (640, int(sys.argv[1])):
    sweep([fake], range(seeds), sys.argv[2], until_ci=(0.0001, "success"))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    paths = [str(REPO / "tests" / "support"), str(REPO)]
    done = subprocess.run(
        [sys.executable, "-B", "-c", code, "6400", str(tmp_path), *paths], capture_output=True, text=True
    )
    few, many = (int(line) for line in done.stdout.split())  # KiB
    rows = 6400 * 64 * 8 / 1024
    assert many - few < rows, (few, many, "keeping the rows would take more")
