"""Who chooses the goals, and their outcomes; torch and NumPy alone, so that it installs anywhere."""
