"""Long attacks on Deimos: hostile options and files, huge and non-finite numbers, kills, memory.

``python -m benchmarks.faults KIND --json FILE``. The tests check the same properties on a few examples of each kind.
"""
