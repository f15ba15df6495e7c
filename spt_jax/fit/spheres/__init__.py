"""A body as spheres, for the regularizer of that name."""
