"""Set-up for all tests: strict JAX, caches of their own, and where the shared data lie."""

import os
import tempfile
from pathlib import Path

# A cache directory for this run alone: the user's own cache is neither read nor written.
_cache = tempfile.TemporaryDirectory(prefix="limsim-jax-tests-")
os.environ["LIMSIM_JAX_CACHE"] = _cache.name
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # false alarms of programs from the cache

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

from limsim_jax.xla import IDLE_PASSES  # noqa: E402

# Most of the time of a test run is compilation, and most of that the optimisation of machine code, which
# runs of a few seconds do not earn back. XLA's own passes, which decide what is computed, stay but for those
# that find next to nothing. The older generator of fused loops compiles in a third of the time. JAX reads
# these flags with its first program.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    f" --xla_cpu_use_fusion_emitters=false --xla_disable_hlo_passes={','.join(IDLE_PASSES)}",
)

# Shapes and types of these modules are checked in every call. Only modules of functions: the pytrees
# that JAX rebuilds with placeholders inside would not pass.
_hooked = ["limsim_jax.numerics", "limsim_jax.geometry"]
_hooked += [f"limsim_jax.maps.{name}" for name in ("outline", "rasterise", "routing", "signals")]
_hooked += [f"limsim_jax.maps.conflicts.{name}" for name in ("build", "overlaps", "priority", "waiting")]
_traffic = "car_following", "collision", "lane_change", "motion", "neighbors", "signals", "speeds"
_hooked += [f"limsim_jax.traffic.{name}" for name in _traffic]
_demand = "build", "departures", "flows", "sample", "seats", "sumo", "tables"
_hooked += [f"limsim_jax.traffic.demand.{name}" for name in _demand]
_hooked += [
    f"limsim_jax.traffic.right_of_way.{x}" for x in ("approaches", "meet", "passage", "rules", "stops")
]
_hooked += [f"limsim_jax.policies.{name}" for name in ("base", "perception", "simple")]
_limsim_tm = "decide", "group", "plan", "policy", "search"
_hooked += [f"limsim_jax.policies.limsim_tm.{name}" for name in _limsim_tm]
_pdm = "learned", "policy", "proposals", "road", "score", "tracker"
_hooked += [f"limsim_jax.policies.pdm.{name}" for name in _pdm]
_calibration = "cleaning", "fit", "population", "uncertainty"
_hooked += [f"limsim_jax.calibration.{name}" for name in _calibration]
_hooked += [f"limsim_jax.calibration.closed_loop.{name}" for name in ("chains", "descent", "distances")]
_hooked += [f"limsim_jax.recordings.{x}" for x in ("checks", "lanelets", "leaders", "openacc", "recording")]
if os.environ.get("SHAPE_CHECKS", "1") != "0":  # they take a sixth of the time of tests that trace much
    install_import_hook(_hooked, "shape_checks.typecheck")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Compiled programs are kept between runs: most of the time of a test run is compilation.
_programs = Path(tempfile.gettempdir()) / f"limsim-jax-tests-xla-{os.getuid()}"
jax.config.update("jax_compilation_cache_dir", str(_programs))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """Compiled kernels take memory maps, of which Linux lets a process have 65,530: XLA crashes there."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > 20_000:
        jax.clear_caches()
