"""Simulated worlds: what an environment promises, and those that there are."""
