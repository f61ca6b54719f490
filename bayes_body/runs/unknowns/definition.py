"""The definition that infers what is not known: a model of keypoints with unknowns, and a first pose that leaves them free."""

from typing import Any

import tomlkit
from tomlkit import TOMLDocument

from bayes_body.base.errors import input_error
from bayes_body.density.kernel import NamedKernel
from bayes_body.model.body.placement import PARTS
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition, evidence_of, parse_definition

KINDS, DELAYS = ("lengths", "cameras", "keypoint_offsets"), "delays"
# The first pose was fitted with the very lengths and cameras that are doubted. A narrow prior about it would hold them.
FIRST_DEG, FIRST_M = 30.0, 0.3
# Names of the position and the direction of the whole body, which have no rest.
PLACE = "root_"
# Newton steps of a frame. From a wide first pose the usual number does not reach the mode.
MOST_STEPS = 40


def with_unknowns(definition: Definition, delay_sd_s: float | None = None) -> Definition:
    """Return the definition with unknowns and a wide first pose. One that has unknowns stays as it is, but for delays that are asked for.

    Args:
        definition: the model.
        delay_sd_s: the standard deviation of the cameras' delays, seconds; None: delays are not asked for.

    Raises:
        InputError: it does not read keypoints, or its body is placed by parts.
        FaultyFileError: its motion prior or its body allows no such unknowns.
    """
    if "keypoints" not in evidence_of(definition):
        reads = " and ".join(evidence_of(definition))
        raise input_error(f"model '{definition.name}'", f"it reads {reads}", "a model that reads keypoints", "leave --model out")
    if definition.placement == PARTS:
        problem, expected = 'its body is placed by "parts"', 'a body with placement = "angles"'
        raise input_error(f"model '{definition.name}'", problem, expected, "leave --model out")
    present = {term.kind for term in definition.unknowns}
    added = [] if present else [_table(kind) for kind in KINDS]
    if delay_sd_s is not None and DELAYS not in present:
        added.append(_table(DELAYS, f"sd_s = {delay_sd_s}\n"))
    if not added:
        return definition
    document = tomlkit.parse(definition.text)
    if not present:
        document["first"] = _wide_first(document)
    text = f"{tomlkit.dumps(document)}\n{''.join(added)}"
    return parse_definition(definition.name, text, definition.body_text, f"{definition.name} with unknowns")


def _table(kind: str, options: str = "") -> str:
    return f'\n[[unknown]]\nkind = "{kind}"\n{options}'


def _wide_first(document: TOMLDocument) -> dict[str, dict[str, float]]:
    """Return the table of a first pose that is almost free. Angles that the motion prior draws to 0 begin there, with its spread."""
    spread = {name: float(sd) for name, sd in document["dynamics"].get("spread_deg", {}).items() if not name.startswith(PLACE)}
    table = {"sd_m": {"*": FIRST_M}, "sd_deg": {**spread, "*": FIRST_DEG}}
    return {**table, "rest_deg": dict.fromkeys(spread, 0.0)} if spread else table


def kernel_of(model: Model) -> NamedKernel:
    """Return the model's kernel; `laplace` has more steps than in tracking."""
    kernel = model.kernel()
    options: Any = kernel.options
    fewer = kernel.kind == "laplace" and options.most_steps < MOST_STEPS
    return model.kernel(most_steps=MOST_STEPS) if fewer else kernel
