r"""Block elimination of a path's block-tridiagonal precision, by loops over the frames.

A frame has the precision $M_t$ of its own. A transition adds $p a^2 - 2 q a b + r b^2$ for each entry, with the value a of the entry and its centre
$b = F x_{t-1}$. The blocks of the precision are $D_t = M_t + \operatorname{diag}(p) + F^T \operatorname{diag}(r) F$ on the diagonal, with r and F of
the next transition, and $O_t = -\operatorname{diag}(q) F$ below it. The first frames are eliminated first:

$$L_t L_t^T = J_t + F^T \operatorname{diag}(r) F, \qquad W_{t+1} = L_t^{-1} O_{t+1}^T, \qquad
J_{t+1} = M_{t+1} + \operatorname{diag}(p) - W_{t+1}^T W_{t+1}.$$

Of an entry that hardly moves, such as an unknown length, p is a hundred thousand times the information that this difference leaves: single precision
would lose it. So it is computed as the inverse of the prediction's covariance, a sum of two positive terms,

$$\operatorname{diag}(p) - W^T W = \big(\operatorname{diag}(1/p) + \kappa F K^{-1} F^T \kappa\big)^{-1}, \qquad
K = J_t + F^T \operatorname{diag}(r - q^2 / p)\, F, \quad \kappa = \operatorname{diag}(q / p),$$

where $r - q^2 / p$ is 0 for a normal transition.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# What the centre knows besides its value, $r - q^2/p$, is rounding if it is less than so many units in the last place of r.
ROUNDED = 16
# The least p: of an entry without a density about its centre, any value will do.
LEAST = 1e-20


class Couplings(NamedTuple):
    """The transitions between frames.

    Attributes:
        blocks: for each entry, the precision of its value and its centre: [[p, -q], [-q, r]].
        slope: F, the derivative of the centres by the earlier frame.
    """

    blocks: Float[Array, "link entry 2 2"]
    slope: Float[Array, "link entry entry"]


def solve_triangular(root: Array, right: Array, transposed: bool = False) -> Array:
    """Return the solution for a lower triangular root, or for its transpose."""
    return jax.scipy.linalg.solve_triangular(root, right, lower=True, trans=int(transposed))


def eliminated(precision: Array, transitions: Couplings, gradient: Array) -> tuple[Array, Array, Array]:
    """Return the roots L, the couplings W, and the reduced right side y, by elimination from the first frame to the last.

    Args:
        precision: M of each frame; that of the first one includes its prior.
        transitions: from each frame to the next.
        gradient: of each frame.
    """

    def eliminate(entering: tuple[Array, Array], frame: tuple[Array, Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (predicted, reduced), (block, slope, by_frame, information) = entering, frame
        p, q, r = block[:, 0, 0], -block[:, 0, 1], block[:, 1, 1]
        information, right = information + predicted, by_frame - reduced
        root = jnp.linalg.cholesky(information + slope.T @ (r[:, None] * slope))
        coupling = solve_triangular(root, -(q[:, None] * slope).T)
        y = solve_triangular(root, right)
        return (_predicted(information, p, q, r, slope), coupling.T @ y), (root, coupling, y)

    # The last frame has no next one.
    blocks = jnp.concatenate([transitions.blocks, jnp.zeros_like(transitions.blocks, shape=(1, *transitions.blocks.shape[1:]))])
    slopes = jnp.concatenate([transitions.slope, jnp.zeros_like(precision[:1])])
    begun = (jnp.zeros_like(precision[0]), jnp.zeros_like(gradient[0]))
    roots, couplings, y = jax.lax.scan(eliminate, begun, (blocks, slopes, gradient, precision))[1]
    return roots, jnp.concatenate([jnp.zeros_like(couplings[:1]), couplings[:-1]]), y


def _predicted(information: Array, p: Array, q: Array, r: Array, slope: Array) -> Array:
    """Return the information about the next frame, without its own."""
    p = jnp.maximum(p, LEAST)
    remainder = r - q * q / p
    remainder = jnp.where(remainder > ROUNDED * jnp.finfo(r.dtype).eps * r, remainder, 0.0)
    root = jnp.linalg.cholesky(information + slope.T @ (remainder[:, None] * slope))
    centres = solve_triangular(root, ((q / p)[:, None] * slope).T)
    covariance = centres.T @ centres + jnp.diag(1 / p)
    inverse = solve_triangular(jnp.linalg.cholesky(covariance), jnp.eye(p.shape[0], dtype=p.dtype))
    return inverse.T @ inverse


def _from_next(couplings: Array) -> Array:
    """Return for each frame its coupling with the next one."""
    return jnp.concatenate([couplings[1:], jnp.zeros_like(couplings[:1])])


def solve_back(roots: Array, couplings: Array, y: Array) -> Array:
    """Solve the upper half of the elimination: for the reduced right side the step, for standard normal numbers a draw about 0."""

    def substitute(following: Array, frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        root, coupling, right = frame
        x = solve_triangular(root, right - coupling @ following, transposed=True)
        return x, x

    return jax.lax.scan(substitute, jnp.zeros_like(y[0]), (roots, _from_next(couplings), y), reverse=True)[1]


@jax.jit
def marginal_covariances(roots: Array, couplings: Array) -> Array:
    """Return the marginal covariance of each frame, (frame, entry, entry)."""
    identity = jnp.eye(roots.shape[1], dtype=roots.dtype)

    def substitute(following: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        root, coupling = frame
        inverse = solve_triangular(root, identity)
        gain = inverse.T @ coupling
        covariance = inverse.T @ inverse + gain @ following @ gain.T
        return covariance, covariance

    return jax.lax.scan(substitute, jnp.zeros_like(roots[0]), (roots, _from_next(couplings)), reverse=True)[1]
