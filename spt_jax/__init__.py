"""A self-intersection penalty for triangle meshes and body models in JAX."""

from spt_jax.classes import VertexClasses as VertexClasses
from spt_jax.classes import classify_vertices as classify_vertices
from spt_jax.penalty import paper_penalty as paper_penalty
from spt_jax.penalty import self_intersection_penalty as self_intersection_penalty
