"""Mutation testing of the metrics: every one is made wrong, place by place, and a test has to notice.

    python experiments/mutate_metrics.py [--modules safety scores ...] [--every 10] [--jobs 2]
    python experiments/mutate_metrics.py --again --rest
    python experiments/mutate_metrics.py --again --engine

With `--engine` mutants meet the slow tests as well.

Five ways of being wrong, each applied wherever it can be (one place at a time):

- sign: `+` for `-` and back, a minus left out, the least for the greatest;
- unit: `*` for `/` and back, a number 3.6 times as large (km/h for m/s);
- mask: a term of `&` or `|` left out, `~` left out, the condition of `where` always true;
- step: a whole number one larger (not an index: JAX takes the last place then);
- threshold: `<` for `<=` and back. Survivors say little: measured quantities are never equal.

A mutant is killed when a test of its module, or of a module that stands on it, fails. One that survives is
either a hole in the tests or no change of behaviour at all; those that were judged to be of the second
kind are in mutants_alike.json, with the reason. Writes experiments/results/metric_mutants.json and .md;
modules that are not named keep their rows.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from limsim_jax.files import write_whole

REPO = Path(__file__).resolve().parents[1]
RESULTS = REPO / "experiments/results"
KINDS = ("sign", "unit", "mask", "step", "threshold")
SLOWEST = 150  # s: a mutant may loop for ever

TESTS = {
    "reductions": ("reductions", "scores", "traffic", "safety", "ego"),
    "safety": ("safety", "blame", "ego"),
    "motion": ("motion", "ego"),
    "blame": ("blame", "ego"),
    "scores": ("scores", "ego"),
    "traffic": ("traffic",),
    "step": ("ego", "own_metrics"),
    "course": ("course",),
    "measure": ("own_metrics",),
    "measures.progress": ("ego",),
    "measures.proximity": ("ego",),
    "measures.rss": ("ego",),
    "measures.contacts": ("ego",),
    "measures.rules": ("ego",),
    "measures.comfort": ("ego",),
    "measures.scores": ("ego",),
    "ego": ("ego", "own_metrics"),
    "record": ("observer",),
    "observer": ("observer", "evaluators", "own_metrics"),
}
"""The tests of each module, the nearest first."""

ALIKE = Path(__file__).with_name("mutants_alike.json")
SAME: dict[tuple[str, str, str], str] = {
    (found["module"], found["function"], change): found["why"]
    for found in json.loads(ALIKE.read_text(encoding="utf-8"))
    for change in found["changes"]
}
"""(module, function, change): why the mutants behave as the original does."""

DESCRIPTIONS = {"columns", "DESCRIPTIONS", "_PARTS", "_column", "_nuplan", "_limsim", "_second"}
"""Names of what describes columns: no mutants, it changes no number."""

SWAPS = {
    ast.Add: ("sign", ast.Sub),
    ast.Sub: ("sign", ast.Add),
    ast.Mult: ("unit", ast.Div),
    ast.Div: ("unit", ast.Mult),
}
COMPARISONS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
OPPOSITE = {"min": "max", "minimum": "maximum", "lesser": "greater"}
OPPOSITE |= {there: back for back, there in OPPOSITE.items()}


@dataclass(frozen=True)
class Mutant:
    """One change of one place."""

    module: str
    function: str
    line: int
    kind: str
    change: str
    nth: int  # of the equal changes in the function, from 0
    source: str  # of the whole module


def places(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Every node that is executed, and the function it is in; no annotations, no indices."""

    def walk(node: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
        yield function, node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "slice"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if not isinstance(child, ast.AST) or _describes(child):
                    continue
                inside = function
                if isinstance(child, ast.FunctionDef | ast.ClassDef):
                    inside = f"{function}.{child.name}".lstrip(".")
                yield from walk(child, inside)

    yield from walk(tree, "")


def _describes(node: ast.AST) -> bool:
    """Whether a statement only describes columns."""
    if isinstance(node, ast.FunctionDef):
        return node.name in DESCRIPTIONS
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return any(isinstance(target, ast.Name) and target.id in DESCRIPTIONS for target in targets)


def changes(node: ast.AST) -> Iterator[tuple[str, str]]:
    """What can be made wrong at a node: the kind, and the code to stand in its place."""
    code = ast.unparse
    match node:
        case ast.BinOp(left, operator, right) if type(operator) in SWAPS:
            kind, other = SWAPS[type(operator)]
            yield kind, code(ast.BinOp(left, other(), right))
        case ast.BinOp(left, ast.BitAnd() | ast.BitOr(), right):
            yield "mask", code(right)
            yield "mask", code(left)
        case ast.AugAssign(target, ast.BitAnd() | ast.BitOr(), value):
            yield "mask", f"{code(target)} = {code(value)}"
            yield "mask", "pass"
        case ast.UnaryOp(ast.USub(), operand):
            yield "sign", code(operand)
        case ast.UnaryOp(ast.Invert(), operand):
            yield "mask", code(operand)
        case ast.Call(ast.Attribute(module, name), arguments, keywords) if name in OPPOSITE:
            yield "sign", code(ast.Call(ast.Attribute(module, OPPOSITE[name]), arguments, keywords))
        case ast.Call(ast.Name(name), arguments, keywords) if name in OPPOSITE:
            yield "sign", code(ast.Call(ast.Name(OPPOSITE[name]), arguments, keywords))
        case ast.Call(ast.Attribute(_, "where"), [condition, *_], _):
            yield "mask", code(node).replace(code(condition), f"({code(condition)}) | True", 1)
        case ast.Compare(left, [operator], [right]) if type(operator) in COMPARISONS:
            yield "threshold", f"{code(left)} {COMPARISONS[type(operator)]} {code(right)}"
        case ast.Constant(value) if isinstance(value, float) and value:
            yield "unit", repr(3.6 * value)
        case ast.Constant(value) if isinstance(value, int) and not isinstance(value, bool):
            yield "step", repr(value + 1)
        case _:
            pass


def _path(module: str) -> Path:
    return REPO / f"limsim_jax/metrics/{module.replace('.', '/')}.py"


def mutants(module: str) -> list[Mutant]:
    """All mutants of a module, in the order of its lines."""
    source = _path(module).read_text()
    starts = [0]  # of the lines, in bytes as `ast` counts
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Mutant] = []
    for function, node in places(ast.parse(source)):
        for kind, code in changes(node):
            if kind == "mask" and not function:  # unions of types
                continue
            assert isinstance(node, ast.expr | ast.stmt) and node.end_lineno and node.end_col_offset
            begin = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            whole = source.encode()
            new = f"({code})" if isinstance(node, ast.expr) else code
            mutated = (whole[:begin] + new.encode() + whole[end:]).decode()
            change = f"{ast.unparse(node)} → {code}"
            nth = sum((x.function, x.change) == (function, change) for x in found)
            found.append(Mutant(module, function, node.lineno, kind, change, nth, mutated))
    return sorted(found, key=lambda mutant: mutant.line)


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Gives a module another source than its file has."""

    def __init__(self, mutant: Mutant) -> None:
        self.name, self.source = f"limsim_jax.metrics.{mutant.module}", mutant.source

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname == self.name:
            return importlib.util.spec_from_loader(fullname, self, origin=self.get_filename(fullname))
        return None

    def get_filename(self, fullname: str) -> str:
        return str(REPO / f"{self.name.replace('.', '/')}.py")

    def get_data(self, path: str) -> bytes:
        return self.source.encode()


def _run(mutant: Mutant, tests: list[str], engine: bool) -> None:
    """Run tests with a mutant; this process ends with pytest's exit status."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    import pytest

    os.chdir(REPO)
    sys.meta_path.insert(0, _Mutated(mutant))
    tier = ["-m", ""] if engine else []
    os._exit(pytest.main(["-q", "-x", "--tb=no", "-p", "no:cacheprovider", *tier, *tests]))


def survives(mutant: Mutant, engine: bool = False) -> bool:
    """Whether no test notices."""
    # forked from a process that has the slow imports behind it, but none of ours and no running JAX
    context = multiprocessing.get_context("forkserver")
    tests = [f"tests/metrics/test_{name}.py" for name in TESTS[mutant.module]]
    process = context.Process(target=_run, args=(mutant, tests, engine))
    process.start()
    process.join(SLOWEST * (3 if engine else 1))
    if process.is_alive():
        process.kill()
        process.join()
    if process.exitcode in (3, 4):
        raise RuntimeError(f"pytest could not run {tests} on {mutant.change}: exit status {process.exitcode}")
    return process.exitcode == 0


def table(rows: list[dict[str, Any]]) -> str:
    """Killed of tried, by module and kind, and the mutants that survive."""
    lines = ["| metrics/ | places | " + " | ".join(KINDS) + " | survive, judged alike |"]
    lines.append("|---" + "|--:" * (len(KINDS) + 2) + "|")
    for module in [*TESTS, "all"]:
        mine = [row for row in rows if module in (row["module"], "all")]
        if not mine:
            continue
        places = sum(len(mutants(name)) for name in {row["module"] for row in mine})
        fates = Counter((row["kind"], row["fate"]) for row in mine)
        killed = {kind: fates[kind, "killed"] for kind in KINDS}
        cells = [f"{killed[kind]} / {killed[kind] + fates[kind, 'survived']}" for kind in KINDS]
        left = [row for row in mine if row["fate"] == "survived"]
        alike = sum(why(row) is not None for row in left)
        lines.append(f"| {module} | {places} | " + " | ".join(cells) + f" | {len(left)}, {alike} |")
    lines += ["", "Every cell: killed / tried. Survivors:", ""]
    for row in rows:
        if row["fate"] == "survived":
            change = row["change"].replace("\n", " ").replace("|", "\\|")
            where = f"{row['module']}, {row['function'] or 'constants'}"
            lines.append(f"- {where}: `{change}`: {why(row) or 'not judged alike'}")
    return "\n".join(lines)


def why(row: dict[str, Any]) -> str | None:
    """Why a survivor behaves as the original does; None if it does not, or has not been judged."""
    if row["kind"] == "threshold":
        return "at equality, which measured quantities hardly ever meet; not judged one by one"
    return SAME.get((row["module"], row["function"], row["change"]))


def main() -> None:
    """Mutate, test, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--modules", nargs="+", choices=list(TESTS), default=list(TESTS), metavar="NAME")
    parser.add_argument("--every", type=int, default=1, help="only every n-th mutant")
    parser.add_argument(
        "--again", action="store_true", help="try survivors that are not judged alike, keep others"
    )
    parser.add_argument("--rest", action="store_true", help="try those not tried yet, keep other results")
    parser.add_argument("--engine", action="store_true", help="with the tests that drive the engine")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    for name in ("every", "jobs"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} {getattr(options, name)}: at least 1")
    multiprocessing.get_context("forkserver").set_forkserver_preload(
        ["jax", "jax.numpy", "pytest", "scipy.stats", "scipy.signal", "pyarrow"]
    )
    file = RESULTS / "metric_mutants.json"
    kept: dict[str, list[dict[str, Any]]] = {}
    if file.exists():
        for row in json.loads(file.read_text())["mutants"]:
            kept.setdefault(row["module"], []).append(row)
    for module in options.modules:
        source = _path(module).read_text()
        if not survives(Mutant(module, "", 0, "", "", 0, source), options.engine):
            parser.error(f"{module}: its tests fail without any mutant")
        known = {(row["function"], row["change"], row["nth"]): row["fate"] for row in kept.get(module, [])}
        anew = not (options.again or options.rest)
        known = {} if anew else known
        stride = options.every if anew or options.rest else 0  # 0: nothing new
        chosen = [
            mutant
            for k, mutant in enumerate(mutants(module))
            if (stride and k % stride == 0) or (mutant.function, mutant.change, mutant.nth) in known
        ]
        rows: list[dict[str, Any]] = []
        start = time.perf_counter()

        def fate(mutant: Mutant, known: dict[Any, Any] = known) -> str:
            before = known.get((mutant.function, mutant.change, mutant.nth))
            judged = before == "survived" and why(asdict(mutant)) is not None
            if before and (before == "killed" or judged or not options.again):
                return before
            return "survived" if survives(mutant, options.engine) else "killed"

        with ThreadPoolExecutor(options.jobs) as pool:
            for mutant, found in zip(chosen, pool.map(fate, chosen), strict=True):
                row = asdict(mutant)
                del row["source"]
                rows.append(row | {"fate": found})
                if found == "survived":
                    print(f"{module}:{mutant.line} survives: {mutant.change}", flush=True)
        left = sum(row["fate"] == "survived" for row in rows)
        spent = time.perf_counter() - start
        print(f"{module}: {len(rows) - left} of {len(rows)} killed, {spent:.0f} s", flush=True)
        kept[module] = rows
        every = [row for name in TESTS for row in kept.get(name, [])]
        write_whole(file, json.dumps({"mutants": every}, indent=1) + "\n")
        head = "Regenerate: `python experiments/mutate_metrics.py`\n\n"
        write_whole(RESULTS / "metric_mutants.md", f"{head}{table(every)}\n")


if __name__ == "__main__":
    main()
