"""The base class of all tables of a TOML file, and types of numbers and names. Numbers must be finite numbers, not strings or booleans."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from bayes_body.base.errors import escaped

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
ProperShare = Annotated[float, Field(strict=True, gt=0, lt=1)]
Count = Annotated[int, Field(strict=True, ge=1)]


def _one_line(text: str) -> str:
    """Return the name, if it has no control characters. Names end up in files for other programs, where a line break would begin a new record."""
    if escaped(text) != text:
        raise ValueError(f"{text!a} has control characters; expected one line of text; rename it")
    return text


Name = Annotated[str, AfterValidator(_one_line)]


class Schema(BaseModel):
    """A table of a TOML file: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)
