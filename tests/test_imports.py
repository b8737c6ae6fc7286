"""What may import what, and that importing is light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from paths import REPO

import limsim_jax

PACKAGE = REPO / "limsim_jax"

# Rooms from the ground up: a module imports from its own room and from rooms before it.
ORDER = [
    {"files"},
    {"numerics"},
    {"xla"},
    {"geometry"},
    {"standards"},
    {"types"},
    {"statistics"},
    {"rare_events"},
    {"maps"},
    {"traffic", "recordings"},
    {"sensors"},
    {"policies"},
    {"simulation"},
    {"metrics"},
    {"sweeps", "calibration"},
    {"scenarios"},
    {"training"},
    {"report"},
    {"api"},
    {"log_replay"},
    {"bridges"},
    {"bench"},
    {"cli"},
]
LEVEL = {room: level for level, rooms in enumerate(ORDER) for room in rooms}


def imported_rooms(source: str) -> set[str]:
    """Rooms of limsim_jax that a module imports, at its top or within functions."""
    rooms = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("limsim_jax.")}
    return rooms - {"__version__"}


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_one_way(path):
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    assert room in LEVEL, f"say in ORDER where '{room}' belongs"
    for other in imported_rooms(path.read_text()):
        assert LEVEL[other] < LEVEL[room] or other == room, f"{path.name} may not import {other}"


def test_the_import_scan_sees_imports():
    source = """
import limsim_jax.cli
from limsim_jax import bench
from limsim_jax import __version__
def f():
    from limsim_jax.maps.network import Lane
"""
    assert imported_rooms(source) == {"cli", "bench", "maps"}


def run(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    ).stdout


def test_import_is_light():
    """`import limsim_jax` loads neither JAX nor any other heavy package."""
    heavy = ["jax", "flax", "scipy", "lxml", "matplotlib", "typer"]
    assert run(f"import sys, limsim_jax; print([m for m in {heavy} if m in sys.modules])").strip() == "[]"


def test_results_are_read_without_jax():
    """Tables of a sweep need Parquet; what runs worlds again is loaded when that is asked for."""
    assert run("import sys, limsim_jax.api.results; print('jax' in sys.modules)").strip() == "False"


@pytest.mark.engine
def test_no_import_starts_a_backend():
    """Not even importing every module of the package."""
    names = [".".join(path.relative_to(REPO).with_suffix("").parts) for path in modules()]
    code = f"""
import importlib
for name in {names}:
    importlib.import_module(name.removesuffix(".__init__"))
from jax._src import xla_bridge
print(xla_bridge.backends_are_initialized())
"""
    assert run(code).strip() == "False"


def test_public_names_resolve():
    names: list[str] = vars(limsim_jax)["__all__"]
    assert len(names) > 10
    for name in names:
        assert getattr(limsim_jax, name).__name__.rpartition(".")[2] == name
        assert name in dir(limsim_jax)
    with pytest.raises(AttributeError, match="attribute load_maps"):
        _ = limsim_jax.load_maps  # pyright: ignore[reportAttributeAccessIssue]
