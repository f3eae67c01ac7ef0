"""Kernels of legged robots."""
