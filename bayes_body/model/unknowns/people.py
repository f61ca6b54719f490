"""How people's bones differ in length, learned from measured people (models/learned/bone_lengths.toml)."""

import tomllib
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.shipped import definitions_folder


class BoneVariation(NamedTuple):
    """How the logarithms of bones over stature differ among people.

    Attributes:
        sd: standard deviation of each bone, by name.
        correlation: of each pair of bones with a correlation.
    """

    sd: dict[str, float]
    correlation: dict[frozenset[str], float]

    def correlations(self, bones: tuple[str, ...]) -> Float[np.ndarray, "bone bone"]:
        """Return the correlations of bones; of those that were not measured they are 0."""
        pairs = [[1.0 if a == b else self.correlation.get(frozenset((a, b)), 0.0) for b in bones] for a in bones]
        return np.array(pairs)


@cache
def bone_variation() -> BoneVariation:
    """Return what was learned (`inference/learn/learn_lengths.py`)."""
    learned = tomllib.loads((definitions_folder() / "learned" / "bone_lengths.toml").read_text("utf-8"))
    pairs = {frozenset((bone, second)): value for bone, row in learned["correlation"].items() for second, value in row.items()}
    return BoneVariation(learned["sd"], pairs)


def symmetric_root(matrix: Float[np.ndarray, "entry entry"]) -> Float[np.ndarray, "entry entry"]:
    """Return the symmetric root of a positive definite matrix.

    Of all roots, it makes correlated numbers that are nearest to the independent ones from which they are made.
    """
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(values)) @ vectors.T
