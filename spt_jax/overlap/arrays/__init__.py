"""Helpers for NumPy arrays that the whole measurement uses: ragged ranges, vectors, sums."""
