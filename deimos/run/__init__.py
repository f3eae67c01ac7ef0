"""A run: training, its folder, its evaluation."""
