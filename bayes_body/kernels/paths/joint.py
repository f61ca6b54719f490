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
lies too far from the limit, by one to three of its standard deviations, and the velocity is too near to 0.

The ratio of the exact density to the Gaussian is known at every path. In a window of frames it gives importance weights, whose Pareto k says whether
the Gaussian is good enough for these frames. It sees outliers and bent likelihoods. It may not see stickiness, which is small in a frame and adds up
over many.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpyro.distributions import Distribution, Independent

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.expansion import expand, without_negative
from bayes_body.density.factor import Particles, State, Transition, nothing_carried, nothing_derived
from bayes_body.density.frames import Frames, Own
from bayes_body.density.gaussian_view import joined, split
from bayes_body.kernels.batching import one_device, over_particles

# The search ends when a step promises less than this, nats.
TOLERANCE = 0.05
MOST_STEPS = 30
# A step may lower the log-density by this much, nats: the rounding of a sum over all frames in float32.
ROUNDING = 0.05
# Factors of the damping after a step that is taken and after one that is refused, the least damping after the latter, and the damping that is none.
EASED, RAISED, LEAST, NONE = 0.1, 10.0, 1e-3, 1e-6
# Share of a new site in its update. Frames near a limit move together, and full updates overshoot: they go back and forth and never settle.
SITE_SHARE = 0.65
# Limits further away than this many standard deviations have no site.
NEAR = 5.0
# A limit further away than this many standard deviations has no effect on the inner side; on the outer, the tail beyond it is exponential: float32.
FARTHEST = 8.0
# The precision of a marginal without its own site is at least this share of its precision with it.
LEAST_CAVITY = 1e-2
# Frames in a batch, and paths in a batch.
FRAMES, PATHS = 10, 4
# A coordinate at which a limited entry is at its limit, in any unit.
BEYOND = 1e6


class FirstFrame(NamedTuple):
    """The prior of the first frame: a Gaussian over its entries.

    Attributes:
        mean: its mean.
        precision: the inverse of its covariance.
    """

    mean: Float[Array, " entry"]
    precision: Float[Array, "entry entry"]


class Links(NamedTuple):
    """The transitions near a path, one for each pair of neighbouring frames.

    Attributes:
        value: their log-densities.
        by_previous: their gradients by the earlier frame.
        by_current: their gradients by the later frame.
        blocks: for each entry, minus the second derivatives by its value and its centre.
        slope: F, the derivative of the centres by the earlier frame.
    """

    value: Float[Array, " link"]
    by_previous: Float[Array, "link entry"]
    by_current: Float[Array, "link entry"]
    blocks: Float[Array, "link entry 2 2"]
    slope: Float[Array, "link entry entry"]


class Terms(NamedTuple):
    """All terms near a path.

    Attributes:
        value: the log-potentials of each frame's factors.
        gradient: their gradients; 0 for entries that they do not read.
        precision: their precisions; likewise.
        links: the transitions.
    """

    value: Float[Array, " frame"]
    gradient: Float[Array, "frame entry"]
    precision: Float[Array, "frame entry entry"]
    links: Links


class Sites(NamedTuple):
    """The Gaussian sites of the limits, about the path: `slope · d - precision · d² / 2` for an entry at a distance d from it."""

    slope: Float[Array, "frame entry"]
    precision: Float[Array, "frame entry"]

    def value(self, moved: Float[Array, "*draw frame entry"]) -> Float[Array, "*draw frame"]:
        """Return the sum over the entries at these distances from the path."""
        return jnp.sum(self.slope * moved - 0.5 * self.precision * moved**2, axis=-1)

    def recentred(self, moved: Float[Array, "frame entry"]) -> "Sites":
        """Return the same sites about a path at these distances."""
        return Sites(self.slope - self.precision * moved, self.precision)


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

    def covariances(self) -> Float[Array, "frame entry entry"]:
        """Return the marginal covariance of each frame."""
        return _covariances(self.roots, self.couplings)

    def draw(self, key: Key, count: int) -> Float[Array, "draw frame entry"]:
        """Return draws of paths, in pairs on both sides of the mean. An entry near a limit may lie beyond it."""
        noise = jax.random.normal(key, ((count + 1) // 2, *self.mean.shape), self.mean.dtype)
        pairs = jnp.concatenate([noise, -noise])[:count]
        return self.mean + jax.lax.map(lambda y: _solve_back(self.roots, self.couplings, y), pairs, batch_size=PATHS)

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


def solve_path(frames: Frames, unlimited: Transition, first: FirstFrame, start: State, most_steps: int = MOST_STEPS) -> JointPath:
    """Return the Gaussian approximation of the joint posterior of all frames.

    Args:
        frames: the frames.
        unlimited: the motion prior without its limits; the motion prior itself if it has none.
        first: the prior of the first frame.
        start: sampled variables (frame, ...), from which the search starts, such as a filter's means. Angles are on neighbouring turns.
        most_steps: largest number of steps.

    Raises:
        InputError: a factor reads the previous frame; the motion prior carries more than the sampled variables of a frame, has coordinates of its
            own, or a distribution without a centre `loc`.
    """
    _check(frames, unlimited, start)
    with one_device():
        return _solved(frames, unlimited, first, dict(start), most_steps)


@partial(jax.jit, static_argnames="most_steps")
def _solved(frames: Frames, unlimited: Transition, first: FirstFrame, start: dict[str, Array], most_steps: int) -> JointPath:
    form = jax.tree.map(lambda leaf: leaf[0], start)
    path, dtype = jax.vmap(joined)(start), first.mean.dtype
    low, high = limits(frames.transition, form)
    terms_at = partial(_terms, frames, unlimited, form)
    no_sites = Sites(jnp.zeros_like(path), jnp.zeros_like(path))

    def step(search: _Search) -> _Search:
        next_terms = terms_at(search.path + search.move)
        gain = _gain(search, next_terms, first)
        # False for NaN, too.
        is_better = (gain >= -ROUNDING) | (search.steps < 0)
        taken = (search.path + search.move, next_terms, search.next_sites)
        path, terms, sites = jax.tree.map(lambda new, old: jnp.where(is_better, new, old), taken, search[:3])
        eased = jnp.where(search.damping > NONE, EASED * search.damping, 0.0)
        damping = jnp.where(is_better, eased, jnp.maximum(RAISED * search.damping, LEAST))
        gradient, diagonal, below = _assembled(path, terms, sites, first)
        roots, couplings, y = _eliminated(diagonal * (1 + damping * jnp.eye(path.shape[1], dtype=dtype)), below, gradient)
        move = _solve_back(roots, couplings, y)
        variances = jnp.diagonal(_covariances(roots, couplings), axis1=1, axis2=2)
        next_sites = _updated(sites, move, variances, low - path, high - path).recentred(move)
        promise = jnp.where(is_better, 0.5 * jnp.sum(move * gradient), jnp.inf)
        return _Search(path, terms, sites, move, next_sites, damping, search.steps + 1, promise)

    def is_unfinished(search: _Search) -> Array:
        return (search.steps < most_steps) & ((search.promise > TOLERANCE) | (search.steps < 1))

    no_terms = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(terms_at, path))
    begun = _Search(path, no_terms, no_sites, jnp.zeros_like(path), no_sites, jnp.zeros((), dtype), jnp.full((), -1), jnp.full((), jnp.inf, dtype))
    last = jax.lax.while_loop(is_unfinished, step, begun)
    gradient, diagonal, below = _assembled(last.path, last.terms, last.sites, first)
    roots, couplings, y = _eliminated(diagonal, below, gradient)
    mean = last.path + _solve_back(roots, couplings, y)
    return JointPath(mean, last.path, roots, couplings, last.terms, last.sites, low, high, last.steps, last.promise)


def limits(transition: Transition, state: State) -> tuple[Float[Array, " entry"], Float[Array, " entry"]]:
    """Return the lower and the upper limits of the entries of a state, ∓∞ without one: where its unconstrained coordinates lead."""
    chart = coordinates_after(transition, state)
    low, high = (joined(chart.constrain({name: jnp.full_like(value, end) for name, value in state.items()})) for end in (-BEYOND, BEYOND))
    return jnp.where(low <= -BEYOND, -jnp.inf, low), jnp.where(high >= BEYOND, jnp.inf, high)


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
        exact = jax.vmap(frames.alone)(frames.own, states)
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


# -- terms ----------------------------------------------------------------------------------------------------------------------------------


def _terms(frames: Frames, unlimited: Transition, form: State, path: Float[Array, "frame entry"]) -> Terms:
    read = _read(frames, form)

    def of_frame(item: tuple[Own, Array], frames: Frames) -> tuple[Scalar, Array, Array]:
        frame, row = item

        def state_of(entries: Array) -> State:
            return frames.transition.with_derived(split(row.at[read].set(entries), form))

        value, gradient, precision = expand(frames.density(frame, Particles({}, jnp.zeros(1))), state_of, row[read])
        every = jnp.zeros((*row.shape, *row.shape), row.dtype).at[np.ix_(read, read)].set(precision)
        return value, jnp.zeros_like(row).at[read].set(gradient), every

    of_frames = over_particles(of_frame, (frames.own, path), frames, FRAMES)
    links = over_particles(lambda rows, transition: _link(transition, form, *rows), (path[:-1], path[1:]), unlimited, FRAMES)
    value, gradient, precision = of_frames
    return Terms(value, gradient, precision, links)


def _read(frames: Frames, form: State) -> np.ndarray:
    """Return the indices of the entries that factors read. If variables are derived, which may come from any of them, these are all."""
    scope = {variable.name for factor in frames.factors for variable in factor.scope}
    derives = getattr(frames.transition.derive, "func", frames.transition.derive) is not nothing_derived
    return np.flatnonzero(np.concatenate([np.full(form[name].shape[0], derives or name in scope) for name in sorted(form)]))


def _link(transition: Transition, form: State, previous: Float[Array, " entry"], current: Float[Array, " entry"]) -> Links:
    """Return one transition near a pair of frames. All derivatives are those of its distributions' own `log_prob`."""
    value, (by_previous, by_current) = jax.value_and_grad(
        lambda previous, current: transition.log_density(split(current, form), split(previous, form)), argnums=(0, 1)
    )(previous, current)
    distributions = transition.conditional(split(previous, form))

    def about(values: Array, centres: Array) -> Scalar:
        a, b = split(values, form), split(centres, form)
        return sum((jnp.asarray(_centred(d, b[name]).log_prob(a[name])) for name, d in distributions.items()), jnp.zeros(()))

    def centres(previous: Array) -> Array:
        return joined({name: _base(d).loc for name, d in transition.conditional(split(previous, form)).items()})

    # Entries are independent: one direction for values and one for centres give the second derivatives of all.
    ones, zeros = jnp.ones_like(current), jnp.zeros_like(current)
    point = (current, centres(previous))
    columns = [jnp.stack(jax.jvp(jax.grad(about, argnums=(0, 1)), point, direction)[1], axis=-1) for direction in ((ones, zeros), (zeros, ones))]
    return Links(value, by_previous, by_current, without_negative(-jnp.stack(columns, axis=-1)), jax.jacfwd(centres)(previous))


def _base(distribution: Distribution) -> Any:
    return distribution.base_dist if isinstance(distribution, Independent) else distribution


def _centred(distribution: Distribution, centre: Array) -> Distribution:
    """Return the distribution with another centre."""
    loc = _base(distribution).loc
    leaves, form = jax.tree.flatten(distribution)
    return jax.tree.unflatten(form, [centre if leaf is loc else leaf for leaf in leaves])


def _gain(search: _Search, next_terms: Terms, first: FirstFrame) -> Scalar:
    """Return how much larger the log-density is after the move. Differences come before sums, which are large."""
    frames, links = next_terms.value - search.terms.value, next_terms.links.value - search.terms.links.value
    d, move = search.path[0] - first.mean, search.move[0]
    prior = -(d + 0.5 * move) @ first.precision @ move
    return jnp.sum(frames) + jnp.sum(links) + prior + jnp.sum(search.sites.value(search.move))


def _assembled(path: Array, terms: Terms, sites: Sites, first: FirstFrame) -> tuple[Array, Array, Array]:
    """Return the gradient, and the blocks D and O of the precision; the first O is 0."""
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
    back = jnp.einsum("tki,tk,tkj->tij", links.slope, links.blocks[..., 1, 1], links.slope)
    diagonal = terms.precision.at[:, every, every].add(sites.precision).at[1:, every, every].add(links.blocks[..., 0, 0])
    diagonal = diagonal.at[:-1].add(back).at[0].add(first.precision)
    below = jnp.zeros_like(diagonal).at[1:].set(links.blocks[..., 0, 1, None] * links.slope)
    return gradient, diagonal, below


# -- block elimination ------------------------------------------------------------------------------------------------------------------------


def _triangular(root: Array, right: Array, transposed: bool = False) -> Array:
    return jax.scipy.linalg.solve_triangular(root, right, lower=True, trans=int(transposed))


def _eliminated(diagonal: Array, below: Array, gradient: Array) -> tuple[Array, Array, Array]:
    """Return the roots L, the couplings W, and the reduced right side y, by elimination from the first frame to the last."""

    def eliminate(eliminated: tuple[Array, Array], frame: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (root, y), (block, link, slope) = eliminated, frame
        coupling = _triangular(root, link.T)
        root = jnp.linalg.cholesky(block - coupling.T @ coupling)
        y = _triangular(root, slope - coupling.T @ y)
        return (root, y), (root, coupling, y)

    begun = (jnp.eye(gradient.shape[1], dtype=gradient.dtype), jnp.zeros_like(gradient[0]))
    return jax.lax.scan(eliminate, begun, (diagonal, below, gradient))[1]


def _from_next(couplings: Array) -> Array:
    """Return for each frame its coupling with the next one."""
    return jnp.concatenate([couplings[1:], jnp.zeros_like(couplings[:1])])


def _solve_back(roots: Array, couplings: Array, y: Array) -> Array:
    """Solve the upper half of the elimination: for the reduced right side the step, for standard normal numbers a draw about 0."""

    def substitute(following: Array, frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        root, coupling, right = frame
        x = _triangular(root, right - coupling @ following, transposed=True)
        return x, x

    return jax.lax.scan(substitute, jnp.zeros_like(y[0]), (roots, _from_next(couplings), y), reverse=True)[1]


@jax.jit
def _covariances(roots: Array, couplings: Array) -> Array:
    identity = jnp.eye(roots.shape[1], dtype=roots.dtype)

    def substitute(following: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        root, coupling = frame
        inverse = _triangular(root, identity)
        gain = inverse.T @ coupling
        covariance = inverse.T @ inverse + gain @ following @ gain.T
        return covariance, covariance

    return jax.lax.scan(substitute, jnp.zeros_like(roots[0]), (roots, _from_next(couplings)), reverse=True)[1]


# -- limits -----------------------------------------------------------------------------------------------------------------------------------


def _updated(sites: Sites, move: Array, variances: Array, low: Array, high: Array) -> Sites:
    """Return the sites about the path after one update. All arguments are (frame, entry), and relative to the path.

    Args:
        sites: the sites.
        move: the mean of the Gaussian.
        variances: its marginal variances.
        low: the lower limits.
        high: the upper limits.
    """
    precision = jnp.maximum(1 / variances - sites.precision, LEAST_CAVITY / variances)
    mean = (move / variances - sites.slope) / precision
    shift, share = _truncated_moments((low - mean) * jnp.sqrt(precision), (high - mean) * jnp.sqrt(precision))
    matched = precision / share
    is_near = jnp.minimum(mean - low, high - mean) * jnp.sqrt(precision) < NEAR
    slope = jnp.where(is_near, matched * (mean + shift / jnp.sqrt(precision)) - precision * mean, 0.0)
    strength = jnp.where(is_near, jnp.maximum(matched - precision, 0.0), 0.0)
    return Sites(sites.slope + SITE_SHARE * (slope - sites.slope), sites.precision + SITE_SHARE * (strength - sites.precision))


def _truncated_moments(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the mean and the variance of a standard normal number between two limits."""
    has_low, has_high, outside = low > -FARTHEST, high < FARTHEST, jnp.maximum(low, -high)
    tail = jnp.maximum(outside, 1.0)
    # A tail beyond z has about the mean z + 1 / z and the variance 1 / z².
    far_mean, far_variance = jnp.where(low > -high, 1.0, -1.0) * (tail + 1 / tail), 1 / tail**2
    low, high = jnp.clip(low, -FARTHEST, FARTHEST), jnp.clip(high, -FARTHEST, FARTHEST)
    cdf, pdf = jax.scipy.stats.norm.cdf, jax.scipy.stats.norm.pdf
    # In the upper tail the difference of the complements keeps its digits.
    mass = jnp.where(low > 0, cdf(-low) - cdf(-high), cdf(high) - cdf(low))
    mass = jnp.maximum(mass, jnp.finfo(mass.dtype).tiny)
    at_low, at_high = jnp.where(has_low, pdf(low), 0.0) / mass, jnp.where(has_high, pdf(high), 0.0) / mass
    mean = at_low - at_high
    # What rounding leaves of the difference is never less than the variance of an exponential tail nearly is.
    variance = jnp.maximum(1 + low * at_low - high * at_high - mean**2, 1 / (3 + jnp.maximum(outside, 0.0) ** 2))
    is_far = outside >= FARTHEST
    return jnp.where(is_far, far_mean, mean), jnp.where(is_far, far_variance, variance)


def _check(frames: Frames, unlimited: Transition, start: State) -> None:
    needed_by, remedy = "the joint posterior of all frames", "smooth by paths"
    transition = frames.transition
    if frames.linked:
        name = next(factor.name for factor in frames.factors if factor.reads_previous)
        raise input_error(needed_by, f"'{name}' compares a frame with the frame before", "a model whose terms read one frame", remedy)
    if getattr(transition.carry, "func", transition.carry) is not nothing_carried:
        problem = f"the dynamics '{transition.name}' carry more along than the sampled variables of one frame"
        raise input_error(needed_by, problem, "dynamics that depend on the pose of the frame before alone", remedy)
    state = jax.tree.map(lambda leaf: leaf[0], dict(start))
    has_centres = all(hasattr(_base(distribution), "loc") for distribution in unlimited.conditional(state).values())
    if transition.chart is not None or not has_centres or any(value.ndim != 1 for value in state.values()):
        problem = f"the dynamics '{transition.name}' are no walk of independent numbers about a centre"
        raise input_error(needed_by, problem, "dynamics such as constant_velocity or diffusion", remedy)
