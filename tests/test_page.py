"""The web page of archives: nothing in it but what archives hold, as text, and no way out of it."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.evaluation.honesty import judge
from ekfslam.figures import series
from ekfslam.figures.maps import spread
from ekfslam.filters.result import Innovation, Rejections
from ekfslam.page.content import PART, packed, sections_of, told_apart
from ekfslam.page.report import read_archives, report_page, write_report
from ekfslam.runner import run
from ekfslam.storage.archive import read_archive, write_archive
from ekfslam.stored import empty

HONEST = "consistent as far as NIS and the truth of one drive can tell"
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


def numbers(packed: dict[str, str], *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["f32"]), "<f4").reshape(shape)


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
    error = np.transpose([numbers(plot["curves"][0]["y"], -1) for plot in shown["errors"][:3]])
    true = read.truth.T_world_imu[:, :3, 3]
    np.testing.assert_allclose(error, full.T_world_imu[read.truth.frame, :3, 3] - true, rtol=1e-5, atol=1e-7)
    nees = np.nanmean(pose_nees(full, read.truth, True)[1])
    assert f"mean {nees:.3g}; grey: 95 % of honest poses" in shown["consistency"][0]["words"]
    landmarks = shown["landmarks"]
    assert landmarks["id"] == [str(i) for i in full.landmarks.id]
    np.testing.assert_allclose(numbers(landmarks["xyz"], -1, 3), full.landmarks.position_m, rtol=1e-6)
    xy = numbers(landmarks["cov"], -1, 6)[:, 1]
    np.testing.assert_allclose(xy, full.landmarks.covariance[:, 0, 1], rtol=1e-5, atol=1e-9)
    for heading in ("ATE [m], unaligned", "pose NEES (6)", "filter.gate_probability", "Track hygiene"):
        assert (heading in page) == (heading != "Track hygiene" or full.hygiene is not None), heading


def test_the_page_states_the_noise_that_a_run_assumed(archive):
    assert "<h4>Assumed noise</h4>" in report_page(read_archives([archive]))


def carded(archive_of, **runs) -> dict[str, tuple[str, list[str]]]:
    """Kind and words of each run's card, by mode."""
    found = dataclasses.replace(archive_of, results=runs)
    (recording,) = sections_of({"some": found})
    return {run.label: (run.honesty.grade, run.said) for run in recording.runs}


def test_every_run_has_a_verdict_from_what_there_is(archive):
    """Innovations where they were kept, NIS where not, and the truth; words as of `ekfslam check`."""
    known = read_archive(archive)
    full = known.results["full"]
    to_honest = 6.0 / sections_of({"some": known})[0].runs[-1].honesty.truth.nees
    honest = dataclasses.replace(
        full, covariance=full.covariance / to_honest, whitened=None, rejections=empty(Rejections)
    )
    small = dataclasses.replace(honest, covariance=honest.covariance / 25.0)
    doubled = dataclasses.replace(
        honest, innovation=dataclasses.replace(honest.innovation, nis=4.0 * honest.innovation.dof)
    )
    bare = dataclasses.replace(honest, innovation=empty(Innovation, T=len(honest.time_s)))
    said = carded(known, first=honest, small=small, doubled=doubled, bare=bare)
    of_truth = "consistent as far as the truth of one drive can tell"
    assert said["bare"] == ("good", [f"{of_truth} (pose NEES 6; 1.2 to 14.4 in 95 % of drives)"])
    assert said["small"][0] == "bad"
    assert "standard deviations about 5.0x too small by the truth" in said["small"][1][0]
    kind, (head, reason) = said["doubled"]
    assert kind == "bad" and "the truth of one drive does not show it" in head
    assert reason.startswith("innovations are about 2.0x larger than expected (NIS 4 \N{PLUS-MINUS SIGN} ")
    blind = dataclasses.replace(known, truth=None)
    assert carded(blind, bare=bare)["bare"][0] == "none"
    assert "no innovations to judge by" in carded(blind, bare=bare)["bare"][1][0]


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """An archive of runs whose innovations were kept."""
    drive = open_sequence("builtin:loop?frames=60")
    path = tmp_path_factory.mktemp("judged") / "archive.h5"
    write_archive(path, drive, {mode: run(drive, mode) for mode in ("mapping-only", "full")})
    return read_archive(path)


@pytest.mark.slow
def test_evidence_is_that_of_check_and_of_the_truth(judged):
    honesty = judge(judged.results["full"], truth=judged.truth, interpolated=judged.interpolated)
    page = report_page({"first": judged})
    for name, found, _ in honesty.evidence:
        row = re.search(rf'<tr><th scope="row">{re.escape(html.escape(name))}[^<]*</th>(.*?)</tr>', page)
        assert f"<td>{found}</td>" in row[1] or f"<td>{found} (" in row[1], name
    assert "filter less smoother" not in page
    assert "pose NEES, with truth noise (6, of one drive 1.2 to 14.4)" in page
    cards = carded(judged, **judged.results)
    assert cards["full"][1] == [honesty.headline, *honesty.reasons] and cards["full"][0] == honesty.grade
    for kind, said in cards.values():
        assert f'<article class="card {kind}">' in page
        assert all(html.escape(words[1:]) in page for words in said)


def test_of_many_runs_only_those_have_cards_that_innovations_judge(judged):
    assert report_page({"a": judged}).count("<article") == 2
    page = report_page({"a": judged, "b": judged, "c": judged})
    assert page.count("<article") == 3
    assert re.findall(r"<article[^>]*>\n<h3>([^<]*)</h3>", page) == ["a: full", "b: full", "c: full"]


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


def test_innovations_have_their_mean_a_degree_of_freedom(sequence):
    dof = np.repeat([0, 30, 60], 20)
    nis = np.linspace(0.5, 1.5, 60) * dof
    result = dataclasses.replace(synthetic_result(sequence), innovation=Innovation(nis, dof, dof // 3, 0 * dof))
    found = series.nis(result)
    assert found.mean == pytest.approx(nis.sum() / dof.sum())
    np.testing.assert_allclose(found.y, nis[20:] / dof[20:])


def test_labels_are_the_parts_of_paths_that_differ():
    def labels(*paths: str) -> list[str]:
        return told_apart([PART.join(path.split("/")) for path in paths])

    assert labels("some/where/one", "some/where/two") == ["one", "two"]
    assert labels("a/full/archive", "b/full/archive") == ["a", "b"]
    assert labels("some/archive") == ["archive"]


def test_archives_of_one_recording_stand_together(sequence, archive, tmp_path):
    other, third = tmp_path / "other" / "archive.h5", tmp_path / "third" / "archive.h5"
    for path in (other, third):
        path.parent.mkdir()
    write_archive(other, sequence, {"full": synthetic_result(sequence, "full")})
    longer = synthetic_sequence(frames=70, landmarks=40)
    write_archive(third, longer, {"full": synthetic_result(longer, "full")})
    sections = sections_of(read_archives([archive, other, third]))
    assert [len(recording.runs) for recording in sections] == [3, 1]
    together = sections[0].runs
    assert len({run.color + run.dash for run in together}) == 3
    assert [run.shown for run in together] == [False, True, True]
    assert together[2].label == "other: full"
    page = report_page(read_archives([archive, other, third]))
    assert page.count('href="#recording-0"') == 3
    assert '<th scope="col">recording, run</th><th scope="col">ATE [m], unaligned</th>' in page


def test_long_series_are_thinned_with_their_ends_and_say_so():
    assert spread(10, 4).tolist() == [0, 3, 6, 9]
    assert spread(3, 10).tolist() == [0, 1, 2]
    assert numbers(packed(np.array([[1.5, -2.0]])), 2).tolist() == [1.5, -2.0]


@pytest.mark.slow
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
    assert main(["report", str(archive), "a\0b", "--out", str(tmp_path / "b.html")]) == 2, "no name of a file"


@pytest.mark.slow
def test_figures_of_a_paper_are_written_beside_the_page(archive, tmp_path):
    assert main(["report", str(archive), "--out", str(tmp_path / "p/report.html"), "--width", "3.25"]) == 0
    assert {"report.html", "map.pdf", "captions.md"} <= {path.name for path in (tmp_path / "p").iterdir()}


@pytest.mark.slow
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
