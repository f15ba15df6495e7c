"""The penalty without leaving the accelerator: pure JAX, arrays of fixed size."""
