"""Networks and how they learn: the leaf that every other package may use; torch and NumPy alone."""
