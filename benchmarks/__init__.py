"""How fast everything is, beside what else there is: ``python -m benchmarks``."""
