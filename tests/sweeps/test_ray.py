"""Sweeps on a local Ray cluster, whose workers die."""

import functools
import os
import secrets
import signal
import time
from pathlib import Path

import pytest
from fake_episodes import FakeEpisodes, both
from paths import REPO
from real_episodes import noted

ray = pytest.importorskip("ray", reason="needs the extra 'ray'")

from limsim_jax.sweeps import cluster  # noqa: E402
from limsim_jax.sweeps.cluster import sweep_on_ray  # noqa: E402
from limsim_jax.sweeps.runner import Progress, sweep  # noqa: E402
from limsim_jax.sweeps.store import open_results  # noqa: E402

pytestmark = pytest.mark.engine


@pytest.fixture(scope="module", autouse=True)
def three_workers():
    """Three workers' worth of a cluster on this machine; small, for other things run here, too."""
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # else Ray writes one to the user's home
    path = os.pathsep.join([str(REPO / "tests" / "support"), str(REPO)])
    ray.init(
        "local",
        num_cpus=3,
        include_dashboard=False,
        object_store_memory=80 * 2**20,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": path}},
    )
    yield
    ray.shutdown()


def whole(path: Path, seeds: int) -> str:
    sweep(both(), range(seeds), path)
    return open_results(path).digest


def jobs(note: Path) -> list[tuple[int, int]]:
    """(process, first seed) of every chunk that a worker began."""
    lines = [line.split() for line in note.read_text().splitlines()]
    return [(int(process), int(seed)) for process, seed in lines]


def test_a_worker_that_is_killed_midway_loses_nothing(tmp_path):
    note = tmp_path / "note"
    killed = []

    def progress(now: Progress) -> None:
        if now.scenario == "flat" and now.done >= 64 and not killed:
            until = time.monotonic() + 10
            while len(jobs(note)) <= now.done // 8 and time.monotonic() < until:
                time.sleep(0.002)  # until a worker has begun another chunk
            killed.append(jobs(note)[-1][0])
            os.kill(killed[0], signal.SIGKILL)

    factory = functools.partial(both, delay=0.1, note=note)
    summary = sweep_on_ray(factory, range(240), tmp_path / "out", workers=3, progress=progress)
    assert [(part.done, part.ran) for part in summary.parts] == [(240, 240)] * 2
    results = open_results(tmp_path / "out")
    assert results.digest == whole(tmp_path / "whole", 240)
    assert results.episodes.num_rows == 480
    began = jobs(note)
    processes = [process for process, _ in began]
    assert killed and os.getpid() not in processes
    assert processes[-1] != killed[0] and len(set(processes)) >= 3, "no worker took the place of the dead"
    assert 60 <= len(began) <= 61, "only the chunk of the dead worker ran again, if it had begun"


@pytest.mark.slow  # every worker compiles
def test_real_worlds_on_ray_end_as_they_do_here(tmp_path):
    note = tmp_path / "note"
    killed = []

    def progress(now: Progress) -> None:
        if now.done >= 4 and not killed:
            killed.append(jobs(note)[-1][0])
            os.kill(killed[0], signal.SIGKILL)

    factory = functools.partial(noted, note)
    (part,) = sweep_on_ray(factory, range(24), tmp_path / "out", workers=2, progress=progress).parts
    assert (part.done, part.ran) == (24, 24) and killed
    sweep(noted(tmp_path / "here"), range(24), tmp_path / "whole")
    there, here = (open_results(tmp_path / name) for name in ("out", "whole"))
    assert there.digest == here.digest and there.episodes.equals(here.episodes)
    assert len({process for process, _ in jobs(note)}) >= 2


def test_a_sweep_on_ray_goes_on_where_one_here_stopped(tmp_path):
    sweep(both(), range(50), tmp_path / "out", shard=(1, 2))
    heard: list[Progress] = []
    (flat, _) = sweep_on_ray(both, range(50), tmp_path / "out", workers=2, progress=heard.append).parts
    assert flat.done == 50 and flat.ran == 26
    assert open_results(tmp_path / "out").digest == whole(tmp_path / "whole", 50)
    assert heard[-1].stage == "finished" and heard[-1].done == 50


def test_stopping_early_does_not_depend_on_the_order_of_workers(tmp_path):
    goal = 0.05, "success"
    (here, _) = sweep(both(chunk=32), range(4000), tmp_path / "here", until_ci=goal).parts
    factory = functools.partial(both, chunk=32)
    (there, _) = sweep_on_ray(factory, range(4000), tmp_path / "there", workers=3, until_ci=goal).parts
    assert there.interval == here.interval and there.done == here.done < 4000
    assert open_results(tmp_path / "here").digest == open_results(tmp_path / "there").digest


class Deadly(FakeEpisodes):
    def run(self, seeds):
        if 16 in seeds:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run(seeds)


def deadly() -> list[FakeEpisodes]:
    return [Deadly()]


def test_a_chunk_that_kills_every_worker_ends_the_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "RETRIES", 1)
    with pytest.raises(RuntimeError, match="2 workers died over the chunk of seed 16"):
        sweep_on_ray(deadly, range(40), tmp_path, workers=2)
    assert open_results(tmp_path).episodes.num_rows >= 8
    assert 16 not in open_results(tmp_path).episodes.column("seed").to_pylist()


class Wrong(FakeEpisodes):
    def run(self, seeds):
        if 16 in seeds:
            raise ValueError("world 16 has no road")
        return super().run(seeds)


def wrong() -> list[FakeEpisodes]:
    return [Wrong()]


def no_episodes() -> list[FakeEpisodes]:
    raise ValueError("paper.toml: no such file")


def unlike() -> list[FakeEpisodes]:
    return [FakeEpisodes(version=str(os.getpid()), delay=0.5)]


def test_errors_of_workers_come_as_they_are(tmp_path):
    with pytest.raises(ValueError, match=r"^world 16 has no road$"):
        sweep_on_ray(wrong, range(40), tmp_path / "a", workers=1)
    assert open_results(tmp_path / "a").episodes.num_rows >= 8
    with pytest.raises(ValueError, match=r"^paper\.toml: no such file$"):
        sweep_on_ray(no_episodes, range(40), tmp_path / "b", workers=1)
    with pytest.raises(ValueError, match="workers are not alike: flat/still: 'code' is"):
        sweep_on_ray(unlike, range(4000), tmp_path / "c", workers=2)
    with pytest.raises(ValueError, match=r"0 workers\? at least 1"):
        sweep_on_ray(both, range(40), tmp_path / "d", workers=0)
    with pytest.raises(ValueError, match="no seeds"):
        sweep_on_ray(both, [], tmp_path / "e", workers=1)
