"""Run by test_host.py: four devices, and a batch that is sharded over them."""

import os

os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jax.sharding import NamedSharding, PartitionSpec

from spt_jax import classify_vertices, self_intersection_penalty

box = trimesh.creation.box()
PAIR = trimesh.Trimesh(
    np.concatenate([box.vertices, np.add(box.vertices, [0.6, 0.13, 0.07])]),
    np.concatenate([box.faces, box.faces + len(box.vertices)]),
    process=False,
)
devices = jax.make_mesh((4,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
batch = jnp.stack([jnp.asarray(PAIR.vertices * s, "float32") for s in np.linspace(1, 2, 8)])
along = NamedSharding(devices, PartitionSpec("d"))
sharded = jax.device_put(batch, along)


def penalty(vertices):
    return self_intersection_penalty(vertices, PAIR.faces)


def with_faces(vertices, faces):
    return self_intersection_penalty(vertices, faces)


def check(found, expected):
    for array, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(array, other)
        assert array.sharding.is_equivalent_to(along, array.ndim), array.sharding
        assert len(array.sharding.device_set) == 4


expected = jax.vmap(jax.value_and_grad(penalty))(batch)
assert len(set(np.asarray(expected[0]).tolist())) == 8
check(penalty(sharded), expected[0])
check(jax.jit(penalty)(sharded), expected[0])
both = jax.jit(jax.vmap(jax.value_and_grad(penalty)))
check(both(sharded), expected)
check(jax.jit(jax.grad(lambda v: penalty(v).sum()))(sharded), expected[1])
lists = jax.jit(jax.vmap(with_faces))
check(lists(sharded, jnp.stack([jnp.asarray(PAIR.faces)] * 8)), expected[0])
check(jax.jit(with_faces)(sharded, jnp.asarray(PAIR.faces)), expected[0])
check(classify_vertices(sharded, PAIR.faces).labels, classify_vertices(batch, PAIR.faces).labels)
# No device gathers what the others have.
assert "all-gather" not in str(both.lower(sharded).compile().as_text())
print("end")
