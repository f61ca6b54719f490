"""The spaces of variables: Euclidean entries, angles, rotations, rigid transforms, and spaces made of them.

Code that averages, compares, crosses over, stores or exports a variable uses its space.
"""

from bayes_body.density.spaces.compound import Plate, Product
from bayes_body.density.spaces.flat import Flat, box, circle, euclidean, flat, numbered
from bayes_body.density.spaces.groups import SE3, SO3
from bayes_body.density.spaces.space import Axis, Space
from bayes_body.density.spaces.text import space_from_text, space_to_text

__all__ = [
    "SE3",
    "SO3",
    "Axis",
    "Flat",
    "Plate",
    "Product",
    "Space",
    "box",
    "circle",
    "euclidean",
    "flat",
    "numbered",
    "space_from_text",
    "space_to_text",
]
