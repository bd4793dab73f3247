"""The web page of archives: nothing in it but what archives hold, as text, and no way out of it."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers import synthetic_result, synthetic_sequence

from ekfslam.cli import main
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.page.content import packed, recordings_of, thinned
from ekfslam.page.report import read_archives, report_page, write_report
from ekfslam.storage.archive import read_archive, write_archive

HOSTILE = "</script><script>alert('x')</script><img src=http://evil.example onerror=alert(1)>\x1b[31m"


class Page(HTMLParser):
    """Tags, attributes and scripts of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.attributes, self.blocks = [], [], {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data):
        if self.tags and self.tags[-1] in ("script", "style", "title") and data.strip():
            self.blocks.setdefault(self.tags[-1], []).append(data)


def numbers(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(shape)


@pytest.fixture(scope="module")
def sequence():
    return synthetic_sequence(frames=60, landmarks=40)


@pytest.fixture(scope="module")
def archive(sequence, tmp_path_factory):
    path = tmp_path_factory.mktemp("first") / "archive.h5"
    write_archive(path, sequence, {mode: synthetic_result(sequence, mode) for mode in ("dead-reckoning", "full")})
    return path


@pytest.fixture(scope="module")
def page(archive):
    return report_page({"first": read_archive(archive)})


def test_the_page_holds_the_numbers_of_the_archive(archive, page):
    read = read_archive(archive)
    full = read.results["full"]
    (recording,) = json.loads(Page(page).blocks["script"][0])
    assert [run["label"] for run in recording["runs"]] == ["dead-reckoning", "full"]
    shown, frames = recording["runs"][1], len(full.time_s)
    np.testing.assert_allclose(numbers(shown["xyz"], frames, 3), full.T_world_imu[:, :3, 3], rtol=1e-6)
    error = numbers(shown["errors"]["error"], -1, 6)[:, :3]
    true = read.truth.T_world_imu[:, :3, 3]
    np.testing.assert_allclose(error, full.T_world_imu[read.truth.frame, :3, 3] - true, rtol=1e-5, atol=1e-7)
    assert shown["errors"]["neesMean"] == pytest.approx(np.nanmean(pose_nees(full, read.truth, True)[1]))
    landmarks = shown["landmarks"]
    assert landmarks["id"] == [str(i) for i in full.landmarks.id]
    np.testing.assert_allclose(numbers(landmarks["xyz"], -1, 3), full.landmarks.position_m, rtol=1e-6)
    xy = numbers(landmarks["cov"], -1, 6)[:, 1]
    np.testing.assert_allclose(xy, full.landmarks.covariance[:, 0, 1], rtol=1e-5, atol=1e-9)
    for heading in ("ATE [m], unaligned", "pose NEES (6)", "filter.gate_probability", "Track hygiene"):
        assert (heading in page) == (heading != "Track hygiene" or full.hygiene is not None), heading


def test_names_from_files_are_text_and_nothing_is_loaded(sequence, tmp_path):
    named = dataclasses.replace(sequence, name=HOSTILE, notes=(HOSTILE,))
    result = synthetic_result(named, "full")
    result = dataclasses.replace(result, attributes={**result.attributes, "comment": HOSTILE})
    write_archive(tmp_path / "archive.h5", named, {"full": result})
    page = report_page({HOSTILE: read_archive(tmp_path / "archive.h5")}, title=HOSTILE)
    parsed = Page(page)
    assert parsed.tags.count("script") == 2
    assert "img" not in parsed.tags
    assert "\x1b" not in page
    assert not [name for name, _ in parsed.attributes if name.startswith("on") or name in ("src", "style")]
    assert all(value.startswith("#") for name, value in parsed.attributes if name == "href")
    assert "alert" in "".join(parsed.blocks["title"])
    addresses = set(re.findall(r"https?://[^\s\"'<>&]+", "".join(parsed.blocks["script"][1:] + parsed.blocks["style"])))
    assert addresses == {"http://www.w3.org/2000/svg"}


def test_only_its_own_script_and_style_may_run(page):
    parsed = Page(page)
    policy = next(value for name, value in parsed.attributes if name == "content" and "default-src" in value)
    for block, kind in ((parsed.blocks["script"][1], "script"), (parsed.blocks["style"][0], "style")):
        digest = base64.b64encode(hashlib.sha256(block.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")


def test_archives_of_one_recording_stand_together(sequence, archive, tmp_path):
    other, third = tmp_path / "other" / "archive.h5", tmp_path / "third" / "archive.h5"
    for path in (other, third):
        path.parent.mkdir()
    write_archive(other, sequence, {"full": synthetic_result(sequence, "full")})
    longer = synthetic_sequence(frames=70, landmarks=40)
    write_archive(third, longer, {"full": synthetic_result(longer, "full")})
    recordings = recordings_of(read_archives([archive, other, third]))
    assert [len(recording.runs) for recording in recordings] == [3, 1]
    together = recordings[0].runs
    assert len({run.color + run.dash for run in together}) == 3
    assert [run.shown for run in together] == [False, True, True]
    assert together[2].label == "other: full"
    page = report_page(read_archives([archive, other, third]))
    assert page.count('href="#recording-0"') == 3


def test_long_series_are_thinned_with_their_ends_and_say_so():
    assert thinned(10, 4).tolist() == [0, 3, 6, 9]
    assert thinned(3, 10).tolist() == [0, 1, 2]
    assert numbers(packed(np.array([[1.5, -2.0]])), 2).tolist() == [1.5, -2.0]


def test_command(archive, tmp_path, capsys):
    out = tmp_path / "page" / "report.html"
    assert main(["report", str(archive), "--out", str(out), "--title", "A & B"]) == 0
    assert "<h1>A &amp; B</h1>" in out.read_text(encoding="utf-8")
    assert main(["report", str(archive), "--out", str(out)]) == 0, "an older report may be replaced"
    out.write_text("mine")
    assert main(["report", str(archive), "--out", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    with pytest.raises(ArchiveError, match="1 to 32"):
        write_report([], out)


def test_the_script_draws_without_an_error(archive, tmp_path):
    """In a real browser: maps and plots are there, and nothing complains."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium to look at the page with")
    path = write_report([archive], tmp_path / "report.html")
    quiet = ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
    call = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", *quiet]
    call += [f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr", "--virtual-time-budget=3000"]
    found = subprocess.run(
        [*call, "--window-size=1280,4000", "--dump-dom", path.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert "CONSOLE" not in found.stderr
    assert found.stdout.count("<figure") == 1 + 2 + 6 + 1 + found.stdout.count("<b>NIS per degree")
    assert found.stdout.count("<svg") > 10
    assert 'class="line truth"' in found.stdout
