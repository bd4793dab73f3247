"""The names at the top of the package: all are there, and none is imported before it is used."""

import subprocess
import sys

import pytest

import ekfslam


def test_every_public_name_is_there():
    assert {"run", "compare", "open_sequence", "Config", "posterior"} <= set(ekfslam.__all__)
    for name in ekfslam.__all__:
        assert getattr(ekfslam, name) is not None
    assert set(ekfslam.__all__) <= set(dir(ekfslam))
    assert ekfslam.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="no_such_name"):
        ekfslam.no_such_name  # noqa: B018


@pytest.mark.parametrize("statement", ["import ekfslam", "from ekfslam.cli import main; main(['--help'])"])
def test_start_up_imports_nothing_heavy(statement):
    program = (
        "import atexit, sys\n"
        "heavy = ('numpy', 'scipy', 'matplotlib', 'h5py')\n"
        "atexit.register(lambda: print('loaded:', [name for name in heavy if name in sys.modules]))\n"
    )
    done = subprocess.run([sys.executable, "-c", program + statement], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded: []"


# Packages that take long to import and that few runs need, each of them imported where it is used.
RARE = [
    "matplotlib",
    "PIL",
    "scipy.stats",
    "scipy.spatial",
    "scipy.ndimage",
    "scipy.optimize",
    "tqdm",
    "multiprocessing",
    "cv2",
]


@pytest.mark.parametrize("module", ["ekfslam.cli.commands.run", "ekfslam.cli.commands.compare", "ekfslam.reports"])
def test_a_command_imports_no_package_that_few_runs_need(module):
    program = f"import sys, {module}; print([name for name in {RARE} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_run_without_figures_draws_with_no_package(tmp_path):
    program = (
        "import sys; from ekfslam.cli import main\n"
        f"code = main(['run', 'builtin:loop', '--frames', '0:8', '--out', {str(tmp_path / 'run.h5')!r}])\n"
        f"print(code, [name for name in {RARE} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 []"


def test_a_name_in_place_of_a_recording_is_refused():
    with pytest.raises(ekfslam.EkfslamError, match="expected a Sequence, as open_sequence returns it, found str"):
        ekfslam.run("builtin:city")
    sequence = ekfslam.open_sequence("builtin:city?frames=3")
    with pytest.raises(ekfslam.EkfslamError, match=r"expected a Config, .* found dict"):
        ekfslam.compare(sequence, "full", {"filter": {}})
    assert list(ekfslam.compare(sequence, "dead-reckoning").results) == ["dead-reckoning"]
