"""Run by test_host.py: the last results are still under way when the script ends."""

import jax
import jax.numpy as jnp
import trimesh

from spt_jax import self_intersection_penalty

ball = trimesh.creation.icosphere(subdivisions=6)
vertices = jnp.asarray(ball.vertices, "float32")
gradient = jax.grad(lambda v: self_intersection_penalty(v @ jnp.eye(3), ball.faces))
for _ in range(6):
    result = gradient(vertices)
print("end")
