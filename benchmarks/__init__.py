"""Measurements of spt_jax, one file a question; `results.md` holds what they printed."""
