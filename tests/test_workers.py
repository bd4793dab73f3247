"""Workers that die: one named error that says what to do, what is finished is kept, and the next call takes up."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from types import ModuleType

import pytest

from ekfslam.cli import main
from ekfslam.errors import WorkerError
from ekfslam.studies.executors import completed, open_executor
from ekfslam.studies.sweep_table import read_table

SWEEP = 'recordings = ["builtin:city?frames=20"]\nseeds = [{}]\n'


def sweep_of(folder: Path, runs: int) -> list[str]:
    (folder / "study.toml").write_text(SWEEP.format(", ".join(map(str, range(runs)))))
    return ["sweep", str(folder / "study.toml"), "--out", str(folder / "out")]


def when_it_has_begun(folder: Path, least: int, action) -> threading.Thread:
    """Do something once some runs of a sweep are in its journal."""
    journal = folder / "out" / ".sweep.h5.journal"

    def wait() -> None:
        while not (journal.exists() and journal.stat().st_size > least):
            time.sleep(0.02)
        action()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def one_line(capsys) -> str:
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("ekfslam: error: ")
    return said


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_a_worker_that_is_killed_ends_a_sweep_with_one_line_and_the_next_one_resumes(tmp_path, capsys):
    def kill_one() -> None:
        os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    call = [*sweep_of(tmp_path, 40), "--workers", "2"]
    when_it_has_begun(tmp_path, 1000, kill_one)
    assert main(call) == 2
    said = one_line(capsys)
    assert "executor processes: a worker was killed" in said and "fewer --workers" in said
    before = read_table(tmp_path / "out" / "sweep.h5").rows()
    assert 1 <= len(before) < 40
    assert main(call) == 0
    assert [row for row in read_table(tmp_path / "out" / "sweep.h5").rows() if row in before] == before


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_any_number_of_interrupts_ends_a_sweep_with_one_line_and_keeps_what_is_finished(tmp_path):
    command = [sys.executable, "-m", "ekfslam", *sweep_of(tmp_path, 40), "--workers", "2"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def interrupt() -> None:
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.01)

    when_it_has_begun(tmp_path, 1000, interrupt)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 130 and said.endswith("ekfslam: interrupted\n") and "Traceback" not in said
    assert 1 <= len(read_table(tmp_path / "out" / "sweep.h5")) < 40
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["sweep.h5"]


def test_an_interrupt_while_a_command_is_imported_is_one_line(monkeypatch, capsys):
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("ekfslam.cli.importlib.import_module", interrupted)
    assert main(["run"]) == 130 and capsys.readouterr().err == "ekfslam: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is before


SCHEDULER = """
import time
from distributed import LocalCluster
cluster = LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None)
print(cluster.scheduler_address, flush=True)
time.sleep(600)
"""


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_a_scheduler_of_dask_that_dies_ends_a_sweep_with_one_line(tmp_path, capsys):
    pytest.importorskip("distributed", reason="distributed is not installed: pip install ekfslam[cluster]")
    import dask

    process = subprocess.Popen([sys.executable, "-c", SCHEDULER], stdout=subprocess.PIPE, text=True)
    address = process.stdout.readline().strip().replace("tcp://", "dask://")
    when_it_has_begun(tmp_path, 1000, process.kill)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        code = main([*sweep_of(tmp_path, 200), "--executor", address])
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert code == 2 and "the cluster has lost its scheduler" in one_line(capsys)
    kept = len(read_table(tmp_path / "out" / "sweep.h5"))
    assert 1 <= kept < 200
    assert main([*sweep_of(tmp_path, kept + 1), "--executor", "serial"]) == 0


def failing(error: Exception) -> Future[int]:
    future: Future[int] = Future()
    future.set_exception(error)
    return future


def test_results_that_arrive_with_the_death_of_a_worker_are_kept():
    waiting: dict[int, Future[int]] = {}

    def submit(task: int) -> Future[int]:
        waiting[task] = Future()
        if task == 4:  # all at once
            for one, future in waiting.items():
                future.set_exception(BrokenExecutor()) if one % 2 else future.set_result(one)
        return waiting[task]

    found = []
    with pytest.raises(BrokenExecutor):
        found.extend(task for task, _ in completed(range(5), submit) if not found.append(task))
    assert set(found) == {0, 2, 4}


def test_a_rank_of_mpi_that_dies_is_a_named_error(monkeypatch):
    class MPIPoolExecutor:
        def __init__(self, max_workers: int | None = None) -> None: ...
        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None: ...
        def submit(self, *_: object) -> Future[int]:
            return failing(BrokenExecutor())

    module = ModuleType("mpi4py.futures")
    module.MPIPoolExecutor = MPIPoolExecutor
    monkeypatch.setitem(sys.modules, "mpi4py", ModuleType("mpi4py"))
    monkeypatch.setitem(sys.modules, "mpi4py.futures", module)
    with pytest.raises(WorkerError, match="a rank of MPI has died"), open_executor("mpi") as executor:
        list(completed([1], executor.submit))


@pytest.mark.parametrize("error", [ValueError("a bug"), KeyboardInterrupt(), MemoryError()])
def test_other_errors_of_a_run_are_not_those_of_its_worker(error):
    with pytest.raises(type(error)), open_executor("serial"):
        raise error
