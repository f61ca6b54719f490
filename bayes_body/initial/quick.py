"""How most programs of a first pose are compiled: quickly, for they run for less time than XLA would take to make them fast."""

QUICK = {"xla_backend_optimization_level": 0}
