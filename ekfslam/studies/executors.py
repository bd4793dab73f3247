"""Executors of many runs: processes of this machine, the calling thread, a Dask cluster, or MPI ranks."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from typing import Any, TypeVar

from ekfslam.errors import ConfigError, WorkerError

_MOST_WORKERS = 1024
_FORGETTING_S = 0.5  # in which the pool drops cancelled runs: it fails at those that are left when its workers end
IN_FLIGHT = 256  # tasks handed to an executor at a time

# Kinds of executors, and the words for the loss of a worker.
_DASK = "the cluster has lost its scheduler or a run has killed several workers, perhaps for memory; mend the cluster"
_LOST = {
    "processes": "a worker was killed or could not start, most often for memory; choose fewer --workers",
    "serial": "a run was cancelled",
    "mpi": "a rank of MPI has died, perhaps for memory; start fewer ranks on a machine",
    "tls": _DASK,
    "dask": _DASK,
}

# BLAS threads are limited for the process as a whole: a worker that runs several threads (Dask) takes turns.
ONE_RUN_AT_A_TIME = threading.Lock()

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


def completed(tasks: Iterable[Task], submit: Callable[[Task], Future[Outcome]]) -> Iterator[tuple[Task, Outcome]]:
    """Submit tasks to an executor, at most `IN_FLIGHT` at a time, and yield each with its result as it finishes."""
    remaining, pending = iter(tasks), dict[Future[Outcome], Task]()
    try:
        while True:
            task = next(remaining, None) if len(pending) < IN_FLIGHT else None
            if task is not None:
                pending[submit(task)] = task
            elif not pending:
                return
            # Do not wait while there is more to submit: an executor in this process has finished by now.
            finished, _ = wait(pending, timeout=None if task is None else 0, return_when=FIRST_COMPLETED)
            # An error ends the work, so it comes last.
            for future in sorted(finished, key=lambda future: future.cancelled() or future.exception() is not None):
                yield pending.pop(future), future.result()
    finally:
        for future in pending:
            future.cancel()


class SerialExecutor(Executor):
    """Executor that runs each task immediately, in the calling thread."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def open_executor(spec: str = "processes", workers: int | None = None) -> Iterator[Executor]:
    """Open an executor.

    Args:
        spec: ``processes`` on this machine; ``serial``, in the calling thread; ``tls://HOST:PORT``, the scheduler of a
            Dask cluster, with the certificates of Dask's configuration ``distributed.comm.tls``; ``dask://HOST:PORT``,
            the same without certificates, for private networks only, since anyone who reaches the port runs programs
            as you; ``mpi``, the ranks of ``mpiexec -n N python -m mpi4py.futures -m ekfslam.cli ...``.
        workers: Number of processes, by default one per core; Dask has its own number.

    Raises:
        ConfigError: The executor is unknown, not installed or not reachable, or ``workers`` is out of range.
        WorkerError: A worker, or the scheduler of a cluster, has died in the meantime.
    """
    if workers is not None and not 1 <= workers <= _MOST_WORKERS:
        raise ConfigError(f"workers must be at least 1 and at most {_MOST_WORKERS}, found {workers}")
    kind = next((kind for kind in _LOST if spec == kind or spec.startswith(f"{kind}://")), None)
    if kind is None:
        known = "processes, serial, tls://HOST:PORT, dask://HOST:PORT, mpi"
        raise ConfigError(f"unknown executor {spec!r}; known: {known}")
    try:
        with _opened(kind, spec, workers) as executor:
            yield executor
    except Exception as error:
        is_of_dask = any(kind.__module__.startswith("distributed.") for kind in type(error).__mro__)
        if not (is_of_dask or isinstance(error, BrokenExecutor | CancelledError)):  # an error of a task
            raise
        raise WorkerError(
            f"executor {spec}: {_LOST[kind]}. What is finished is kept: give the same command again"
        ) from None


@contextmanager
def _opened(kind: str, spec: str, workers: int | None) -> Iterator[Executor]:
    if kind == "serial":
        yield SerialExecutor()
    elif kind == "processes":
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor

        context = multiprocessing.get_context("spawn")
        others = multiprocessing.active_children()
        with ProcessPoolExecutor(workers or os.cpu_count(), context, _end_with_parent) as processes:
            try:
                yield processes
            except KeyboardInterrupt:  # runs that go on would be lost anyway
                processes.shutdown(wait=False, cancel_futures=True)
                time.sleep(_FORGETTING_S)
                for worker in {*multiprocessing.active_children()} - {*others}:
                    worker.terminate()
                raise
    elif kind == "mpi":
        with _imported(spec):
            from mpi4py.futures import MPIPoolExecutor
        with MPIPoolExecutor(max_workers=workers) as ranks:
            yield ranks
    else:
        with _dask_client(spec) as client, client.get_executor() as cluster, _quiet("distributed.client"):
            yield cluster


@contextmanager
def _quiet(logger: str) -> Iterator[None]:
    """Let a package log nothing: the loss of a cluster is one named error, not many tracebacks."""
    found = logging.getLogger(logger)
    before, found.disabled = found.disabled, True
    try:
        yield
    finally:
        found.disabled = before


def _dask_client(spec: str) -> Any:
    """Return a client of a Dask scheduler, with certificates or without."""
    with _imported(spec):
        from distributed import Client
        from distributed.security import Security
    security = None
    if spec.startswith("tls://"):
        security = Security(require_encryption=True)  # with the files of Dask's configuration
        if not all(getattr(security, name) for name in ("tls_ca_file", "tls_client_cert")):
            raise ConfigError(
                f"executor {spec}: Dask's configuration has no certificates; set distributed.comm.tls.ca-file, and "
                "cert and key below distributed.comm.tls.client"
            )
    try:
        return Client(spec.replace("dask://", "tcp://"), timeout="10s", security=security)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"executor {spec}: no scheduler there ({error})") from None


@contextmanager
def _imported(spec: str) -> Iterator[None]:
    try:
        yield
    except (ImportError, RuntimeError) as error:  # RuntimeError: there is no MPI library to load
        said = f"executor {spec} is not installed ({error}); it comes with: pip install 'ekfslam[cluster]'"
        raise ConfigError(said) from None


def _end_with_parent() -> None:
    """Leave Ctrl-C to the parent of a worker, and exit if the parent is killed."""
    from multiprocessing import parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
