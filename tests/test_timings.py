"""CPU and wall-clock time of the parts of a command."""

import time

import pytest

from ekfslam.cli import main
from ekfslam.timings import Timings


def test_an_inner_part_is_not_charged_to_the_outer_one():
    timings, begin = Timings(), time.perf_counter()
    with timings.part("outer"):
        time.sleep(0.02)
        with timings.part("inner"):
            time.sleep(0.05)
        time.sleep(0.02)
    (cpu_s, inner_s), (_, outer_s) = timings.spent["inner"], timings.spent["outer"]
    assert inner_s >= 0.05 and outer_s >= 0.04
    assert inner_s + outer_s <= time.perf_counter() - begin
    assert cpu_s < 0.04, "sleep takes no CPU time"


def test_all_time_of_the_process_is_charged_even_after_an_error():
    timings = Timings()
    with pytest.raises(ValueError, match="known"), timings.part("fails"):
        raise ValueError("known")
    lines = timings.table.splitlines()
    assert [line.split()[0] for line in lines] == ["CPU", "imports", "fails", "total"]
    total = sum(cpu_s for cpu_s, _ in timings.spent.values())
    assert total == pytest.approx(time.process_time(), abs=0.05)


@pytest.mark.parametrize("command", [["run", "--mode", "full"], ["compare", "--no-figures"]])
def test_a_command_shows_where_its_time_went(tmp_path, capsys, command):
    name, *options = command
    out = tmp_path / ("run.h5" if name == "run" else "out")
    arguments = [name, "builtin:loop", *options, "--frames", "0:8", "--out", str(out), "--timings"]
    assert main(arguments) == 0
    table = capsys.readouterr().out.split("CPU [s]")[1]
    parts = ["imports", "reading", "automatic model", "full", "archive", "evaluation", "total"]
    assert [part for part in parts if f"\n{part} " not in table] == []
    assert ("smoothed" in table) == (name == "compare")
