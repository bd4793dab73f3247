"""The documentation says what is: the tutorial runs, equations are all derived, quoted keys and files exist."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import ekfslam

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS / "hooks"))

from notebook import as_markdown, execute  # noqa: E402 (a folder of the documentation, no package)


def test_the_tutorial_runs():
    names: dict = {}
    cells = execute(DOCS / "tutorial.ipynb", names)
    page = as_markdown(cells)
    assert page.count("data:image/png") >= 1 and "Traceback" not in page
    assert cells[-1].shown.endswith('<pre class="shown">True</pre>')
    assert np.abs(names["error_m"]).max() < 1.0
    joint_m, alone_m = (
        float(x) for x in re.findall(r"([0-9.]+) m", next(c.shown for c in cells if "apart" in c.source))[1:]
    )
    assert 0.0 < joint_m < alone_m
    assert names["mine"].noise is not None and len(names["mine"].landmarks) > 100


def test_what_a_cell_shows(tmp_path):
    path = tmp_path / "a.ipynb"
    path.write_text(
        '{"cells": [{"cell_type": "code", "source": ["x = 1\\n", "print(\'a<b\')\\n", "x + 1"]},'
        ' {"cell_type": "code", "source": ["x"]}, {"cell_type": "code", "source": ["None"]}]}',
        encoding="utf-8",
    )
    shown = [cell.shown for cell in execute(path)]
    assert shown == ['<pre class="shown">a&lt;b</pre>\n\n<pre class="shown">2</pre>', '<pre class="shown">1</pre>', ""]


def test_every_numbered_equation_is_derived():
    assert ekfslam.__doc__ is not None
    numbered = set(re.findall(r"  \((\d+'?)\) ", ekfslam.__doc__))
    page = (DOCS / "equations.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## \((\d+'?)\) .*\n([\s\S]*?)(?=^## |\Z)", page, re.MULTILINE)
    assert numbered == {number for number, _ in sections} and len(sections) == 12
    assert all("$$" in text and "][ekfslam." in text for _, text in sections)


def test_settings_and_bounds_are_those_of_the_code(tmp_path):
    block = re.search(r"```toml\n([\s\S]*?)```", (DOCS / "settings.md").read_text(encoding="utf-8"))
    assert block is not None
    path = tmp_path / "a.toml"
    path.write_text(block[1], encoding="utf-8")
    assert ekfslam.Config.from_toml(path).blocks["twist_bias"]
    hygiene = re.findall(r"^\| `(\w+)` \|", (DOCS / "hygiene.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(hygiene) == set(ekfslam.HygieneConfig.__dataclass_fields__)


def test_the_package_says_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    install = (DOCS / "install.md").read_text(encoding="utf-8")
    for extra in project["optional-dependencies"]:
        assert f"| `{extra}` |" in install, extra
    recipe = {
        re.sub("^matplotlib-base", "matplotlib", x) for x in re.findall(r"^    - ([\w-]+ [>=\d.]+)$", install, re.M)
    }
    for requirement in project["dependencies"]:
        assert re.sub(r"(>|=)=", lambda m: " >=" if m[1] == ">" else " ", requirement) in recipe
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None and cited[1] == project["version"]
    assert f"## {project['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda path: path.name)
def test_quoted_files_exist(page):
    text = page.read_text(encoding="utf-8")
    quoted = re.findall(r"(?:experiments|results|tests|ekfslam|docs)/[\w/.-]*\w", text)
    missing = [name for name in quoted if not (ROOT / name).exists() and "local" not in name and "NAME" not in name]
    assert not missing
