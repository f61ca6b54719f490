r"""Block elimination of a block-tridiagonal precision, by loops over the frames.

With blocks $D_t$ on the diagonal and $O_t$ below it, $L_t L_t^T = D_t - W_t^T W_t$ and $W_t = L_{t-1}^{-1} O_t^T$.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array


def solve_triangular(root: Array, right: Array, transposed: bool = False) -> Array:
    """Return the solution for a lower triangular root, or for its transpose."""
    return jax.scipy.linalg.solve_triangular(root, right, lower=True, trans=int(transposed))


def eliminated(diagonal: Array, below: Array, gradient: Array) -> tuple[Array, Array, Array]:
    """Return the roots L, the couplings W, and the reduced right side y, by elimination from the first frame to the last."""

    def eliminate(eliminated: tuple[Array, Array], frame: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (root, y), (block, link, slope) = eliminated, frame
        coupling = solve_triangular(root, link.T)
        root = jnp.linalg.cholesky(block - coupling.T @ coupling)
        y = solve_triangular(root, slope - coupling.T @ y)
        return (root, y), (root, coupling, y)

    begun = (jnp.eye(gradient.shape[1], dtype=gradient.dtype), jnp.zeros_like(gradient[0]))
    return jax.lax.scan(eliminate, begun, (diagonal, below, gradient))[1]


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
