"""Which of several learned activities a person does, over the frames: the posterior probabilities of a hidden Markov model's states, by activity."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import escaped
from bayes_body.model.dynamics.activity_arrays import BELIEF
from bayes_body.results.posterior.blocks import weights_of_runs
from bayes_body.view.report.figures import draw_runs, encoded, frames_a_point, new_panel, time_axis, time_label
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup, details, figures, tag

LEGEND = "The probability of each activity in each frame, given the images so far. Each activity is a block of states of the motion prior."


def activity_details(inspection: Inspection) -> Markup | None:
    """Return a panel for each activity; None if there are not several, or if the spread of the particles means nothing."""
    posterior, stats = (inspection.run.tree[group].to_dataset() for group in ("posterior", "sample_stats"))
    if BELIEF not in posterior or inspection.diagnosis.mode_seeker:
        return None
    belief = posterior[BELIEF]
    labels = [escaped(str(name)).rpartition("_")[0] for name in belief.coords[str(belief.dims[-1])].values]
    if len(set(labels)) < 2:
        return None
    frames = np.arange(0, inspection.run.frames, frames_a_point(inspection.run.frames))
    weights = weights_of_runs(stats["log_weight"].isel(frame=frames).values)
    probabilities = activity_probabilities(belief.isel(frame=frames).values, weights, labels)
    panels = []
    for label, values in probabilities.items():
        figure, axes = new_panel(label, time_label(inspection.fps), "probability")
        draw_runs(axes, frames, values)
        time_axis(axes, inspection.run.frames, inspection.fps)
        axes.set_ylim(-0.03, 1.03)
        panels.append(encoded(figure, f"Probability of the activity {label} over the frames; {values.mean():.2f} in the mean."))
    return details("Activities", tag("p", LEGEND), figures(panels))


def activity_probabilities(
    belief: Float[np.ndarray, "run draw frame state"], weights: Float[np.ndarray, "run draw frame"], labels: list[str]
) -> Mapping[str, Float[np.ndarray, "run frame"]]:
    """Return the posterior probability of each activity: the weighted mean of the particles' probabilities of its states.

    Args:
        belief: probabilities of the states of each particle.
        weights: of the particles, with the sum 1 in each run and frame.
        labels: the activity of each state.
    """
    states = np.einsum("rdf,rdfs->rfs", weights, belief)
    return {label: states[..., [state_label == label for state_label in labels]].sum(axis=-1) for label in dict.fromkeys(labels)}
