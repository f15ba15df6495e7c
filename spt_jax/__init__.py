"""A self-intersection penalty for triangle meshes and body models in JAX."""
