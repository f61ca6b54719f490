"""The schema of a body file, with the check that its tables fit together."""

from pydantic import model_validator

from bayes_body.model.body.check import faults
from bayes_body.model.body.tables import BodyTables


class BodySchema(BodyTables):
    """A whole body: a tree of joints, the parts attached to it, and its virtual markers.

    `measured_as` names another body with the same dofs and the same lengths and parts, as far as the other has them. A subject's measurements under
    the other body's names are valid for this one.
    """

    @model_validator(mode="after")
    def _check_references(self) -> "BodySchema":
        sentences = faults(self)
        if sentences:
            raise ValueError("\n".join(sentences))
        return self
