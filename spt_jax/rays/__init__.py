"""Ray crossings of a closed mesh and all that follows from them, in NumPy alone."""
