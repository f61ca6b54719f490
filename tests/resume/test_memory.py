"""Memory does not grow with the number of frames: neither while tracking nor in what is made of the frames afterwards."""

import subprocess
import sys

import pytest

# The current set, not its peak: what the compiler took and gave back does not count.
PROGRAM = """
import sys
from pathlib import Path
import jax
import bayes_body as bb
from bayes_body.results.metrics import log_evidence, marker_disagreement
from bayes_body.results.posterior import stream_posterior
from bayes_body.results.storage import FrameFiles
from bayes_body.tracking.track import track

folder, out, frames = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])

def megabytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

early = largest = 0.0
def watch(progress):
    global early, largest
    if progress.frame % 100 == 0:
        early, largest = (megabytes() if progress.frame == 200 else early), max(largest, megabytes())

bb.configure()
session = bb.load_session(folder)
model = bb.load_model("arm", session)
draws = track(jax.random.key(0), session, model, bb.kernels.sir(), particles=1000, runs=2, on_frame=watch, into=FrameFiles(out / "frames"))
stream_posterior(draws, out / "posterior.nc")
after_posterior = megabytes()
log_evidence(draws), marker_disagreement(draws), draws.frames_lost
print(early, largest, after_posterior, megabytes(), len(draws.frames))
"""


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_two_thousand_frames_take_no_more_than_two_hundred(looped, tmp_path):
    frames = 2000
    done = subprocess.run([sys.executable, "-c", PROGRAM, looped(frames), tmp_path, str(frames)], capture_output=True, text=True, check=True)
    early, *later, count = map(float, done.stdout.split())
    assert count == frames
    # All draws together are 96 MB, which a process of some 300 MB would not hide.
    assert max(later) < 1.15 * early, done.stdout
