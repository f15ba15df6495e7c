"""Hands in 41 poses, and what intersects far apart, told by ipctk and by paths of our own."""

import functools
import json
from pathlib import Path

import ipctk
import jax
import numpy as np
import scipy
from helpers import body_faces, embedded_body
from scipy.sparse.csgraph import dijkstra

from spt_jax._exclusions import as_exclusions
from spt_jax.overlap.exact import ExactOverlap
from spt_jax.overlap.surface import ExactSurface

# Left hands by name, as rows of axis-angle by joint: free ones and colliding ones.
HANDS = json.loads((Path(__file__).parent / "data" / "hands.json").read_text())


@functools.cache
def body_exclusions():
    return as_exclusions(None, (), embedded_body().rest_surface, body_faces())


def overlap_of(vertices, faces=None, exclusions=None) -> ExactOverlap:
    """What counts, from the triangles alone."""
    surface = ExactSurface(
        vertices, body_faces() if faces is None else faces, float(np.finfo(np.float64).eps)
    )
    return ExactOverlap(surface, body_exclusions() if exclusions is None else exclusions)


@functools.cache
def _posed():
    body = embedded_body()
    return jax.jit(lambda pose: body(pose).vertices)


def posed_by(pose) -> np.ndarray:
    return np.asarray(_posed()(np.asarray(pose, np.float32)), np.float64)


def with_joints(rows) -> np.ndarray:
    """A pose of the embedded body at rest but for some joints."""
    names = embedded_body().joint_names
    pose = np.zeros((len(names), 3), np.float32)
    for name, angles in rows.items():
        pose[names.index(name)] = angles
    return pose


def both_hands(rows) -> np.ndarray:
    """The pose of a left hand on both, the right one as in a mirror."""
    left = {f"left_{name}": angles for name, angles in rows.items()}
    right = {f"right_{name}": (x, -y, -z) for name, (x, y, z) in rows.items()}
    return with_joints(left | right)


def intersecting_pairs(vertices, faces) -> np.ndarray:
    """Triangles that intersect without a common vertex, by ipctk's predicates."""
    faces = np.asarray(faces, np.int32)
    edges = np.asarray(ipctk.edges(faces))
    points = np.asfortranarray(vertices, np.float64)
    boxes = ipctk.LBVH()
    boxes.build(points, np.asfortranarray(edges), np.asfortranarray(faces))
    beside: dict[tuple[int, int], list[int]] = {}
    for face, corners in enumerate(np.sort(faces, axis=1).tolist()):
        for pair in ((0, 1), (1, 2), (0, 2)):
            beside.setdefault((corners[pair[0]], corners[pair[1]]), []).append(face)
    found = set()
    for candidate in boxes.detect_edge_face_candidates():
        edge, face = edges[candidate.edge_id], candidate.face_id
        if ipctk.is_edge_intersecting_triangle(*points[edge], *points[faces[face]]):
            for other in beside[tuple(sorted(edge.tolist()))]:
                found.add((min(other, face), max(other, face)))
    pairs = np.array(sorted(found), np.int64).reshape(-1, 2)
    common = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any(axis=(1, 2))
    return pairs[~common]


@functools.cache
def _body_graph():
    vertices, faces = np.asarray(embedded_body().template, np.float64), body_faces()
    ends = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    size = (len(vertices), len(vertices))
    return scipy.sparse.csr_array((length, ends.T), shape=size)


def rest_distances(pairs, limit) -> np.ndarray:
    """The shortest way along the rest body's edges between each pair; endless beyond a limit."""
    faces = body_faces()
    if not len(pairs):
        return np.zeros(0)
    sources, row = np.unique(faces[pairs[:, 0]], return_inverse=True)
    rows = dijkstra(_body_graph(), directed=False, indices=sources, limit=limit)
    ways = rows[row.reshape(-1, 3)[:, :, None], faces[pairs[:, 1]][:, None, :]]
    return ways.min(axis=(1, 2))
