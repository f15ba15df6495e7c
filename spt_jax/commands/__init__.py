"""The commands of `spt-jax`, one module each; what they need is imported when they run."""
