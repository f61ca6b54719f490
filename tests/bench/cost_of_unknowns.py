"""What unknowns cost: `python tests/bench/cost_of_unknowns.py SESSION [--model M] [--frames N] [--kernel K ...]`.

CPU time of a frame, after compilation, with the model's unknowns and without them. Both are run in turns, so that other work on the machine slows
both: read the ratio.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import bayes_body as bb

# Before the other imports, which may touch JAX.
bb.configure(devices=1)

import jax  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.model.definition import load_definition  # noqa: E402
from bayes_body.recording.session.read import load_session  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

PARTICLES = {"laplace": 512, "tempered": 1000}


def tracked(session, model, kernel, frames):
    """CPU seconds a frame, and the log-evidence."""
    begin = time.process_time()
    draws = track(jax.random.key(0), session, model, kernel, frames=frames)
    seconds = (time.process_time() - begin) / frames
    return seconds, float(sum(np.sum(frame.info.log_evidence) for frame in draws.frames))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path, help="folder of a session with keypoints")
    parser.add_argument("--model", default="keypoints", help="a definition's name or path")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--kernel", nargs="+", default=list(PARTICLES), choices=PARTICLES)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    session, definition = load_session(options.session), load_definition(options.model)
    models = [bb.load_model(chosen, session, show=lambda _: None) for chosen in (replace(definition, unknowns=()), definition)]
    rows = {}
    for kind in options.kernel:
        kernels = [model.kernel(kind, particles=PARTICLES[kind]) for model in models]
        for model, kernel in zip(models, kernels, strict=True):
            tracked(session, model, kernel, 2)
        runs = [[tracked(session, *pair, options.frames) for pair in zip(models, kernels, strict=True)] for _ in range(options.repetitions)]
        seconds, evidence = np.moveaxis(np.array(runs), -1, 0)
        known_ms, unknown_ms = 1e3 * np.median(seconds, axis=0)
        ratio = float(np.median(seconds[:, 1] / seconds[:, 0]))
        rows[kind] = {"without_ms": known_ms, "with_ms": unknown_ms, "ratio": ratio, "log_evidence": evidence[0].tolist()}
        figures = f"{known_ms:.1f} ms without unknowns, {unknown_ms:.1f} with them, ratio {ratio:.2f}"
        print(f"{kind}: {figures}; log-evidence {evidence[0].round(2)}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
