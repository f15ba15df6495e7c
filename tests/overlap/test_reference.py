"""The fast algorithms against their slow and readable versions, on small solids."""

import helpers_reference as reference
import numpy as np
import pytest
from helpers import bent_tube, box, inverted, join, moved, random_rotation

from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.surface import ExactSurface
from spt_jax.overlap.triangles import box_words, pair_boxes, pair_layout
from spt_jax.overlap.triangles.pair_layout import CLUSTER
from spt_jax.rest import paths
from spt_jax.rest.surface import RestSurface
from spt_jax.xla.tables import rest_table


def random_boxes(seed, count):
    rng = np.random.default_rng(seed)
    boxes = [
        moved(box(rng.uniform(0.5, 1.5, 3)), random_rotation(rng), 0.4 * rng.normal(size=3))
        for _ in range(count)
    ]
    vertices, faces = join(*boxes[:-1], inverted(boxes[-1]))
    return vertices + 1e-3 * rng.normal(size=vertices.shape), faces  # no four in a plane


def nested_boxes():
    rng = np.random.default_rng(9)
    return join(*(moved(box((s, s, s)), random_rotation(rng)) for s in (1.0, 0.3, 0.1)))


def tube_into_itself():
    tube = bent_tube(0.6, 0.3, 0.13, sides=5, steps=14)
    return moved(tube, random_rotation(np.random.default_rng(3)))


MESHES = {
    "boxes, one inside out": random_boxes(1, 3),
    "more boxes": random_boxes(2, 4),
    "nested boxes": nested_boxes(),
    "a tube into itself": tube_into_itself(),
}


@pytest.fixture(scope="module", params=MESHES)
def solids(request):
    """The mesh as it is measured, and what is found in it."""
    vertices, faces = MESHES[request.param]
    surface = ExactSurface(vertices, faces, 2.2e-16)
    (layer,) = surface.layers(NOTHING)
    return (surface.points, faces), surface, layer


def test_winding_numbers(solids):
    mesh, _, layer = solids
    expected = reference.winding_numbers(mesh)
    assert any(expected) and layer.ends.fits
    np.testing.assert_array_equal(layer.ends.of_vertices()[:, 0], expected)


def test_contours(solids):
    mesh, surface, _ = solids
    expected = reference.contours(mesh)
    found = dict(
        zip(map(tuple, surface.contours.pair.tolist()), surface.contours.point, strict=True)
    )
    assert found.keys() == expected.keys()
    for pair, segment in expected.items():
        np.testing.assert_allclose(found[pair], segment, atol=1e-13)


def test_shares_of_triangles(solids):
    mesh, _, layer = solids
    expected = np.array(list(reference.shares(mesh).values()))
    found = np.zeros_like(expected)
    found[layer.shares.faces] = layer.shares.share
    assert layer.shares.sound.all() and np.abs(expected).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_pairs_whose_boxes_meet(solids):
    (vertices, faces), *_ = solids
    pair_layout._meshes.clear()
    mesh = pair_layout.prepared(faces, len(vertices))
    points = np.ascontiguousarray(vertices.T)
    layout, *rest = pair_boxes.near_groups(mesh, points)
    every = np.ones(len(faces), bool)
    parts = list(pair_boxes.near_pairs(layout, *rest, every))
    slots = np.concatenate([np.stack(part, axis=1) for part in parts])
    found = [frozenset(pair) for pair in layout.face[slots].tolist()]
    assert len(found) == len(set(found))
    meet = reference.near_pairs((vertices, faces))
    step = np.ptp(vertices, axis=0).max() / box_words.STEPS
    assert meet <= set(found) <= reference.near_pairs((vertices, faces), slack=3 * step)
    assert len(meet) > 100


def test_clusters():
    rng = np.random.default_rng(4)
    faces = rng.permutation(np.arange(3 * 203)).reshape(-1, 3)
    vertices = rng.normal(size=(faces.size, 3))
    corners = vertices[faces]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    layout = pair_layout.prepared(faces, len(vertices)).arrange(boxes)
    filled = np.ones(len(layout.face), bool)
    filled[layout.empty] = False
    rows = zip(layout.face.reshape(-1, CLUSTER), filled.reshape(-1, CLUSTER), strict=True)
    found = [set(faces_of[here].tolist()) for faces_of, here in rows if here.any()]
    centers = boxes[:, :3] + boxes[:, 3:]
    assert found == [set(x) for x in reference.clusters(centers, range(len(faces)), CLUSTER)]


def test_tables_of_a_rest_surface(monkeypatch):
    monkeypatch.setattr(paths, "_SEEDS", 12)  # a small mesh has as many as vertices
    vertices, faces = join(moved(tube_into_itself(), translation=(5.0, 0, 0)), nested_boxes())
    allowed = np.where(np.arange(len(faces)) % 2, 0.2, 0.9)
    expected = reference.distances_at_rest(vertices, faces)
    table = rest_table(RestSurface(vertices, faces, allowed))
    rows, longest = np.asarray(table.paths.rows), np.asarray(table.paths.longest)
    # From any seed both sides of the triangle inequality, up to the longest edge of a triangle.
    slack = np.maximum(longest[:, None], longest)[..., None]
    with np.errstate(invalid="ignore"):
        between = np.abs(rows[:, None] - rows[None]) - slack
    lower = np.nanmax(between, axis=2, initial=0.0)
    upper = (rows[:, None] + rows[None]).min(axis=2)
    assert (lower <= expected + 1e-5).all() and (expected <= upper + 1e-5).all()
    nearest = np.asarray(table.paths.nearest)
    np.testing.assert_array_equal(table.paths.to_nearest, rows[np.arange(len(faces)), nearest])
    # Of the faces with a short distance, a bit for each that is nearer than that.
    listed = np.flatnonzero(np.asarray(table.places.row) >= 0)
    bits = np.unpackbits(np.asarray(table.places.around), axis=1)[:, : len(faces)]
    assert len(listed)
    for face in listed:
        near = bits[table.places.row[face]] == 1
        unclear = np.abs(expected[face] - allowed[face]) < 1e-6
        np.testing.assert_array_equal(near[~unclear], (expected[face] < allowed[face])[~unclear])
    # The three nested boxes lie in each other at rest, the tube in none.
    part, each_other = np.asarray(table.places.part), np.asarray(table.places.in_each_other)
    tube = len(MESHES["a tube into itself"][1])
    assert set(part[:tube]) == {0} and len(set(part[tube:])) == 3
    assert not each_other[0].any()
    boxes = each_other[1:, 1:]
    np.testing.assert_array_equal(boxes, ~np.eye(3, dtype=bool))
