"""Where a fit starts, and the local minima that it looks through."""
