"""Every compiler trick does what it is for, in the compiled program or in the numbers."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from limsim_jax import xla
from limsim_jax.xla import (
    batch_last,
    column_min,
    computed_once,
    enable_compilation_cache,
    interval,
    mapped_like,
    run_often,
    run_once,
    use_all_cores,
)


def compiled_text(function, *args):
    return jax.jit(function).lower(*args).compile().as_text() or ""


def test_a_value_computed_once_stays_a_call_of_its_own():
    """XLA inlines calls and removes barriers; what it may not inline keeps its value in one place."""
    table, index = jnp.arange(64.0), jnp.arange(16) % 7

    def uses(keep):
        def function(table, index):
            value = table[index] * 2.0
            value = computed_once(value) if keep else value
            return tuple(jnp.sum(jnp.sin(value + k), axis=0) for k in range(4))

        return function

    kept, fused = (compiled_text(uses(keep), table, index) for keep in (True, False))
    assert kept.count(" call(") == fused.count(" call(") + 1
    for with_it, without in zip(uses(True)(table, index), uses(False)(table, index), strict=True):
        np.testing.assert_allclose(with_it, without, rtol=1e-6)


def test_a_value_computed_once_has_the_same_gradient():
    x = jnp.linspace(0.1, 2.0, 7)
    np.testing.assert_array_equal(
        jax.grad(lambda x: computed_once(jnp.sin(x)).sum())(x), jax.grad(lambda x: jnp.sin(x).sum())(x)
    )


def test_number_and_fraction_of_an_interval_belong_together():
    place = jnp.asarray([-0.5, 0.0, 0.999, 1.0, 2.5, 3.0, 7.25], jnp.float32)
    number, fraction = jax.jit(interval, static_argnums=1)(place, 3)
    np.testing.assert_array_equal(number, [0, 0, 0, 1, 2, 2, 2])
    np.testing.assert_array_equal(number.astype(fraction.dtype) + fraction, place)


def test_the_least_of_each_column_has_a_finite_gradient_where_rows_are_equal():
    rows = jnp.asarray([[1.0, 5.0, 2.0], [1.0, 4.0, 3.0]])
    np.testing.assert_array_equal(column_min(rows), rows.min(0))
    gradient = jax.grad(lambda rows: column_min(rows).sum())(rows)
    np.testing.assert_array_equal(gradient.sum(0), [1.0, 1.0, 1.0])


def test_the_start_of_a_scan_is_mapped_as_its_input():
    def run(x, aligned):
        def body(carry, _):
            return (carry[0] + x, carry[1] * 2), None

        start = (jnp.zeros(()), jnp.ones(()))
        return jax.lax.scan(body, mapped_like(x, start) if aligned else start, None, length=3)[0]

    x = jnp.arange(4.0)
    start = jax.vmap(lambda x: mapped_like(x, jnp.zeros(())))(x)
    assert start.shape == (4,)
    found = jax.vmap(lambda x: run(x, True))(x)
    np.testing.assert_array_equal(found[0], 3 * x)
    np.testing.assert_array_equal(found[1], np.full(4, 8.0))


def test_a_batch_axis_that_is_last_gives_the_same_numbers():
    x = jnp.arange(12.0).reshape(3, 4)
    seen = []

    def double(x, y):
        seen.append(x.shape)
        return 2 * x + y

    found = jax.vmap(batch_last(double), in_axes=(0, None))(x, jnp.ones(4))
    np.testing.assert_array_equal(found, 2 * x + 1)
    assert (4, 3) in seen


def test_a_program_that_runs_often_is_compiled_without_idle_passes():
    """One of them takes loops apart that turn once."""

    def function(x):
        return jax.lax.fori_loop(0, 1, lambda _, x: jnp.sin(x), x)

    lowered = jax.jit(function).lower(jnp.arange(4.0))
    if jax.default_backend() == "cpu":
        options: list[Any] = [{"xla_disable_hlo_passes": ""}, run_often()]
        every, some = (lowered.compile(x).as_text() or "" for x in options)
        assert (every.count(" while("), some.count(" while(")) == (0, 1)


def test_no_loop_of_a_program_that_runs_often_is_divided_among_threads():
    def function(x):
        return jnp.sin(x) * jnp.cos(x) + 1

    lowered = jax.jit(function).lower(jnp.zeros((1024, 1024)))
    if jax.default_backend() == "cpu":
        text = lowered.compile(run_often()).as_text() or ""
        assert "sine" in text and "outer_dimension_partitions" not in text


@pytest.mark.parametrize(("spare", "threads"), [(True, "4"), (False, "2")])
def test_spare_threads_are_for_functions_on_the_host(monkeypatch, spare, threads):
    monkeypatch.delenv("NPROC", raising=False)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    use_all_cores(2, spare=spare)
    assert os.environ["NPROC"] == threads


def test_threads_that_the_user_chose_stay(monkeypatch):
    monkeypatch.setenv("NPROC", "7")
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    use_all_cores(2, spare=False)
    assert os.environ["NPROC"] == "7"


def test_a_program_that_runs_once_is_compiled_without_optimisation():
    options = run_once()
    if jax.default_backend() == "cpu":
        assert options is not None and options["xla_backend_optimization_level"] == 0
        assert float(jax.jit(lambda x: x + 1, compiler_options=options)(1.0)) == 2.0


def test_a_compilation_cache_that_the_user_chose_stays(tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    assert before is not None
    enable_compilation_cache()
    assert jax.config.values["jax_compilation_cache_dir"] == before


@pytest.mark.parametrize("count", [1, 5])
def test_an_interval_is_within_its_count(count):
    number, _ = interval(jnp.asarray([-1e6, 1e6], jnp.float32), count)
    np.testing.assert_array_equal(number, [0, count - 1])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of JAX for this test alone."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / "limsim_jax"
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def test_kept_programs_are_loaded_without_a_trace(folder):
    program = jax.jit(lambda x: {"twice": 2 * x}).lower(jnp.zeros(3)).compile()
    assert xla.load_program("twice") is None
    assert xla.keep_program("twice", program) is program
    found = xla.load_program("twice")
    np.testing.assert_array_equal(found(jnp.arange(3.0))["twice"], [0, 2, 4])
    assert xla.load_program("thrice") is None and xla.load_program(None) is None
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:100])  # damaged: it is as if it were not there
    assert xla.load_program("twice") is None


def test_a_program_that_jax_has_in_its_cache_can_be_kept(folder):
    def wave(x):
        return jax.lax.fori_loop(0, 5, lambda _, y: jnp.sin(y) * 2 + jnp.roll(y, 1) * jnp.cumsum(y), x)

    def compiled():
        jax.clear_caches()
        return jax.jit(wave).lower(x).compile()

    x, least = jnp.linspace(0.0, 1.0, 1000), jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    try:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        compilation_cache.reset_cache()
        want = compiled()(x)
        assert list(folder.parent.glob("*wave*"))
        with xla.without_compilation_cache():
            xla.keep_program("wave", compiled())
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    np.testing.assert_array_equal(xla.load_program("wave")(x), want)


def test_jax_gets_its_cache_back_when_the_last_thread_is_done():
    def on() -> bool:
        return jax.config.values["jax_enable_compilation_cache"]

    assert on()
    first, second = xla.without_compilation_cache(), xla.without_compilation_cache()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not on(), "the second thread still compiles"
    second.__exit__(None, None, None)
    assert on()


def test_threads_that_want_the_same_program_compile_it_once(folder):
    traced = []

    def trace_it(name: str):
        first = not traced
        traced.append(name)
        time.sleep(0.05)
        if first:
            raise ValueError("the first one fails")
        return jax.jit(lambda x: x + len(name)).lower(1.0)

    def program(name: str):
        try:
            shapes, get = xla.begin_program(name, lambda: trace_it(name), compiling)
        except ValueError:
            shapes, get = xla.begin_program(name, lambda: trace_it(name), compiling)
        assert shapes.shape == ()
        return get()

    names = ["one", "three", "one", "three", "one"]
    with ThreadPoolExecutor(5) as pool, ThreadPoolExecutor(2) as compiling:
        found = list(pool.map(program, names))
        assert sorted(traced[1:]) == ["one", "three"]
        assert [float(one(1.0)) for one in found] == [4, 6, 4, 6, 4]
        for _ in range(2):
            xla.begin_program(None, lambda: trace_it("apart"), compiling)[1]()
    assert traced[3:] == ["apart", "apart"]


def test_rows_of_a_batch_are_slices_and_not_loops():
    x = np.arange(24, dtype=np.float32).reshape(2, 4, 3)  # worlds, rows, values
    new = -np.arange(6, dtype=np.float32).reshape(2, 3)

    @jax.jit
    def both(x, new, i):
        taken = jax.vmap(xla.row, (0, None))({"x": x}, i)["x"]
        put_one = jax.vmap(xla.with_row, (0, None, None))(x, i, new[0])
        return taken, jax.vmap(xla.with_row, (0, None, 0))(x, i, new), put_one

    taken, replaced, same = both(x, new, np.int32(2))
    np.testing.assert_array_equal(taken, x[:, 2])
    want = x.copy()
    want[:, 2] = new
    np.testing.assert_array_equal(replaced, want)
    want[:, 2] = new[0]
    np.testing.assert_array_equal(same, want)
    text = both.lower(x, new, np.int32(2)).as_text()
    assert "dynamic_slice" in text and "gather" not in text and "scatter" not in text


def test_programs_that_were_not_used_for_long_are_forgotten(folder, monkeypatch):
    monkeypatch.setattr(xla, "PROGRAMS", 2)
    program = jax.jit(lambda x: x + 1).lower(1.0).compile()
    for name in ("a", "b", "a", "c"):
        if xla.load_program(name) is None:
            xla.keep_program(name, program)
        for path in folder.iterdir():  # time passes
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 10))
    assert [xla.load_program(name) is not None for name in "abc"] == [True, False, True]


ASKS = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec
from limsim_jax.xla import use_all_cores

assert use_all_cores(2) == 2
mesh, many = Mesh(np.array(jax.local_devices()), ("worlds",)), PartitionSpec("worlds")


def world(x):
    def step(sum, _):
        seen = jnp.broadcast_to(x[0] + sum, (20, 200, 1000))
        told = jax.pure_callback(lambda y: np.asarray(y).mean(), jax.ShapeDtypeStruct((), jnp.float32), seen)
        return sum + told / (x[0] + sum), None

    return jax.lax.scan(step, jnp.float32(0), None, length=5)[0][None]


run = jax.jit(jax.shard_map(world, mesh=mesh, in_specs=many, out_specs=many, check_vma=False))
np.testing.assert_allclose(run(jnp.array([1.0, 2.0])), 5, rtol=1e-4)
"""


def test_all_devices_may_wait_for_the_host_at_once():
    """Large arguments of a function on the host arrive although every device waits."""
    plain = {name: x for name, x in os.environ.items() if name not in ("NPROC", "XLA_FLAGS")}
    subprocess.run([sys.executable, "-c", ASKS], env=plain, check=True, timeout=120)


KEEPS = """
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from limsim_jax.xla import keep_program, load_program, use_all_cores

assert use_all_cores(2) == 2
spread = NamedSharding(Mesh(np.array(jax.local_devices()), ("worlds",)), PartitionSpec("worlds"))
for name, where in {"one": jax.local_devices()[0], "two": spread}.items():
    x = jax.device_put(jnp.arange(4.0), where)
    keep_program(name, jax.jit(lambda x: 2 * x).lower(x).compile())
    np.testing.assert_array_equal(load_program(name)(x), [0, 2, 4, 6])
"""


def test_programs_of_one_device_and_of_several_are_kept_side_by_side(tmp_path):
    clean = {name: x for name, x in os.environ.items() if name not in ("NPROC", "XLA_FLAGS")}
    clean["LIMSIM_JAX_CACHE"] = str(tmp_path)
    subprocess.run([sys.executable, "-c", KEEPS], env=clean, check=True, timeout=120)
