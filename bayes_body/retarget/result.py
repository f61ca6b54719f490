"""What a motion became: angles of a body, and how far its markers are from where they were captured."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.body.solids import Body


class Retargeted(NamedTuple):
    """A motion as the joint angles of a body.

    Attributes:
        angles: (frame, dof), radians and metres, in the order of `body.dof_names`.
        lengths_m: the body's lengths if they were fitted, else empty.
        residual_m: (frame, marker), the distance of each of the body's markers from the motion's point of that name; NaN where it has none. Of an
            exact motion the points are where its joints carry the markers, but for the ends of limbs.
        exact: whether the angles are the motion's own, decomposed, and not a fit.
        body: with the fitted lengths.
        markers_m: (frame, marker, 3), where the body's markers are at these angles.
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
        """Of the columns of `residual_m`."""
        return self.body.markers.names

    def residual(self, marker: str | None = None) -> "Residual":
        """The residuals of one marker, or of all."""
        columns = slice(None) if marker is None else [self.marker_names.index(marker)]
        return summed_up(self.residual_m[:, columns])


class Residual(NamedTuple):
    """Distances in millimetres: their mean, what 95 % lie below, and the largest; NaN without any."""

    mean_mm: float
    most_mm: float
    max_mm: float


def summed_up(residual_m: Float[np.ndarray, "frame marker"]) -> Residual:
    """Distances in a few numbers; what is NaN does not count."""
    known = 1000 * residual_m[np.isfinite(residual_m)]
    if not known.size:
        return Residual(float("nan"), float("nan"), float("nan"))
    return Residual(float(known.mean()), float(np.percentile(known, 95)), float(known.max()))
