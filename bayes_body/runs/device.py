"""The line about the device that computes a run, and a note about a GPU that JAX cannot use. Nothing is imported to look for it."""

import os
import platform
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import jax

from bayes_body.base.config import core_count
from bayes_body.kernels.batching import accelerator_memory
from bayes_body.runs.study.host import CUDA_PLUGINS

# NVIDIA's driver lists the GPUs of the machine here, a folder each.
GPU_FOLDERS = Path("/proc/driver/nvidia/gpus")
CPU_INFO = Path("/proc/cpuinfo")
INSTALL = "pip install 'bayes-body[cuda]'"


def device_lines() -> Iterator[str]:
    """Yield the line about the device, and a note if the machine has a GPU that JAX does not use although nobody asked for that."""
    if accelerator_memory() is not None:
        yield f"device     {_accelerators()}"
        return
    cores = core_count()
    yield f"device     {cores} core{'s' if cores > 1 else ''} of {_processor()}"
    if not _is_unwanted() and (_gpu_count() or shutil.which("nvidia-smi")):
        if any(find_spec(name) for name in CUDA_PLUGINS):
            yield "note: this machine has a GPU, but JAX cannot use it: see with `nvidia-smi` whether its driver works (docs: On a GPU)."
        else:
            yield f"note: this machine has a GPU, but JAX has no plugin for it: {INSTALL}"


def _accelerators() -> str:
    """Return the name, the memory and the numbers of the accelerators that JAX uses."""
    devices, memory = jax.local_devices(), accelerator_memory() or 0.0
    numbers = _visible() or [str(device.id) for device in devices]
    count = max(_gpu_count(), len(devices))
    prefix, plural = (f"{len(devices)} × ", "s") if len(devices) > 1 else ("", "")
    gpus = f" (GPU{plural} {', '.join(numbers)} of {count})" if count > 1 else ""
    return f"{prefix}{devices[0].device_kind}, {memory / 1e9:,.0f} GB for JAX{' on each' if prefix else ''}{gpus}"


def _visible() -> list[str]:
    """Return the numbers of the GPUs that the environment allows; none if it does not restrict them."""
    return [number.strip() for number in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if number.strip()]


def _is_unwanted() -> bool:
    """Return whether the environment keeps JAX from GPUs."""
    visible, platforms = os.environ.get("CUDA_VISIBLE_DEVICES"), os.environ.get("JAX_PLATFORMS", "")
    return (visible is not None and visible.strip() in ("", "-1")) or bool(platforms and "cuda" not in platforms and "gpu" not in platforms)


def _gpu_count() -> int:
    try:
        return len(list(GPU_FOLDERS.iterdir()))
    except OSError:
        return 0


def _processor() -> str:
    """Return the processor's name as the system tells it."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next((name for name in names if name), platform.processor() or platform.machine())
