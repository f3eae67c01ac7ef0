"""Populations of runs: a grid of cells, the workers that train it, and what its results say."""
