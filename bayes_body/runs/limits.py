"""Bounds of options that the command line and a study's file have in common. The command line needs them before it loads anything."""

# The largest seed of a JAX key without 64-bit arrays.
LARGEST_SEED = 2**32 - 1
# With fewer draws, 5 % and 95 % quantiles rest on one or two of them.
FEWEST_KEPT = 20
