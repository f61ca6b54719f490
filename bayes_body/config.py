"""Process-wide settings of JAX. Importing bayes_body sets none; the command line and the programs call `configure()` before anything is traced."""

import os
import sys
from pathlib import Path

CACHE_LIMIT_BYTES = 2**30
# `compiler_options` of a program that runs for less time than XLA would take to optimise it.
FAST_COMPILE: dict[str, int] = {"xla_backend_optimization_level": 0}


def configure(devices: int | None = None, cache: bool = True) -> None:
    """Prepare JAX: one host device a core (at most `devices`), and a persistent compilation cache in the user's cache folder.

    Particles are spread over the host devices. Call it before the first JAX computation; a setting that the environment already makes is left alone.

    Args:
        devices: how many host devices to make; by default one a core, at most 16.
        cache: whether compiled programs are kept between processes.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        count = devices or min(os.cpu_count() or 1, 16)
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={count}".strip()
    import jax

    if cache and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(_cache_folder(jax.__version__)))
    # XLA's default leaves out what compiles fast; all our programs together are what the user waits for.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_max_size", CACHE_LIMIT_BYTES)


def _cache_folder(version: str) -> Path:
    import platformdirs

    # Compiled code is for one processor: on a home shared by several machines each needs a folder of its own.
    return Path(platformdirs.user_cache_dir("bayes_body")) / f"jax-{version}-{_processor()}"


def _processor() -> str:
    import hashlib
    import platform

    text = platform.machine() + sys.platform
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        text += "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    except OSError:
        # No such file on this system: the architecture and platform must do.
        text += platform.processor()
    return hashlib.sha256(text.encode()).hexdigest()[:12]
