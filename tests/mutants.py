"""Mutants of some files, each against the tests that run its line: `python tests/mutants.py FILES --tests TESTS`.

A mutant has one changed sign, term, comparison, condition, number or statement. It is killed if a test fails or takes
too long. Tests are those that ran the line in a first run, the fastest first. A mutant never touches a file: a process
forked for it imports the changed module.
"""

from __future__ import annotations

import argparse
import ast
import collections
import copy
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
OPERATORS: dict[type, type] = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
UNSEEN = (ast.JoinedStr, ast.arguments, ast.Raise, ast.Import, ast.ImportFrom, ast.Assert)  # words and types


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what may stand in place of a node."""
    match node:
        case ast.BinOp(op=op) if type(op) in OPERATORS:
            yield ast.BinOp(node.left, OPERATORS[type(op)](), node.right)
            if isinstance(op, ast.Add | ast.Sub):
                yield node.left
        case ast.Compare(ops=[op]):
            yield from (ast.Compare(node.left, [kind()], node.comparators) for kind in COMPARISONS[type(op)])
        case ast.BoolOp(op=op, values=values):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
            yield from (values[i] for i in range(len(values)))
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            yield node.operand
        case ast.IfExp():
            yield ast.IfExp(node.test, node.orelse, node.body)
        case ast.If() | ast.While():
            yield type(node)(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1 if isinstance(value, int) else 2.0 * value + 0.001)
        case ast.Assign() | ast.AugAssign() | ast.Expr(value=ast.Call() | ast.YieldFrom() | ast.Yield()) | ast.Delete():
            yield ast.Pass()
        case ast.Return(value=value) if value is not None and not isinstance(value, ast.Constant):
            yield ast.Return(None)


def sites(node: ast.AST, path: tuple[tuple[str, int], ...] = ()) -> Iterator[tuple[tuple[tuple[str, int], ...], int]]:
    """Yield the place of each change below a node: fields and indices, and the number of the change there."""
    yield from ((path, i) for i, _ in enumerate(changes(node)))
    for field, value in ast.iter_fields(node):
        if field in ("decorator_list", "annotation", "returns", "keywords") and not isinstance(node, ast.Call):
            continue
        for i, below in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(below, ast.AST) and not isinstance(below, UNSEEN):
                yield from sites(below, (*path, (field, i if isinstance(value, list) else -1)))


def at(tree: ast.AST, path: tuple[tuple[str, int], ...]) -> Any:
    for field, i in path:
        tree = getattr(tree, field) if i < 0 else getattr(tree, field)[i]
    return tree


def mutated(tree: ast.Module, path: tuple[tuple[str, int], ...], which: int) -> tuple[ast.Module, str]:
    """Return a tree with one change, and the change in words."""
    tree = copy.deepcopy(tree)
    parent, (field, i) = at(tree, path[:-1]), path[-1]
    node = at(tree, path)
    new = list(changes(node))[which]
    words = [ast.unparse(each).splitlines()[0] for each in (node, new)]
    if i < 0:
        setattr(parent, field, new)
    else:
        getattr(parent, field)[i] = new
    return ast.fix_missing_locations(ast.copy_location(tree, tree)), " -> ".join(words)


class Changed(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Importer of one module from a changed tree."""

    def __init__(self, name: str, file: Path, tree: ast.Module) -> None:
        self.name, self.file, self.tree = name, file, tree

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> Any:
        is_package = self.file.name == "__init__.py"
        return (
            importlib.util.spec_from_file_location(
                name, self.file, loader=self, submodule_search_locations=[str(self.file.parent)] if is_package else None
            )
            if name == self.name
            else None
        )

    def get_source(self, name: str) -> str:
        return ast.unparse(self.tree)

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self.tree, str(self.file), "exec"), module.__dict__)


class Covering:
    """Plugin of pytest: lines of files that each test runs, and its time."""

    def __init__(self, files: list[Path]) -> None:
        self.files, self.lines = {str(file) for file in files}, collections.defaultdict[str, set[tuple[str, int]]](set)
        self.seconds, self.failed = dict[str, float](), set[str]()

    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> None:
        found = self.lines[item.nodeid]

        def line(frame: FrameType, event: str, arg: Any) -> Any:
            found.add((frame.f_code.co_filename, frame.f_lineno))
            return line

        sys.settrace(
            lambda frame, event, arg: line(frame, event, arg) if frame.f_code.co_filename in self.files else None
        )

    def pytest_runtest_logreport(self, report: Any) -> None:
        sys.settrace(None) if report.when == "teardown" else None
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.failed.add(report.nodeid)


def forked(function: Any, seconds: float) -> Any:
    """Return what a function returns in a process of its own; "killed" if that dies or takes too long."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer"
        if not (child := os.fork()):
            os.setpgid(0, 0)
            with Path(folder, "out").open("w") as out:
                os.dup2(out.fileno(), 1)
                os.dup2(out.fileno(), 2)
                answer.write_text(json.dumps(function()))
                os._exit(0)
        end = time.monotonic() + seconds
        while not os.waitpid(child, os.WNOHANG)[0]:
            time.sleep(0.02)
            if time.monotonic() > end:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return "killed"
        return json.loads(answer.read_text()) if answer.exists() else "killed"


def tested(arguments: list[str], plugins: list[Any]) -> int:
    import pytest

    os.chdir(ROOT)
    return int(
        pytest.main(["-n", "0", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *arguments], plugins=plugins)
    )


def covered(files: list[Path], arguments: list[str]) -> dict[str, Any]:
    plugin = Covering(files)
    tested(arguments, [plugin])
    lines = {test: sorted(found) for test, found in plugin.lines.items() if test not in plugin.failed}
    return {"lines": lines, "seconds": plugin.seconds, "failed": sorted(plugin.failed)}


def judged(file: Path, tree: ast.Module, tests: list[str]) -> str:
    name = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    sys.meta_path.insert(0, Changed(name, file, tree))
    return "survives" if tested(["-x", *tests], []) == 0 else "killed"


def tests_of(file: Path, node: Any, in_function: bool, found: dict[str, Any]) -> list[str]:
    """Return the tests that run a node, the fastest first; those that run the file, if an import runs the node."""
    tests = [
        test
        for test, seen in found["lines"].items()
        if any(name == str(file) and (line == node.lineno or not in_function) for name, line in seen)
    ]
    return sorted(tests, key=found["seconds"].get)[:40]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--tests", nargs="+", required=True, help="files or arguments of pytest")
    parser.add_argument("--count", type=int, default=60, help="mutants drawn over all files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0, help="most a mutant may take")
    parser.add_argument("--marks", default="not slow and not data", help="which tests, as pytest's -m")
    options = parser.parse_args()
    import h5py, matplotlib.figure, numpy, pytest, scipy.linalg, scipy.spatial, scipy.stats  # noqa: E401, F401, I001

    files = [file.resolve() for file in options.files]
    found = forked(lambda: covered(files, [*options.tests, "-m", options.marks]), 3600.0)
    print(f"{len(found['lines'])} tests, without those that fail: {found['failed']}", flush=True)
    trees = {file: ast.parse(file.read_text()) for file in files}
    drawn = [(file, *site) for file, tree in trees.items() for site in sites(tree)]
    random.Random(options.seed).shuffle(drawn)
    counts = collections.Counter[str]()
    for file, path, which in drawn[: options.count]:
        above = [at(trees[file], path[:n]) for n in range(len(path), 0, -1)]
        nearest = next(node for node in above if hasattr(node, "lineno"))
        in_function = any(isinstance(node, ast.FunctionDef | ast.Lambda) for node in above)
        tests, (tree, words) = tests_of(file, nearest, in_function, found), mutated(trees[file], path, which)
        verdict = forked(lambda f=file, t=tree, some=tests: judged(f, t, some), options.seconds) if tests else "not run"
        counts[verdict] += 1
        if verdict != "killed":
            print(f"{file.relative_to(ROOT)}:{nearest.lineno}: {verdict} ({len(tests)} tests): {words}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
