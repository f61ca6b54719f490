"""What makes a fit doubtful, in sentences."""

from collections.abc import Iterator, Mapping

import numpy as np

from bayes_body.recording.session.session import Session
from bayes_body.runs.unknowns.definition import DELAYS
from bayes_body.runs.unknowns.posterior import Posterior
from bayes_body.runs.unknowns.table import LENGTHS
from bayes_body.tracking.draws import Draws

# Standard deviations of the posterior by which two runs may differ in the worst of some 70 entries, and of the prior by which a result may be off
# what the session says.
FARTHEST_RUNS, FARTHEST = 2.0, 3.0


def remarks_of(posteriors: Mapping[str, Posterior], drawn: Draws, session: Session) -> list[str]:
    """Return the warnings about a fit.

    Args:
        posteriors: from `posteriors_of`.
        drawn: the filters with unknowns.
        session: the recording.
    """
    return [*_lost(drawn), *_disagreeing(posteriors), *_surprising(posteriors), *_late(posteriors, session)]


def farthest_runs(posteriors: Mapping[str, Posterior]) -> tuple[str, float]:
    """Return the entry in which the runs differ most, and by how many standard deviations."""
    entries = [
        (f"{name}: {label}", float(disagreement))
        for name, values in posteriors.items()
        for label, disagreement in zip(values.labels, values.disagreement, strict=True)
    ]
    return max(entries, key=lambda entry: entry[1])


def _lost(drawn: Draws) -> Iterator[str]:
    if lost := len(drawn.frames_lost):
        yield f"{lost} of {len(drawn.frames)} frames were lost with unknowns: the body does not fit the keypoints; look at the import's check.png."


def _disagreeing(posteriors: Mapping[str, Posterior]) -> Iterator[str]:
    entry, disagreement = farthest_runs(posteriors)
    if disagreement > FARTHEST_RUNS:
        yield f"the two runs differ by {disagreement:.1f} standard deviations in {entry}: the result depends on chance; use more --frames."


def _surprising(posteriors: Mapping[str, Posterior]) -> Iterator[str]:
    for name, values in posteriors.items():
        off = np.abs(values.mean - values.prior_mean) / values.prior_sd
        worst = int(off.argmax())
        if off[worst] > FARTHEST:
            reference = "the session" if name == LENGTHS else "what is usual"
            remedy = f"give a model with a wider [[unknown]] kind = '{name}', if this can be"
            yield f"{name}: {values.labels[worst]} is {off[worst]:.1f} prior standard deviations from {reference}; {remedy}."


def _late(posteriors: Mapping[str, Posterior], session: Session) -> Iterator[str]:
    if DELAYS not in posteriors:
        return
    offsets = {view.camera.name: view.offset for view in session.views}
    for camera, delay_s in zip(posteriors[DELAYS].labels, posteriors[DELAYS].mean, strict=True):
        if frames := round(float(delay_s) * session.fps):
            late = "late" if frames > 0 else "early"
            yield f"camera '{camera}' is {late} by about {1000 * abs(delay_s):.0f} ms: set its offset to {offsets[camera] - frames} in session.toml."
