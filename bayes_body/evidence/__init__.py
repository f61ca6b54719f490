"""The arrays of one frame, as observations write them and likelihoods read them."""
