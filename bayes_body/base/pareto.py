"""What a fit of the tail of importance weights needs, on the host (results/posterior/pareto.py) and in a program (kernels/laplace/pareto.py)."""

# A shorter tail is not fitted.
FEWEST_TAIL = 5
# The grid of the fit ends at this multiple of the quartile (Zhang & Stephens 2009). k is pulled towards a value, with the weight of some draws
# (Vehtari et al. 2024).
PRIOR_QUARTILE, PRIOR_SHAPE, PRIOR_DRAWS = 3, 0.5, 10


def tail_size(draws: int) -> int:
    """Return the number of largest weights that form the tail."""
    return int(3 * draws**0.5) if draws > 225 else draws // 5
