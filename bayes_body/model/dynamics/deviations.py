"""Standard deviations per frame, as a definition gives them: by names of dofs or parts, or patterns, at one frame rate."""

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase

from bayes_body.base.errors import InputError, nearest
from bayes_body.model.body.skeleton import Topology


def by_part(table: Mapping[str, float], names: tuple[str, ...], field: str) -> list[float]:
    """The number of every part, from names or patterns. An exact name wins, else the first pattern that matches.

    Raises:
        InputError: a part has none, or a key matches no part.
    """
    _check_keys(table, names, field, "part")
    numbers = []
    for name in names:
        key = _key_of(name, table)
        if key is None:
            raise InputError(f"{field}: none for the part '{name}'; expected one for every part; add '{name}' or a pattern.")
        numbers.append(table[key])
    return numbers


def by_dof(table: Mapping[str, float], names: tuple[str, ...], field: str) -> dict[str, float]:
    """The numbers of those dofs that have one, from names or patterns.

    Raises:
        InputError: a key matches no dof.
    """
    _check_keys(table, names, field, "dof")
    return {name: table[key] for name in names if (key := _key_of(name, table)) is not None}


def standard_deviations(sd_deg: Mapping[str, float], sd_m: Mapping[str, float], topology: Topology, prefix: str = "") -> dict[str, float]:
    """The standard deviation of every dof, radians or metres. An exact name wins, else the first pattern that matches.

    Args:
        sd_deg: those of angles, degrees.
        sd_m: those of shifts, metres.
        topology: the body's dofs.
        prefix: what the names of the two tables begin with in the definition, such as "velocity_".

    Raises:
        InputError: a dof has none, or a key matches no dof.
    """
    deviations = known_deviations(sd_deg, sd_m, topology, f"dynamics.{prefix}")
    for name, unit in zip(topology.dof_names, topology.dof_units, strict=True):
        if name not in deviations:
            field = f"dynamics.{prefix}{'sd_deg' if unit == 'rad' else 'sd_m'}"
            raise InputError(f"{field}: no standard deviation for the dof '{name}'; expected one for every dof; add '{name}' or a pattern.")
    return deviations


def known_deviations(sd_deg: Mapping[str, float], sd_m: Mapping[str, float], topology: Topology, place: str) -> dict[str, float]:
    """The standard deviations of those dofs that have one, radians or metres.

    Raises:
        InputError: a key matches no dof.
    """
    deviations: dict[str, float] = {}
    for unit, field, table, si in (("rad", "sd_deg", sd_deg, math.pi / 180), ("m", "sd_m", sd_m, 1.0)):
        dofs = [name for name, u in zip(topology.dof_names, topology.dof_units, strict=True) if u == unit]
        for key in table:
            if not any(fnmatchcase(name, key) for name in dofs):
                measure = "degrees" if unit == "rad" else "metres"
                raise InputError(f"{place}{field}.{key}: matches no dof of the body in {measure}; {nearest(key, dofs)}")
        for name in dofs:
            key = _key_of(name, table)
            if key is not None:
                deviations[name] = table[key] * si
    return deviations


def _key_of(name: str, table: Mapping[str, float]) -> str | None:
    return name if name in table else next((pattern for pattern in table if fnmatchcase(name, pattern)), None)


def _check_keys(table: Mapping[str, float], names: tuple[str, ...], field: str, what: str) -> None:
    for key in table:
        if not any(fnmatchcase(name, key) for name in names):
            raise InputError(f"{field}.{key}: matches no {what} of the body; {nearest(key, names)}")
