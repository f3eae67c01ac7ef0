"""Warp kernels behind documented launchers; imports Warp and NumPy only, and starts no device."""
