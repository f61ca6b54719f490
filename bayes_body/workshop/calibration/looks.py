r"""How a check decides: in up to three looks at its replications, with a stated probability of a false alarm (a group sequential design).

At look k every test has m p-values, one for each quantity. With the smallest of them, $p$:

- $p \le \alpha s_k / (t m)$: the kernel fails. Here t is the number of tests (ranks, and the Markov move if there is one), and $s_k$ is the look's
  share of the false alarms.
- $p > \gamma / m$, or this is the last look: the test passes.
- In between the result is close. New replications are added to the old ones, and the next look is at all of them.

The shares of the looks add up to 1. By Bonferroni's inequality over tests, looks and quantities, a correct kernel fails with probability at most
$\alpha$, however the quantities depend on each other. To stop early with a pass only makes this smaller. $\gamma$ has no effect on false alarms: a
larger one misses fewer faults and draws more replications.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# The largest probability that a correct kernel fails, over all tests and looks of a check.
FALSE_ALARM = 0.01
# The replications of each look, old ones included, in multiples of the first look's; and the share of the false alarms that each look may cause.
REPLICATIONS, SHARES = (1, 2, 4), (0.25, 0.25, 0.5)
# A correct kernel is close at the first look with about this probability for each test.
CLOSE = 0.1


class Limits(NamedTuple):
    """The limits of a p-value at a look: at most `fails`, and the kernel fails; above `passes`, and the quantity passes."""

    fails: float
    passes: float


def limits(look: int, tests: int, quantities: int) -> Limits:
    """The limits for each p-value of a test.

    Args:
        look: number of the look, from 0.
        tests: number of tests that the check has.
        quantities: number of p-values of this test.
    """
    fails = FALSE_ALARM * SHARES[look] / (tests * quantities)
    return Limits(fails, fails if look == len(SHARES) - 1 else CLOSE / quantities)


def fails(p: Float[np.ndarray, " quantity"], limit: Limits) -> bool:
    """Whether some p-value shows a fault."""
    return bool(p.min() <= limit.fails)


def is_close(p: Float[np.ndarray, " quantity"], limit: Limits) -> bool:
    """Whether the test neither fails nor passes, so that more replications are needed."""
    return bool(limit.fails < p.min() <= limit.passes)
