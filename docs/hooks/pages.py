"""Generate pages: the tutorial, the command line, and files of the top folder."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
AS_THEY_ARE = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, and the pictures that pages show from ``results``."""
    pages = {
        name: (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
        for name, source in AS_THEY_ARE.items()
    }
    notebook = _beside("notebook")
    pages["tutorial.md"] = notebook.as_markdown(notebook.execute(ROOT / "docs" / "tutorial.ipynb"))
    pages["command_line.md"] = _command_line()
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    for name in ("demo/city/map", "demo/city/map_before_and_after", "consistency/nees_mid", "inertial/nees"):
        path = ROOT / "results" / f"{name}.png"
        files.append(File.generated(config, f"pictures/{path.name}", abs_src_path=str(path)))
    return files


def _beside(name: str) -> ModuleType:
    """Return a module of this folder, which is not a package."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _command_line() -> str:
    """Return the help of every subcommand."""
    from ekfslam.cli import commands

    names = sorted(path.stem for path in Path(commands.__path__[0]).glob("*.py") if path.stem != "__init__")
    parts = [
        "# Command line",
        "Every subcommand is a thin call of the Python function of the same name. This page shows the output of "
        "`--help`. An error of the user is one line and exit code 2.",
        _help(),
        *(f"## {name}\n\n{_help(name)}" for name in names),
    ]
    return "\n\n".join(parts) + "\n"


def _help(*command: str) -> str:
    environment = {**os.environ, "COLUMNS": "100"}
    call = [sys.executable, "-m", "ekfslam.cli", *command, "--help"]
    text = subprocess.run(call, capture_output=True, text=True, check=True, env=environment, cwd=ROOT).stdout
    return f"```text\n{text.rstrip()}\n```"
