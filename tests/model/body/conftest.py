"""Bodies small enough to compute by hand."""

from collections.abc import Callable, Sequence

import jax
import pytest

from bayes_body.model.body.build import build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body

# A part wherever one wants it: shifted along the world's axes, then turned.
FREE = [("tx", "tx"), ("ty", "ty"), ("tz", "tz"), ("z", "z"), ("x", "x"), ("y", "y")]


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def free_parts() -> Callable[..., Body]:
    """`free_parts(part, ...)`: parts that move freely, each with the six dofs x, y, z and turns about z, x, y; every pair may penetrate.

    A part is a mapping: `length` and `radii` in metres, and if need be `section` and `kind`.
    """

    def build(*parts: dict, spheres_per_part: int = 4) -> Body:
        return build_body("parts", BodySchema.model_validate(_document(parts, spheres_per_part)))

    return build


def _document(parts: Sequence[dict], spheres_per_part: int) -> dict:
    names = [f"part_{k}" for k in range(len(parts))]
    return {
        "title": "free parts",
        "source": "a test",
        # Shares of a height of one metre are metres.
        "height_m": 1.0,
        "spheres_per_part": spheres_per_part,
        "penetration": [[a, b] for k, a in enumerate(names) for b in names[:k]],
        "lengths_of_height": {name: part["length"] for name, part in zip(names, parts, strict=True)},
        "joint": [{"name": n, "parent": "world", "dofs": [{"name": f"{n}_{dof}", "axis": axis} for dof, axis in FREE]} for n in names],
        "part": [
            {"name": n, "joint": n, "length": n, "radius_of_height": part["radii"]} | {k: part[k] for k in ("section", "kind") if k in part}
            for n, part in zip(names, parts, strict=True)
        ],
    }
