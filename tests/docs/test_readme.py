"""The README's example runs and says the truth."""

import math
import re
import subprocess
import sys
import textwrap

from paths import REPO

from limsim_jax.maps import bundled_maps
from limsim_jax.policies import host

README = (REPO / "README.md").read_text()


def test_example(capsys):
    (code,) = re.findall(r"<!-- test: example -->\n```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert "laneSection" in capsys.readouterr().out
    assert abs(float(names["s"]) - 25.0) < 1e-3 and abs(float(names["d"]) - 0.5) < 1e-3
    assert math.isclose(float(names["slope"]), math.cos(float(names["heading"])), abs_tol=1e-3)


def test_own_policies_are_those_that_are_shown():
    code = (REPO / "experiments" / "own_policies.py").read_text()
    shown = re.findall(r"```python\n(@dataclass\(frozen=True\)\nclass Cautious\(.*?)```", README, re.DOTALL)
    assert all(block in code for block in shown)
    (shown,) = re.findall(r"( {4}def follow.*?)\n\n", host.__doc__ or "", re.DOTALL)
    assert textwrap.dedent(shown) in code


def test_figures_are_those_measured():
    command = [sys.executable, str(REPO / "experiments" / "readme_tables.py"), "--check"]
    assert subprocess.run(command).returncode == 0, "run python experiments/readme_tables.py"


def test_bundled_maps_are_listed():
    for name in bundled_maps():
        assert f"`{name}`" in README


def test_pictures_and_tables_exist():
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert any(link.endswith(".png") for link in links)
    for link in links:
        assert link.startswith("https://") or (REPO / link).is_file(), link
