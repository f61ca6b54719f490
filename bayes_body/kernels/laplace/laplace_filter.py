r"""A filter for smooth likelihoods: a Gaussian about the mode of each frame's posterior, corrected by importance weights and slopes.

The prediction is one Gaussian (density/gaussian_view.py). In its whitened coordinates the log-density of a frame is
$f(z) = -\tfrac12 |z|^2 + \log C + \log \psi + \log L$. A frame takes four steps:

1. the mode of f and the precision A there (laplace/mode.py);
2. draws of $q = \mathcal N(z^*, A^{-1})$, in pairs whose covariance is exact (laplace/proposal.py);
3. weights $w = e^{f} / q$. Their mean is the evidence $\hat p(z_t \mid z_{1:t-1})$. It contains the share of the prediction that constraints exclude;
4. moments corrected by the slopes $\nabla f$ (smc/moment_correction.py). Otherwise dofs that the images hardly determine lose variance in each frame.

The weights say when the Gaussian is not good enough: by Pareto k and the effective sample size. Then the frame is done again. The second attempt
searches modes from several starts: the mean and draws of the prediction. Its proposal is the mixture of the Gaussians at all modes, with a share of
the prediction itself. If that fails too, the frame is sampled by tempered SMC (laplace/fallback.py).

The weights of a single mode do not see another one. With two cameras or more there is hardly ever another. With one camera a limb may flip towards
the camera or away from it, while all figures look good: then take the kernel `tempered`.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.registry import FewCameras, register
from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, Positive, ProperShare, Schema
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.gaussian_view import GaussianView, gaussian_view
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo, Kernel, KernelWithFallback
from bayes_body.kernels.batching import one_device, over_particles
from bayes_body.kernels.laplace.fallback import TEMPERED, build_fallback
from bayes_body.kernels.laplace.mode import find_mode
from bayes_body.kernels.laplace.pareto import pareto_shape
from bayes_body.kernels.laplace.proposal import COMPETES, draw, numbers, proposal_from
from bayes_body.kernels.smc.moment_correction import corrected_moments, noise_beside, with_moments
from bayes_body.kernels.smc.moves import check_gradients
from bayes_body.kernels.smc.tempering import MOST_IMPOSSIBLE
from bayes_body.kernels.weights import LogWeights, effective_sample_size, normalise


class Options(Schema):
    """Options of `[kernel] kind = "laplace"`.

    A frame in which a few weights dominate (Pareto k above `most_k`, or less than `least_ess` of the draws effective) is done again from
    `more_starts` starts. If that does not help, `fallback` does it.
    """

    particles: Count = 512
    """[particles] per run."""
    starts: Count = 1
    """starting points of the search for modes in every frame: the mean of the prediction, and draws of it."""
    more_starts: Count = 8
    """starting points in a frame that is done again."""
    most_steps: Count = 12
    """largest number of steps of a search."""
    moments: Literal["weights", "slopes"] = "weights"
    """`"weights"`: the draws keep their importance weights, and their moments are corrected by slopes. `"slopes"`: the draws are moved to the moments
    at which their slopes agree with a normal posterior, and count equally; the weights only judge. This is a normal approximation. In many
    dimensions, where weights are noisy, it has a tenth of the random error."""
    most_k: Positive = 0.7
    """largest Pareto k of a frame that is not done again."""
    least_ess: ProperShare = 0.1
    """smallest share of effective draws of such a frame."""
    fallback: Literal["tempered", "none"] = "tempered"
    """what samples a frame if importance sampling fails: `"tempered"`, by stages of Hamiltonian Monte Carlo, or `"none"`."""


class Attempt(NamedTuple):
    """The draws of one frame.

    Attributes:
        number: number of attempts so far.
        draws: whitened coordinates.
        slopes: the gradient of the log-density at each.
        log_weights: normalised.
        log_evidence: log of the mean weight.
        is_lost: whether all weights are zero.
        impossible: share of the draws without density.
        pareto_k: tail shape of the weights.
        modes: number of distinct modes that compete.
        steps: steps of all searches so far.
        evaluations: evaluations of the likelihood so far.
    """

    number: Int[Array, ""]
    draws: Float[Array, "draw dof"]
    slopes: Float[Array, "draw dof"]
    log_weights: LogWeights
    log_evidence: Scalar
    is_lost: Flag
    impossible: Scalar
    pareto_k: Scalar
    modes: Scalar
    steps: Int[Array, ""]
    evaluations: Int[Array, ""]


class Limits(NamedTuple):
    """When a few weights dominate: above this Pareto k, or with a smaller share of effective draws. A k of NaN belongs to nearly equal weights."""

    most_k: float
    least_ess: float

    def exclude(self, attempt: Attempt) -> Flag:
        """Whether a few weights dominate in an attempt."""
        return self._exclude(attempt.is_lost, effective_sample_size(attempt.log_weights), attempt.log_weights.shape[0], attempt.pareto_k)

    def fails(self, info: FilterInfo) -> Any:
        """Whether they do after the last attempt by importance sampling."""
        return self._exclude(info.lost, info.ess, info.ancestors.shape[-1], info.modes["pareto_k"])

    # Of a program's arrays, and of numbers of NumPy on the host.
    def _exclude(self, is_lost: Any, ess: Any, count: int, pareto_k: Any) -> Any:
        return is_lost | (ess < self.least_ess * count) | (pareto_k > self.most_k)


def build_kernel(**options: Any) -> Kernel:
    """Return a kernel that samples one frame. It returns as many particles as it is given.

    Args:
        options: those of `Options`, except `particles`.

    Raises:
        InputError: an option that does not exist or is outside its range.
    """
    checked = validate(Options, options, "laplace()")

    def kernel(key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        check_gradients(density, "the kernel laplace", ", or use --kernel tempered with --set move=random_walk")
        view_key, attempt_key, end_key, _ = jax.random.split(key, 4)
        # Draws are few. Another device would be waited for longer than it computes.
        with one_device():
            view = gaussian_view(view_key, density.with_previous(particles), "the kernel laplace", "use --kernel tempered")
            attempts = _attempts(attempt_key, view, particles.log_weights.shape[0], checked)
            return _result(end_key, view, attempts, checked.moments)

    return kernel if checked.fallback == "none" else KernelWithFallback(kernel, _limits(checked).fails, build_fallback())


def _limits(options: Options) -> Limits:
    return Limits(options.most_k, options.least_ess)


class Attempts(NamedTuple):
    """The first attempt, and the last one: the same, or if that is bad the second."""

    first: Attempt
    last: Attempt

    @property
    def agree(self) -> Flag:
        """Whether the second attempt confirms the normal distribution of the first: no other mode competes, and the evidence is the same."""
        one_mode = jnp.round(self.last.modes) <= 1
        return one_mode & (self.first.log_evidence > self.last.log_evidence - COMPETES)

    @property
    def with_normal_draws(self) -> Attempt:
        """The last attempt, with the draws of the first if both agree.

        The draws of the second come from a mixture, which has no single mean and covariance, and its few effective weights would put a noise of one
        standard deviation into the moments.
        """
        first, last = ({"draws": tried.draws, "slopes": tried.slopes, "impossible": tried.impossible} for tried in self)
        return self.last._replace(**jax.tree.map(lambda old, new: jnp.where(self.agree, old, new), first, last))


def _attempts(key: Key, view: GaussianView, count: int, options: Options) -> Attempts:
    """Return the attempts of a frame."""

    def attempt(previous: Attempts) -> Attempts:
        last = _attempt(jax.random.fold_in(key, previous.last.number), view, previous.last, options)
        # Only the slopes need the first one again.
        is_first = (last.number == 1) | (options.moments != "slopes")
        return Attempts(jax.tree.map(lambda new, old: jnp.where(is_first, new, old), last, previous.first), last)

    most, limits, begin = 2 if options.more_starts > options.starts else 1, _limits(options), _empty(view, count)

    def goes_on(attempts: Attempts) -> Flag:
        return (attempts.last.number == 0) | (limits.exclude(attempts.last) & (attempts.last.number < most))

    return jax.lax.while_loop(goes_on, attempt, Attempts(begin, begin))


def _empty(view: GaussianView, count: int) -> Attempt:
    """Return an attempt without content."""
    zero, count_zero = jnp.zeros((), view.mean.dtype), jnp.zeros((), jnp.int32)
    draws = jnp.zeros((count, view.mean.shape[0]), view.mean.dtype)
    return Attempt(count_zero, draws, draws, draws[:, 0], zero, jnp.zeros((), bool), zero, zero, zero, count_zero, count_zero)


def _attempt(key: Key, view: GaussianView, previous: Attempt, options: Options) -> Attempt:
    # As in runs of earlier versions, which go on as they began.
    key = jax.random.split(jax.random.split(key)[1], 3)[0]
    count, dof = previous.draws.shape
    starts = max(options.starts, options.more_starts)
    is_used = jnp.arange(starts) < jnp.where(previous.number == 0, options.starts, starts)
    random = numbers(key, count, dof, starts - 1)
    begin = jnp.concatenate([jnp.zeros((1, dof)), random.starts])
    modes = jax.lax.map(lambda start: find_mode(view, start[0], options.most_steps * start[1]), (begin, is_used))
    proposal = proposal_from(modes, is_used)
    draws, log_proposal = draw(random, proposal)
    log_density, slopes = over_particles(lambda z, view: jax.value_and_grad(view.log_density_at)(z), draws, view)
    weights = normalise(log_density - log_proposal)
    steps = jnp.sum(modes.steps)
    return Attempt(
        number=previous.number + 1,
        # The prediction goes on where no draw explains the frame.
        draws=jnp.where(weights.lost, random.noise, draws),
        slopes=slopes,
        log_weights=weights.log_weights,
        log_evidence=weights.log_sum - jnp.log(count),
        is_lost=weights.lost,
        impossible=jnp.mean(~jnp.isfinite(log_density)),
        pareto_k=pareto_shape(weights.log_weights),
        modes=proposal.modes.astype(draws.dtype),
        steps=previous.steps + steps,
        # An expansion pushes all dofs through the linearised kinematics.
        evaluations=previous.evaluations + count + steps * (dof + 1),
    )


def _result(key: Key, view: GaussianView, attempts: Attempts, how: Literal["weights", "slopes"]) -> tuple[Particles, FilterInfo]:
    """Return the particles of the last attempt, with corrected moments, and its figures."""
    last = attempts.with_normal_draws if how == "slopes" else attempts.last
    log_weights = last.log_weights
    if how == "slopes":
        is_normal = ((last.number == 1) | attempts.agree) & ~last.is_lost & jnp.all(jnp.isfinite(last.slopes))
        log_weights = jnp.where(is_normal, -jnp.log(log_weights.shape[0]), log_weights)
    corrected = with_moments(last.draws, log_weights, corrected_moments(last.draws, log_weights, last.slopes))
    # Slopes know nothing of a wall without a slope.
    draws = jnp.where((last.impossible > MOST_IMPOSSIBLE) | last.is_lost, last.draws, corrected)
    noise = noise_beside(key, draws, log_weights, view.unread_size)
    states = jax.vmap(lambda noise, z: view.completed(noise, jnp.zeros((), jnp.int32), view.draw(z)))(noise, draws)
    count = last.log_weights.shape[0]
    ess = effective_sample_size(last.log_weights)
    info = FilterInfo(
        ancestors=jnp.full((count,), NO_ANCESTOR),
        ess=ess,
        survival_rate=(ess / count)[None],
        inverse_temperatures=jnp.ones((1,), ess.dtype),
        log_evidence=jnp.where(last.is_lost, -jnp.inf, last.log_evidence),
        lost=last.is_lost,
        acceptance_rate=jnp.full((1,), jnp.nan, ess.dtype),
        evaluations=last.evaluations,
        modes={"attempt": last.number - 1, "steps": last.steps, "modes": last.modes, "pareto_k": last.pareto_k},
    )
    return Particles(states, log_weights), info


# With one camera.
BLIND = "a limb may be bent towards the camera or away from it, and the weights of laplace see one of the two"
ONE_CAMERA = FewCameras(2, "tempered", {**TEMPERED, "particles": 1000}, BLIND)


# Its moments have little noise, so paths need no more than these.
SMOOTHED = {"start": "gaussian", "moves": 0}


@register(
    "kernel",
    "laplace",
    Options,
    samples_posterior=True,
    instead="use --kernel tempered",
    runs_together=True,
    few_cameras=ONE_CAMERA,
    smoothed_by=SMOOTHED,
)
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return build_kernel(**options.model_dump(exclude={"particles"}))
