"""`replay --sensors`: what is refused before anything runs, and what is written."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_films import film_of
from fake_replays import SELF, TIME, intersection_trace
from fake_results import made

from limsim_jax import cli
from limsim_jax.api import results as api_results
from limsim_jax.api import sensed
from limsim_jax.api.world import World
from limsim_jax.sweeps import store


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run the command on results of a made-up world; the policy declares no sensors."""
    found = made({("small", "plain"): {"success": [1.0, 1.0]}})
    monkeypatch.setattr(store, "open_results", lambda path: found)
    episodes = SimpleNamespace(egos=1, policy="plain", rollout=SimpleNamespace(policy=object()))
    monkeypatch.setattr(api_results, "rebuild", lambda results, *group: episodes)

    def run(*options, world=None, egos=1):
        episodes.egos = egos

        def replay(of, seed):
            assert world is not None, "nothing should run"
            return world

        monkeypatch.setattr(World, "run", replay)
        code = cli.main(["replay", str(tmp_path), "--seed", "0", *map(str, options)])
        return code, *capsys.readouterr()

    return run


@pytest.mark.parametrize(
    ("options", "egos", "words"),
    [
        (["--sensors", "own"], 1, "sensors: own: policy 'plain' declares no sensors; use six, front or one"),
        (["--sensors", "nine"], 1, "'nine'"),
        (["--sensors", "six"], 0, "'small' has no ego"),
        (["--sensors", "six", "--out", "x.parquet"], 1, "not for .parquet files"),
    ],
)
def test_it_refuses_before_it_runs(run, options, egos, words):
    code, out, err = run(*options, egos=egos)
    assert code == 2 and out == "" and err.count("\n") == 1 and words in err


def test_the_page_holds_what_the_ego_senses(run, monkeypatch, tmp_path):
    network, lane_map, trace = intersection_trace()
    town: Any = SimpleNamespace(network=network, lanes=lane_map)
    world = World("small", "plain", 0, SELF, town, trace, {}, [])
    frames = np.array([4, 9])
    film = film_of(TIME[frames], trace.box[frames, SELF, :3])
    asked = []
    monkeypatch.setattr(sensed, "watch", lambda world, rig: asked.append(rig) or film)
    code, out, _ = run("--sensors", "front", "--out", tmp_path / "a.html", world=world)
    assert code == 0 and asked == ["front"]
    assert "Film of a scene: 2 frames, front, back, lidar, one every 0.5 s" in out
    plain = run("--out", tmp_path / "b.html", world=world)
    assert plain[0] == 0 and "Film" not in plain[1]
    sizes = [(tmp_path / name).stat().st_size for name in ("a.html", "b.html")]
    assert sizes[0] > sizes[1]
