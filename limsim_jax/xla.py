"""Every compiler trick of the package: what it does, why, and what it gained.

Three of them change rounding, so they belong to correctness as well as to speed: `computed_once`, `interval`
and `column_min`. All gains were measured on CPUs with JAX 0.9.2. `tests/test_xla.py` holds each of them.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jaxlib
from jax import lax
from jax.custom_batching import custom_vmap
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, Int

from limsim_jax.files import cache_directory, write_whole

Tree = TypeVar("Tree")

IDLE_PASSES = (
    "simplify-while-loops", "while-loop-invariant-code-motion", "while-loop-constant-sinking",
    "simplify-conditional", "reshape-mover", "simplify-sorts", "zero_sized_hlo_elimination",
)  # fmt: skip
"""Passes of XLA that run up to 14 times over a world and find next to nothing."""

DIVIDING_PASS = "cpu-parallel-task-assigner"
"""The pass of XLA that divides loops among threads, where worlds are divided already."""

TREES_PASS = "tree_reduction_rewriter"
"""The pass of XLA that makes trees of windows of long reductions, without vector code."""

PROGRAMS = 96
"""Compiled programs that are kept on disk, of 4 to 20 MB each."""

HELD = 24
"""Programs that stay loaded in a process: a scenario and its replays under half a dozen policies."""

_held: dict[Path, Any] = {}  # the last used one at the end
_kept_apart = jax.jit(lax.optimization_barrier)


def computed_once(tree: Tree) -> Tree:
    """The same arrays, which XLA computes once for all their uses.

    Why: XLA:CPU fuses cheap-looking operations into every consumer, whole chains of gathers among them, and
    removes `optimization_barrier` before it does so. A call that is marked as not inlineable survives.
    Gain: the sampling of LimSim-TM took a third of the time (0.72 to 0.24 ms per planned vehicle). Elsewhere
    than on CPUs the barrier does.
    """
    if jax.default_backend() != "cpu":
        return lax.optimization_barrier(tree)
    with set_xla_metadata(inlineable="false"):
        return _kept_apart(tree)


def interval(place: Float[Array, "*b"], count: int) -> tuple[Int[Array, "*b"], Float[Array, "*b"]]:
    """The unit interval that holds a place, and the place within it.

    Args:
      place: in units of intervals.
      count: number of intervals; a place outside belongs to the nearest one.

    Why: XLA may round the place differently where it computes it again, and a number and a fraction that do
    not belong together are off by a whole interval. The number is computed once.
    """
    k = computed_once(jnp.clip(jnp.floor(place).astype(jnp.int32), 0, count - 1))
    return k, place - k.astype(place.dtype)


def column_min(rows: Float[Array, " K *b"]) -> Float[Array, "*b"]:
    """The least value of each column.

    Why: the gradient of `min` divides among the rows that equal it. Where XLA computes the rows twice and
    rounds them differently, no row equals it, and the gradient is NaN.
    """
    return functools.reduce(lambda x, y: jnp.where(x < y, x, y), rows)


def mapped_like(x: Array, tree: Tree) -> Tree:
    """The same arrays, mapped by `vmap` wherever it maps `x`: a start for a scan.

    Why: where the body of a scan replaces unmapped values by mapped ones, `vmap` traces the body once more,
    and four times that of a scan within a scan. Gain: half of the tracing time of a rollout.
    """
    first = jnp.ravel(x)[0]
    return jax.tree.map(lambda y: jnp.where(first == first, y, y), tree)


def row(tree: Tree, i: Int[Array, ""]) -> Tree:
    """Row `i` of every array, the same row for all worlds.

    Why: `vmap` makes a gather of a slice, and XLA makes a loop of one turn of that, with five kernels.
    Gain: with `with_row`, a quarter of the kernels of a world, and a twentieth of the time to compile it.
    """

    def along(axis: int) -> Callable[[Array, Array], Array]:
        @custom_vmap
        def one(x: Array, i: Array) -> Array:
            return lax.dynamic_index_in_dim(x, i, axis, keepdims=False)

        @one.def_vmap
        def _(size: int, batched: Any, x: Array, i: Array) -> tuple[Array, bool]:
            del size
            assert tuple(batched) == (True, False), "one row of all worlds"
            return along(axis + 1)(x, i), True

        return one

    return jax.tree.map(lambda x: along(0)(x, i), tree)


def with_row(tree: Tree, i: Int[Array, ""], new: Tree) -> Tree:
    """The same arrays with another row `i`, see `row`."""

    def along(axis: int) -> Callable[[Array, Array, Array], Array]:
        @custom_vmap
        def one(x: Array, i: Array, new: Array) -> Array:
            return lax.dynamic_update_index_in_dim(x, new, i, axis)

        @one.def_vmap
        def _(size: int, batched: Any, x: Array, i: Array, new: Array) -> tuple[Array, bool]:
            of, which, values = batched
            assert not which, "one row of all worlds"
            x, new = (
                y if has else jnp.broadcast_to(y, (size, *y.shape)) for y, has in ((x, of), (new, values))
            )
            return along(axis + 1)(x, i, new), True

        return one

    return jax.tree.map(lambda x, y: along(0)(x, i, y), tree, new)


def batch_last(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function; `vmap` puts its axis last in all arrays.

    Why: loops over the last axis become vector code on CPUs, while small arrays per vehicle do not.
    """
    mapped = custom_vmap(function)

    @mapped.def_vmap
    def _(size: int, batched: Any, *of: Any) -> tuple[Any, Any]:
        def last(x: Array, has: bool) -> Array:
            return jnp.moveaxis(x, 0, -1) if has else jnp.broadcast_to(x[..., None], (*x.shape, size))

        result = mapped(*jax.tree.map(last, of, tuple(batched)))
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), result), jax.tree.map(lambda _: True, result)

    return mapped


def run_often() -> dict[str, Any] | None:
    """Compiler options of a program that drives many worlds.

    Why: `IDLE_PASSES` are left out. Gain: `sweep intersection` of 50 worlds from nothing takes 75 s, not 82.
    `DIVIDING_PASS` is, too. Gain: a tenth of the CPU time of a run, where XLA has spare threads.
    So is `TREES_PASS`. Gain: a twentieth of the time of a run.

    Where a pass has found something, results differ by rounding.
    """
    if jax.default_backend() != "cpu":
        return None
    return {"xla_disable_hlo_passes": ",".join((*IDLE_PASSES, DIVIDING_PASS, TREES_PASS))}


def run_once() -> dict[str, Any] | None:
    """Compiler options of a program that runs once per world: compile fast, run slowly.

    Why: machine code is not optimised, and the older generator of fused loops is used, which compiles faster.
    Gain: a world of 16 vehicles compiles in 1.8 s of CPU time, not 9.

    Two programs that must agree to the last bit need the same options.
    """
    often = run_often()
    return often and {
        **often,
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
        "xla_cpu_use_fusion_emitters": False,
    }


def use_all_cores(cores: int | None = None, *, spare: bool = True) -> int:
    """Make every CPU core a device; return the number of devices.

    Why: XLA:CPU runs one program on about one core, so a batch is divided among devices. Once the backend
    runs, the numbers of devices and of threads stay as they are.

    Args:
      cores: how many; None: all that this process may use.
      spare: XLA gets a further thread per device. A device that waits for a function on the host holds one,
        and large arguments of the function need another to arrive. Without such functions idle threads only
        take work from each other. Gain of leaving them out: a quarter of the CPU time of a run.
    """
    if cores is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("NPROC", str(2 * cores if spare else cores))  # threads of XLA:CPU, read once
    with contextlib.suppress(RuntimeError):  # the backend runs already
        jax.config.update("jax_num_cpu_devices", cores)
    return jax.local_device_count()


def enable_compilation_cache() -> None:
    """Keep compiled programs on disk, in JAX's folder if it has one."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_directory() / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


class _Aside:
    """Threads that want JAX's cache left alone; whether it was on before them."""

    lock = threading.Lock()
    threads = 0
    before = True


@contextlib.contextmanager
def without_compilation_cache() -> Iterator[None]:
    """JAX's own cache is neither read nor written within, in any thread.

    Why: a program for CPUs that JAX has read from its cache cannot be kept: once written and read again, it
    lacks some of its functions, and fails where it runs.
    """

    def switch(on: bool) -> None:
        jax.config.update("jax_enable_compilation_cache", on)
        compilation_cache.reset_cache()  # or JAX goes by what it has seen in the first place

    with _Aside.lock:
        if _Aside.threads == 0:
            _Aside.before = jax.config.values["jax_enable_compilation_cache"]
            switch(False)
        _Aside.threads += 1
    try:
        yield
    finally:
        with _Aside.lock:
            _Aside.threads -= 1
            if _Aside.threads == 0:
                switch(_Aside.before)


def begin_program(
    name: str | None, lowered: Callable[[], Any], pool: Executor
) -> tuple[Any, Callable[[], Any]]:
    """The program of a name: held, from disk or compiled.

    It compiles in a pool while the caller goes on. Threads that want the same program wait for the first one.

    Args:
      name: see `load_program`; None: it is compiled.
      lowered: traces and lowers it, `without_compilation_cache`.
      pool: compiles it.

    Returns:
      Shapes of what it makes, and the program once it is called for.
    """
    lock = threading.Lock() if name is None else _program_lock(name)
    lock.acquire()
    try:
        found = held_program(name)
        if found is not None:
            lock.release()
            return found.out_info, lambda: found
        program = lowered()
    except BaseException:
        lock.release()
        raise

    def compiled() -> Any:
        try:
            return hold_program(name, keep_program(name, program.compile()))
        finally:
            lock.release()

    return program.out_info, pool.submit(compiled).result


@functools.cache
def _program_lock(name: str) -> threading.Lock:
    del name
    return threading.Lock()


def load_program(name: str | None) -> Any:
    """A compiled program that `keep_program` has kept; None if there is none.

    Why: JAX's own cache keeps machine code only, so a program is traced and lowered in every process before
    it is found. Gain: a warm `sweep intersection` starts its first world after 1.2 s, not 12.

    Args:
      name: all that the program depends on, beside the versions and settings of JAX and the machine, which
        are added. None: nothing is kept by it.
    """
    if name is None:
        return None
    path = _program_path(name)
    try:
        devices, *program = pickle.loads(path.read_bytes())
        on = jax.local_devices()[:devices]  # without a word, of all devices
        found = serialize_executable.deserialize_and_load(*program, execution_devices=on)
        os.utime(path)
        return found
    except Exception:  # not there, damaged, or of another machine
        return None


def held_program(name: str | None) -> Any:
    """As `load_program`; a program that this process has used is still there.

    Why: a load takes seconds, and the memory of a program out of use is not always given back.
    Gain: 45 scenarios of one shape share one program, where they ran out of memory mappings.
    """
    if name is None:
        return None
    path = _program_path(name)
    found = _held.pop(path, None)
    return hold_program(name, load_program(name) if found is None else found)


def hold_program(name: str | None, program: Any) -> Any:
    """Keep a program loaded, unless it is None, and return it."""
    if name is not None and program is not None:
        _held[_program_path(name)] = program
        for path in list(_held)[:-HELD]:
            _held.pop(path, None)
    return program


def keep_program(name: str | None, program: Any) -> Any:
    """Keep a program on disk that was compiled `without_compilation_cache`, and return it."""
    if name is None:
        return program
    path = _program_path(name)
    with contextlib.suppress(Exception):  # a program that cannot be kept, or a full disk
        path.parent.mkdir(parents=True, exist_ok=True)
        shardings = jax.tree.leaves((program.input_shardings, program.output_shardings))
        devices = max((len(x.device_set) for x in shardings), default=1)
        write_whole(path, pickle.dumps((devices, *serialize_executable.serialize(program))))
        _forget(path.parent)
    return program


def _program_path(name: str) -> Path:
    enable_compilation_cache()
    config, device = jax.config.values, jax.local_devices()[0]
    settings = [
        jax.__version__, jaxlib.version.__version__, device.platform, device.device_kind,
        jax.local_device_count(), platform.machine(), platform.processor(), os.environ.get("XLA_FLAGS"),
        config["jax_enable_x64"], config["jax_default_prng_impl"], config["jax_threefry_partitionable"],
        config["jax_default_matmul_precision"],
    ]  # fmt: skip
    key = hashlib.sha256(repr((name, settings)).encode()).hexdigest()[:32]
    return Path(config["jax_compilation_cache_dir"]) / "limsim_jax" / f"{key}.bin"


def _forget(folder: Path) -> None:
    """Remove the programs that were not used for the longest time."""
    paths = sorted(folder.glob("*.bin"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in paths[PROGRAMS:]:
        path.unlink(missing_ok=True)
