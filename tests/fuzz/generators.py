"""Hostile inputs from a seed: files of every format, settings, worlds and command lines, most of them nearly right.

Each generator takes prepared valid files and a random generator, and answers with the files to write and the command.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import crafted
import h5py
import numpy as np
import scipy.io
from folders import Files, folders, is_text, png
from support.recordings import ece276a_fields, utias_fields, write_mat, write_npz

from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers.hdf5 import sequence_image
from ekfslam.data.simulate import BUILTIN, builtin, numbers_of
from ekfslam.errors import EkfslamError
from ekfslam.storage.exports import EXPORTS

ODD: tuple[Any, ...] = (0, -1, 1, 2, 0.5, 1e-300, 1e-9, 1e9, 1e300, -1e300, np.nan, np.inf, -np.inf, 1 << 31, 1 << 62)
WORDS = ("", "x", "nan", "inf", "-1", "1e999", "0", "../../x", "\x1b[2J", "é", "$a$", "a|b", "{0}", "9" * 400, "true")
MODES = ("dead-reckoning", "mapping-only", "full", "smoothed")
TABLES = {name: table for name, table in vars(Config()).items() if name not in ("blocks", "tuning")}
QUICK = "[filter]\nrelative_frames = 5\n"


@dataclass(frozen=True)
class Case:
    """One input: what to write into an empty folder, and the arguments to run there."""

    files: dict[str, bytes]
    arguments: list[str]
    program: Callable[[], str] | None = None  # in place of the command; it returns what is wrong


@dataclass(frozen=True)
class Valid:
    """Valid files by kind."""

    recordings: dict[str, bytes]
    archives: dict[str, bytes]
    texts: dict[str, bytes]
    folders: dict[str, tuple[Files, str]]
    journals: dict[str, tuple[str, bytes, list[str]]]

    @staticmethod
    def prepared() -> Valid:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            npz = write_npz(place / "a.npz", ece276a_fields()).read_bytes()
            mat = write_mat(place / "a.mat", utias_fields(extra=2)).read_bytes()
            night = write_mat(place / "b.mat", utias_fields(starry_night=True)).read_bytes()
            own = sequence_image(builtin("city?frames=12"))
            (place / "c.toml").write_text(QUICK + "[calibration]\nlever_arm_m = 0.01\n")
            archive = str(place / "full.h5")
            assert main(["run", "builtin:city?frames=12", "--config", str(place / "c.toml"), "--out", archive]) == 0
            full = Path(archive).read_bytes()
            assert main(["posterior", archive, "--out", folder]) == 0
            study = ["consistency", "--runs", "1", "--variants", "fej", "--executor", "serial", "--out"]
            assert main([*study, folder]) == 0
            return Valid(
                {"npz": npz, "mat": mat, "night": night, "own": own},
                {"full": full, "both": Path(archive).read_bytes(), "study": (place / "study.h5").read_bytes()},
                {"kitti": _kitti(), "tum": _tum(), "euroc": _euroc()},
                folders(),
                crafted.journals(),
            )


def _kitti() -> bytes:
    return b"".join(b"1 0 0 %d 0 1 0 0 0 0 1 0\n" % i for i in range(7))


def _stamps() -> list[float]:
    return [float(stamp) for stamp in ece276a_fields()["time_stamps"][0]]


def _tum() -> bytes:
    return "".join(f"{stamp:.6f} {i} 0 0 0 0 0 1\n" for i, stamp in enumerate(_stamps())).encode()


def _euroc() -> bytes:
    rows = [f"{round(stamp * 1e9)},{i},0,0,1,0,0,0" + ",0" * 9 for i, stamp in enumerate(_stamps())]
    return ("#timestamp, p_x\n" + "\n".join(rows) + "\n").encode()


def _pick(rng: np.random.Generator, choices: Any) -> Any:
    choices = list(choices)
    return choices[int(rng.integers(len(choices)))]


def _use(rng: np.random.Generator, name: str) -> list[str]:
    """A command for a recording: mostly the quick ones."""
    command = _pick(rng, ["info"] * 5 + ["run"] * 4 + ["compare"])
    if command == "info":
        return ["info", name]
    if command == "run":
        return ["run", name, "--mode", _pick(rng, MODES), "--out", "out.h5"]
    return ["compare", name, "--modes", *rng.permutation(MODES)[: rng.integers(1, 4)].tolist(), "--out", "out"]


def _use_archive(rng: np.random.Generator, name: str) -> list[str]:
    command = _pick(rng, ["info"] * 8 + ["export"] * 6 + ["plot", "check", "posterior", "report", "animate"])
    more = {"export": ["--format", _pick(rng, EXPORTS)], "animate": ["--pictures", "1"]}
    return [command, name, *more.get(command, [])]


def mutated(content: bytes, rng: np.random.Generator, other: bytes = b"") -> bytes:
    """A file with some bytes changed, cut out, doubled or taken from another."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        if not data:
            break
        at, count = int(rng.integers(len(data))), int(2 ** rng.uniform(0, 9))
        kind = rng.integers(7)
        if kind <= 1:
            for i in rng.integers(0, len(data), min(count, 16)):
                data[i] = int(rng.integers(256))
        elif kind == 2:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 3:
            del data[at : at + count]
        elif kind == 4:
            data[at : at + count] = _pick(rng, (b"\0", b"\xff", b"\x7f", b" ", b"9")) * count
        elif kind == 5:
            data[at:at] = data[at : at + count]
        else:
            start = int(rng.integers(max(len(other), 1)))
            data[at : at + count] = other[start : start + count]
    return bytes(data[: int(rng.integers(len(data) + 1))] if rng.random() < 0.1 else data)


def bytes_of_recordings(valid: Valid, rng: np.random.Generator) -> Case:
    content = valid.recordings[_pick(rng, valid.recordings)]
    other = valid.recordings[_pick(rng, valid.recordings)]
    return Case({"a": mutated(content, rng, other)}, _use(rng, "a"))


def bytes_of_archives(valid: Valid, rng: np.random.Generator) -> Case:
    kind = _pick(rng, valid.archives)
    content = mutated(valid.archives[kind], rng, valid.archives[_pick(rng, valid.archives)])
    if kind == "study":
        study = ["consistency", "--runs", "1", "--variants", "fej", "--executor", "serial", "--out", "."]
        return Case({"study.h5": content}, study if rng.random() < 0.1 else ["info", "study.h5"])
    return Case({"a.h5": content}, _use_archive(rng, "a.h5"))


def spoilt(value: Any, rng: np.random.Generator) -> Any:
    """An array with odd entries, or of another shape or type."""
    try:
        value = np.array(value)
    except ValueError:  # ragged already
        return value
    kind = rng.integers(12)
    if value.size and value.dtype.kind in "iufb" and kind <= 5:
        with np.errstate(all="ignore"):
            odd = np.float64(_pick(rng, ODD))
            if value.dtype.kind != "f":
                odd = np.nan_to_num(odd, posinf=1 << 62, neginf=-(1 << 62)).clip(-(2.0**62), 2.0**62)
            if kind == 5:
                return (value * odd).astype(value.dtype)
            value.reshape(-1)[rng.integers(0, value.size, 1 if kind < 4 else value.size)] = odd.astype(value.dtype)
        return value
    choices: list[Callable[[], Any]] = [
        lambda: value.T.copy(),
        lambda: value[..., None].copy(),
        lambda: value[:0].copy() if value.ndim else np.zeros(0),
        lambda: value[:-1].copy() if value.ndim else value,
        lambda: np.array(["text"] * 3),
        lambda: value.astype(_pick(rng, ("f4", "f8", "i1", "u8", "c16", "?"))),
        lambda: np.array(_pick(rng, ODD), dtype=float),
        lambda: np.zeros_like(value),
        lambda: value.ravel().copy(),
        lambda: np.concatenate([value, value]) if value.ndim else value,
    ]
    with np.errstate(all="ignore"):
        try:
            return _pick(rng, choices)()
        except (ValueError, TypeError):
            return np.zeros(2)


def fields_of_recordings(valid: Valid, rng: np.random.Generator) -> Case:
    make = _pick(rng, (ece276a_fields, utias_fields, lambda: utias_fields(starry_night=True)))
    fields = make()
    for _ in range(int(rng.integers(1, 3))):
        name = _pick(rng, fields)
        fields[name] = spoilt(fields[name], rng)
        if rng.random() < 0.1:
            del fields[name]
    stream = io.BytesIO()
    try:
        if "features" in fields or make is ece276a_fields:
            np.savez(stream, **fields)
        else:
            scipy.io.savemat(stream, fields, do_compression=bool(rng.integers(2)))
    except (TypeError, ValueError):
        return bytes_of_recordings(valid, rng)
    return Case({"a": stream.getvalue()}, _use(rng, "a"))


def items_of_hdf5(valid: Valid, rng: np.random.Generator) -> Case:
    """A data set, attribute or group of an archive or recording replaced."""
    is_archive = rng.random() < 0.8
    content = valid.archives[_pick(rng, ("full", "both"))] if is_archive else valid.recordings["own"]
    with h5py.File(io.BytesIO(content), "r") as source, tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        path.write_bytes(content)
        names: list[str] = []
        source.visit(names.append)
        with h5py.File(path, "r+") as h5file:
            for _ in range(int(rng.integers(1, 3))):
                with contextlib.suppress(TypeError, ValueError):  # HDF5 has no such type: it stays as deleted
                    _replace(h5file, _pick(rng, names), rng)
        content = path.read_bytes()
    return Case({"a.h5": content}, _use_archive(rng, "a.h5") if is_archive else _use(rng, "a.h5"))


def _replace(h5file: h5py.File, name: str, rng: np.random.Generator) -> None:
    if name not in h5file:
        return
    item, kind = h5file[name], rng.integers(10)
    if len(item.attrs) and kind < 3:
        attribute = _pick(rng, item.attrs)
        value = item.attrs[attribute]
        if isinstance(value, bytes | str) and rng.random() < 0.7:
            text = value if isinstance(value, bytes) else value.encode()
            item.attrs[attribute] = np.bytes_(mutated(text, rng).replace(b"\0", b"") or b"?")
        else:
            odd = (h5py.Empty("f8"), np.zeros(3), np.nan, -1, "text", 1 << 40, np.zeros((2, 2)), True)
            item.attrs[attribute] = _pick(rng, odd)
        return
    value = item[()] if isinstance(item, h5py.Dataset) and item.size and item.size < 1e6 else None
    del h5file[name]
    if kind == 3:
        h5file[name] = _pick(rng, (h5py.SoftLink("/"), h5py.ExternalLink("a.h5", "/"), h5py.Empty("f8")))
    elif kind == 4:
        h5file.create_dataset(name, (10**9,), "f8", chunks=(1000,))
    elif kind == 5:
        h5file.create_group(name)
    elif value is not None:
        new = spoilt(value, rng)
        h5file[name] = new.astype("S") if getattr(new, "dtype", np.dtype("f8")).kind == "U" else new


def settings(valid: Valid, rng: np.random.Generator) -> Case:
    lines = [QUICK] if rng.random() < 0.5 else []
    for _ in range(int(rng.integers(1, 5))):
        table = _pick(rng, TABLES)
        key = _pick(rng, [field.name for field in dataclasses.fields(TABLES[table])])
        value = _pick(
            rng, [repr(odd) for odd in ODD] + [f'"{word}"' for word in WORDS] + ["true", "[]", "{}", "0", "1", "2.0"]
        )
        name = f"blocks.{_pick(rng, ('twist_bias', 'camera_jitter', 'x'))}" if rng.random() < 0.1 else table
        lines.append(f"[{name}]\n{key} = {value}\n")
    text = "".join(lines).encode(errors="replace")
    if rng.random() < 0.2:
        text = mutated(text, rng)
    recording = valid.recordings[_pick(rng, valid.recordings)]
    mode = _pick(rng, MODES)
    return Case({"c.toml": text, "a": recording}, ["run", "a", "--mode", mode, "--config", "c.toml", "--out", "o.h5"])


def truths(valid: Valid, rng: np.random.Generator) -> Case:
    text = valid.texts[_pick(rng, valid.texts)]
    if rng.random() < 0.5:
        text = mutated(text, rng, _pick(rng, valid.texts.values()))
    else:
        rows = [line.split(" ") for line in text.decode().splitlines()]
        for _ in range(int(rng.integers(1, 4))):
            row = _pick(rng, rows)
            row[int(rng.integers(len(row)))] = _pick(rng, [repr(odd) for odd in ODD] + list(WORDS))
        text = "\n".join(" ".join(row) for row in rows).encode(errors="replace")
    name = _pick(rng, ("npz", "mat"))
    command = [*_use(rng, "a"), "--truth", "t.txt"]
    if rng.random() < 0.2:
        keys = ("roll_deg", "stamp_s", "position_m", "x")
        command += ["--truth-noise", f"{_pick(rng, keys)}={_pick(rng, WORDS)}"]
    return Case({"a": valid.recordings[name], "t.txt": text}, command)


def worlds(valid: Valid, rng: np.random.Generator) -> Case:
    world = _pick(rng, BUILTIN)
    changes = {"frames": "8"}
    for _ in range(int(rng.integers(1, 4))):
        key = _pick(rng, numbers_of(BUILTIN[world]))
        changes[key] = _pick(rng, [repr(odd) for odd in ODD] + ["3", "8", "0.1", "30", "1e3", "1e-3", "x", ""])
    name = f"builtin:{world}?" + "&".join(f"{key}={value}" for key, value in changes.items())
    if rng.random() < 0.2:
        return Case({}, ["simulate", name, "--out", "o.h5"])
    return Case({}, _use(rng, name))


def drives(valid: Valid, rng: np.random.Generator) -> Case:
    """Recordings that are well-formed and still beyond what filters expect."""
    sequence = builtin(f"{_pick(rng, ('city', 'loop'))}?frames={_pick(rng, (2, 3, 8, 20))}&seed={rng.integers(99)}")
    twist, pixels, time_s = sequence.twist.copy(), sequence.observations.pixels_px.copy(), sequence.time_s.copy()
    for _ in range(int(rng.integers(1, 4))):
        kind = rng.integers(10)
        if kind == 0:
            twist *= _pick(rng, (0.0, -1.0, 1e3, 1e5))
        elif kind == 1:
            twist[rng.integers(len(twist))] = _pick(rng, (1e6, -1e6, 0.0))
        elif kind == 2:
            pixels[:, 2] = pixels[:, 0] - _pick(rng, (0.0, 1e-12, 1e-3, -5.0, 1e6))
        elif kind == 3:
            pixels += rng.normal(0, _pick(rng, (30.0, 1e4)), pixels.shape)
        elif kind == 4:
            pixels[:] = pixels[0]
        elif kind == 5:
            time_s = time_s[0] + (time_s - time_s[0]) * _pick(rng, (1e-9, 1e6, 1e9))
        elif kind == 6:
            pixels = np.clip(pixels * _pick(rng, (1e-6, 1e3)), -1e7, 1e7)
        elif kind == 7:
            pixels[:, 3] += _pick(rng, (1e-3, 50.0, 1e6))
        elif kind == 8:
            pixels = np.round(pixels)
        else:
            twist = np.roll(twist, 1, axis=1)
    np.clip(twist, -1e6, 1e6, out=twist)
    observations = dataclasses.replace(sequence.observations, pixels_px=np.clip(pixels, -1e7, 1e7))
    changed = {"twist": twist, "observations": observations, "time_s": time_s}
    changed["noise"] = _pick(rng, (sequence.noise, None, dataclasses.replace(sequence.noise, pixel_std_px=np.zeros(4))))
    if rng.random() < 0.5:
        changed["truth"] = None
    text = QUICK
    if rng.random() < 0.5:
        text += "[hygiene]\nmax_row_mismatch_sigma = 0\nmin_disparity_sigma = 0\nrestart_at_repeats = false\n"
    elif rng.random() < 0.3:
        text += "[hygiene]\nmin_observations = 1000\n"
    try:
        content = sequence_image(dataclasses.replace(sequence, **changed))
    except EkfslamError:  # stamps beyond all sense
        return worlds(valid, rng)
    mode = _pick(rng, MODES)
    extra = _pick(rng, ([], [], ["--sigma-px", "0.003"], ["--variant", "standard"], ["--variant", "fej"]))
    run = ["run", "a.h5", "--mode", mode, "--config", "c.toml", "--out", "o.h5", *extra]
    return Case({"a.h5": content, "c.toml": text.encode()}, ["info", "a.h5"] if rng.random() < 0.2 else run)


def _odd_number(text: bytes, rng: np.random.Generator) -> bytes:
    """A text with one of its words replaced."""
    words = re.split(rb"([\s,\[\]=:#\"]+)", text)
    words[2 * int(rng.integers((len(words) + 1) // 2))] = str(_pick(rng, ODD + WORDS)).encode()
    return b"".join(words)


def files_of_folders(valid: Valid, rng: np.random.Generator) -> Case:
    """A folder of images, packets or a bag, of which some files are changed, missing, doubled or of another place."""
    whole, path = valid.folders[_pick(rng, valid.folders)]
    files = crafted.text_of(whole, rng, mutated) if rng.random() < 0.5 else dict(whole)
    for _ in range(int(rng.integers(1, 4))):
        names = sorted(files)
        texts = [name for name in names if is_text(name)]
        name = _pick(rng, texts if texts and rng.random() < 0.7 else names)
        kind = rng.integers(12)
        if kind == 0:
            del files[name]
        elif kind == 1:
            files[name] = files[_pick(rng, names)]
        elif kind == 2:
            files[f"{name}{_pick(rng, WORDS).replace('/', '')[:99]}x"] = files[name]
        elif kind == 3 and name.endswith(".png"):
            shape = _pick(rng, ((1, 1), (8, 12), (200, 400), (8, 12, 3), (3000, 1), (0, 5), (900, 900)))
            with contextlib.suppress(SystemError, ValueError):  # no picture has no pixels
                files[name] = png(np.full(shape, int(rng.integers(256)), np.uint8))
        elif is_text(name) and kind <= 8:
            files[name] = _odd_number(files[name], rng)
        else:
            files[name] = mutated(files[name], rng, files[_pick(rng, names)])
        if not files:
            break
    command = _pick(rng, ("info", "info", "track", "run", "compare"))
    out = {"track": "out.h5", "run": "out.h5", "compare": "out"}
    more = ["--mode", _pick(rng, MODES)] if command == "run" else []
    return Case(files, [command, path, *(["--out", out[command]] if command in out else []), *more])


STUDY = """recordings = ["builtin:city?frames=8", { data = "a", truth = "t.txt", frames = "0:9" }]
modes = ["full"]
variants = ["invariant"]
seeds = [0]
[settings.noise]
sigma_px = [2.0]
[settings.filter]
gate_probability = 0.99
[cases.a.hygiene]
restart_at_repeats = false
[cases.b]
mode = "dead-reckoning"
"""


def sweeps(valid: Valid, rng: np.random.Generator) -> Case:
    text = STUDY.encode()
    for _ in range(int(rng.integers(1, 4))):
        text = _odd_number(text, rng) if rng.random() < 0.8 else mutated(text, rng)
    files = {"s.toml": text, "a": valid.recordings["npz"], "t.txt": valid.texts["tum"]}
    more = ["--plot", "ate_m", _pick(rng, ("mode", "noise.sigma_px", "x"))] if rng.random() < 0.1 else []
    return Case(files, ["sweep", "s.toml", "--executor", "serial", "--out", "o", *more])


def velocities(valid: Valid, rng: np.random.Generator) -> Case:
    rows = [f"{stamp - 0.05:.6f}" + ",1,0,0,0,0,0.1" for stamp in [*_stamps(), _stamps()[-1] + 0.2]]
    text = "\n".join((["# frame: imu"] if rng.random() < 0.5 else []) + rows).encode() + b"\n"
    text = _odd_number(text, rng) if rng.random() < 0.7 else mutated(text, rng)
    if rng.random() < 0.1:
        text = valid.recordings[_pick(rng, valid.recordings)]
    return Case({"a": valid.recordings["npz"], "v.csv": text}, [*_use(rng, "a"), "--velocities", "v.csv"])


COMMANDS = (
    *("run", "compare", "info", "simulate", "plot", "check", "posterior", "export", "tune", "consistency", "x"),
    *("track", "sweep", "report", "animate"),
)
OPTIONS = (
    *("--out", "--mode", "--modes", "--truth", "--config", "--format", "--force", "--sigma-px", "--iterations"),
    *("--runs", "--level", "--variants", "--executor", "--workers", "--seed", "--read-limit", "--truth-noise"),
    *(
        "--velocities",
        "--frames",
        "--resume",
        "--no-figures",
        "--table",
        "--plot",
        "--title",
        "--pictures",
        "--features",
    ),
)
VALUES = (
    *("a.npz", "a.h5", "full.h5", "c.toml", ".", "..", "/dev/null", "/dev/full", "/dev/zero", "no/where", "a.npz/x"),
    *("full", "tum", "kitti", "truth", "serial", "dask://x", "mid", "fej", "1", "0", "-1", "nan", "1e9", "\0", ""),
    *("builtin:city?frames=8", "builtin:loop?frames=8", "builtin:x", "position_m=1", "=", "x" * 300, "--", "-h"),
)


def command_lines(valid: Valid, rng: np.random.Generator) -> Case:
    arguments = [_pick(rng, COMMANDS)]
    if arguments[0] in ("run", "compare", "info", "tune", "simulate"):
        arguments.append(_pick(rng, ("builtin:city?frames=8", "a.npz", "a.h5")))  # the default is a long drive
    for _ in range(int(rng.integers(0, 6))):
        arguments.append(_pick(rng, OPTIONS if rng.random() < 0.4 else VALUES))
    if arguments[0] == "consistency":
        arguments += ["--runs", _pick(rng, ("0", "-1", "x", "999999999"))]  # never one that really runs
    files = {"a.npz": valid.recordings["npz"], "a.h5": valid.recordings["own"], "full.h5": valid.archives["full"]}
    return Case({**files, "c.toml": QUICK.encode()}, arguments)


def pickles(valid: Valid, rng: np.random.Generator) -> Case:
    return Case({"dataset00.npy": crafted.pickled(ODD, rng)}, _use(rng, "dataset00.npy"))


def checkpoints(valid: Valid, rng: np.random.Generator) -> Case:
    """The journal of a sweep or study that was killed, changed with right digests."""
    name, content, command = valid.journals[_pick(rng, valid.journals)]
    content = mutated(content, rng) if rng.random() < 0.2 else crafted.forged(content, ODD, rng)
    return Case({name: content, "s.toml": crafted.SWEEP.encode()}, command)


def streams(valid: Valid, rng: np.random.Generator) -> Case:
    return Case({}, ["live"], crafted.Stream(ODD, spoilt, rng))


GENERATORS: tuple[Callable[[Valid, np.random.Generator], Case], ...] = (
    *(bytes_of_recordings, bytes_of_archives, fields_of_recordings, items_of_hdf5),
    *(settings, truths, worlds, drives, command_lines, files_of_folders, sweeps, velocities),
    *(pickles, checkpoints, streams),
)


def case_of(valid: Valid, seed: int) -> Case:
    """The input of a seed."""
    return GENERATORS[seed % len(GENERATORS)](valid, np.random.default_rng(seed))
