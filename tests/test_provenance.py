"""Archives say what computed them, and the citation is that of CITATION.cff."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import ekfslam
from ekfslam.cli import main
from ekfslam.provenance import bibtex, commit, in_words, provenance

ROOT = Path(ekfslam.__file__).parents[1]


def test_an_archive_states_commit_engine_and_platform_and_info_shows_them(tmp_path, capsys):
    world = ekfslam.open_sequence("builtin:city?frames=8")
    ekfslam.write_archive(tmp_path / "a.h5", world, {"full": ekfslam.run(world)})
    facts = ekfslam.read_archive(tmp_path / "a.h5").results["full"].attributes
    assert {"version_numpy", "engine_build", "smoother_library", "platform"} <= facts.keys()
    assert {name: facts[name] for name in provenance()} == dict(provenance())
    assert main(["info", str(tmp_path / "a.h5")]) == 0
    assert f"full: made by {in_words(facts)}" in capsys.readouterr().out


def test_the_commit_is_that_of_the_checkout_or_none():
    found = commit()
    if not (ROOT / ".git").exists():
        assert found == ""
        return
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert head.stdout.startswith(re.split(r"-g|-dirty", found)[-1 if "-g" in found else 0])


def test_an_older_archive_without_them_is_described_by_its_versions():
    assert in_words({"version_ekfslam": "0.0.9", "version_numpy": "1.26"}) == "ekfslam 0.0.9, numpy 1.26"
    assert in_words({}) == ""


def test_the_citation_is_that_of_the_repository(capsys):
    cff = (ROOT / "CITATION.cff").read_text()
    assert main(["cite"]) == 0 and capsys.readouterr().out == bibtex()
    for pattern in (r'title: "(.*)"', r"- name: (.*)", r"version: ([\d.]+)"):
        assert re.findall(pattern, cff)[-1] in bibtex()
