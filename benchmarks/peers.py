"""What other libraries take to find what we find, on the same mesh: `benchmarks.suite` times it.

Each peer is given the mesh as it likes it best, and is timed from the vertices on: its trees are
built anew for every call, as a loss must, whose mesh has moved since the last one. None of them has
a gradient of the overlap.
"""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.rays.beam import aim

RAYS = 512
TOWARDS = np.array([0.0, 0.0, -1.0])

Call = Callable[[], Any]
Make = Callable[[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]], Call]


@dataclass(frozen=True)
class Peer:
    """A library's call, or why there is none.

    Attributes:
        name: for the table.
        needs: the module; `pip install` installs `package`.
        package: what to install.
        make: prepares the call outside the clock.
    """

    name: str
    needs: str
    package: str
    make: Make

    @property
    def missing(self) -> str | None:
        """Why it cannot run here; None if it can."""
        if importlib.util.find_spec(self.needs) is None:
            return f"{self.needs} is not installed: pip install {self.package}"
        try:
            importlib.import_module(self.needs)
        except ImportError as error:  # a system library, such as libGL for open3d
            return f"{self.needs} does not load: {error}"
        return None


def _igl_fast(vertices, faces) -> Call:
    import igl

    return lambda: igl.fast_winding_number(vertices, faces, vertices)


def _igl_exact(vertices, faces) -> Call:
    import igl

    return lambda: igl.winding_number(vertices, faces, vertices)


def _screen(vertices):
    """Origins of the rays that `rays=512` casts along -z, in front of the mesh."""
    beam, _ = aim(vertices, TOWARDS, RAYS)
    rows, columns = np.mgrid[: beam.shape[0], : beam.shape[1]]
    at = np.stack([columns.ravel() + beam.origin[0], rows.ravel() + beam.origin[1]], axis=1)
    nearest = (vertices @ TOWARDS).min() - 1.0
    return (at * beam.pixel) @ beam.frame[:2] + nearest * TOWARDS


def _open3d(vertices, faces) -> Call:
    import open3d

    core: Any = open3d.core  # whose stubs know no arrays
    origins = _screen(vertices)
    rays = np.concatenate([origins, np.broadcast_to(TOWARDS, origins.shape)], axis=1)
    rays = core.Tensor(rays.astype(np.float32))
    points, triangles = (
        core.Tensor(vertices.astype(np.float32)),
        core.Tensor(faces.astype(np.uint32)),
    )

    def call():
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(points, triangles)
        return scene.list_intersections(rays, nthreads=1)

    return call


def _embree(vertices, faces) -> Call:
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    origins = _screen(vertices)
    directions = np.broadcast_to(TOWARDS, origins.shape)

    def call():
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return RayMeshIntersector(mesh).intersects_id(origins, directions, multiple_hits=True)

    return call


def _ipctk(vertices, faces) -> Call:
    import ipctk

    def call():
        mesh = ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces)
        return ipctk.has_intersections(mesh, vertices)

    return call


PEERS = (
    Peer("libigl, fast winding number at the vertices", "igl", "libigl", _igl_fast),
    Peer("libigl, exact winding number at the vertices", "igl", "libigl", _igl_exact),
    Peer("Open3D (Embree), all crossings of 512 x 512 rays", "open3d", "open3d", _open3d),
    Peer("trimesh with embreex, all crossings of 512 x 512 rays", "embreex", "embreex", _embree),
    Peer("ipctk, whether any edge crosses a triangle", "ipctk", "ipctk", _ipctk),
)
