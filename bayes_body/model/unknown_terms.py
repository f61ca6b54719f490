"""The unknowns of a definition, built for a session, and checks that the model can infer them."""

from collections.abc import Sequence

from bayes_body.base.errors import input_error
from bayes_body.base.registry import find
from bayes_body.density.factor import Factor, State
from bayes_body.model.body.placement import PARTS
from bayes_body.model.definition import Definition
from bayes_body.model.unknowns import lengths, widths
from bayes_body.model.unknowns.unknown import Setting, Unknown


def unknowns_of(definition: Definition, setting: Setting, cameras: int) -> tuple[Unknown, ...]:
    """Return the unknowns of a definition for which there are enough cameras.

    Args:
        definition: the definition of the model.
        setting: what they are built for.
        cameras: number of cameras that have what the likelihoods read.

    Raises:
        InputError: the body is placed by parts, and it is no size of a part; or an option does not fit the body.
    """
    foreign = next((term.kind for term in definition.unknowns if term.kind not in (lengths.NAME, widths.NAME)), None)
    if foreign and definition.placement == PARTS:
        table, expected = f"[[unknown]] kind = '{foreign}'", 'kind = "lengths" or "widths", or a body with placement = "angles"'
        raise input_error(table, 'with a body that is placed by "parts"', expected, "take the table out, or place the body by angles")
    enough = [term for term in definition.unknowns if cameras >= getattr(term.options, "least_cameras", 1)]
    return tuple(find("unknown", term.kind).build(options=term.options, setting=setting) for term in enough)


def check_read(unknowns: Sequence[Unknown], factors: Sequence[Factor], state: State) -> None:
    """Check that each unknown changes a factor, and that the motion prior has the variables that it needs.

    Raises:
        InputError: one does not, or a variable is missing.
    """
    for term in unknowns:
        if not any(term.concerns(factor) for factor in factors):
            problem = f"no term of the model reads it: {', '.join(factor.name for factor in factors)}"
            raise input_error(f"unknown '{term.name}'", problem, "a term that does", "take the table out, or add a likelihood that reads it")
        if not term.space.dimension:
            raise input_error(f"unknown '{term.name}'", "nothing to know in this session", "at least one entry", "take the table out")
        for name in term.reads:
            if name not in state:
                problem = f"the motion prior has no variable '{name}'"
                raise input_error(f"unknown '{term.name}'", problem, "one that has", 'take [dynamics] kind = "constant_velocity"')
