"""What `check_mesh` tells people to do works, as it is printed, where this package is installed."""

import re

import numpy as np
import pytest
import trimesh
from helpers import box, inverted, join, sphere
from trimesh.visual import TextureVisuals

from spt_jax import check_mesh

CALLS = re.compile(r"(?:mesh|trimesh\.repair)\.\w+\((?:[^()]|\([^()]*\))*\)")


def hole(size):
    vertices, faces = sphere(subdivisions=2)
    return vertices, faces[vertices[faces].mean(axis=1)[:, 2] < size]


def test_small_holes_need_no_hint():
    for size in (0.95, 0.2):
        checked = check_mesh(*hole(size))
        assert checked.ok and "closed by fans" in checked.warnings[0]
        assert checked.holes == 1 and checked.largest_hole.is_closed


def seam():
    """A textured box whose every side has its own corners, as texture coordinates want it."""
    vertices, faces = box()
    corners, triangles = vertices[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    uv = np.random.default_rng(0).random((36, 2))
    visual = TextureVisuals(uv=uv)
    return trimesh.Trimesh(corners, triangles, visual=visual, process=False)


def doubled():
    vertices, faces = box()
    return vertices, np.concatenate([faces, faces[:2]])


def turned():
    vertices, faces = box()
    return vertices, np.concatenate([faces[1:], faces[:1, ::-1]])


@pytest.mark.parametrize(
    ("mesh", "place"),
    [
        (seam, 0),
        (lambda: hole(-0.3), 1),
        (turned, 0),
        (doubled, 0),
        (lambda: join(inverted(box()), box(center=(3, 0, 0))), 0),
    ],
    ids=["seam", "large hole", "turned", "doubled", "inverted"],
)
def test_the_hint_puts_it_right(mesh, place):
    made = mesh()
    found = made if isinstance(made, trimesh.Trimesh) else trimesh.Trimesh(*made, process=False)
    checked = check_mesh(found.vertices, found.faces)
    assert not checked.ok
    calls = CALLS.findall(checked.problems[0])
    eval(calls[place], {"mesh": found, "trimesh": trimesh})
    assert check_mesh(np.array(found.vertices), np.array(found.faces)).ok
