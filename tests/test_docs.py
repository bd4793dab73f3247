"""The documentation says what is: the tutorial runs, equations are all derived, quoted keys and files exist."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import ekfslam
from ekfslam.evaluation.metrics import METRICS
from ekfslam.figures.registry import FIGURES
from ekfslam.models.blocks import OPTIONAL_BLOCKS
from ekfslam.storage.exports import EXPORTS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS / "hooks"))

from notebook import as_markdown, execute  # noqa: E402 (a folder of the documentation, no package)


@pytest.fixture
def registries():
    """Restore what examples register."""
    before = [(registry, dict(registry)) for registry in (OPTIONAL_BLOCKS, EXPORTS, METRICS, FIGURES)]
    yield
    for registry, entries in before:
        registry.clear()
        registry.update(entries)


@pytest.mark.slow
def test_the_examples_of_extensions_run(registries, tmp_path):
    text = (DOCS / "extending.md").read_text(encoding="utf-8")
    names: dict = {}
    for code in re.findall(r"^```python\n([\s\S]*?)^```", text, re.MULTILINE):
        exec(compile(code, "extending.md", "exec"), names)
    drive, ekf = names["drive"], names["ekf"]
    assert np.linalg.norm(ekf.T_world_imu[:3, 3] - drive.truth.T_world_imu[-1, :3, 3]) < 1.0
    np.testing.assert_allclose(names["seeing"].positions_m, [[0.5, 0.0, 4.0]])
    result = ekfslam.run(drive, config=ekfslam.Config(blocks={"slip": {}}))
    assert result.parameters is not None and result.parameters.name == ("slip",)
    assert "longest step" in ekfslam.compare(drive, ["full"]).table and names["counts"](result).axes
    result.export(tmp_path / "last.txt", "last")
    (tmp_path / "a.mine").write_text("MINE\n0 3 640 180 610 180\n1 3 640 180 610 180\n", encoding="utf-8")
    source = names["Source"].at(tmp_path / "a.mine")
    assert names["READER"].recognises(source) and len(names["READER"].tracks(source)) == 2


@pytest.mark.slow
def test_the_tutorial_runs():
    names: dict = {}
    cells = execute(DOCS / "tutorial.ipynb", names)
    page = as_markdown(cells)
    assert page.count("data:image/png") >= 1 and "Traceback" not in page
    assert cells[-1].shown.endswith('<pre class="shown">True</pre>')
    assert np.abs(names["error_m"]).max() < 1.0
    joint_m, alone_m = (
        float(x) for x in re.findall(r"([0-9.]+) m", next(c.shown for c in cells if "apart =" in c.source))[1:]
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
    assert numbered == {number for number, _ in sections} and len(sections) == 15
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
    quoted = re.findall(r"(?<!/)(?:experiments|results|tests|ekfslam|docs)/[\w/.-]*\w", text)
    missing = [name for name in quoted if not (ROOT / name).exists() and "local" not in name and "NAME" not in name]
    assert not missing


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_links_of_the_top_folder_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)", (ROOT / page).read_text(encoding="utf-8"))
    assert links and not [link for link in links if not (ROOT / link).exists()]


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")]
    assert not [name for name in pages if f": {name}\n" not in navigation]


def quotations() -> list:
    """Paragraphs that cite one file of results: page, file, and the numbers in them."""
    found = []
    for page in (ROOT / "README.md", *sorted(DOCS.glob("*.md"))):
        for paragraph in re.split(r"\n\n|\n(?=[-|] )", page.read_text(encoding="utf-8")):
            cited = set(re.findall(r"results/[\w/]+\.md", paragraph))
            numbers = re.findall(r"(?<![\w.])\d+\.\d+(?=x?(?:[^\w.]|\.\s|$))", paragraph)
            if len(cited) == 1 and numbers:
                found.append(pytest.param(*cited, numbers, id=f"{page.name}-{numbers[0]}"))
    return found


@pytest.mark.parametrize(("cited", "numbers"), quotations())
def test_figures_stand_in_the_results_they_cite(cited, numbers):
    text = (ROOT / cited).read_text(encoding="utf-8")
    assert not [number for number in numbers if number not in text]


def test_the_tables_of_the_pages_stand_in_the_results():
    table = (ROOT / "results" / "demo" / "city" / "summary.md").read_text(encoding="utf-8")
    start = (DOCS / "start.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?:ATE \[|RPE|pose NEES|NIS|landmark RMSE).*", start, re.MULTILINE)
    assert len(rows) >= 4 and not [row for row in rows if "".join(row.split()) not in "".join(table.split())]
    noise = (DOCS / "noise.md").read_text(encoding="utf-8")
    study = (ROOT / "results" / "consistency" / "table.md").read_text(encoding="utf-8")
    first_page = (ROOT / "README.md").read_text(encoding="utf-8")
    quoted = re.findall(r"\d+\.\d+ ± \d+\.\d+", noise + first_page)
    assert len(quoted) >= 8
    if "textbook" in study:  # a table from before that row says nothing about the variants of today
        assert all(f"| {x}" in study for x in quoted)
    real = (ROOT / "results" / "real_data" / "table.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d\d)_(\d\d)_(\d{4}) \| (\S+) \((\S+)\) \| (.*) \|$", noise, re.MULTILINE)
    assert len(rows) == 7
    for month, day, drive, full_m, dead_m, others in rows:
        found = re.findall(rf"^\| 2011_{month}_{day}_drive_{drive}_sync_KLT \|.*", real, re.MULTILINE)
        assert re.search(rf"\| {dead_m} \(.*\) \| {full_m} \(", found[0])
        assert all(f" {value} " in found[1] for value in others.split(" | "))


@pytest.mark.slow
@pytest.mark.parametrize(("page", "said"), [("frames", ""), ("course", "mapping-only 14.49 m, NEES 465922")])
def test_the_examples_of_a_page_run(page, said, capsys):
    names: dict = {}
    for code in re.findall(
        r"^```python\n([\s\S]*?)^```", (DOCS / f"{page}.md").read_text(encoding="utf-8"), re.MULTILINE
    ):
        exec(compile(code, f"{page}.md", "exec"), names)
    assert said in capsys.readouterr().out
