"""Widths of a density of relative poses, as a definition gives them: by names of parts or patterns, one number or one for each axis."""

from collections.abc import Mapping
from fnmatch import fnmatchcase

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, nearest

type Width = float | tuple[float, float, float]


def widths_by_part(name: str, parts: tuple[str, ...], sd_m: Mapping[str, Width], sd_deg: Mapping[str, Width]) -> Float[np.ndarray, "part 6"]:
    """Return the standard deviations of every part: three of the translation, metres, then three of the rotation, radians.

    Raises:
        InputError: a part has none, or a key matches no part.
    """
    return np.concatenate([_axis_widths(name, "sd_m", parts, sd_m), np.radians(_axis_widths(name, "sd_deg", parts, sd_deg))], axis=1)


def _axis_widths(name: str, field: str, parts: tuple[str, ...], table: Mapping[str, Width]) -> Float[np.ndarray, "part 3"]:
    for key in table:
        if not any(fnmatchcase(part, key) for part in parts):
            raise InputError(f"{name}: {field}.{key}: matches no part of the body; {nearest(key, parts)}")
    widths = np.empty((len(parts), 3))
    for row, part in zip(widths, parts, strict=True):
        key = part if part in table else next((pattern for pattern in table if fnmatchcase(part, pattern)), None)
        if key is None:
            raise InputError(f"{name}: {field}: none for the part '{part}'; expected one for every part; add '{part}' or a pattern.")
        row[:] = table[key]
    return widths
