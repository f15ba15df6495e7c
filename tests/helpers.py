"""Solids with known overlaps, and slow oracles from libraries that we did not write."""

import functools

import igl
import manifold3d
import numpy as np
import trimesh

from spt_jax.body import load_body, load_mocap
from spt_jax.overlap.measure import Sampling
from spt_jax.overlap.rays.beam import aim, orthogonal_directions
from spt_jax.overlap.rays.crossings import cast

Mesh = tuple[np.ndarray, np.ndarray]


def sampling(rays, directions=3):
    if isinstance(directions, int):
        directions = orthogonal_directions(directions)
    return Sampling(rays, tuple(tuple(map(float, d)) for d in directions))


@functools.cache
def embedded_body():
    return load_body()


@functools.cache
def mocap():
    return load_mocap()


def body_faces() -> np.ndarray:
    return np.asarray(embedded_body().faces, np.int64)


def posed_bodies(frames) -> np.ndarray:
    """Vertices (N, V, 3) of the embedded body in frames given by index or name, as float64."""
    names = list(mocap().names)
    frames = [names.index(frame) if isinstance(frame, str) else frame for frame in frames]
    pose = embedded_body().pose_from_smpl(mocap().pose[np.array(frames)])
    return np.asarray(embedded_body()(pose).vertices, np.float64)


def box(extents=(1.0, 1.0, 1.0), center=(0.0, 0.0, 0.0)) -> Mesh:
    mesh = trimesh.creation.box(extents=extents)
    return np.array(mesh.vertices) + center, np.array(mesh.faces, np.int64)


def sphere(radius=1.0, center=(0.0, 0.0, 0.0), subdivisions=4) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices) + center, np.array(mesh.faces, np.int64)


def lens_volume(distance: float, radius: float = 1.0) -> float:
    """Intersection of two equal spheres whose centers are `distance` apart."""
    return np.pi * (4 * radius + distance) * (2 * radius - distance) ** 2 / 12


def bent_tube(angle: float, thick: float, thin: float, bend=1.0, sides=48, steps=400) -> Mesh:
    """A closed tube bent about the z axis through 2 pi + angle, whose thin end enters its thick
    beginning: the overlap is that of the last `angle` radians, thin all along."""
    turn = np.linspace(0, 2 * np.pi + angle, steps)
    radius = np.interp(turn, [0, angle * 1.2, 2 * np.pi - 0.3, 10], [thick, thick, thin, thin])
    around = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    out = bend + radius[:, None] * np.cos(around)
    up = np.broadcast_to(radius[:, None] * np.sin(around), out.shape)
    ring = np.stack([out * np.cos(turn)[:, None], out * np.sin(turn)[:, None], up], axis=-1)
    centers = bend * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)[[0, -1]]
    vertices = np.concatenate([ring.reshape(-1, 3), centers])
    i, j = np.meshgrid(np.arange(steps - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = a + sides, b + sides
    wall = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    k = np.arange(sides)
    first = np.stack([np.full(sides, len(vertices) - 2), (k + 1) % sides, k], -1)
    last_ring = (steps - 1) * sides
    last = np.stack(
        [np.full(sides, len(vertices) - 1), last_ring + k, last_ring + (k + 1) % sides], -1
    )
    faces = np.concatenate([wall, first, last])
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1]
    return vertices, np.ascontiguousarray(faces)


def join(*meshes: Mesh) -> Mesh:
    vertices, faces, count = [], [], 0
    for v, f in meshes:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def inverted(mesh: Mesh) -> Mesh:
    return mesh[0], np.ascontiguousarray(mesh[1][:, ::-1])


def moved(mesh: Mesh, rotation=None, translation=(0.0, 0.0, 0.0), scale=1.0) -> Mesh:
    rotation = np.eye(3) if rotation is None else rotation
    return scale * mesh[0] @ rotation.T + np.asarray(translation), mesh[1]


def random_rotation(rng) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def signed_volume(vertices, faces) -> float:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def boolean_overlap(first: Mesh, second: Mesh) -> float:
    """Volume of the intersection of two simple solids, by manifold3d."""
    solids = [
        manifold3d.Manifold(manifold3d.Mesh64(vert_properties=v, tri_verts=f.astype(np.uint64)))
        for v, f in (first, second)
    ]
    return (solids[0] ^ solids[1]).volume()


def winding_number(mesh: Mesh, points) -> np.ndarray:
    """The exact winding number, by libigl."""
    return np.asarray(igl.winding_number(mesh[0], mesh[1], np.ascontiguousarray(points)))


def cast_rays(mesh: Mesh, direction, rays):
    """The crossings of one beam, with the beam and the vertices on its screen."""
    beam, points = aim(mesh[0], np.asarray(direction, float), rays)
    return beam, points, cast(beam, points, mesh[1])
