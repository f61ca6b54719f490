"""Many recordings: a study is a list of units, and a unit is one ordinary `bayes-body track` in a fresh process.

A driver (`driver`) hands units to places: processes of this machine (`places`), or the workers of a cluster (`cluster`). Everything that a unit says
lies on the shared disk (`records`), so that a study that was stopped goes on, and two drivers can share it. None of these modules loads JAX, except
`combine`, which puts the runs of a session together in a unit of its own.
"""
