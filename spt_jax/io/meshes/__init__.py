"""Mesh files read: one module a format, and what all of them need done afterwards."""
