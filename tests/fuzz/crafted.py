"""Hostile inputs that look honest: pickled lists, compressed bags, checkpoints with right digests, live messages."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import pickle
import struct
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from support.npy import npy_fields
from test_live_robust import CAMERA, NOISE, T_CAM_IMU, messages

from ekfslam import LiveEKF
from ekfslam.cli import main
from ekfslam.data.inputs import InertialNoise
from ekfslam.data.simulate import builtin
from ekfslam.errors import DataError, EkfslamError
from ekfslam.studies.journal import Journal, framed

SWEEP = """recordings = ["builtin:city?frames=6"]
modes = ["full", "dead-reckoning"]
seeds = [0, 1]
"""
STUDY = ["consistency", "--runs", "2", "--variants", "invariant", "--executor", "serial", "--out", "."]
WINDOWS: dict[str, tuple[Any, ...]] = {
    "delay_s": (0.0, 0.05, 0.4),
    "gap_s": (np.inf, 0.05),
    "history_s": (1.0, 0.0),
    "late": ("raise", "count"),
    "jump_s": (10.0, 0.5),
    "backlog": (100_000, 20),
    "log_frames": (10_000, 5),
}


def pick(rng: np.random.Generator, choices: Any) -> Any:
    return list(choices)[int(rng.integers(len(choices)))]


# --- pickles ----------------------------------------------------------------------------------------------------------


def listed(value: Any, odd: tuple[Any, ...], rng: np.random.Generator) -> Any:
    """Return nested lists of an array, some of which are odd, ragged, shared or within themselves."""
    lists = value.tolist() if isinstance(value, np.ndarray) else value
    for _ in range(int(rng.integers(1, 4))):
        inner = lists
        while isinstance(inner, list) and inner and isinstance(inner[0], list) and rng.random() < 0.7:
            inner = inner[int(rng.integers(len(inner)))]
        if not isinstance(inner, list) or not inner:
            break
        i, kind = int(rng.integers(len(inner))), rng.integers(8)
        if kind == 0:
            del inner[i]
        elif kind == 1:
            inner[i] = inner
        elif kind == 2:
            inner[i] = lists if rng.random() < 0.2 else [inner[i]] * int(10 ** rng.uniform(0, 3))
        elif kind == 3:
            shared: Any = inner[i]
            for _ in range(int(rng.integers(1, 40))):
                shared = [shared] * 3
            inner[i] = shared
        else:
            inner[i] = pick(rng, (*odd, None, "x", b"1", {}, (), [], 1 << 70, 1j, True))
    return lists


def pickled(odd: tuple[Any, ...], rng: np.random.Generator) -> bytes:
    """Return an .npy file of one pickled dictionary."""
    fields = npy_fields(builtin("loop?frames=7"))
    for _ in range(int(rng.integers(1, 3))):
        name = pick(rng, fields)
        fields[name] = listed(fields[name], odd, rng)
    head = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    head += b" " * (63 - (len(head) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + pickle.dumps(fields, int(rng.integers(2, 5)))


# --- checkpoints ------------------------------------------------------------------------------------------------------


def journals() -> dict[str, tuple[str, bytes, list[str]]]:
    """Return the journal of a sweep and of a study that were killed at the end: its name, content and command."""
    found, remove = {}, Journal.remove
    Journal.remove = lambda self: None  # type: ignore[method-assign]
    try:
        for kind, command in (("sweep", ["sweep", "s.toml", "--executor", "serial", "--out", "."]), ("study", STUDY)):
            with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
                Path("s.toml").write_text(SWEEP)
                assert main(command) == 0
                (path,) = Path(place).rglob(".*.journal")
                found[kind] = str(path.relative_to(Path(place).resolve())), path.read_bytes(), command
    finally:
        Journal.remove = remove  # type: ignore[method-assign]
    return found


def entries(content: bytes) -> list[bytes]:
    found, at = [], 0
    while at < len(content):
        length = int.from_bytes(content[at : at + 8], "big")
        found.append(content[at + 40 : at + 40 + length])
        at += 40 + length
    return found


def forged(content: bytes, odd: tuple[Any, ...], rng: np.random.Generator) -> bytes:
    """Return a journal with entries that changed, each with the right digest."""
    some = entries(content)
    for _ in range(int(rng.integers(1, 4))):
        i, kind = int(rng.integers(len(some))), rng.integers(8)
        heading, line, body = some[i].partition(b"\n")
        if kind == 0:
            some.insert(i, some[int(rng.integers(len(some)))])
        elif kind == 1 and len(some) > 1:
            del some[i]
        elif kind == 2:
            level = pick(rng, (*odd, "x", "mid", None, [], {}, "__class__", "0" * 64))
            some[i] = json.dumps([level, pick(rng, (*odd, -1, 99, "x", None, []))]).encode() + line + body
        elif kind == 3:
            some[i] = heading.replace(b"1", b"9", 1) + line + body
        elif len(body) >= 8:
            at, new = int(rng.integers(len(body) // 8)) * 8, np.float64(pick(rng, odd)).tobytes()
            some[i] = heading + line + body[:at] + (new if kind < 6 else rng.bytes(8)) + body[at + 8 :]
    return b"".join(map(framed, some))


# --- live messages ----------------------------------------------------------------------------------------------------


class Stream:
    """Messages for a live filter, nearly all right, by one thread or three; call it to hear what is wrong."""

    def __init__(self, odd: tuple[Any, ...], spoilt: Any, rng: np.random.Generator) -> None:
        self.odd, self.spoilt, self.rng = odd, spoilt, rng
        self.is_inertial, self.is_threaded = rng.random() < 0.4, rng.random() < 0.15
        self.window = {name: pick(rng, some) for name, some in WINDOWS.items() if rng.random() < 0.4}
        self.unclean = 0

    def new(self) -> LiveEKF:
        imu = InertialNoise(2e-3, 3e-2, 1e-4, 1e-3) if self.is_inertial else None
        return LiveEKF.from_rig(CAMERA, T_CAM_IMU, NOISE, imu=imu, **self.window)

    def calls(self) -> list[tuple[str, tuple[Any, ...]]]:
        """Return names of methods and arguments, the stamp last."""
        found: list[tuple[str, tuple[Any, ...]]] = []
        for name, arguments, t in messages(int(self.rng.integers(10, 60))):
            if name == "predict" and self.is_inertial:
                name, arguments = "imu", (arguments[0][3:], np.array([0.0, 0.0, 9.81]) + 0.1 * arguments[0][:3])
            found.append((name, (*arguments, t)))
        for _ in range(int(self.rng.integers(1, 12))):
            self.disturb(found)
        return found

    def disturb(self, calls: list[tuple[str, tuple[Any, ...]]]) -> None:
        rng, i, kind = self.rng, int(self.rng.integers(len(calls))), self.rng.integers(10)
        name, arguments = calls[i]
        t = 0.02 * i
        if kind == 0:
            calls.insert(int(rng.integers(len(calls))), calls[i])
        elif kind == 1:
            del calls[i]
            calls.append((name, arguments))
        elif kind == 2:
            calls.insert(i, pick(rng, (("reset", ()), ("flush", ()), ("pose", ()), ("block", ("pose",)))))
        elif kind == 3:
            calls.insert(i, ("pose", (pick(rng, (*self.odd, "x", None, True, [t])),)))
        elif kind == 4 and arguments:
            calls[i] = (name, (*arguments[:-1], pick(rng, (*self.odd, t + 100.0, t - 100.0, "x", None, True, [t]))))
        elif kind == 5:
            calls[i] = (pick(rng, ("predict", "imu", "update")), arguments)
        elif arguments:
            at = int(rng.integers(len(arguments)))
            new = self.spoilt(arguments[at], rng) if rng.random() < 0.7 else pick(rng, (*self.odd, "x", None, [[1], 2]))
            calls[i] = (name, (*arguments[:at], new, *arguments[at + 1 :]))

    def send(self, live: LiveEKF, name: str, arguments: tuple[Any, ...]) -> bool:
        before = live.ekf, live.time_s, live.counts.taken_in
        try:
            getattr(live, name)(*arguments)
        except DataError:
            is_same = live.ekf is before[0] and live.time_s == before[1] and live.counts.taken_in == before[2]
            self.unclean += not (is_same or self.is_threaded)
            return False
        except EkfslamError:
            return False
        except TypeError as error:  # a call with arguments too many or too few is none of the library's errors
            if "positional argument" in str(error):
                return False
            raise
        return True

    def __call__(self) -> str:
        """Return what is wrong, if anything."""
        live, calls, errors = self.new(), self.calls(), list[Exception]()

        def run(some: list[tuple[str, tuple[Any, ...]]]) -> None:
            try:
                for name, arguments in some:
                    if self.send(live, name, arguments):
                        accepted.append((name, arguments))
            except Exception as error:
                errors.append(error)

        accepted: list[tuple[str, tuple[Any, ...]]] = []
        parts = [[call for call in calls if (hash(call[0]) + i) % 3 == 0] for i in range(3)]
        threads = [threading.Thread(target=run, args=(part,)) for part in (parts if self.is_threaded else [calls])]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise errors[0]
        with contextlib.suppress(EkfslamError):
            live.flush()
        P = live.ekf.P
        if not (np.isfinite(P).all() and np.isfinite(live.ekf.T_world_imu).all()):
            return "the state is not finite"
        if np.linalg.eigvalsh(0.5 * (P + P.T))[0] < -1e-9 * max(1.0, float(np.abs(P).max())):
            return "the covariance is not positive semi-definite"
        return "an error in an argument changed the filter" if self.unclean else self.replayed(live, accepted)

    def replayed(self, live: LiveEKF, accepted: list[tuple[str, tuple[Any, ...]]]) -> str:
        """Return whether the messages that were accepted, sent alone, lead to another state."""
        if self.is_threaded or live.counts.failed or live.counts.resets or self.window.get("late") == "count":
            return ""
        other = self.new()
        for name, arguments in accepted:
            if name in ("predict", "imu", "update", "flush"):
                self.send(other, name, copy.deepcopy(arguments))
        with contextlib.suppress(EkfslamError):
            other.flush()
        same = live.time_s == other.time_s and np.array_equal(live.ekf.P, other.ekf.P)
        return "" if same else "the state is not that of the accepted messages alone"


def text_of(bag: dict[str, bytes], rng: np.random.Generator, mutated: Any) -> dict[str, bytes]:
    """Return the files of a bag, whose compressed ones are changed inside."""
    from rosbags.rosbag2.reader import zstd

    found = dict(bag)
    for name in [name for name in bag if name.endswith((".zstd", ".zst"))]:
        with zstd.open(io.BytesIO(bag[name]), "rb") as stream:
            found[name] = zstd.compress(mutated(stream.read(), rng))
    return found
