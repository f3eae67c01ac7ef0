"""Simulated worlds: the interface of environments, and the environments."""
