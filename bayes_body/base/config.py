"""Process-wide settings of JAX and of plots. The command line and the programs call `configure()` before they trace or plot anything."""

import os
import sys
from importlib import import_module
from pathlib import Path

from bayes_body.base.program_cache import check_programs

CACHE_LIMIT_BYTES = 2**30
# `compiler_options` for a program whose optimisation by XLA would take longer than its run.
FAST_COMPILE: dict[str, int] = {"xla_backend_optimization_level": 0}
# Settings that a plotting library reads from the current folder when it is imported, and the module that reads them.
FOUND_IN_FOLDERS = {"matplotlibrc": "matplotlib", "arvizrc": "arviz_base.rcparams"}


def configure(devices: int | None = None, cache: bool = True) -> None:
    """Prepare JAX: one host device per core (at most `devices`), and a persistent compilation cache in the user's cache folder.

    Settings of matplotlib and ArviZ in the current folder are ignored. OpenBLAS, which XLA calls for small solves, gets one thread, unless the
    variable OPENBLAS_NUM_THREADS says otherwise.

    Particles are distributed over the host devices. Call this before the first JAX computation. Settings made by environment variables are kept.

    Args:
        devices: number of host devices; default: one per core that this process may use, at most 16.
        cache: whether to keep compiled programs between processes.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        count = devices or min(core_count(), 16)
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={count}".strip()
    _use_one_blas_thread()
    # Errors of XLA arrive as exceptions. What it would log instead is an alarm that asks users to report that compiling takes a while.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    if cache and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    # By default XLA does not cache programs that compile fast, but together they take most of the user's waiting time.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_max_size", CACHE_LIMIT_BYTES)
    check_programs()
    ignore_plot_settings_here()


def _use_one_blas_thread() -> None:
    """Let OpenBLAS compute in the calling thread. In solves as small as 31 x 31, threads wait for each other longer than they compute."""
    if "OPENBLAS_NUM_THREADS" in os.environ:
        return
    # For libraries that are loaded later, and for the programs that this one starts.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "scipy" in sys.modules:
        # It has read the variable already.
        from threadpoolctl import threadpool_limits

        threadpool_limits(1, user_api="blas")


def ignore_plot_settings_here() -> None:
    """Import the plotting libraries now if the current folder has settings for them, without reading those.

    Settings can import code (a `module://` backend) and start programs (`usetex`), and a folder from someone else may hold any. Settings in the
    user's own folders and environment still count. The current folder is changed meanwhile, so no other thread may use relative paths.
    """
    modules = [module for name, module in FOUND_IN_FOLDERS.items() if os.path.lexists(name) and module not in sys.modules]
    if not modules:
        return
    folder_before = os.open(".", os.O_RDONLY)
    os.chdir(Path(__file__).parent)
    try:
        for module in modules:
            import_module(module)
    finally:
        os.chdir(folder_before)
        os.close(folder_before)


def core_count() -> int:
    """The cores that this process may use; a cluster gives it some of the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_folder(use: str = "") -> Path:
    """The folder of compiled programs, one for each release of JAX and type of processor. JAX is not imported.

    Compiled code is for one type of processor: on a home folder shared by several machines, each type needs a separate cache.

    Args:
        use: a prefix of the folder's name, so that tests and runs do not evict each other's programs.
    """
    from importlib.metadata import version

    import platformdirs

    return Path(platformdirs.user_cache_dir("bayes_body")) / f"{use}jax-{version('jax')}-{_processor()}"


def _processor() -> str:
    import hashlib
    import platform

    text = platform.machine() + sys.platform
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        text += "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    except OSError:
        # No such file on this system: architecture and platform are the best information available.
        text += platform.processor()
    return hashlib.sha256(text.encode()).hexdigest()[:12]
