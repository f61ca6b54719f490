"""A body file whose tables fit together: the schema that definitions are read with."""

from pydantic import model_validator

from bayes_body.body.check import faults
from bayes_body.body.tables import BodyTables


class BodySchema(BodyTables):
    """A whole body: a tree of joints, the parts that hang on it, and its virtual markers.

    `measured_as` names another body with the same dofs and, as far as that has them, the same lengths and parts: what is measured of a subject in the
    names of that one holds for this one.
    """

    @model_validator(mode="after")
    def _check_references(self) -> "BodySchema":
        sentences = faults(self)
        if sentences:
            raise ValueError("\n".join(sentences))
        return self
