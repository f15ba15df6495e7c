"""Solids of one shape of arrays, so that the device path is compiled once for all of them."""

import numpy as np
from helpers import box, inverted, join, moved, random_rotation, sampling, sphere
from helpers_depth import DEEP, as_mesh

from spt_jax.overlap.measure import measure

_TURNED = random_rotation(np.random.default_rng(3))
SOLIDS = {
    "two boxes": join(box(), box(center=(0.6, 0.1, 0.2))),
    "two spheres": join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2)),
    "three boxes": moved(
        join(box(), box(center=(0.3, 0.1, 0.2)), box(center=(0.1, 0.4, 0.3))), _TURNED
    ),
    "inverted box": join(inverted(box()), box(center=(3.0, 0.0, 0.0))),
    "box in a box": join(box(), box(extents=(0.5, 0.4, 0.3), center=(0.1, 0.0, 0.0))),
    "four boxes": moved(as_mesh(DEEP["four boxes"]), _TURNED),
    "inverted nest": moved(as_mesh(DEEP["inverted nest"]), _TURNED),
    "apart": join(sphere(subdivisions=2), sphere(center=(2.5, 0.0, 0.0), subdivisions=2)),
}
_VERTICES = max(len(mesh[0]) for mesh in SOLIDS.values())
_FACES = max(len(mesh[1]) for mesh in SOLIDS.values())


def padded(name, dtype):
    """Vertices and faces of one shape: unused vertices and triangles of a single corner added."""
    vertices, faces = SOLIDS[name]
    more = np.repeat(vertices[:1], _VERTICES - len(vertices), axis=0)
    corners = np.zeros((_FACES - len(faces), 3), int)
    vertices, faces = np.concatenate([vertices, more]), np.concatenate([faces, corners])
    return vertices.astype(dtype), faces.astype(np.int32)


def on_host(vertices, faces, rays, directions):
    """The measurement by NumPy, in double precision whatever the vertices' dtype."""
    return measure(vertices.astype(np.float64), faces.astype(np.int64), sampling(rays, directions))
