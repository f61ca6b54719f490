"""The shape vocabulary. Axes: `dof` degrees of freedom, `joint`, `part`, `camera`, `row` and `column` of an image, `particle`."""

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

type Key = PRNGKeyArray
type Keys = Shaped[PRNGKeyArray, " particle"]
type Scalar = Float[Array, ""]
type Flag = Bool[Array, ""]
type Vector3 = Float[Array, "3"]
type Rotation = Float[Array, "3 3"]
type Pose = Float[Array, " dof"]
# What places a body: a pose (dof,), or the transforms of its parts (part, 7); see model/body/placement.py.
type Configuration = Float[Array, "*entries"]
type Index = Int[Array, ""]
