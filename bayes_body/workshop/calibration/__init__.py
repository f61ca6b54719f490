"""Check that a kernel samples the model's posterior: ranks of simulated truths, invariance of Markov moves, coverage, quadrature."""

from bayes_body.workshop.calibration.problem import Problem, Quantities, problem_of

__all__ = ["Problem", "Quantities", "problem_of"]
