"""Imports lead downwards, without a circle. Tests and experiments use public names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import ekfslam
from ekfslam.models import blocks
from ekfslam.models.blocks import StateBlock

# Rooms from the lowest to the highest: folders, and the modules that lie in ekfslam/ itself. A new one gets its place.
ROOMS: tuple[tuple[str, ...], ...] = (
    ("arrays", "errors", "names", "limits", "progress", "shown", "files", "stored", "hdf5", "timings"),
    ("geometry",),
    ("config",),
    ("data",),
    ("frontend",),
    ("models",),
    ("engine",),
    ("filters",),
    ("smoother",),
    ("inertial",),
    ("storage",),
    ("evaluation",),
    ("resolve",),
    ("provenance", "runner", "live_stereo"),
    ("given", "others"),
    ("studies",),
    ("figures",),
    ("page",),
    ("reports",),
    ("cli", "__main__"),
)


def packages(module: str) -> set[str]:
    """Return the packages that a module lies in, the outermost excepted."""
    parts = module.split(".")
    return {".".join(parts[:n]) for n in range(2, len(parts))}


def imported(path: Path, modules: set[str]) -> Iterator[str]:
    """Yield the modules of the package that a file imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in modules else str(node.module) for name in full]
        yield from (name for name in names if name in modules)


def imports_of(root: Path) -> dict[str, set[str]]:
    """Return the modules of a package with the modules that each imports, and whose packages are imported with them."""
    paths = {
        ".".join((root.name, *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__"): path
        for path in root.rglob("*.py")
    }
    found = {}
    for module, path in paths.items():
        direct = set(imported(path, set(paths)))
        everything = direct.union(*(packages(name) for name in direct))
        found[module] = everything - packages(module) - {module, root.name}
    return found


def circles(imports: dict[str, set[str]]) -> list[set[str]]:
    """Return the groups of modules that import each other, directly or through others."""
    names = sorted(imports)
    pairs = [(names.index(name), names.index(other)) for name in names for other in imports[name]]
    rows, columns = np.array(pairs).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (rows, columns)), shape=(len(names),) * 2)
    _, group = connected_components(graph, connection="strong")
    return [{names[i] for i in np.flatnonzero(group == n)} for n in np.flatnonzero(np.bincount(group) > 1)]


def upwards(imports: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Return the imports that lead to a higher room."""
    height = {room: i for i, rooms in enumerate(ROOMS) for room in rooms}
    room = {module: height[module.split(".")[1]] for module in imports if "." in module}
    return {(name, other) for name in room for other in imports[name] if room[other] > room[name]}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    return imports_of(Path(ekfslam.__file__).parent)


def test_no_circle_of_imports_lazy_ones_counted(imports: dict[str, set[str]]) -> None:
    assert circles(imports) == []


def test_no_room_imports_from_a_room_above_it(imports: dict[str, set[str]]) -> None:
    assert upwards(imports) == set()


def test_a_lazy_import_closes_a_circle(tmp_path: Path) -> None:
    package = tmp_path / "ekfslam"
    package.mkdir()
    (package / "files.py").write_text("import ekfslam.config\n")
    (package / "config.py").write_text("def f():\n    from ekfslam import files\n")
    found = imports_of(package)
    assert circles(found) == [{"ekfslam.files", "ekfslam.config"}]
    assert upwards(found) == {("ekfslam.files", "ekfslam.config")}


def block_names() -> set[str]:
    """Return the names of all blocks of the package but the pose's."""
    kinds = {kind for kind in vars(blocks).values() if isinstance(kind, type) and issubclass(kind, StateBlock)}
    return {str(kind.name) for kind in kinds if isinstance(kind.name, str)} - {"pose"}


def names_a_block(node: ast.AST, names: set[str], kinds: set[str]) -> bool:
    """Return whether a node indexes by the name of a block, compares with it, or asks for its class."""
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name | ast.Attribute):
        where = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
        literal = isinstance(node.slice, ast.Constant) and node.slice.value in names
        return literal and where in ("layout", "values", "before", "after", "shared")
    if isinstance(node, ast.Compare):
        parts = [node.left, *node.comparators]
        asks = any(isinstance(part, ast.Attribute) and part.attr == "name" for part in parts)
        return asks and any(isinstance(part, ast.Constant) and part.value in names for part in parts)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass"):
        return any(isinstance(part, ast.Name) and part.id in kinds for part in ast.walk(node.args[1]))
    return False


def test_no_other_file_names_a_block():
    names = block_names()
    kinds = {kind for kind in vars(blocks) if isinstance(vars(blocks)[kind], type)} - {"StateBlock", "Layout"}
    assert {"twist", "calibration", "velocity", "previous_view"} <= names
    root = Path(ekfslam.__file__).parent
    found = [
        f"{path.relative_to(root)}:{node.lineno}"
        for path in sorted(root.rglob("*.py"))
        if root / "models" / "blocks" not in path.parents
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.expr) and names_a_block(node, names, kinds)
    ]
    assert found == []


def private_names(node: ast.AST) -> Iterator[str]:
    """Yield the private names that a piece of code imports from the package, or uses as attributes."""
    if isinstance(node, ast.ImportFrom) and str(node.module).startswith("ekfslam"):
        yield from (alias.name for alias in node.names if alias.name.startswith("_"))
    is_own = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "self"
    if isinstance(node, ast.Attribute) and not is_own and node.attr.startswith("_") and not node.attr.endswith("_"):
        yield node.attr


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["tests", "experiments"])
def test_no_private_name_of_the_package_is_used(folder: str) -> None:
    paths = sorted((Path(__file__).parents[1] / folder).rglob("*.py"))
    assert len(paths) > 10
    trees = {path.name: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    used = {(name, used) for name, tree in trees.items() for node in ast.walk(tree) for used in private_names(node)}
    assert used <= {("conftest.py", "_fixtureinfo"), ("mutants.py", "_exit")}, "those are pytest's and Python's"
