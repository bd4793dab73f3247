"""The writer of Markdown: columns, rules, numbers, missing values, and the text that committed results already have."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ekfslam.evaluation.summary import compare_table
from ekfslam.evaluation.tables import document, markdown_table, number, plus_minus, significant
from ekfslam.studies.summary import study_table

RESULTS = Path(__file__).parents[1] / "results"


def test_plain_table_aligns_numbers_to_the_right():
    table = markdown_table(["set", "ATE [m]", "frames"], [["0027", number(3.972, ".2f"), "1106"], ["", "-", "0"]])
    assert table == "| set | ATE [m] | frames |\n|---|---:|---:|\n| 0027 | 3.97 | 1106 |\n| | - | 0 |"
    assert markdown_table(["a", "b"], [], left=2) == "| a | b |\n|---|---|"
    assert markdown_table(["a"], [], left=0) == "| a |\n|---:|"


def test_padded_table_has_lines_of_one_length():
    table = markdown_table(["", "full"], [["ATE [m], unaligned", "12.345"], ["x", "-"]], padded=True)
    assert table.splitlines() == [
        "|                    |   full |",
        "|--------------------|-------:|",
        "| ATE [m], unaligned | 12.345 |",
        "| x                  |      - |",
    ]
    assert markdown_table(["a", "b"], [["1", "2"]], padded=True).splitlines()[1] == "|------|-----:|"


def test_rows_of_another_length_are_refused():
    with pytest.raises(ValueError, match="2 cells"):
        markdown_table(["a", "b"], [["1"]])


def test_numbers_and_what_is_missing():
    assert (number(1.5, ".2f"), number(3, "d"), number(None, ".2f")) == ("1.50", "3", "-")
    assert [significant(x) for x in (123.4, -5.678, 0.01234, None)] == ["123", "-5.68", "0.012", "-"]
    assert plus_minus("1.50", "0.20") == "1.50 ± 0.20"
    assert plus_minus("1.50", "-") == "1.50"
    assert plus_minus("-", "-") == "-"


def test_blocks_of_a_document_are_apart_by_one_blank_line():
    assert document("# Title\n", "text", "\n| a |\n|---|") == "# Title\n\ntext\n\n| a |\n|---|\n"


def committed(name: str) -> str:
    return (RESULTS / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("world", ["city", "loop"])
def test_table_of_modes_is_that_of_the_committed_summary(world):
    summary = json.loads(committed(f"demo/{world}/summary.json"))
    assert committed(f"demo/{world}/summary.md").startswith(compare_table(summary))


def test_table_of_a_study_is_that_of_the_committed_summary():
    assert study_table(json.loads(committed("consistency/summary.json"))) == committed("consistency/table.md")
