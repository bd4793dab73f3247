"""Tables of papers: means, paired tests, and files of LaTeX, Markdown and CSV."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import shutil
import subprocess

import numpy as np
import pytest
from scipy import stats

from ekfslam.cli import main
from ekfslam.evaluation.metrics import METRICS
from ekfslam.evaluation.paired import paired_grid, paired_test
from ekfslam.evaluation.tables import Column, Grid, is_table, latex
from ekfslam.names import without_common_ends
from ekfslam.studies.study import LEVELS, Study, StudyArchive, run_one
from ekfslam.studies.summary import FIGURES, study_runs, summarise_study
from ekfslam.studies.sweep_table import SweepTable

RNG = np.random.default_rng(0)
GRID = Grid(
    [
        Column("set_1", ["a & b", "a & b", "[c]"]),
        Column("filter", ["full", "mine", "full"]),
        Column("ATE [m]", [0.0123, 0.0456, None], [0.001, 0.002, None], is_compared=True),
        Column("frames", [100, 20, 3]),
    ],
    ["a", "a", "c"],
    ["50 % of 3 runs"],
)


def test_latex_escapes_aligns_and_sets_the_best_of_a_group_in_bold():
    assert GRID.text(".tex") == (
        "% 50 % of 3 runs\n"
        "\\begin{tabular}{llrr}\n\\toprule\n"
        "set\\_1 & filter & ATE [m] & frames \\\\\n\\midrule\n"
        "a \\& b & full   & \\textbf{0.0123} $\\pm$ 0.0010 &    100 \\\\\n"
        "       & mine   &          0.0456 $\\pm$ 0.0020 &     20 \\\\\n"
        "\\addlinespace\n"
        "{}[c]  & full   &                            - &      3 \\\\\n"
        "\\bottomrule\n\\end{tabular}\n"
    )


def test_long_headings_are_stacked_so_that_a_table_fits_a_page():
    column = Column("ATE [m], unaligned, [x]", [1.0])
    assert r" & \shortstack[r]{ATE [m]\\unaligned, [x]} \\" in Grid([Column("a", ["b"]), column]).text(".tex")


def test_no_character_of_a_name_means_anything_to_latex():
    assert latex("\\a{b} 5% $x_1^2$ #~&<|>") == (
        r"\textbackslash{}a\{b\} 5\% \$x\_1\textasciicircum{}2\$ \#\textasciitilde{}\&"
        r"\textless{}\textbar{}\textgreater{}"
    )


def test_markdown_has_the_same_cells():
    lines = GRID.text(".md").splitlines()
    assert lines[2] == "| a & b | full   | **0.0123** ± 0.0010 |    100 |"
    assert lines[-1] == "50 % of 3 runs"


def test_csv_keeps_every_digit_and_has_a_column_of_errors():
    head, first, _, last = csv.reader(io.StringIO(GRID.text(".csv")))
    assert head == ["set_1", "filter", "ATE [m]", "ATE [m], standard error", "frames"]
    assert first == ["a & b", "full", "0.0123", "0.001", "100"] and last == ["[c]", "full", "", "", "3"]


def test_equal_numbers_as_shown_are_both_the_best_and_a_single_one_is_not():
    column = Column("ATE [m]", [1.0001, 1.0002, 2.0, 5.0], is_compared=True)
    assert Grid([column], ["a", "a", "a", "b"]).best == {(0, 0), (0, 1)}


def test_paired_tests_are_those_of_scipy_on_complete_pairs():
    a, b = RNG.normal(1.0, 0.3, (2, 9))
    a[4] = np.nan
    found, kept = paired_test(a, b), np.isfinite(a)
    assert found.n == 8 and found.mean == pytest.approx(np.mean(b[kept] - a[kept]))
    assert found.error == pytest.approx(stats.sem(b[kept] - a[kept]))
    assert found.p_t == pytest.approx(stats.ttest_rel(a[kept], b[kept]).pvalue)
    assert found.p_wilcoxon == pytest.approx(stats.wilcoxon(a[kept], b[kept]).pvalue)


def test_too_few_pairs_are_said_and_not_tested():
    choices = {("full",): {k: 1.0 * k for k in range(5)}, ("mine",): {k: 2.0 * k for k in range(4)}}
    grid, said = paired_grid({"ATE [m]": choices})
    assert grid is None
    assert said == ("4 pairs are not enough for a test, 6 are needed: full and mine",)


def test_of_many_choices_those_that_differ_in_one_part_are_compared():
    choices = [("drift", "-", "-"), *((("full", a, b)) for a in ("x", "y") for b in ("1", "2"))]
    values = {choice: {k: float(v) for k, v in enumerate(RNG.normal(size=6))} for choice in choices}
    grid, said = paired_grid({"ATE [m]": values})
    pairs = set(zip(grid.columns[1].values, grid.columns[2].values, strict=True))
    of_full = {("full, x, 1", "full, x, 2"), ("full, x, 1", "full, y, 1"), ("full, x, 2", "full, y, 2")}
    of_full.add(("full, y, 1", "full, y, 2"))
    assert pairs == of_full | {("drift", f"full, {a}, {b}") for a in ("x", "y") for b in ("1", "2")}
    assert said == () and grid.notes[0].endswith("Only choices that differ in one part are compared.")


def test_an_estimator_without_a_figure_is_not_said_to_have_too_few_pairs():
    choices = {("drift",): dict.fromkeys(range(6), np.nan), ("full",): dict.fromkeys(range(6), 1.0)}
    assert paired_grid({"NIS": choices}) == (None, ())


def test_equal_values_have_no_p_value():
    found = paired_test(np.ones(7), np.ones(7))
    assert found.mean == found.error == 0.0 and np.isnan([found.p_t, found.p_wilcoxon]).all()


@pytest.fixture(scope="module")
def table():
    """Two modes and two gates on two drives with four seeds; dead reckoning does not know the gate."""
    rows = []
    for recording in ("a", "b"):
        for seed in range(4):
            of_seed = dict(zip(("dead-reckoning", "full"), RNG.uniform(1.0, 2.0, 2), strict=True))
            for gate in (0.99, 0.999):
                for mode, ate in of_seed.items():
                    ate_m = ate + (gate if mode == "full" else 0.0)
                    facts = {"recording": recording, "mode": mode, "seed": seed, "filter.gate_probability": gate}
                    rows.append({**facts, "ate_m": ate_m, "total_s": RNG.uniform()})
    return SweepTable.of_rows(rows, ("recording", "mode", "seed", "filter.gate_probability"), len(rows))


def test_means_have_standard_errors_median_and_worst_over_seeds(table):
    grid = table.means(["ate_m"])
    found = {column.heading: column for column in grid.columns}
    assert found["mode"].values == ["dead-reckoning", "full", "full"] * 2
    of_a = table.where("recording", "a").where("mode", "full").where("filter.gate_probability", "0.99").column("ate_m")
    ate = found["ATE [m], unaligned"]
    assert ate.values[1] == pytest.approx(of_a.mean()) and ate.errors[1] == pytest.approx(stats.sem(of_a))
    assert found["median"].values[1] == pytest.approx(np.median(of_a)) and found["worst"].values[1] == of_a.max()
    assert found["runs"].values == [4] * 6


def test_dead_reckoning_has_one_row_without_the_setting_that_it_does_not_know(table):
    grid = table.means(["ate_m"])
    assert grid.columns[2].values == ["-", "0.99", "0.999"] * 2


def test_settings_are_paired_by_recording_and_seed(table):
    tests, said = table.tests(["ate_m", "total_s"])
    assert said == ()
    first, second, pairs = (tests.columns[i].values for i in (1, 2, 3))
    place = list(zip(first, second, strict=True)).index(("full, 0.99", "full, 0.999"))
    assert pairs == [8, 8, 8] and tests.columns[4].values[place] == pytest.approx(0.009)


def test_compare_writes_the_table_of_several_recordings(tmp_path, capsys):
    drives = [f"builtin:{name}?frames=8" for name in ("city", "loop")]
    arguments = ["--modes", "dead-reckoning", "full", "--no-figures", "--out", str(tmp_path), "--executor", "serial"]
    path = tmp_path / "paper.tex"
    assert main(["compare", *drives, *arguments, "--table", str(path)]) == 0
    text = path.read_text()
    assert (
        r"recording & estimator & \shortstack[r]{ATE [m]\\unaligned} & " in text and text.count("\\addlinespace") == 2
    )
    assert re.search(r"\nmean +& dead-reckoning & +0\.2\d+ \$\\pm\$ 0\.\d+ &", text)
    assert text.count("\\textbf{") >= 4 and "not enough for a test" in text
    for name, words in (("paper.doc", "does not end in one of .md, .tex, .csv"), ("thesis.tex", "is no table of")):
        (tmp_path / name).write_text("\\documentclass{article}")
        with pytest.raises(SystemExit):
            main(["compare", *drives, *arguments, "--table", str(tmp_path / name)])
        assert words in capsys.readouterr().err
    assert is_table(path)
    assert main(["compare", *drives, *arguments, "--columns", "ate"]) == 2
    assert "there is no column 'ate'; known: ate_m, " in capsys.readouterr().err


def test_a_study_has_means_over_runs_and_paired_tests():
    world = dataclasses.replace(LEVELS["low"], frames=12, landmarks=30)
    study = Study({"short": world}, ("invariant", "standard"), runs=2)
    archive = StudyArchive.empty(study)
    for run in range(2):
        archive.put(("short", run), run_one(study, "short", run))
    table = study_runs(archive)
    text = table.paper(".md", FIGURES)
    assert re.search(r"\| variant +\| runs \| +pose NEES \(6\) \| median \| worst \|", text)
    assert "2 pairs are not enough for a test, 6 are needed: invariant and standard" in text
    means = [x["mean"] for x in (summarise_study(archive)["levels"]["short"]["standard"][k] for k in FIGURES[:6])]
    assert [table.where("variant", "standard").column(k).mean() for k in FIGURES[:6]] == pytest.approx(means)


def test_a_mean_of_fewer_values_than_runs_says_so(table):
    columns = {**table.columns, "ate_m": np.where(np.arange(len(table)) == 1, np.nan, table.column("ate_m"))}
    notes = dataclasses.replace(table, columns=columns).means(["ate_m"]).notes
    assert "ATE [m], unaligned is missing in 1 run;" in notes[0]
    assert "missing" not in table.means(["ate_m"]).notes[0]


def test_names_lose_the_words_at_both_ends_that_all_have():
    names = ["2011_09_26_drive_0001_KLT", "2011_09_30_drive_0001_KLT"]
    assert without_common_ends(names) == ["26", "30"] == without_common_ends(["a_26_b", "a_30_b"])
    assert without_common_ends(["city", "loop"]) == ["city", "loop"] and without_common_ends(["a_b"]) == ["a_b"]
    assert without_common_ends(["a_b", "a_b_c"]) == ["b", "b_c"]


ODD = ("V1_01_easy", "50% & more #2", "a~b^c_{x}$y$", "[1] first", "*star", "Straße 3 µ ° ±", "back\\slash", "<a|b>")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
def test_pdflatex_compiles_tables_whatever_the_names(tmp_path):
    names = [*ODD, "--dash---", "long_name_" * 12]
    columns = [
        Column(metric.heading, [-0.25, None, *[1e4] * 8], [0.1] * 10, is_compared=True) for metric in METRICS.values()
    ]
    parts = [Grid([Column("recording", names), column], names, ["% of #1 & \\x"]) for column in columns]
    text = "\n\n".join(part.text(".tex") for part in parts)
    assert r"$-$0" in text
    page = r"\documentclass{article}\usepackage{booktabs}\begin{document}\tiny " + text + r"\end{document}"
    (tmp_path / "t.tex").write_text(page, encoding="utf-8")
    call = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "t.tex"]
    found = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=120, errors="replace")
    assert found.returncode == 0 and "Missing character" not in (tmp_path / "t.log").read_text(errors="replace")
