"""The device path's labels against the host's."""

import jax
import numpy as np
import pytest
from helpers import body_faces, posed_bodies
from helpers_device import SOLIDS, padded

from spt_jax import classify_vertices
from spt_jax.overlap.surface import ExactSurface

FRAMES = ["crawl/0092", "roll/0056", "run/0010"]


def labels(vertices, faces, rule, backend="xla"):
    return classify_vertices(vertices, faces, rays=48, rule=rule, backend=backend).labels


on_device = jax.jit(labels, static_argnums=2)


@pytest.mark.parametrize("name", SOLIDS)
def test_vertex_rule(name, dtype):
    mesh = padded(name, dtype)
    label = on_device(*mesh, "vertex")
    assert label.dtype == np.int8
    np.testing.assert_array_equal(label, labels(*mesh, "vertex", "numpy"))
    assert (name == "apart") == (not label.any())


@pytest.mark.parametrize("name", SOLIDS)
def test_triangle_rule(name):
    mesh = padded(name, "float32")
    label = on_device(*mesh, "triangle")
    np.testing.assert_array_equal(label, labels(*mesh, "triangle", "numpy"))
    assert (name == "apart") == (not label.any())


def test_vertex_rule_of_bodies():
    bodies = posed_bodies(FRAMES).astype(np.float32)
    label = on_device(bodies, body_faces().astype(np.int32), "vertex")
    expected = labels(bodies, body_faces(), "vertex", "numpy")
    # A vertex whose own triangles pass through each other has several numbers.
    for vertices, ours, hosts in zip(bodies, np.asarray(label), np.asarray(expected), strict=True):
        surface = ExactSurface(vertices.astype(float), body_faces(), 1.2e-7)
        cusps = np.unique(surface.contours.cusp)
        assert set(np.flatnonzero(ours != hosts)) <= set(cusps) and len(cusps) < 200
    assert (np.count_nonzero(label, axis=1) > 20).all()


def test_vertices_by_a_hole():
    """What the first ray leaves open is told by the next ones, as on the host."""
    vertices, faces = padded("box in a box", "float32")
    some = faces.copy()
    some[2] = 0  # a hole in the outer box
    expected = labels(vertices, some, "vertex", "numpy")
    np.testing.assert_array_equal(on_device(vertices, some, "vertex"), expected)
    assert expected.any()


def test_what_cannot_be_measured_is_clear():
    vertices, faces = padded("two boxes", "float32")
    vertices[0, 0] = np.nan
    for rule in ("vertex", "triangle"):
        assert not on_device(vertices, faces, rule).any()
