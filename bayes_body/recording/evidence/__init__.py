"""The arrays of one frame that observations write and likelihoods read."""
