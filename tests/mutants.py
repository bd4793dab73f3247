"""Mutants of some files, each against the tests that run its line: `python tests/mutants.py FILES --tests TESTS`.

A mutant has one changed sign, term, comparison, condition, number or statement. It is killed if a test fails or takes
too long. Tests are those that ran the line in a first run: half of them the fastest, half those that run the fewest
lines. A mutant never touches a file: tests are collected once, and a process forked for each mutant changes the code of
the function. What an import runs is changed in a process that imports it.
"""

from __future__ import annotations

import argparse
import ast
import collections
import copy
import dataclasses
import gc
import importlib.abc
import importlib.util
import itertools
import json
import math
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
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
    """Return what a function returns in a process of its own; "killed" if that dies or takes too long.

    That is so many seconds of the processor, or three times as many of the clock: other work on the machine kills none.
    """
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer"
        if not (child := os.fork()):
            os.setpgid(0, 0)
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 1))
            with Path(folder, "out").open("w") as out:
                os.dup2(out.fileno(), 1)
                os.dup2(out.fileno(), 2)
                answer.write_text(json.dumps(function()))
                os._exit(0)
        end = time.monotonic() + 3.0 * seconds
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


def name_of(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def judged(mutant: Mutant) -> str:
    """Return the verdict on a mutant of what an import runs."""
    sys.meta_path.insert(0, Changed(name_of(mutant.file), mutant.file, mutant.tree))
    return "survives" if tested(["-x", *mutant.tests], []) == 0 else "killed"


def codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from codes(each)


def change_functions(file: Path, tree: ast.Module) -> None:
    """Give the functions of a module the code of a changed tree."""
    importlib.import_module(name_of(file))
    new = {(code.co_qualname, code.co_firstlineno): code for code in codes(compile(tree, str(file), "exec"))}
    for each in gc.get_objects():
        if type(each) is FunctionType and each.__code__.co_filename == str(file):
            each.__code__ = new.get((each.__code__.co_qualname, each.__code__.co_firstlineno), each.__code__)


class Judging:
    """Plugin of pytest: judges mutants of functions once all tests are collected."""

    def __init__(self, mutants: list[Mutant], seconds: float, tell: Callable[[Mutant, str], None]) -> None:
        self.mutants, self.seconds, self.tell = mutants, seconds, tell

    def pytest_runtestloop(self, session: Any) -> bool:
        items = {item.nodeid: item for item in session.items}
        for mutant in self.mutants:
            tests = [items[test] for test in mutant.tests]
            self.tell(mutant, forked(lambda m=mutant, some=tests: self.verdict(m, some), self.seconds))
        return True

    def verdict(self, mutant: Mutant, tests: list[Any]) -> str:
        change_functions(mutant.file, mutant.tree)
        for test, following in itertools.zip_longest(tests, tests[1:]):
            test.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
            if test.session.testsfailed:
                return "killed"
        return "survives"


def tests_of(file: Path, line: int | None, found: dict[str, Any]) -> list[str]:
    """Return tests that run a line, or the file if an import runs the line: fast ones and narrow ones, at most 40."""
    tests = [
        test
        for test, seen in found["lines"].items()
        if any(name == str(file) and line in (None, at) for name, at in seen)
    ]
    fast, narrow = sorted(tests, key=found["seconds"].get), sorted(tests, key=lambda test: len(found["lines"][test]))
    return sorted({*fast[:20], *narrow[:20]}, key=fast.index)


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A changed file, the change, and the tests that run it."""

    file: Path
    line: int
    words: str
    tree: ast.Module
    in_function: bool
    tests: list[str]


def drawn(files: list[Path], count: int, seed: int, found: dict[str, Any]) -> Iterator[Mutant]:
    """Yield mutants drawn over all files."""
    trees = {file: ast.parse(file.read_text()) for file in files}
    every = [(file, *site) for file, tree in trees.items() for site in sites(tree)]
    random.Random(seed).shuffle(every)
    for file, path, which in every[:count]:
        above = [at(trees[file], path[:n]) for n in range(len(path), 0, -1)]
        line = next(node.lineno for node in above if hasattr(node, "lineno"))
        in_function = any(isinstance(node, ast.FunctionDef | ast.Lambda) for node in above)
        tree, words = mutated(trees[file], path, which)
        yield Mutant(file, line, words, tree, in_function, tests_of(file, line if in_function else None, found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--tests", nargs="+", required=True, help="files or arguments of pytest")
    parser.add_argument("--count", type=int, default=60, help="mutants drawn over all files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0, help="most of the processor that a mutant may take")
    parser.add_argument("--marks", default="not slow and not data", help="which tests, as pytest's -m")
    options = parser.parse_args()
    import h5py, matplotlib.figure, numpy, pytest, scipy.linalg, scipy.spatial, scipy.stats  # noqa: E401, F401, I001

    files = [file.resolve() for file in options.files]
    found = forked(lambda: covered(files, [*options.tests, "-m", options.marks]), 3600.0)
    print(f"{len(found['lines'])} tests, without those that fail: {found['failed']}", flush=True)
    counts = collections.Counter[str]()

    def tell(mutant: Mutant, verdict: str) -> None:
        counts[verdict] += 1
        if verdict != "killed":
            place = f"{mutant.file.relative_to(ROOT)}:{mutant.line}"
            print(f"{place}: {verdict} ({len(mutant.tests)} tests): {mutant.words}", file=sys.__stderr__, flush=True)

    later = []
    for mutant in drawn(files, options.count, options.seed, found):
        if mutant.in_function and mutant.tests:
            later.append(mutant)
        else:
            tell(mutant, forked(lambda m=mutant: judged(m), options.seconds) if mutant.tests else "not run")
    with tempfile.TemporaryDirectory() as folder:
        arguments = ["-s", "-x", "--basetemp", f"{folder}/tests", "-m", options.marks, *options.tests]
        tested(arguments, [Judging(later, options.seconds, tell)])
    print(dict(counts))


if __name__ == "__main__":
    main()
