"""Who chooses the goals, and what became of them; torch and NumPy alone, so that it installs anywhere."""
