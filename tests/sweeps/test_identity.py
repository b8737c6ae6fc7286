"""Which code and numbers a policy is: what changes rows changes the identity, and nothing else does."""

import dataclasses
import functools
import importlib
import logging
import sys
import textwrap
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.policies.base import LikeTraffic, Policy, named
from limsim_jax.policies.host import HostPolicy
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.sweeps.identity import describe, is_foreign, policy_code, without_sources


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Writes modules, imports them anew, and makes a policy of one of them."""
    monkeypatch.syspath_prepend(tmp_path)
    written: set[str] = set()

    def make(module: str = "planner", **texts: str):
        for name, text in texts.items():
            path = tmp_path / f"{name}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(textwrap.dedent(text))
            written.add(name.partition("/")[0])
        for name in [x for x in sys.modules if x.partition(".")[0] in written]:
            del sys.modules[name]
        importlib.invalidate_caches()
        sys.dont_write_bytecode = True
        return HostPolicy(importlib.import_module(module).plan)

    yield make
    for name in [x for x in sys.modules if x.partition(".")[0] in written]:
        del sys.modules[name]


PLAN = """
    import numpy as np
    import gains

    def plan(seen):
        return {"acceleration": gains.GAIN * seen.v, "steering": 0 * seen.v}
"""


def test_an_edit_of_any_module_of_a_planner_is_another_code(package):
    first = policy_code(package(planner=PLAN, gains="GAIN = 0.3\n", other="X = 1\n"))
    assert set(first["sources"]) == {"planner.py", "gains.py"} and "values" not in first
    assert policy_code(package()) == first
    assert policy_code(package(other="X = 2\n")) == first  # no module imports it
    second = policy_code(package(gains="GAIN = 0.2\n"))
    assert second["sources"]["planner.py"] == first["sources"]["planner.py"]
    assert second["sources"]["gains.py"] != first["sources"]["gains.py"]
    assert policy_code(package(planner=PLAN + "\n    # a note\n"))["sources"] != second["sources"]


def test_imports_within_functions_and_packages_are_found(package):
    plan = """
        from pack.deep import helper

        def plan(seen):
            from pack import late
            return late.f(helper(seen))
    """
    texts = {
        "pack/__init__": "",
        "pack/deep": "from .deeper import G\n\ndef helper(x):\n    return G\n",
        "pack/deeper": "import json\nG = 1\n",
        "pack/late": "def f(x):\n    return x\n",
    }
    found = policy_code(package(planner=plan, **texts))["sources"]
    assert set(found) >= {"planner.py", "deep.py", "deeper.py", "late.py"}
    assert not any("json" in name for name in found)


def test_numbers_that_a_planner_holds_count(package):
    weights = """
        import numpy as np
        W = np.arange(3.0) + {}

        def plan(seen):
            return W
    """
    one, two = (policy_code(package(planner=weights.format(k)))["values"] for k in (0, 1))
    assert one != two

    class Net:
        def __init__(self, w):
            self.w = np.full(4, w)

        def state_dict(self):
            return {"w": self.w}

    class Planner:
        def __init__(self, w):
            self.net, self.itself = Net(w), self

        def __call__(self, seen):
            return self.net

        def plan(self, seen):
            return self.net

    def closed(w):
        array = np.full(2, w)
        return lambda seen: array

    def two_args(array, seen):
        return array

    class Tuned:
        def __init__(self, w):
            self.gain, self.mode = w, "fast"

        def __call__(self, seen):
            return self.gain

    def tuned(w):
        return lambda seen: w

    def by_default(w):
        return lambda seen, w=w: w

    kinds = (
        Planner,
        Tuned,
        tuned,
        by_default,
        lambda w: Planner(w).plan,
        closed,
        lambda w: functools.partial(two_args, np.full(3, w)),
        lambda w: functools.partial(two_args, array=jnp.full(3, w)),
    )
    for make in kinds:
        codes = [policy_code(HostPolicy(make(w))) for w in (1.0, 1.0, 2.0)]
        assert codes[0] == codes[1] != codes[2]
        assert is_foreign(HostPolicy(make(1.0)))


@dataclasses.dataclass(frozen=True, eq=False)
class Scaled(Policy):
    """Scales what it is given."""

    factor: float
    table: Any

    def __call__(self, config, lane_map, state: Any, memory, key) -> Any:
        return state * self.factor + self.table[1], memory


def program_of(policy):
    return [jax.make_jaxpr(lambda x: policy(None, None, x, None, None)[0])(jnp.zeros(3))]


def test_the_program_of_a_policy_is_its_code_and_its_constants():
    table = jnp.arange(6.0).reshape(2, 3)
    codes = [
        policy_code(policy, program_of(policy))
        for policy in (
            Scaled(2.0, table), Scaled(2.0, table + 0.0), Scaled(3.0, table),
            Scaled(2.0, table.at[1, 2].add(1e-5)), Scaled(2.0, table.at[0, 0].add(1.0)),
        )
    ]  # fmt: skip
    assert codes[0] == codes[1] and set(codes[0]) == {"program"}
    assert len({code["program"] for code in codes}) == 4


def test_a_program_that_calls_the_host_counts_by_its_sources_too():
    def ask(x):
        return np.asarray(x)

    def called(x):
        return jax.pure_callback(ask, jax.ShapeDtypeStruct((3,), jnp.float32), x)

    code = policy_code(Scaled(1.0, jnp.zeros((2, 3))), [jax.make_jaxpr(called)(jnp.zeros(3))])
    assert set(code) == {"program", "sources", "values"} and "test_identity.py" in code["sources"]


def test_whose_code_takes_part():
    assert not is_foreign(PDMClosed()) and not is_foreign(named("mine", LikeTraffic()))
    assert is_foreign(Scaled(1.0, jnp.zeros(2)))
    assert is_foreign(HostPolicy(lambda seen: {}))


def test_the_file_of_a_policy_does_not_count_beside_its_program():
    described = describe(Scaled(2.0, (jnp.zeros(2), [HostPolicy(test_whose_code_takes_part)])))
    assert "source" in str(described) and "source" not in str(without_sources(described))
    assert without_sources(described)["factor"] == 2.0


def test_modules_and_objects_of_libraries_are_not_walked():
    logger, module = logging.getLogger("planner"), np
    policy = HostPolicy(lambda seen: (logger, module, seen))
    code = policy_code(policy)
    logger.extra = 3.0  # pyright: ignore[reportAttributeAccessIssue]
    assert policy_code(policy) == code and set(code["sources"]) == {"test_identity.py"}


def test_failures_of_a_run_do_not_change_what_a_policy_is():
    policy = HostPolicy(test_whose_code_takes_part)
    before = describe(policy), policy_code(policy)
    policy.failures[b"key"] = "it failed"
    assert (describe(policy), policy_code(policy)) == before
    assert "it failed" not in str(before)
