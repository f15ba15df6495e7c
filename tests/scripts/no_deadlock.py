"""Run by test_host.py in a process of its own: one core, two threads, arrays of many sizes.

JAX hands a callback operands above about 100 kB on the thread pool that waits for the callback
(https://github.com/jax-ml/jax/issues/24255, https://github.com/jax-ml/jax/issues/25861); without
the pieces of host.py this program hangs.
"""

import os
import sys

CORES = int(sys.argv[1])
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:CORES]))

import threading

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from spt_jax import self_intersection_penalty

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
BOX_FACES = np.array([[a, *pair] for a, b, c, d in QUADS for pair in ((b, c), (c, d))], np.int32)


def padded(num_bytes: int) -> tuple[jax.Array, jax.Array]:
    """Two boxes that overlap by half, and as many idle vertices and triangles as asked for.

    The host's own work stays small, so thirty calls of each size fit into a test.
    """
    boxes = np.concatenate([BOX, BOX + np.float32([0.5, 0, 0])])
    idle = np.full((max(num_bytes // 12 - len(boxes), 1), 3), 0.5, np.float32)
    faces = np.concatenate(
        [BOX_FACES, BOX_FACES + 8, np.full((min(num_bytes, 480_000) // 12, 3), 16, np.int32)]
    )
    return jnp.asarray(np.concatenate([boxes, idle])), jnp.asarray(faces)


def penalty(vertices, faces):
    # Outside jit the product is still being computed when the callback starts: that is the case
    # which hangs.
    moved = vertices @ jnp.eye(3)
    return self_intersection_penalty(moved, faces, rays=8, directions=1).sum()


eager = jax.value_and_grad(penalty)
step = jax.jit(eager)
real_step = jax.value_and_grad(lambda v, f: self_intersection_penalty(v, f, rays=64))
batched = jax.jit(jax.vmap(jax.value_and_grad(penalty), in_axes=(0, None)))


def work(name: str) -> None:
    for num_bytes in (10_000, 90_000, 147_000, 480_000, 2_000_000, 8_000_000):
        vertices, faces = padded(num_bytes)
        for run in (eager, step):
            results = [run(vertices, faces) for _ in range(30)]
            for value, gradient in results:
                assert abs(float(value) - 0.5) < 0.1 and gradient.shape == vertices.shape
    vertices, faces = padded(147_000)
    bodies = jnp.broadcast_to(vertices, (16, *vertices.shape))
    for _ in range(30):
        values, _ = batched(bodies, faces)
        assert np.abs(np.asarray(values) - 0.5).max() < 0.1
        values, _ = eager(bodies, faces)
        values.block_until_ready()
    ball = trimesh.creation.icosphere(subdivisions=5)  # 123 kB, with the host's own threads
    for _ in range(30):
        real_step(jnp.asarray(ball.vertices, "float32") @ jnp.eye(3), ball.faces)
    print(name, "finished", flush=True)


threads = [threading.Thread(target=work, args=(f"thread {k}",)) for k in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
sys.exit(0)
