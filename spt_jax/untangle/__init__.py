"""Freeing bodies and meshes of their self-intersections."""
