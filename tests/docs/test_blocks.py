"""Every Python block of README and docs runs."""

import os
import re
import shutil
from pathlib import Path

import doc_blocks
import jax
import numpy as np
import pytest
from paths import REPO

from limsim_jax.sweeps import episode, experiment

LONGEST = 10
"""Lines of a block without its imports."""

HORIZON = 20.0
"""s, of bundled experiments: unoptimised code drives a whole episode in minutes."""

SEEDS = 10
"""Most seeds of a sweep, and its worlds per call: unoptimised code takes minutes for hundreds."""

PAGES = [page for page in doc_blocks.pages() if page.mode != "none"]


def _marked(page):
    marks = [] if page.mode == "quick" else [pytest.mark.engine]
    return pytest.param(page, marks=marks, id=page.name)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files that the pages name."""
    shutil.copy(REPO / "maps" / "intersection.xodr", tmp_path / "Town05.xodr")
    time = np.arange(0, 90, 0.1)
    leader = np.cumsum(0.1 * (12 + 6 * np.sin(time / 6))) + 30
    x, v = [0.0], 12.0
    for one, ahead in zip(leader, np.gradient(leader, 0.1), strict=True):
        gap = max(one - 4.5 - x[-1], 0.1)
        wish = 2 + max(1.2 * v + v * (v - ahead) / (2 * 1.5**0.5), 0)
        v = max(v + 0.1 * (1 - (v / 30) ** 4 - (wish / gap) ** 2), 0.0)
        x.append(x[-1] + 0.1 * v)
    rows = [f"{t:.1f},{one:.3f},{other:.3f}" for t, one, other in zip(time, leader, x, strict=False)]
    (tmp_path / "pairs.csv").write_text("\n".join(["t,leader,follower", *rows]) + "\n")
    short = {}
    (tmp_path / ".bundled").mkdir()
    for name, path in experiment.bundled_experiments().items():
        short[name] = tmp_path / ".bundled" / path.name
        short[name].write_text(re.sub(r"(?m)^horizon = .*$", f"horizon = {HORIZON}", path.read_text()))
    monkeypatch.setattr(experiment, "bundled_experiments", lambda: short)
    monkeypatch.setitem(episode._WORLDS, "cpu", 1)
    monkeypatch.setitem(episode._LEAST, "cpu", SEEDS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _few_seeds(code):
    return re.sub(r"\bseeds=(\d+)", lambda found: f"seeds={min(int(found[1]), SEEDS)}", code)


@pytest.mark.parametrize("page", [_marked(page) for page in PAGES])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_blocks_of_a_page_run(page, folder, capsys):
    if page.mode.startswith("needs "):
        name = page.mode.removeprefix("needs ")
        shared = os.environ.get("LIMSIM_SHARED_DATA")
        found = next(Path(shared).rglob(name), None) if shared else None
        if found is None:
            pytest.skip(f"needs {name}")
        shutil.copy(found, folder / name)
    names = {"__name__": "__main__"}
    for line, code in page.blocks:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as users have it
            exec(compile("\n" * line + _few_seeds(code), str(page.path), "exec"), names)
    assert "Traceback" not in capsys.readouterr().out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_import_the_public_names_only(page):
    for _, code in page.blocks:
        code = re.sub(r"limsim_jax\.bridges\.(gymnasium|jaxmarl)", "a_library", code)  # in the names of these
        assert "from limsim_jax" not in code and "import limsim_jax." not in code


def test_jobs_take_at_most_ten_lines():
    for page in PAGES:
        for line, code in page.blocks:
            lines = [
                line for line in code.splitlines() if line.strip() and not line.startswith(("import", "from"))
            ]
            assert len(lines) <= LONGEST, f"{page.name}: {len(lines)} lines"
