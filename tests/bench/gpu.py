"""What a GPU gives: evaluations a second, seconds a frame, runs at once or one by one, memory. `BAYES_BODY_DATA=... python tests/bench/gpu.py`.

On an H200 it is meant to take less than eight minutes; no part begins after `--seconds`. `--quick` tries every part with small sizes, on a CPU too:
there batches are as on an accelerator of 0.4 GB, and the speed means nothing. Rows are printed as they come, and written to `--json` as well.
"""

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import bayes_body

# Compiled anew each time: what compilation costs is one of the figures. Before the other imports, which may touch JAX.
bayes_body.configure(cache=False)

import jax  # noqa: E402
from case import Case, load, recording  # noqa: E402
from throughput import gradient, likelihood  # noqa: E402

from bayes_body.base.registry import find  # noqa: E402
from bayes_body.kernels.batching import accelerator_memory, assumed_accelerator, over_particles  # noqa: E402
from bayes_body.kernels.working_memory import work_bytes  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.kernel_options import kernel_options  # noqa: E402
from bayes_body.recording.session.session import Session  # noqa: E402
from bayes_body.runs.device import device_lines  # noqa: E402
from bayes_body.tracking.program import Order, runs_computed  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

RUNS, LEAST_SECONDS = 2, 1.0
ORDERS: tuple[Order, ...] = ("at once", "one by one")
# (what, look-up, function of one particle)
EVALUATIONS = (("nearest value", "nearest", likelihood), ("bilinear value", "bilinear", likelihood), ("value + gradient", "bilinear", gradient))


def peak_gigabytes() -> float | None:
    """The most that this process has had on the device; None where the device does not say."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return stats["peak_bytes_in_use"] / 1e9 if "peak_bytes_in_use" in stats else None


def evaluations(case: Case, function: Any) -> dict[str, Any]:
    """Evaluations a second of all particles of a case, the size of the program's work, and the peak of the device's memory so far."""
    begun = time.perf_counter()
    program = jax.jit(lambda states, density: over_particles(function, states, density)).lower(case.states, case.density).compile()
    compiled, seconds = time.perf_counter() - begun, list[float]()
    jax.block_until_ready(program(case.states, case.density))
    while sum(seconds) < LEAST_SECONDS:
        begun = time.perf_counter()
        jax.block_until_ready(program(case.states, case.density))
        seconds.append(time.perf_counter() - begun)
    count, analysis = jax.tree.leaves(case.states)[0].shape[0], program.memory_analysis()
    return {
        "particles": count,
        "evaluations_per_second": count / sorted(seconds)[len(seconds) // 2],
        "compile_s": compiled,
        "estimated_bytes_a_particle": work_bytes(function, case.states, case.density),
        "temporary_gb": analysis.temp_size_in_bytes / 1e9 if analysis is not None else None,
        "peak_gb": peak_gigabytes(),
    }


def frames(session: Session, name: str, kernel: str, particles: int, count: int) -> dict[str, Any]:
    """Seconds a frame of two runs of a model, without and with decoding and silhouettes, after the first frame."""
    model = build_model(name, session)
    kind, options = kernel_options(model.definition, kernel, {"particles": particles})
    times = list[float]()
    begun = time.perf_counter()
    built = find("kernel", kind).build(options=options)
    draws = track(jax.random.key(0), session, model, built, particles, RUNS, count, on_frame=lambda progress: times.append(time.perf_counter()))
    return {
        "particles": particles,
        "seconds_a_frame": sorted(frame.seconds for frame in list(draws.frames)[1:])[(count - 1) // 2],
        "seconds_a_frame_wall": (times[-1] - times[0]) / (count - 1),
        "first_frame_s": times[0] - begun,
        "lost": len(draws.frames_lost),
        "peak_gb": peak_gigabytes(),
    }


def parts(session: Session, quick: bool) -> Iterator[tuple[str, Any]]:
    """Yield the name and the function of each measurement, the most important first."""
    tracked = 2 if quick else session.frames
    # Which compiles fast.
    name, kernel = ("deutscher_2005", "sir") if quick else ("silhouettes", "tempered")
    for particles in (40,) if quick else (300, 3000, 20_000):
        for order in ORDERS:

            def run(particles: int = particles, order: Order = order) -> dict[str, Any]:
                with runs_computed(order):
                    return frames(session, name, kernel, particles, tracked)

            yield f"{kernel}, {RUNS} runs {order}", run
    # Last, since the peak of the memory is that of the whole process.
    for what, lookup, function in EVALUATIONS:
        count = 2000 if quick else 262_144
        yield what, lambda lookup=lookup, function=function, count=count: evaluations(load(session, lookup, count), function)
    yield "value + gradient", lambda: evaluations(load(session, "bilinear", 4000 if quick else 1_000_000), gradient)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see whether everything runs")
    parser.add_argument("--seconds", type=float, default=420, help="no part begins later")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    begun, session, rows = time.perf_counter(), recording(), []
    assumed = assumed_accelerator(4e8) if accelerator_memory() is None else nullcontext()
    for line in device_lines():
        print(line)
    with assumed:
        for what, measure in parts(session, options.quick):
            if time.perf_counter() - begun > options.seconds:
                print(f"{what}: left out, {options.seconds:.0f} s are over")
                continue
            rows.append({"what": what, **measure()})
            figures = ", ".join(f"{key} {value:.4g}" for key, value in rows[-1].items() if isinstance(value, float | int))
            print(f"{what:30} {figures}", flush=True)
            if options.json:
                options.json.write_text(
                    json.dumps({"jax": jax.__version__, "devices": [str(device) for device in jax.devices()], "rows": rows}, indent=2)
                )
    print(f"{time.perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main()
