"""Process-wide settings: what lies in the current folder or in the cache of compiled programs decides nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# What configure() leaves, from within a folder; the plotting libraries are imported as a report does.
PLOTS = """
from bayes_body.base.config import configure
configure(cache=False)
import os
here = os.getcwd()
import arviz_base, matplotlib
from matplotlib.backends import backend_agg
import matplotlib.pyplot
print(here, matplotlib.rcParams["text.usetex"], matplotlib.rcParams["figure.dpi"], arviz_base.rcParams["plot.max_subplots"], matplotlib.get_backend())
"""
PROGRAMS = """
from bayes_body.base.config import configure
configure()
import os
import jax
def double(x):
    return 2 * x
def triple(x):
    return 3 * x
print(float(jax.jit(double)(1.0)), float(jax.jit(triple)(1.0)), os.environ["TF_CPP_MIN_LOG_LEVEL"])
"""

THREADS = """
import scipy.linalg
from bayes_body.base.config import configure
configure(cache=False)
from threadpoolctl import threadpool_info
print(*sorted({library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}))
"""


def output(code: str, folder: Path, **environment: str) -> str:
    """What a program prints that runs in a folder. A program that hangs is stopped."""
    unset = ("MPLBACKEND", "MATPLOTLIBRC", "TF_CPP_MIN_LOG_LEVEL")
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=folder, env=inherited | environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def folder(tmp_path):
    """Settings and a module from someone else."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "matplotlibrc").write_text("backend: module://theirs\ntext.usetex: True\nfigure.dpi: 33\n")
    (folder / "arvizrc").write_text("plot.max_subplots: 3\n")
    (folder / "theirs.py").write_text("open('ran', 'w').close()\n")
    return folder


@pytest.mark.slow
def test_plot_settings_of_the_current_folder_are_ignored(folder, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    # Even where the folder is on the module path.
    said = output(
        PLOTS, folder, PYTHONPATH=f"{os.environ.get('PYTHONPATH', '')}{os.pathsep}{folder}", MPLCONFIGDIR=str(mine), XDG_CONFIG_HOME=str(mine)
    )
    where, usetex, dpi, most, backend = said.split()
    assert (where, usetex, dpi, backend.lower()) == (str(folder), "False", "100.0", "agg")
    assert int(most) > 3
    assert not (folder / "ran").exists()


@pytest.mark.slow
def test_the_users_own_plot_settings_count_and_a_pipe_of_that_name_does_not_hang(tmp_path):
    for name in ("matplotlibrc", "arvizrc"):
        os.mkfifo(tmp_path / name)
    mine = tmp_path / "mine"
    mine.write_text("figure.dpi: 77\n")
    where, usetex, dpi, *_ = output(PLOTS, tmp_path, MATPLOTLIBRC=str(mine), MPLBACKEND="svg").split()
    assert (where, usetex, dpi) == (str(tmp_path), "False", "77.0")


@pytest.mark.slow
def test_exchanged_compiled_programs_are_compiled_again(tmp_path):
    """On the way: of XLA's log only fatal errors are shown, unless the user wants more."""
    cache = tmp_path / "cache"
    assert output(PROGRAMS, tmp_path, JAX_COMPILATION_CACHE_DIR=str(cache)) == "2.0 3.0 3"
    double, triple = (next(cache.glob(f"jit_{name}-*-checked-cache")) for name in ("double", "triple"))
    sound, other = double.read_bytes(), triple.read_bytes()
    double.write_bytes(other)
    triple.write_bytes(other[:-1])
    assert output(PROGRAMS, tmp_path, JAX_COMPILATION_CACHE_DIR=str(cache), TF_CPP_MIN_LOG_LEVEL="2") == "2.0 3.0 2"
    # The entry was replaced.
    assert double.read_bytes()[32:] != other[32:] and len(double.read_bytes()) == pytest.approx(len(sound), rel=0.1)


def test_blas_has_one_thread_unless_the_user_says_otherwise(tmp_path, monkeypatch):
    """Also where SciPy was imported before."""
    assert output(THREADS, tmp_path, OPENBLAS_NUM_THREADS="2") == "2"
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert output(THREADS, tmp_path) == "1"
