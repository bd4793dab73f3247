"""`write_report`: archives as one self-contained web page for all screens, light or dark.

Tables and words are HTML; ``report.js`` draws plots from numbers in the page. Names from files are text, never markup.
A content security policy lets the page run only its own script, and load nothing.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from ekfslam import files
from ekfslam.config import Config
from ekfslam.data.trajectory import Trajectory
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.brief import brief_rows
from ekfslam.evaluation.evidence import BLIND
from ekfslam.evaluation.summary import KEY_FIGURES, definitions, error_in_words, merit_rows
from ekfslam.evaluation.tables import MISSING
from ekfslam.figures.older import marked
from ekfslam.names import components, printable
from ekfslam.others import Others
from ekfslam.page.content import PART, Run, Section, plotted, remarks_of, sections_of, told_apart
from ekfslam.provenance import versions
from ekfslam.shown import count
from ekfslam.storage.archive import Archive, read_archive

MOST_ARCHIVES = 32
_GENERATOR = '<meta name="generator" content="ekfslam report">'
_JUDGED = (
    "Verdicts on <i>full</i> are by innovations, and by the truth if there is one, of which one drive is one sample. "
    "<code>ekfslam check</code> adds the smoother."
)
_MOST_CARDS = 4  # of more runs, only those judged by innovations have a card


def write_report(
    archives: Sequence[str | Path],
    path: str | Path,
    title: str = "",
    others: Others | Mapping[str, Trajectory | str | Path] | None = None,
    width: str | float | None = None,
) -> Path:
    """Write one HTML page of archives, and return its path; archives of one recording share a section.

    The title is by default the names of the recordings. ``others`` are trajectories of other programs, as in
    `ekfslam.compare`; ``{name}`` in a path is the name of the recording. With a ``width`` (``column``, ``page`` or
    inches) the figures of a paper are written beside, in a folder for each of several archives.

    Raises:
        ArchiveError: There is none, there are too many, or one cannot be read or holds no run.
        WriteError: The page cannot be written.
        ConfigError, TruthError: A trajectory cannot be compared, see `ekfslam.others`.
    """
    files.require_writable(path)
    files.write_all(report_contents(archives, Path(path), title, others, width))
    return Path(path)


def report_contents(
    archives: Sequence[str | Path],
    path: Path,
    title: str = "",
    others: Others | Mapping[str, Trajectory | str | Path] | None = None,
    width: str | float | None = None,
) -> dict[Path, str | bytes]:
    """Return the files of `write_report` with their contents."""
    joined = _joined(read_archives(archives), Others.of(others))
    contents: dict[Path, str | bytes] = {path: report_page(joined, title)}
    if width:
        from ekfslam.figures.paper import draw_paper, paper_contents, width_of  # imports Matplotlib

        for label, archive in joined.items():
            drawn = draw_paper(archive.results, archive.truth, archive.interpolated, width_of(width))
            contents |= paper_contents(path.parent / label if len(joined) > 1 else path.parent, drawn)
    return marked(contents, map(Path, archives))


def _joined(archives: Mapping[str, Archive], others: Others) -> dict[str, Archive]:
    """Return archives with trajectories of other programs as results of the first archive of each recording."""
    found, seen = dict(archives), set[tuple[str, bytes]]()
    for label, archive in archives.items():
        if (recording := (archive.name, archive.time_s.tobytes())) not in seen:
            seen.add(recording)
            theirs = others.named(archive.name).results(archive, next(iter(archive.results.values())))
            found[label] = replace(archive, results={**archive.results, **theirs})
    others.require_distinct(len(seen))
    return found


def read_archives(paths: Sequence[str | Path]) -> dict[str, Archive]:
    """Read archives by distinct labels from the names of folders and files; errors as of `write_report`."""
    if not 1 <= len(paths) <= MOST_ARCHIVES:
        raise ArchiveError(f"a report is of 1 to {MOST_ARCHIVES} archives, found {len(paths)}")
    # Not `Path.resolve`, which raises ValueError for invalid names of files.
    parts = [(*Path(os.path.abspath(path)).parts[1:-1], Path(path).stem) for path in paths]  # noqa: PTH100
    labels = components(told_apart([PART.join(part) for part in parts]))
    found = {label: read_archive(path) for label, path in zip(labels, paths, strict=True)}
    for path, archive in zip(paths, found.values(), strict=True):
        if not archive.results:
            raise ArchiveError(f"{path}: holds no run")
    return found


def is_report(path: Path) -> bool:
    """Return whether a file is a page of `write_report`."""
    with path.open("rb") as file:
        return _GENERATOR.encode() in file.read(4096)


def report_page(archives: Mapping[str, Archive], title: str = "") -> str:
    """Return the text of a page of archives by label."""
    sections = sections_of(archives)
    title = printable(title) or _title([section.name for section in sections])
    style = _file("report.css") + _colors(sections)
    script = _file("report.js")
    data = json.dumps([plotted(section) for section in sections], allow_nan=False).replace("<", "\\u003c")
    policy = f"default-src 'none'; style-src '{_digest(style)}'; script-src '{_digest(script)}'; img-src data:"
    body = "\n".join(_section(i, section, len(sections) == 1) for i, section in enumerate(sections))
    runs = sum(len(section.runs) for section in sections)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
{_GENERATOR}
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title>
<style>{style}</style>
</head>
<body>
<header>
<p class="kind">ekfslam report</p>
<h1>{escape(title)}</h1>
{_facts([count(len(sections), "recording"), count(len(archives), "archive"), count(runs, "run")])}
</header>
<main>
{_overview(sections) if len(sections) > 1 else ""}
{body}
</main>
<footer>Made by ekfslam {escape(versions()["version_ekfslam"])}. This page loads nothing from elsewhere.</footer>
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>
"""


def _title(names: Sequence[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(different[:3]) + (f" and {len(different) - 3} more" if len(different) > 3 else "")


def _section(number: int, section: Section, is_alone: bool) -> str:
    archive, time_s = section.archive, section.archive.time_s
    facts = [
        count(len(time_s), "frame"),
        f"{time_s[-1] - time_s[0]:.1f} s",
        f"{section.length_m:.0f} m" if section.length_m >= 10 else f"{section.length_m:.2f} m",
        f"truth of {count(len(archive.truth.frame), 'pose')}" if archive.truth is not None else "no truth",
    ]
    notes = _list([*remarks_of(section), *archive.notes])
    if notes:
        notes = f"<details><summary>Notes on the recording</summary><div>{notes}</div></details>"
    heading = "" if is_alone else f"<h2>{escape(section.name)}</h2>"
    return f"""<section id="recording-{number}">
{heading}
{_facts(facts)}
{notes}
<div class="cards">{"".join(map(_card, _carded(section)))}</div>
<p class="notes">{_JUDGED} {escape(BLIND)}</p>
<noscript><p class="notes">A script in this page draws its plots; this browser does not run it.</p></noscript>
<div class="plots" data-recording="{number}"></div>
{_evidence(section)}
<h3>Figures of merit</h3>
{_runs_table(section, merit_rows(run.summary for run in section.runs))}
{_list((f"{heading}: {words}" for heading, words in definitions(run.summary for run in section.runs)), "notes")}
<h3>Runs in detail</h3>
{"".join(_detail(run) for run in section.runs)}
</section>"""


def _facts(facts: Iterable[str]) -> str:
    return f'<p class="facts">{" · ".join(facts)}</p>'


def _carded(section: Section) -> list[Run]:
    """Return the runs with a card: all; of many, those judged by innovations, or the last."""
    runs = list(section.runs)
    judged = [run for run in runs if run.honesty.shared is not None] or runs[-1:]
    return runs if len(runs) <= _MOST_CARDS else judged


def _card(run: Run) -> str:
    """Return the verdicts of a run, their evidence, and the rows that a terminal shows."""
    head, *items = run.said
    return f"""<article class="card {run.honesty.grade}">
<h3>{escape(run.label)}</h3>
<p class="verdict">{escape(head[:1].upper() + head[1:])}</p>
{_list([*items, *run.result.remarks, *filter(None, [error_in_words(run.result, run.truth)])], "causes")}
{_pairs(brief_rows(run.result, run.truth), "")}
</article>"""


def _evidence(section: Section) -> str:
    """Return a table of the evidence; an expected value that all runs share is next to the name."""
    found = [{name: cells for name, *cells in run.honesty.evidence} for run in section.runs]
    rows = []
    for name in dict.fromkeys(name for evidence in sorted(found, key=len, reverse=True) for name in evidence):
        cells = [evidence.get(name, [MISSING, ""]) for evidence in found]
        expected = {own for value, own in cells if value != MISSING}
        if len(expected) == 1:
            rows.append([_expecting(name, expected.pop()), *(value for value, _ in cells)])
        else:
            rows.append([name, *(_expecting(value, own) for value, own in cells)])
    heading = "<h3>Evidence <small>found (expected)</small></h3>"
    return f"{heading}\n{_runs_table(section, rows)}" if rows else ""


def _runs_table(section: Section, rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts with one column a run."""
    return _table(["", *(run.label for run in section.runs)], [[escape(cell) for cell in row] for row in rows])


def _expecting(text: str, expected: str) -> str:
    return f"{text} ({expected})" if expected else text


def _detail(run: Run) -> str:
    result = run.result
    hygiene = () if result.hygiene is None else result.hygiene.lines(result.config["hygiene"])
    noise = {key: value for key, value in vars(result.noise).items() if value is not None}
    blocks = [
        ("Remarks", _list(result.remarks)),
        ("Counts", _pairs(result.counts)),
        ("Track hygiene", _list(hygiene)),
        ("Estimated parameters", _list(() if result.parameters is None else result.parameters.lines)),
        ("Velocity and biases at the end", _list(() if result.inertial is None else result.inertial.lines)),
        ("Configuration", "" if result.is_other else _configuration(result.config)),
        ("Assumed noise", "" if result.is_other else _pairs(noise)),
        ("Attributes", _pairs(result.attributes)),
    ]
    shown = "".join(f"<h4>{heading}</h4>{content}" for heading, content in blocks if content)
    return f"<details><summary>{escape(run.label)}</summary><div>{shown}</div></details>"


def _configuration(config: Mapping[str, Any]) -> str:
    """Return settings that differ from the defaults, then all of them."""
    tables = {table: settings for table, settings in config.items() if isinstance(settings, Mapping)}
    found = [(table, key, value) for table, settings in tables.items() for key, value in settings.items()]
    default = Config()
    changed = [one for one in found if one[2] != getattr(getattr(default, one[0], None), *one[1:])]
    own, every = (_pairs({f"{table}.{key}": value for table, key, value in some}) for some in (changed, found))
    own = own or "<p>Every setting has its default.</p>"
    return f"{own}<details><summary>all settings</summary>{every}</details>"


def _overview(sections: Sequence[Section]) -> str:
    """Return a table of all runs."""
    runs = [(i, section, run) for i, section in enumerate(sections) for run in section.runs]
    columns = merit_rows({key: run.summary[key] for key in KEY_FIGURES} for _, _, run in runs)
    rows = []
    for row, (i, section, run) in enumerate(runs, 1):
        link = f'<a href="#recording-{i}">{escape(section.name)}</a>, {escape(run.label)}'
        rows.append([link, *(escape(column[row]) for column in columns)])
    return f"<section><h2>All runs</h2>{_table(['recording, run', *(column[0] for column in columns)], rows)}</section>"


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells are HTML, headings are text."""
    head = "".join(f'<th scope="col">{escape(heading)}</th>' for heading in headings)
    lines = (f'<th scope="row">{name}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) for name, *cells in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _list(items: Iterable[str], kind: str = "") -> str:
    shown = "".join(f"<li>{escape(printable(item))}</li>" for item in items)
    return f'<ul class="{kind}">{shown}</ul>' if shown else ""


def _pairs(values: Mapping[str, Any], kind: str = "pairs") -> str:
    shown = "".join(
        f"<div><dt>{escape(printable(str(key)))}</dt><dd>{escape(_spoken(value))}</dd></div>"
        for key, value in values.items()
    )
    return f'<dl class="{kind}">{shown}</dl>' if shown else ""


def _spoken(value: Any) -> str:
    if value is None:
        return "default"
    if isinstance(value, float):
        return f"{value:.6g}"
    if hasattr(value, "tolist"):
        return _spoken(value.tolist())
    if isinstance(value, list | tuple):
        return ", ".join(map(_spoken, value))
    return printable(str(value))


def _colors(sections: Sequence[Section]) -> str:
    """Return colours of runs as variables of the style: ``--run-<recording>-<run>``."""
    runs = [(i, j, run) for i, section in enumerate(sections) for j, run in enumerate(section.runs)]
    return f"\n:root{{{''.join(f'--run-{i}-{j}:{run.color};' for i, j, run in runs)}}}\n"


def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
