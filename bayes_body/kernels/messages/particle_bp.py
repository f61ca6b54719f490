r"""Particle belief propagation on a pairwise graph: loose-limbed bodies (Sigal et al. 2011), or any other (Ihler & McAllester 2009).

A round draws particles of its nodes from their proposals (kernels/messages/node_proposals.py) and evaluates the messages into them
(kernels/messages/messages.py); kernels/messages/passing.py puts both together. After the last round, all nodes are redrawn at once, and joint draws
are taken from the exact sum over a forest of the graph's edges (kernels/messages/joint_particles.py). Their weights include the factors that this sum
leaves out, so the draws are a weighted sample of the posterior.

On a graph with loops, messages need not converge, and beliefs are not the true marginals. The joint draws are still a valid importance sample. If few
of them carry the weight, `joint_ess` is small (kernels/messages/messages.py).
"""

from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.shapes import Index, Key
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, NonNegative, Positive, Schema
from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.factor import Particles, State
from bayes_body.density.graph import Graph
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.density.parts_graph import parts_graph
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.messages.joint_particles import JointParticles, joint_particles
from bayes_body.kernels.messages.messages import Beliefs, Directed, NodeValues, Summary, message_figures, shares_of_weight
from bayes_body.kernels.messages.methods import MethodName
from bayes_body.kernels.messages.node_proposals import Shares
from bayes_body.kernels.messages.pampas import Pampas
from bayes_body.kernels.messages.passing import Passing, Settings
from bayes_body.kernels.messages.schedules import Round, Schedule, schedule
from bayes_body.kernels.weights import effective_sample_size, normalise, predict, resampler

# Iterations for the normaliser of the prior, whose beliefs are near its prediction.
PRIOR_ITERATIONS = 3
# Strata of products take ten times as long, and the normaliser has no bias by any method.
OF_PRIOR = {"method": "mixture", "schedule": "flooding"}


class Options(Schema):
    """Options of `[kernel] kind = "particle_bp"`.

    `particles` is the number of joint draws, `samples` the number of particles of each node. Messages of factors that propose nothing and only close
    loops, such as penetration, take `loop_samples` of them: the weights of the joint draws evaluate these factors exactly. In iteration m of M the
    likelihood has the power `annealing`^(M - m). `shares` are those of a node's proposal: messages, prior, detections, and a normal fit to the last
    belief, whose covariance is multiplied by `fit_inflation`. `method` is `mixture`, or one of the papers (kernels/messages/methods.py). Messages are
    mixed with the last ones by the share `damping` (kernels/messages/passing.py). Of the particles of the previous frame, `ancestors` are kept.
    """

    particles: Count = 500
    """[draws] joint draws of the whole body, per run."""
    samples: Count = 500
    """[particles] of each part; the cost of messages grows with the square."""
    loop_samples: Count = 32
    """[particles] of each part in the messages of penetration; the weights of the joint draws evaluate penetration exactly."""
    iterations: Count = 6
    """the first draws from the motion prior and detections; with each further one a part hears from parts one joint farther away."""
    method: MethodName = "mixture"
    """where a part's particles come from: one mixture of messages, prior, detections and a normal fit (`"mixture"`), or as in a paper: a kernel
    estimate of the last belief (`"pbp"`), a normal distribution by expectation propagation (`"epbp"`), or strata of products of messages
    (`"pampas"`); [Message passing](message_passing.md#published-methods) compares them."""
    schedule: Schedule = "flooding"
    """`"flooding"`: all parts at once; `"tree"`: from the hands, feet and head to the torso and back, as in the paper."""
    damping: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """share of the last message in a new one, from 0 to below 1; more ends oscillations and needs more iterations."""
    annealing: Annotated[float, Field(strict=True, gt=0, le=1)] = 1.0
    """κ: the likelihood's power in iteration m of M is κ^(M − m)."""
    shares: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (0.3, 0.05, 0.2, 0.65)
    """of a part's proposal: messages, motion prior, detections, and a normal distribution fitted to the last belief."""
    fit_inflation: Positive = 1.5
    """factor of the fit's covariance."""
    ancestors: Annotated[int, Field(strict=True, ge=1)] = 100
    """[particles] of the previous frame that are kept."""


class Passed(NamedTuple):
    """The result of message passing.

    Attributes:
        points: particles of every node.
        log_beliefs: log-weights of the particles in the belief of their node. On a tree beliefs are the marginals; on loops they are the estimate of
            loopy belief propagation.
        beliefs: the messages.
        cavities: for each term of two nodes, the normalised log-weights of the particles of each message's source.
        rounds: summaries of the beliefs after each round.
        joint: joint draws of all nodes.
        proposal_shares: for each node, the share of messages, prior, detections and fit in the weight of the joint draws' points.
    """

    points: Float[Array, "node sample *entry"]
    log_beliefs: NodeValues
    beliefs: Beliefs
    cavities: tuple[Directed, ...]
    rounds: Summary
    joint: JointParticles
    proposal_shares: Float[Array, "node 4"]


def pass_messages(key: Key, graph: Graph, options: Options, rounds: Round) -> Passed:
    """Pass messages through the rounds of a schedule, and take joint draws.

    Args:
        key: random key.
        graph: the graph.
        options: the options.
        rounds: the schedule (`kernels.messages.schedules.schedule`).
    """
    first_key, round_key, redraw_key, joint_key = jax.random.split(key, 4)
    passing = _passing(graph, options)
    begin = passing.begin(first_key)
    keys = jax.random.split(round_key, rounds.power.shape[0])
    (beliefs, memory), by_round = jax.lax.scan(lambda state, turn: passing.round(state, *turn), begin, (keys, rounds))
    log_beliefs, cavities = passing.weigh(beliefs, 1.0)
    proposal, _, last = passing.proposals(beliefs, memory, 1.0)
    redrawn, log_shares = passing.redraw(redraw_key, beliefs, proposal)
    joint = joint_particles(joint_key, graph, redrawn, options.particles)
    # A round summarises the beliefs that it begins with.
    summaries = jax.tree.map(lambda early, late: jnp.concatenate([early[1:], late[None]]), by_round, last)
    return Passed(beliefs.points, log_beliefs, beliefs, cavities, summaries, joint, shares_of_weight(joint.log_beliefs, log_shares))


def _passing(graph: Graph, options: Options) -> Passing:
    if options.method == "pampas" and any(term.plate.log_beside is not None for term in graph.pairs):
        # A product of messages says nothing of sizes, so it has no draws.
        problem, expected = "'pampas', and the sizes of the parts are not known", '"mixture", "pbp" or "epbp"'
        raise input_error("the kernel 'particle_bp': method", problem, expected, "take another method, or the tables [[unknown]] out")
    of_proposals = Shares(*options.shares), options.fit_inflation
    settings = Settings(options.samples, options.loop_samples, *of_proposals, options.method, options.damping)
    return Pampas(graph, settings) if options.method == "pampas" else Passing(graph, settings)


class ParticleBP:
    """The sampler, for one choice of options. Called as a kernel, it samples a frame of a model of parts; `on` takes any pairwise graph."""

    # The attribute `kind` of `NamedKernel`.
    kind = "particle_bp"

    def __init__(self, options: Options):
        self.options = options
        self.resample = resampler("systematic")

    def on(self, key: Key, graph: Graph) -> Passed:
        """Pass messages on a graph and take `particles` joint draws of its nodes. Compile it with `jax.jit` once for all graphs of one form.

        Args:
            key: random key.
            graph: the graph, from `bayes_body.graph`.
        """
        options = self.options
        return pass_messages(key, graph, options, schedule(graph, options.schedule, options.iterations, options.annealing))

    def __call__(self, key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        """Sample one frame, as every kernel does. It returns as many particles as it is given."""
        thin_key, pass_key, prior_key, ancestor_key, predict_key = jax.random.split(key, 5)
        count = particles.log_weights.shape[0]
        options = self.options.model_copy(update={"particles": count})
        thinned, density = self._thinned(thin_key, density.with_previous(particles))
        graph = parts_graph(density)
        rounds = schedule(graph, options.schedule, options.iterations, options.annealing)
        passed = pass_messages(pass_key, graph, options, rounds)
        log_evidence = passed.joint.log_evidence
        if density.has_potentials:
            # The potentials are not normalised given the previous frame: the evidence is the ratio of both normalisers, as in `tempered`.
            # Detections say where the likelihood may be large, and the motion prior proposes itself.
            prior_factors = tuple(factor for factor in density.factors if factor.side != "likelihood")
            prior = parts_graph(replace(density, factors=prior_factors, proposals=()))
            of_prior = options.model_copy(update=OF_PRIOR) if options.method == "pampas" else options
            log_evidence -= pass_messages(prior_key, prior, of_prior, schedule(prior, of_prior.schedule, PRIOR_ITERATIONS)).joint.log_evidence
        posterior = normalise(passed.joint.log_weights)
        unconstrained = density.unconstrained()
        # The sizes of nodes do not tell ancestors apart (density/sized_nodes.py).
        unconstrained = unconstrained._replace(predictions={graph.variable: unconstrained.predictions[graph.variable]})

        def complete(key_and_value: tuple[Key, Array], unconstrained: Unconstrained) -> tuple[State, Index]:
            key, value = key_and_value
            return unconstrained.completed(key, graph.sampled(value))

        states, ancestors = over_particles(complete, (jax.random.split(ancestor_key, count), passed.joint.values), unconstrained)
        predicted = predict(predict_key, self.resample(predict_key, density.previous.log_weights, count), density).states
        states = jax.tree.map(lambda filtered, prediction: jnp.where(posterior.lost, prediction, filtered), states, predicted)
        ess = effective_sample_size(posterior.log_weights)
        # A round evaluates the factors of some nodes, the redrawing those of all nodes, and the weights those that read the whole body.
        of_rounds = passed.points.shape[1] * jnp.sum(rounds.nodes < graph.count) // graph.count
        evaluations = of_rounds + options.samples + (0 if graph.joint_factors is None else count)
        info = FilterInfo(
            ancestors=thinned[ancestors],
            ess=ess,
            survival_rate=(ess / count)[None],
            inverse_temperatures=jnp.ones((1,), ess.dtype),
            log_evidence=jnp.where(posterior.lost, -jnp.inf, log_evidence),
            lost=posterior.lost,
            acceptance_rate=jnp.full((1,), jnp.nan, ess.dtype),
            evaluations=evaluations,
            messages=message_figures(graph.space, passed.rounds, options.iterations, options.samples, ess, passed.proposal_shares),
        )
        return Particles(states, posterior.log_weights), info

    def _thinned(self, key: Key, density: Density) -> tuple[Int[Array, " ancestor"], Density]:
        """Return some of the previous frame's particles with equal weights, and the density given these."""
        previous = density.previous
        count = min(self.options.ancestors, previous.log_weights.shape[0])
        thinned = self.resample(key, previous.log_weights, count)
        states = jax.tree.map(lambda leaf: leaf[thinned], previous.states)
        return thinned, density.with_previous(Particles(states, jnp.full((count,), -jnp.log(count), previous.log_weights.dtype)))


def build_kernel(**options: Any) -> ParticleBP:
    """Return the sampler.

    Args:
        options: those of `Options`. As a kernel it returns as many particles as it is given, whatever `particles` is.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    return ParticleBP(validate(Options, options, "particle_bp()"))


@register("kernel", "particle_bp", Options, samples_posterior=True, recovers=True, takes_proposals=True)
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return ParticleBP(options)
