"""The body model: blend shapes, a kinematic tree and linear blend skinning in JAX."""
