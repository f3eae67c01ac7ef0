"""How fast everything is, compared with the alternatives: ``python -m benchmarks``."""
