"""The building blocks of kernels: resampling, weights, moves, mass matrices, batching."""
