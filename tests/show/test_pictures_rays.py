"""Ray pictures, arrows and the curves' look: what is drawn is what was measured."""

import numpy as np
import pytest
import trimesh
from helpers_show import needs_drawing
from PIL import Image

from spt_jax.overlap.measure import Sampling, measure
from spt_jax.show import look, plot_curves, plot_ray, plot_rays, ray_images, render_arrows
from spt_jax.show.arrows import _spread_out
from spt_jax.show.ray_pictures import _telling_ray
from spt_jax.show.rays import cast_beam, profile


def one_mesh(*meshes) -> trimesh.Trimesh:
    both = trimesh.util.concatenate(list(meshes))
    assert isinstance(both, trimesh.Trimesh)
    return both


def bundle_of(picture):
    """What a notebook asks an object for."""
    return picture._repr_mimebundle_()


@pytest.fixture(scope="module")
def balls():
    """Two unit balls whose centers are 1.2 apart along x and z, above one another along neither."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    moved = ball.copy().apply_translation([0.9, 0.2, 0.7])
    both = one_mesh(ball, moved)
    return np.array(both.vertices), np.array(both.faces)


def near(picture, color, tolerance=12):
    channels = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return (np.abs(picture.astype(int) - channels).max(axis=2) <= tolerance).sum()


@pytest.mark.parametrize("view", ["front", "left", "top", (33.0, 21.0)])
def test_the_lengths_add_up_to_the_volume_from_every_side(balls, view):
    exact = measure(*balls, Sampling(None, ((0.0, 0.0, -1.0),))).volume
    images = ray_images(*balls, view=view, rays=200)
    assert images.volume == pytest.approx(exact, rel=2e-3)
    assert images.overlap.sum() * images.ray_area == images.volume
    # No ray of a closed mesh is crossed an odd number of times, and only crossed rays overlap.
    assert not (images.crossings % 2).any()
    assert (images.crossings[images.overlap > 0] >= 4).all()
    crossed = (images.crossings > 0).sum() * images.ray_area
    hull = trimesh.Trimesh(*balls)
    if view == "front":  # from z, the union of two discs of radius 1, centers 0.92 apart
        distance = np.hypot(0.9, 0.2)
        lens = 2 * np.arccos(distance / 2) - distance / 2 * np.sqrt(4 - distance**2)
        assert crossed == pytest.approx(2 * np.pi - lens, rel=0.02)
    assert crossed < hull.bounding_box.area


def test_the_images_stand_as_a_picture_does(balls):
    vertices, faces = balls
    big = vertices.copy()
    big[:, 1] += 3.0 * (vertices[:, 1] > 0.0)  # something high up, and to the body's left
    lone = trimesh.creation.box().apply_translation([4.0, 5.0, 0.0])
    scene = one_mesh(trimesh.Trimesh(vertices, faces, process=False), lone)
    count = ray_images(scene.vertices, scene.faces, rays=120).crossings
    rows, columns = np.nonzero(count)
    top = rows < count.shape[0] / 4
    # The body's left, +x, is on the viewer's right; up is up.
    assert top.any() and columns[top].min() > count.shape[1] / 2


def test_a_profile_is_the_winding_number_along_its_ray():
    # Shells of radius 1, 0.5 (the right way) and, within the outer, 0.25 turned inside out.
    outer = trimesh.creation.icosphere(subdivisions=4)
    inner = outer.copy().apply_scale(0.5)
    hole = outer.copy().apply_scale(0.25)
    for others, counters, classes in (
        ([inner], [1, 2, 1, 0], [0, 1, 1, 0]),
        ([hole.copy()], [1, 0, 1, 0], [0, 0, 0, 0]),
    ):
        if others[0].extents[0] < 0.6:
            others[0].invert()
        both = one_mesh(outer, *others)
        found = cast_beam(both.vertices, both.faces, "front", 101)
        ray = _telling_ray(found)
        along = profile(found, ray)
        np.testing.assert_array_equal(along.counter, counters)
        np.testing.assert_array_equal(along.label, classes)
        assert (np.diff(along.depth) > 0).all()
    inverted = outer.copy()
    inverted.invert()
    found = cast_beam(inverted.vertices, inverted.faces, "front", 101)
    along = profile(found, _telling_ray(found))
    np.testing.assert_array_equal(along.counter, [-1, 0])
    np.testing.assert_array_equal(along.label, [-1, -1])
    # Depth counts from the mesh's nearest point to its farthest.
    assert np.ptp(along.depth) == pytest.approx(2.0, abs=0.02)
    assert along.depth[0] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("third", [False, True])
def test_the_profile_and_the_image_measure_one_length(balls, third):
    vertices, faces = balls
    if third:  # a ball that both others overlap, and their overlap too
        more = vertices[: len(vertices) // 2] * 0.8 + np.array([0.4, 0.1, 0.3])
        of_more = faces[: len(faces) // 2] + len(vertices)
        vertices, faces = np.concatenate([vertices, more]), np.concatenate([faces, of_more])
    found = cast_beam(vertices, faces, "front", 150)
    assert found.crossings.sign.cumsum().max() == (3 if third else 2)
    for ray in np.flatnonzero(found.overlap)[::97]:
        along = profile(found, int(ray))
        gaps = np.diff(along.depth)
        length = (gaps * along.counter[:-1] * (along.counter[:-1] - 1) / 2).sum()
        assert length == pytest.approx(found.overlap[ray], abs=1e-9)


def test_ray_pictures_show_overlap_where_there_is_some(balls, tmp_path):
    vertices, faces = balls
    size = (400, 260)
    both = plot_rays(vertices, faces, rays=80, size=size, path=tmp_path / "a.png")
    assert both.shape == (260, 400, 3) and both.dtype == np.uint8
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), both)
    cut = plot_ray(vertices, faces, rays=80, size=size, unit="m")
    apart = vertices + 5.0 * (np.arange(len(vertices)) >= len(vertices) // 2)[:, None]
    clear = plot_ray(apart, faces, rays=80, size=size, unit="m")
    assert near(cut, look.LABEL_COLORS[1]) > 500 and near(clear, look.LABEL_COLORS[1]) == 0
    inside_out = plot_ray(apart, faces[:, ::-1], rays=80, size=size)
    assert near(inside_out, look.LABEL_COLORS[-1]) > 500 and near(clear, look.LABEL_COLORS[-1]) == 0


@needs_drawing
def test_arrows_point_where_they_are_told_to(balls):
    vertices, faces = balls
    ball, triangles = vertices[: len(vertices) // 2], faces[: len(faces) // 2]
    plain = render_arrows(ball, triangles, 0 * ball, size=(120, 120), view=(0.0, 0.0))
    top = np.argmax(ball[:, 2])  # at the middle of the picture

    def center(vector):
        vectors = np.zeros_like(ball)
        vectors[top] = vector
        picture = render_arrows(ball, triangles, vectors, size=(120, 120), view=(0.0, 0.0))
        rows, columns = np.nonzero((picture != plain).any(axis=2))
        assert len(rows) > 15
        return columns.mean() - 59.5, 59.5 - rows.mean()

    for vector in ([1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]):
        # About half of an arrow's length, a fifth of 120 pixels, and not off to a side.
        x, y = center(vector)
        assert np.dot((x, y), vector[:2]) == pytest.approx(12.5, abs=2)
        assert abs(np.cross([x, y, 0], vector)[2]) < 1
    with pytest.raises(ValueError, match="one for each vertex"):
        render_arrows(ball, triangles, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="not finite"):
        render_arrows(ball, triangles, np.full_like(ball, np.nan))


def test_arrows_left_out_lie_beside_one_that_points_their_way(rng):
    points = rng.random((500, 3))
    vectors = rng.normal(size=(500, 3))
    vectors[::2] = 0.0
    assert (_spread_out(points, vectors, 500) == vectors.any(axis=1)).all()
    kept = _spread_out(points, vectors, 60)
    assert 0 < kept.sum() <= 60 and not (kept & ~vectors.any(axis=1)).any()
    assert kept[np.linalg.norm(vectors, axis=1).argmax()]
    # Opposite vectors at one place both stay, however few there may be.
    pair = np.array([[1.0, 0, 0], [-1.0, 0, 0]] * 4)
    assert _spread_out(np.zeros((8, 3)), pair, 2).sum() == 2
    assert _spread_out(points[:8], 10 * pair, 1).sum() == 1


def test_pictures_show_themselves_in_notebooks_and_only_as_pictures():
    picture = plot_curves({"a": [1.0, 0.1]}, xlabel="step", ylabel="value", title="a $b$")
    shown = bundle_of(picture)
    assert shown["image/png"][:8] == b"\x89PNG\r\n\x1a\n"
    assert shown["text/plain"] == "a picture of 720 x 440 pixels"
    assert bundle_of(picture[..., 0]) is None
    assert type(picture / 2) is np.ndarray and isinstance((picture > 0).sum(), np.integer)


def test_curves_past_the_colors_are_dashed():
    flat = {str(i): np.full(40, float(i)) for i in range(len(look.CURVES) + 1)}
    every = plot_curves(flat, **_AXES)
    for color in look.CURVES:
        assert near(every, color) > 500  # a row at least of 600 pixels
    twice = near(every, look.CURVES[0])
    flat.popitem()
    once = near(plot_curves(flat, **_AXES), look.CURVES[0])
    assert 1.4 * once < twice < 1.9 * once


_AXES = {"xlabel": "step", "ylabel": "value"}


def test_what_the_ray_pictures_refuse(balls, tmp_path, untyped):
    vertices, faces = balls
    with pytest.raises(TypeError, match=r"rays must be a whole number: got 2\.5"):
        ray_images(vertices, faces, rays=2.5)
    with pytest.raises(ValueError, match="rays must be from 1 to 4096"):
        ray_images(vertices, faces, rays=0)
    with pytest.raises(ValueError, match="view must be"):
        plot_rays(vertices, faces, view="side")
    with pytest.raises(ValueError, match=r"must end in \.png"):
        plot_ray(vertices, faces, path=tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="most must be at least 1"):
        render_arrows(vertices, faces, vertices, most=0)
    with pytest.raises(ValueError, match="crossed by a ray"):
        plot_ray(vertices * [1, 0, 0], faces, rays=4)
    assert not list(tmp_path.iterdir())
