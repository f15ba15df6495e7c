"""Pictures without OpenGL: as VTK draws them, and the geometry by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers_show import needs_drawing, needs_opengl

from spt_jax import PinholeCamera
from spt_jax.show import render_arrows, render_mesh, render_overlay
from spt_jax.show.offscreen import SOFTWARE
from spt_jax.show.software import SoftwarePlotter

pytestmark = needs_drawing


@pytest.fixture
def without_opengl(monkeypatch):
    monkeypatch.setattr("spt_jax.show.offscreen.offscreen_window", lambda: SOFTWARE)


def scene():
    """A large ball with a labelled cap, and a small one inside it."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices = np.concatenate([ball.vertices, 0.3 * ball.vertices])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    labels = np.where(np.arange(len(vertices)) >= len(ball.vertices), 1, 0)
    labels[ball.vertices[:, 0].argsort()[:40]] = -1
    return vertices, faces, labels.astype(np.int8)


def pictures():
    vertices, faces, labels = scene()
    camera = PinholeCamera((150.0, 120.0), (70.0, 55.0), translation=(0.1, 0.0, 4.0))
    vectors = np.where(labels[:, None] == 1, vertices, 0.0)
    return [
        render_mesh(vertices, faces, labels, size=(120, 96), view=(30.0, 20.0)),
        render_arrows(vertices, faces, vectors, size=(96, 96), view="front"),
        render_overlay((128, 100), jnp.asarray(vertices), faces, camera),
    ]


@needs_opengl
def test_pictures_are_those_of_opengl(monkeypatch):
    expected = pictures()
    monkeypatch.setattr("spt_jax.show.offscreen.offscreen_window", lambda: SOFTWARE)
    # OpenGL draws the thin shafts of arrows paler: what they cover in part, they color in part.
    for found, opengl, limit in zip(pictures(), expected, (1.0, 5.0, 1.0), strict=True):
        # Over blocks of pixels, because outlines are sampled elsewhere within a pixel.
        pair = np.stack([found, opengl]).astype(float)[:, :96, :96].reshape(2, 24, 4, 24, 4, 3)
        off = np.abs(np.diff(pair.mean(axis=(2, 4)), axis=0))
        assert off.mean() < limit and np.quantile(off, 0.99) < 30


def test_a_square_fills_its_pixels_and_the_nearer_one_is_seen(without_opengl):
    pyvista = pytest.importorskip("pyvista")
    plotter = SoftwarePlotter(20, 10)
    plotter.set_background((0.0, 0.0, 0.0))
    camera = plotter.camera
    camera.position, camera.focal_point = (0.0, 0.0, 5.0), (0.0, 0.0, 0.0)
    camera.parallel_projection, camera.parallel_scale = True, 5.0  # a pixel is one unit
    square = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    for color, shift in (("red", (0, 0, 1.0)), ("blue", (3.0, 1.0, 0))):
        mesh = pyvista.PolyData.from_regular_faces(square + shift, faces)
        plotter.add_mesh(mesh, color=color, lighting=False)
    seen = plotter.screenshot(transparent_background=True)
    assert seen.shape == (10, 20, 4)
    red, blue = ((seen == [*rgb, 255]).all(axis=2) for rgb in ((255, 0, 0), (0, 0, 255)))
    expected = np.zeros((10, 20), bool)
    expected[3:7, 8:12] = True
    np.testing.assert_array_equal(red, expected)
    behind = np.zeros((10, 20), bool)
    behind[2:6, 11:15] = True
    np.testing.assert_array_equal(blue, behind & ~red)
    np.testing.assert_array_equal(seen[..., 3] > 0, red | blue)


def test_light_falls_off_with_the_cosine_and_the_back_is_lit_as_the_front(without_opengl):
    pyvista = pytest.importorskip("pyvista")
    tilted = np.deg2rad([0.0, 40.0, 75.0])
    found = []
    for turn in (1, -1):
        for angle in tilted:
            plotter = SoftwarePlotter(9, 9)
            plotter.add_light(pyvista.Light(position=(0, 0, 1), light_type="camera light"))
            camera = plotter.camera
            camera.position, camera.focal_point = (0.0, 0.0, 5.0), (0.0, 0.0, 0.0)
            camera.parallel_projection, camera.parallel_scale = True, 1.0
            corners = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]])
            corners[:, 2] = corners[:, 0] * np.tan(angle)
            mesh = pyvista.PolyData.from_regular_faces(corners, np.array([[0, 1, 2]])[:, ::turn])
            plotter.add_mesh(mesh, color="white", ambient=0.1, diffuse=0.8)
            found.append(plotter.screenshot()[4, 4, 0] / 255)
    expected = np.tile(0.1 + 0.8 * np.cos(tilted), 2)
    np.testing.assert_allclose(found, expected, atol=1 / 255)


def test_panels_are_drawn_in_pieces_as_at_once(without_opengl, monkeypatch):
    vertices, faces, labels = scene()
    whole = render_mesh(vertices, faces, labels, size=(64, 64))
    monkeypatch.setattr("spt_jax.show.software._AT_ONCE", 1000)
    np.testing.assert_array_equal(render_mesh(vertices, faces, labels, size=(64, 64)), whole)
