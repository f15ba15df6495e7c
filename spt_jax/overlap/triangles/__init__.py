"""Exact computations on the triangles, without rays: intersections, winding numbers, volume."""
