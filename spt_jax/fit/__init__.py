"""Fitting: objectives and solvers that use the penalty."""
