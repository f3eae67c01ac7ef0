"""Attacks on Deimos, at length: hostile options and files, numbers that are none, kills, memory.

``python -m benchmarks.faults KIND --json FILE``. The tests hold the same properties on a few examples of each kind.
"""
