"""Host side: turn a frame's images into the arrays that likelihoods read."""
