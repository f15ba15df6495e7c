"""Beams of parallel rays: what they cross, and the overlaps between the crossings."""
