"""Process-wide settings of JAX. Importing bayes_body sets none. The command line and the programs call `configure()` before they trace anything."""

import os
import sys
from pathlib import Path

CACHE_LIMIT_BYTES = 2**30
# `compiler_options` for a program whose optimisation by XLA would take longer than its run.
FAST_COMPILE: dict[str, int] = {"xla_backend_optimization_level": 0}


def configure(devices: int | None = None, cache: bool = True) -> None:
    """Prepare JAX: one host device per core (at most `devices`), and a persistent compilation cache in the user's cache folder.

    Particles are distributed over the host devices. Call this before the first JAX computation. Settings made by environment variables are kept.

    Args:
        devices: number of host devices; default: one per core that this process may use, at most 16.
        cache: whether to keep compiled programs between processes.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        count = devices or min(_cores(), 16)
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={count}".strip()
    import jax

    if cache and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    # By default XLA does not cache programs that compile fast, but together they take most of the user's waiting time.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_max_size", CACHE_LIMIT_BYTES)


def _cores() -> int:
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
