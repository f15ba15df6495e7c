"""One side of `benchmarks.against`: measures the calls that it is asked for by name.

It imports the tree that it is given, not its own, so it uses nothing but the public API, and
`host.forget`.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, sys.argv[1])

import spt_jax
from spt_jax import host


def main() -> None:
    """Answer each line of standard input with [milliseconds, [numbers that tell the result]]."""
    if not str(spt_jax.__file__).startswith(sys.argv[1]):
        sys.exit(f"spt_jax must be imported from {sys.argv[1]}: got {spt_jax.__file__}.")
    if hasattr(spt_jax, "config"):  # before its first release, processes were always started
        spt_jax.config.processes = "auto"
    body, mocap = spt_jax.load_body(), spt_jax.load_mocap()
    rows = [mocap.names.index(name) for name in ("crawl/0092", "walk/0010")]
    place = jnp.array([[0.0, 0.0, 0.0], [0.45, 0.0, 0.0]])
    posed = body(body.pose_from_smpl(jnp.asarray(mocap.pose[jnp.array(rows)])), translation=place)
    scene = spt_jax.join_bodies(posed.vertices, body.faces)
    one = posed.vertices[0]

    def penalty(vertices, faces, **options):
        def loss(v):
            return spt_jax.self_intersection_penalty(v, faces, **options)

        call = jax.jit(jax.value_and_grad(loss))
        return lambda: call(vertices)

    def classify(v):
        found = spt_jax.classify_vertices(v, body.faces)
        # Before its first release, VertexLabels had another field name.
        return vars(found)["labels" if hasattr(found, "labels") else "label"]

    classify = jax.jit(classify)
    calls = {
        "default": penalty(one, body.faces),
        "rays512": penalty(one, body.faces, rays=512, directions=1),
        "rays512x3": penalty(one, body.faces, rays=512),
        "rays2048": penalty(one, body.faces, rays=2048, directions=1),
        "scene": penalty(scene.vertices, scene.faces),
        "labels": lambda: (classify(one),),
    }
    for line in sys.stdin:
        host.forget()
        start = time.perf_counter()
        found = jax.block_until_ready(calls[line.strip()]())
        taken = 1e3 * (time.perf_counter() - start)
        told = [float(f(np.asarray(x, np.float64))) for x in found for f in (np.sum, np.ptp)]
        print(json.dumps([taken, told]), flush=True)


if __name__ == "__main__":
    main()
