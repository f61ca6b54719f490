"""The result of retargeting: angles of a body, and the distances of its markers from the captured points."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.model.body.solids import Body


class Retargeted(NamedTuple):
    """A motion as the joint angles of a body.

    Attributes:
        angles: (frame, dof), radians and metres, in the order of `body.dof_names`.
        lengths_m: the body's lengths if they were fitted, else empty.
        residual_m: (frame, marker), the distance of each of the body's markers from the motion's point of that name; NaN where it has none. For an
            exact motion, the points are the markers as attached to the motion's joints, except at the ends of limbs.
        exact: whether the angles are the motion's own, from an exact decomposition, rather than a fit.
        body: the body with the fitted lengths.
        markers_m: (frame, marker, 3), the positions of the body's markers at these angles.
        remarks: sentences for the user.
    """

    angles: Float[np.ndarray, "frame dof"]
    lengths_m: Mapping[str, float]
    residual_m: Float[np.ndarray, "frame marker"]
    exact: bool
    body: Body
    markers_m: Float[np.ndarray, "frame marker 3"]
    remarks: tuple[str, ...] = ()

    @property
    def marker_names(self) -> tuple[str, ...]:
        """The names of the columns of `residual_m`."""
        return self.body.markers.names

    def residual(self, marker: str | None = None) -> "Residual":
        """Return a summary of the residuals of one marker, or of all."""
        columns = slice(None) if marker is None else [self.marker_names.index(marker)]
        return summed_up(self.residual_m[:, columns])


class Residual(NamedTuple):
    """Summary of distances in millimetres: mean, 95 % quantile and maximum; NaN without distances."""

    mean_mm: float
    most_mm: float
    max_mm: float


def summed_up(residual_m: Float[np.ndarray, "frame marker"]) -> Residual:
    """Return a summary of the distances; NaN values are ignored."""
    known = 1000 * residual_m[np.isfinite(residual_m)]
    if not known.size:
        return Residual(float("nan"), float("nan"), float("nan"))
    return Residual(float(known.mean()), float(np.percentile(known, 95)), float(known.max()))
