"""The overlap of one mesh with itself, measured in NumPy and SciPy alone."""
