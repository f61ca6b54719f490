"""Is a kernel's posterior the model's? Ranks of simulated truths, invariance of Markov moves, coverage; quadrature where nothing can be simulated."""

from bayes_body.calibration.problem import Problem, Quantities, problem_of

__all__ = ["Problem", "Quantities", "problem_of"]
