"""Functions and classes stay short: 50 and 250 lines, apart from the exceptions below."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import ekfslam

LONGEST = {"function": 50, "class": 250}

# Name to reason. The list may only become shorter.
EXCEPTIONS: dict[str, str] = {}


def lengths(tree: ast.Module, module: str) -> Iterator[tuple[str, str, int]]:
    """Yield name, kind and number of lines of every function and class of a module, nested ones too."""

    def walk(node: ast.AST, name: str) -> Iterator[tuple[str, str, int]]:
        for child in ast.iter_child_nodes(node):
            own = name
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                own = f"{name}.{child.name}"
                kind = "class" if isinstance(child, ast.ClassDef) else "function"
                assert child.end_lineno is not None
                yield own, kind, child.end_lineno - child.lineno + 1
            yield from walk(child, own)

    return walk(tree, module)


def too_long(root: Path) -> dict[str, int]:
    """Return functions and classes of a package that are longer than allowed, with their lengths."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        module = ".".join((root.name, *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {name: size for name, kind, size in lengths(tree, module) if size > LONGEST[kind]}
    return found


@pytest.fixture(scope="module")
def found() -> dict[str, int]:
    return too_long(Path(ekfslam.__file__).parent)


def test_functions_and_classes_are_short_apart_from_exceptions_with_a_reason(found: dict[str, int]) -> None:
    assert {name: size for name, size in found.items() if name not in EXCEPTIONS} == {}


def test_no_exception_outlives_its_reason(found: dict[str, int]) -> None:
    assert sorted(name for name in EXCEPTIONS if name not in found) == []


def test_a_function_of_51_lines_is_too_long(tmp_path: Path) -> None:
    package = tmp_path / "some"
    package.mkdir()
    (package / "part.py").write_text(
        "class A:\n    def f(self):\n" + "        pass\n" * 50 + "    def g(self):\n" + "        pass\n" * 49
    )
    assert too_long(package) == {"some.part.A.f": 51}


def functions_in_cpp(text: str) -> Iterator[tuple[int, int]]:
    """Yield first line and number of lines of each function of a file in C++, formatted as the project's are."""
    first = 0
    for number, line in enumerate(text.splitlines(), start=1):
        if line and not line.startswith((" ", "}", "#", "//", "namespace", "struct", "class", "template")):
            first = first or number
        if line.endswith(";") and not line.startswith((" ", "}")):
            first = 0
        if line.startswith("}"):
            if first:
                yield first, number - first + 1
            first = 0


def test_functions_in_cpp_are_short():
    found = {
        f"{path.name}:{first}": length
        for path in sorted(Path(ekfslam.__file__).parent.joinpath("engine").glob("*.[ch]pp"))
        for first, length in functions_in_cpp(path.read_text(encoding="utf-8"))
    }
    assert len(found) > 100
    assert not {name: length for name, length in found.items() if length > LONGEST["function"]}


def test_a_long_function_in_cpp_is_found():
    text = "int before();\nint f(int a,\n      int b) {\n" + "    ++a;\n" * 60 + "}\n"
    assert list(functions_in_cpp(text)) == [(2, 63)]
