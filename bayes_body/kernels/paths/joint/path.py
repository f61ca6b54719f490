r"""The joint posterior of all frames of a recording as one Gaussian, by Gauss-Newton steps on a block-tridiagonal precision.

A path is x = (x_1, ..., x_T), where $x_t$ holds all sampled variables of frame t in their own units. Its log-density is

$$\log p(x) = \log p(x_1) + \sum_t \ell_t(x_t) + \sum_t \sum_k \log p_k(a_{tk} \mid b_{tk}) + \sum_t \log 1[\mathrm{low} \le x_t \le \mathrm{high}],$$

with the value $a_t = x_t$ and the centre $b_t = b(x_{t-1})$ of each entry k of a transition. With $F = \partial b / \partial x_{t-1}$ and minus the
second derivatives $H_{aa}, H_{ab}, H_{bb}$ of an entry's log-density, without negative eigenvalues, and the precision $M_t$ of a frame's factors
(density/expansion.py), the precision of the path has the blocks

$$D_t = M_t + \operatorname{diag} H_{aa} + F^T \operatorname{diag}(H_{bb}) F, \qquad O_t = \operatorname{diag}(H_{ab}) F, \qquad
L_t L_t^T = D_t - W_t^T W_t, \quad W_t = L_{t-1}^{-1} O_t^T.$$

Limits are no part of a Gaussian. A truncated walk near its limit is neither smooth nor concave, so that a search that meets the limit itself takes
many steps. Here transitions go on beyond limits, and each limit is an approximate factor of expectation propagation instead (Minka 2001): a
Gaussian site that gives an entry the moments of its truncated marginal (Cunningham, Hennig & Lacoste-Julien 2011). All sites are updated after each
step. The result then is nearer to the mean of the posterior than to its mode, where the mode lies on a limit.

So paths stay inside the limits because they must, and not because a walk stops there. The normaliser of each truncated step, and a prediction that
counts as the limit, have no site. Both draw a path to a limit that it touches for many frames: a truncated walk is sticky there. The Gaussian then
lies too far from the limit, by one to three of its standard deviations.

The ratio of the exact density to the Gaussian is known at every path. In a window of frames it gives importance weights, whose Pareto k says whether
the Gaussian is good enough for these frames. It sees outliers and bent likelihoods. It may not see stickiness, which is small in a frame and adds up
over many.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.factor import Factor, State, Transition, nothing_carried
from bayes_body.density.frames import Frames
from bayes_body.density.gaussian_view import joined, split
from bayes_body.kernels.batching import on_first_device, one_device, over_particles
from bayes_body.kernels.paths.joint.elimination import Couplings, eliminated, marginal_covariances, solve_back
from bayes_body.kernels.paths.joint.limits import Sites, limits, updated
from bayes_body.kernels.paths.joint.terms import Terms, base_of, terms_near

# The search ends when a step promises less than this, nats.
TOLERANCE = 0.05
MOST_STEPS = 30
# A step may lower the log-density by this much, nats: the rounding of a sum over all frames in float32.
ROUNDING = 0.05
# Factors of the damping after a step that is taken and after one that is refused, the least damping after the latter, and the damping that is none.
EASED, RAISED, LEAST, NONE = 0.1, 10.0, 1e-3, 1e-6
# Paths in a batch.
PATHS = 4


class FirstFrame(NamedTuple):
    """The prior of the first frame: a Gaussian over its entries.

    Attributes:
        mean: its mean.
        precision: the inverse of its covariance.
    """

    mean: Float[Array, " entry"]
    precision: Float[Array, "entry entry"]


class JointPath(NamedTuple):
    """The Gaussian approximation of the joint posterior.

    Attributes:
        mean: the mean path. Entries are those of the sampled variables, in the order of their names.
        point: the path about which the terms and sites are, one small step before the mean.
        roots: $L_t$.
        couplings: $W_t$; the first one is 0.
        terms: the terms near this path.
        sites: the sites of the limits.
        low: lower limits, or -∞.
        high: upper limits, or ∞.
        steps: number of steps of the search.
        promise: what the next step would have gained, nats; larger than `TOLERANCE` if the search did not end.
    """

    mean: Float[Array, "frame entry"]
    point: Float[Array, "frame entry"]
    roots: Float[Array, "frame entry entry"]
    couplings: Float[Array, "frame entry entry"]
    terms: Terms
    sites: Sites
    low: Float[Array, " entry"]
    high: Float[Array, " entry"]
    steps: Int[Array, ""]
    promise: Scalar

    @property
    def converged(self) -> bool:
        """Whether the search ended before its largest number of steps."""
        return float(self.promise) <= TOLERANCE

    def covariances(self) -> Float[Array, "frame entry entry"]:
        """Return the marginal covariance of each frame."""
        return marginal_covariances(self.roots, self.couplings)

    def draw(self, key: Key, count: int) -> Float[Array, "draw frame entry"]:
        """Return draws of paths, in pairs on both sides of the mean. An entry near a limit may lie beyond it."""
        noise = jax.random.normal(key, ((count + 1) // 2, *self.mean.shape), self.mean.dtype)
        # Side by side, so that halves of the draws, which R-hat compares, have the same mean.
        pairs = jnp.stack([noise, -noise], axis=1).reshape(-1, *self.mean.shape)[:count]
        return self.mean + jax.lax.map(lambda y: solve_back(self.roots, self.couplings, y), pairs, batch_size=PATHS)

    def inside(self, paths: Float[Array, "*draw frame entry"]) -> Float[Array, "*draw frame entry"]:
        """Return paths whose entries beyond a limit are at it, as a motion prior takes a prediction beyond a limit."""
        return jnp.clip(paths, self.low, self.high)


class _Search(NamedTuple):
    """The state of a search: the best path, its terms and sites; the next path, and the sites there if it is better."""

    path: Array
    terms: Terms
    sites: Sites
    move: Array
    next_sites: Sites
    damping: Scalar
    steps: Array
    promise: Scalar


class _Fixed(NamedTuple):
    """What a search does not change: the arguments of `solve_path`, the state of a frame for its shapes, and the limits of its entries."""

    frames: Frames
    unlimited: Transition
    first: FirstFrame
    form: State
    low: Array
    high: Array


def solve_path(
    frames: Frames,
    unlimited: Transition,
    first: FirstFrame,
    start: State,
    most_steps: int = MOST_STEPS,
    on_step: Callable[[int, float], None] | None = None,
) -> JointPath:
    """Return the Gaussian approximation of the joint posterior of all frames.

    Args:
        frames: the frames.
        unlimited: the motion prior without its limits; the motion prior itself if it has none.
        first: the prior of the first frame.
        start: sampled variables (frame, ...), from which the search starts, such as a filter's means. Angles are on neighbouring turns.
        most_steps: largest number of steps.
        on_step: called after each step with its number and with what the next one promises, nats.

    Raises:
        InputError: there is no such Gaussian (`check_path`).
    """
    form = jax.tree.map(lambda leaf: leaf[0], dict(start))
    check_path(frames.transition, frames.factors, unlimited, form)
    with one_device():
        low, high = limits(frames.transition, form)
        fixed, path = on_first_device((_Fixed(frames, unlimited, first, form, low, high), jax.vmap(joined)(dict(start))))
        search = _begun(fixed, path)
        while (search.steps < most_steps) & ((search.promise > TOLERANCE) | (search.steps < 1)):
            search = _stepped(fixed, search)
            if on_step is not None:
                on_step(int(search.steps), float(search.promise))
        return _ended(fixed, search)


def _begun(fixed: _Fixed, path: Array) -> _Search:
    """Return the search before its first step, which knows no terms yet."""
    no_terms = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(_terms, fixed, path))
    no_sites, zero = Sites(jnp.zeros_like(path), jnp.zeros_like(path)), jnp.zeros((), path.dtype)
    begun = _Search(path, no_terms, no_sites, jnp.zeros_like(path), no_sites, zero, jnp.full((), -1, jnp.int32), jnp.full_like(zero, jnp.inf))
    # Placed as the program's results are: it is compiled once.
    return on_first_device(begun)


def _terms(fixed: _Fixed, path: Array) -> Terms:
    return terms_near(fixed.frames, fixed.unlimited, fixed.form, path)


@jax.jit
def _stepped(fixed: _Fixed, search: _Search) -> _Search:
    """Return the search after one more step: the move before it is taken or refused, and the next one is made."""
    first = fixed.first
    next_terms = _terms(fixed, search.path + search.move)
    gain = _gain(search, next_terms, first)
    # False for NaN, too.
    is_better = (gain >= -ROUNDING) | (search.steps < 0)
    taken = (search.path + search.move, next_terms, search.next_sites)
    path, terms, sites = jax.tree.map(lambda new, old: jnp.where(is_better, new, old), taken, search[:3])
    eased = jnp.where(search.damping > NONE, EASED * search.damping, 0.0)
    damping = jnp.where(is_better, eased, jnp.maximum(RAISED * search.damping, LEAST))
    roots, couplings, y, gradient = _eliminated(path, terms, sites, first, damping)
    move = solve_back(roots, couplings, y)
    variances = jnp.diagonal(marginal_covariances(roots, couplings), axis1=1, axis2=2)
    next_sites = updated(sites, move, variances, fixed.low - path, fixed.high - path).recentred(move)
    promise = jnp.where(is_better, 0.5 * jnp.sum(move * gradient), jnp.inf)
    return _Search(path, terms, sites, move, next_sites, damping, search.steps + 1, promise)


@jax.jit
def _ended(fixed: _Fixed, search: _Search) -> JointPath:
    """Return the Gaussian about the best path, without damping."""
    roots, couplings, y, _ = _eliminated(search.path, search.terms, search.sites, fixed.first)
    mean = search.path + solve_back(roots, couplings, y)
    about = (search.path, roots, couplings, search.terms, search.sites)
    return JointPath(mean, *about, fixed.low, fixed.high, search.steps, search.promise)


@jax.jit
def log_ratios(
    frames: Frames, joint: JointPath, paths: Float[Array, "draw frame entry"], start: State
) -> tuple[Float[Array, "draw frame"], Float[Array, "draw frame"]]:
    """Return the log of the ratio of each exact term to its Gaussian, up to a constant: of each frame, and of the transition into it.

    Args:
        frames: the frames.
        joint: their approximation.
        paths: draws of it, as they are, also beyond limits, where the exact density is 0.
        start: sampled variables (frame, ...), for the shapes.
    """
    form = jax.tree.map(lambda leaf: leaf[0], dict(start))

    def of_path(path: Array, shared: tuple[Frames, JointPath]) -> tuple[Array, Array]:
        frames, joint = shared
        terms, links = joint.terms, joint.terms.links
        d = path - joint.point
        states = jax.vmap(lambda row: frames.transition.with_derived(split(row, form)))(path)
        exact = jax.vmap(frames.log_single_frame)(frames.inputs, states)
        quadratic = terms.value + jnp.sum(terms.gradient * d, axis=1) - 0.5 * jnp.einsum("ti,tij,tj->t", d, terms.precision, d)
        previous, current = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], states) for cut in (slice(-1), slice(1, None)))
        linked = jax.vmap(frames.transition.log_density)(current, previous)
        ab = jnp.stack([d[1:], jnp.einsum("tij,tj->ti", links.slope, d[:-1])], axis=-1)
        bent = jnp.einsum("tki,tkij,tkj->t", ab, links.blocks, ab)
        straight = links.value + jnp.sum(links.by_previous * d[:-1], axis=1) + jnp.sum(links.by_current * d[1:], axis=1)
        into = jnp.concatenate([jnp.zeros(1, path.dtype), linked - straight + 0.5 * bent])
        # The first frame has no transition that would say so.
        is_inside = jnp.all((path >= joint.low) & (path <= joint.high), axis=1)
        return jnp.where(is_inside, exact - quadratic - joint.sites.value(d), -jnp.inf), into

    with one_device():
        return over_particles(of_path, paths, (frames, joint), PATHS)


def window_log_weights(of_frames: Float[Array, "draw frame"], of_links: Float[Array, "draw frame"], half_width: int) -> Float[Array, "draw frame"]:
    """Return log-weights of paths for the window about each frame, up to a constant.

    They belong to the density whose terms are exact in the window, its transitions from the frame before it and to the frame after it included, and
    Gaussian elsewhere.

    Args:
        of_frames: the ratios of frames, of `log_ratios`.
        of_links: those of the transitions.
        half_width: number of frames of the window on both sides of its middle.
    """
    count = of_frames.shape[1]
    frames = jnp.arange(count)

    def shifted(values: Array, by: int) -> Array:
        is_known = (frames + by >= 0) & (frames + by < count)
        return jnp.where(is_known, values[:, jnp.clip(frames + by, 0, count - 1)], 0.0)

    terms = [shifted(of_frames, by) for by in range(-half_width, half_width + 1)]
    return sum([shifted(of_links, by) for by in range(-half_width, half_width + 2)], sum(terms, jnp.zeros_like(of_frames)))


def _gain(search: _Search, next_terms: Terms, first: FirstFrame) -> Scalar:
    """Return how much larger the log-density is after the move. Differences come before sums, which are large."""
    frames, links = next_terms.value - search.terms.value, next_terms.links.value - search.terms.links.value
    d, move = search.path[0] - first.mean, search.move[0]
    prior = -(d + 0.5 * move) @ first.precision @ move
    return jnp.sum(frames) + jnp.sum(links) + prior + jnp.sum(search.sites.value(search.move))


def _eliminated(path: Array, terms: Terms, sites: Sites, first: FirstFrame, damping: Scalar | float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Return the roots, the couplings and the reduced right side of the path's precision, and its gradient.

    `damping` is a share of the diagonal blocks' diagonals, and is added to them.
    """
    links, every = terms.links, jnp.arange(path.shape[1])
    gradient = (
        (terms.gradient + sites.slope)
        .at[1:]
        .add(links.by_current)
        .at[:-1]
        .add(links.by_previous)
        .at[0]
        .add(-first.precision @ (path[0] - first.mean))
    )
    precision = terms.precision.at[:, every, every].add(sites.precision).at[0].add(first.precision)
    by_centres = jnp.sum(links.slope**2 * links.blocks[..., 1, 1, None], axis=1)
    diagonal = jnp.diagonal(precision, axis1=1, axis2=2).at[1:].add(links.blocks[..., 0, 0]).at[:-1].add(by_centres)
    precision = precision.at[:, every, every].add(damping * diagonal)
    return *eliminated(precision, Couplings(links.blocks, links.slope), gradient), gradient


def check_path(transition: Transition, factors: Sequence[Factor], unlimited: Transition, form: State) -> None:
    """Check that a model's paths have a Gaussian approximation.

    Args:
        transition: the motion prior.
        factors: the other terms of a frame.
        unlimited: the motion prior without its limits.
        form: the sampled variables of a frame.

    Raises:
        InputError: a factor reads the previous frame; the motion prior carries more than the sampled variables of a frame, has coordinates of its
            own, or a distribution without a centre `loc`.
    """
    needed_by, remedy = "the joint posterior of all frames", "smooth by paths, such as --start ensemble"
    reading = [factor.name for factor in factors if factor.reads_previous]
    if reading:
        raise input_error(needed_by, f"'{reading[0]}' compares a frame with the frame before", "a model whose terms read one frame", remedy)
    if getattr(transition.carry, "func", transition.carry) is not nothing_carried:
        problem = f"the dynamics '{transition.name}' carry more along than the sampled variables of one frame"
        raise input_error(needed_by, problem, "dynamics that depend on the pose of the frame before alone", remedy)
    has_centres = all(hasattr(base_of(distribution), "loc") for distribution in unlimited.conditional(form).values())
    if transition.chart is not None or not has_centres or any(value.ndim != 1 for value in form.values()):
        problem = f"the dynamics '{transition.name}' are no walk of independent numbers about a centre"
        raise input_error(needed_by, problem, "dynamics such as constant_velocity or diffusion", remedy)
