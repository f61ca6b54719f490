"""A long recording: memory every 1000 frames, and seconds a frame. `BAYES_BODY_DATA=... python tests/bench/endurance.py [--frames 36000]`.

The four frames of the real recording, to and fro, so that the motion is continuous. Frames go to files, as in a run.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import bayes_body

# Before the other imports, which may touch JAX.
bayes_body.configure()

import jax  # noqa: E402
from case import recording  # noqa: E402

from bayes_body.base.registry import find  # noqa: E402
from bayes_body.model.build import build_model  # noqa: E402
from bayes_body.model.kernel_options import kernel_options  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.results.posterior import stream_posterior  # noqa: E402
from bayes_body.results.storage import FrameFiles  # noqa: E402
from bayes_body.tracking.track import Progress, track  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "resume"))
from looped import link_looped  # noqa: E402

EVERY = 1000


def memory_mb() -> float:
    """What this process holds now."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS")]
    return int(line.split()[1]) * 1024 / 1e6


def show(progress: Progress) -> None:
    if progress.frame % EVERY == 0 or progress.frame in (100, progress.frames):
        print(f"{progress.frame:8d} {memory_mb():10.0f} {progress.seconds_per_frame:10.4f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=36_000)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--kernel", default="annealed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        session = load_session(link_looped(recording(), Path(folder) / "session", options.frames))
        model = build_model("deutscher_2005", session)
        kind, kernel = kernel_options(model.definition, options.kernel, {"particles": options.particles})
        print(f"{kind}, {options.particles} particles; frames, memory (MB), seconds a frame")
        files = FrameFiles(Path(folder) / "frames")
        draws = track(jax.random.key(0), session, model, find("kernel", kind).build(options=kernel), options.particles, on_frame=show, into=files)
        begun = time.perf_counter()
        stream_posterior(draws, Path(folder) / "posterior.nc")
        print(f"posterior.nc: {time.perf_counter() - begun:.1f} s, {memory_mb():.0f} MB held, {len(draws.frames_lost)} frames lost")


if __name__ == "__main__":
    main()
