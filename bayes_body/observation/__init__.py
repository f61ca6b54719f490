"""Host side: a frame's images become the arrays that likelihoods look at."""
