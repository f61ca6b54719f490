"""How the tests run: two host devices, the compilation cache, the order of the files. What they stand on is in shared_fixtures.py."""

import os
import sys
from pathlib import Path

import pytest

from bayes_body.base.config import cache_folder

# Read by JAX when it is imported, here and in the programs that tests start: nothing above this line may import it.
os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
# As `configure` does: two workers with two BLAS threads each would wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder("tests-")))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# Most tests wait for the compiler, not for what it compiles: less of it by default; `optimised` where it is the other way round.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Python's own compilation, of this process and of those that tests start: beside the sources, or in a cache of its own where that is forbidden.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = sys.pycache_prefix or str(cache_folder("python-"))
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_configure(config):
    """Load the fixtures, and with them JAX, where tests run: the process that hands files to the workers needs neither."""
    if hasattr(config, "workerinput") or not getattr(config.option, "numprocesses", None):
        config.pluginmanager.import_plugin("shared_fixtures")


TESTS = Path(__file__).parent
# The files that take longest, the longest first: with all others after them both workers end at about the same time.
LONGEST = (
    "workshop/compare/test_benchmark.py",
    "resume/test_resume.py",
    "closed_forms/test_backward_simulation.py",
    "closed_forms/test_gaussian_paths.py",
    "closed_forms/test_definitions.py",
    "programs/test_python_of_docs.py",
    "closed_forms/test_particle_bp.py",
    "resume/test_smooth.py",
    "cli/test_loose_limbed.py",
    "kernels/test_two_devices.py",
    "cli/test_track.py",
    "programs/test_guide.py",
    "closed_forms/test_gaussian_view.py",
    "workshop/calibration/test_sbc.py",
    "view/report/test_page.py",
    "model/likelihood/test_markers_gaussian.py",
    "resume/test_full_disk.py",
    "closed_forms/test_tempered.py",
    "programs/test_plugins_guide.py",
    "closed_forms/test_loose_limbed.py",
    "kernels/test_kernels.py",
    "model/body/test_placement.py",
    "programs/test_bodytrack.py",
    "kernels/test_hmc_filter.py",
    "model/likelihood/test_silhouette_edges.py",
    "model/likelihood/test_regions.py",
    "cli/test_nonsense.py",
    "closed_forms/test_window.py",
    "model/likelihood/test_silhouette_bernoulli.py",
    "workshop/learning/test_activity_hmm.py",
    "cli/test_first_frame.py",
    "initial/test_first_pose.py",
    "model/likelihood/test_edge_phase.py",
    "cli/test_plugin.py",
    "view/report/test_viewer.py",
    "model/likelihood/test_image_motion.py",
    "results/storage/test_fuzz_runs.py",
    "closed_forms/test_particle_gibbs.py",
    "cli/test_export.py",
    "initial/test_load_model.py",
    "closed_forms/test_derived.py",
    "cli/test_import.py",
    "density/test_spaces.py",
    "density/test_parts_graph.py",
    "closed_forms/test_invariance.py",
    "cli/test_models.py",
)


def pytest_collection_modifyitems(items):
    """Order files by LONGEST; xdist hands them out in this order."""
    rank = {TESTS / name: place for place, name in enumerate(LONGEST)}
    missing = [str(path) for path in rank if not path.is_file()]
    if missing:
        raise pytest.UsageError(f"tests/conftest.py: LONGEST: {', '.join(missing)}: no such file; expected files of tests; correct the list")
    items.sort(key=lambda item: rank.get(item.path, len(rank)))
