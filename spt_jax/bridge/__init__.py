"""The only way from JAX to Python and back: callback, batches, cache of results, processes."""
