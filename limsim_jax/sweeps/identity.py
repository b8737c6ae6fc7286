"""What rows depend on, as JSON: values of Python, and the code of a policy that is not ours.

`describe` tells what a value is and of which numbers. `policy_code` tells which code drove: the program of a
policy in JAX, the sources of a planner on the host. Results of other code are other results.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import json
import re
import sys
import sysconfig
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.policies.host import HostPolicy

_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = tuple(
    Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")
)


def describe(value: Any, inside: frozenset[int] = frozenset()) -> Any:
    """A policy, a population, a model or metrics as JSON: what it is and of which numbers.

    Arrays are hashed. A class that comes from a file outside installed packages brings the hash of that file.
    """
    if isinstance(value, str | int | float | bool | None):
        return value
    if id(value) in inside:
        return "itself"
    inside |= {id(value)}
    if isinstance(value, tuple | list):
        return [describe(x, inside) for x in value]
    if isinstance(value, Mapping):
        return {str(name): describe(x, inside) for name, x in value.items()}
    if isinstance(value, np.ndarray | jax.Array):
        keys = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(value) if keys else value)
        return f"{array.dtype}{list(array.shape)} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"
    kind = value if isinstance(value, type | FunctionType) else type(value)
    found = {"is": f"{kind.__module__}.{kind.__qualname__}"}
    if source := _own_source(kind):
        found["source"] = source
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [x.name for x in dataclasses.fields(value) if x.compare]
        found |= {name: describe(getattr(value, name), inside) for name in fields}
    elif not isinstance(value, type | FunctionType):
        found |= {name: describe(x, inside) for name, x in sorted(getattr(value, "__dict__", {}).items())}
    return found


def without_sources(description: Any) -> Any:
    """A description without hashes of files: of a policy `policy_code` tells more exactly what drove."""
    if isinstance(description, Mapping):
        return {name: without_sources(x) for name, x in description.items() if name != "source"}
    return [without_sources(x) for x in description] if isinstance(description, list) else description


def describe_program(*parts: Any) -> str | None:
    """All that a compiled program depends on; None if code that is not ours takes part.

    The source of the package and shapes of arguments are not included.
    """
    found = describe(parts)
    return None if _foreign(found) else json.dumps(found, sort_keys=True)


def is_foreign(policy: Any) -> bool:
    """Whether code that is not ours takes part in a policy."""
    return _foreign(describe(policy))


def _foreign(description: Any) -> bool:
    def kinds(tree: Any) -> Iterator[str]:
        if isinstance(tree, Mapping):
            yield tree.get("is", "limsim_jax.")
        for x in tree.values() if isinstance(tree, Mapping) else tree if isinstance(tree, list) else ():
            yield from kinds(x)

    return any(
        not kind.startswith("limsim_jax.") or kind.endswith(".HostPolicy") for kind in kinds(description)
    )


def _own_source(kind: Any) -> str | None:
    """Hash of the source file of a class or function.

    None for what comes with an installed package."""
    try:
        path = Path(inspect.getsourcefile(kind) or "")
    except (TypeError, OSError):  # built in, or typed into a notebook
        return None
    return _hash(path.read_bytes()) if _is_own(path) else None


# --- the code of a policy


def policy_code(policy: Any, programs: Sequence[Any] = ()) -> dict[str, Any]:
    """The code that drives, where not all of it is ours.

    Args:
      policy: with code that is not ours.
      programs: its jaxprs on the shapes of an experiment, with constants; without, its sources count.

    Returns:
      `program`, a hash of the jaxpr and all its constants; or `sources`, hashes of the files outside
      installed packages that the planner's code is from or imports, and `values`, a hash of the numbers that
      it holds. Functions typed into a notebook or the script that runs count by their own text.
    """
    if not programs:
        return _sources(policy)
    text = re.sub(r"0x[0-9a-f]+", "0x", "\n".join(str(program.jaxpr) for program in programs))
    constants = [describe(x) for program in programs for x in _constants(program)]
    found: dict[str, Any] = {"program": _hash(json.dumps([text, constants]).encode())}
    return found | (_sources(policy) if "callback" in text else {})


def _constants(program: Any) -> Iterator[Any]:
    """Arrays within a program, at any depth."""
    jaxpr = getattr(program, "jaxpr", program)
    yield from getattr(program, "consts", ())
    for equation in jaxpr.eqns:
        yield from (x.val for x in equation.invars if np.ndim(getattr(x, "val", 0)) > 0)
        for part in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(part, "eqns") or hasattr(part, "jaxpr"):
                yield from _constants(part)


def _sources(policy: Any) -> dict[str, Any]:
    """Files and numbers of a planner on the host."""
    texts: dict[str, str] = {}
    values: list[Any] = []
    files: dict[Path, None] = {}
    seen: dict[int, Any] = {}  # kept, so that no other object gets the same number

    def visit(value: Any) -> None:
        if isinstance(value, str | bytes | int | float | None):
            values.append(repr(value))
        if id(value) in seen or isinstance(value, str | bytes | int | float | None):
            return
        seen[id(value)] = value
        fields = dict(sorted(vars(value).items())) if hasattr(value, "__dict__") else {}
        if isinstance(value, HostPolicy):
            visit([value.function, value.observe])
        elif type(value).__module__.startswith("limsim_jax."):  # its numbers are told by `describe`
            visit([x for x in fields.values() if not isinstance(x, str | int | float | None)])
        elif isinstance(value, np.ndarray | jax.Array):
            values.append(describe(value))
        elif isinstance(value, Mapping):
            for x in value.values():
                visit(x)
        elif isinstance(value, list | tuple | set | frozenset):
            for x in value:
                visit(x)
        elif callable(getattr(value, "state_dict", None)):  # torch
            state = value.state_dict()
            values.extend(
                [name, describe(np.asarray(x.detach().cpu() if hasattr(x, "detach") else x))]
                for name, x in sorted(state.items())
            )
            visit_code(type(value))
        elif isinstance(value, functools.partial):
            visit([value.func, value.args, value.keywords])
        elif isinstance(value, MethodType):
            visit([value.__func__, value.__self__])
        elif isinstance(value, FunctionType):
            visit_code(value)
            visit([cell.cell_contents for cell in value.__closure__ or ()])
            visit([value.__defaults__ or (), value.__kwdefaults__ or {}])
        elif isinstance(value, type):
            visit_code(value)
        elif not isinstance(value, ModuleType):
            visit_code(type(value))
            if _is_typed(type(value)) or _is_own(_file_of(type(value))):  # not an object of some library
                visit(fields)

    def visit_code(kind: Any) -> None:
        module, path = sys.modules.get(kind.__module__), _file_of(kind)
        if _is_typed(kind):
            try:
                text = textwrap.dedent(inspect.getsource(kind))
            except (TypeError, OSError):
                text = repr(getattr(getattr(kind, "__code__", None), "co_code", kind.__qualname__))
            texts[f"{kind.__module__}.{kind.__qualname__}"] = _hash(text.encode())
            code = getattr(kind, "__code__", None)
            known = getattr(kind, "__globals__", {})
            for name in code.co_names if code else ():
                if isinstance(known.get(name), FunctionType | type | np.ndarray | jax.Array):
                    visit(known[name])
        elif _is_own(path):
            for file in _imports(path.resolve(), getattr(module, "__package__", None) or ""):
                files.setdefault(file)
            for x in vars(module).values():
                if isinstance(x, np.ndarray | jax.Array) or callable(getattr(x, "state_dict", None)):
                    visit(x)

    visit(policy)
    found = {file.name: _hash(file.read_bytes()) for file in sorted(files)}
    names = [file.name for file in files]
    found |= {str(x): _hash(x.read_bytes()) for x in files if names.count(x.name) > 1}
    return {"sources": found | texts, **({"values": _hash(json.dumps(values).encode())} if values else {})}


def _is_typed(kind: Any) -> bool:
    """Whether a notebook, or the script that runs, defines it."""
    return kind.__module__ == "__main__" or kind.__module__ not in sys.modules


def _file_of(kind: Any) -> Path:
    return Path(getattr(sys.modules.get(kind.__module__), "__file__", None) or "")


def _imports(path: Path, package: str) -> list[Path]:
    """A file and the files that it imports.

    At any depth, also within functions; not those of installed packages."""
    found: dict[Path, None] = {}
    waiting = [(path, package)]
    while waiting:
        path, package = waiting.pop()
        if path in found:
            continue
        found[path] = None
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = "." * node.level + (node.module or "")
                names = [base, *(f"{base}{'' if base.endswith('.') else '.'}{x.name}" for x in node.names)]
            else:
                continue
            for name in names:
                module = _module(name, package)
                if module is not None and _is_own(module[0]):
                    waiting.append(module)
    return list(found)


def _module(name: str, package: str) -> tuple[Path, str] | None:
    """File and package of a module by its name; None where there is none."""
    try:
        name = importlib.util.resolve_name(name, package)
        top = name.partition(".")[0]
        if top in sys.stdlib_module_names or top in ("jax", "numpy", "limsim_jax"):
            return None
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError, AttributeError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    inner = name if spec.submodule_search_locations is not None else name.rpartition(".")[0]
    return Path(spec.origin).resolve(), inner


def _is_own(path: Path) -> bool:
    """Whether a file is neither installed nor of this package."""
    if path.suffix != ".py" or not path.is_file():
        return False
    path = path.resolve()
    if path.is_relative_to(_PACKAGE) or {"site-packages", "dist-packages"} & set(path.parts):
        return False
    return not any(path.is_relative_to(folder) for folder in _INSTALLED)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
