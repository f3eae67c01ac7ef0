"""Terrain for the legged robots; imports NumPy, trimesh and Warp only."""
