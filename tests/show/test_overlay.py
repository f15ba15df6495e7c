"""Bodies and keypoints drawn over photographs: everything where the camera says it is."""

import numpy as np
import pytest
import trimesh
from helpers_show import needs_drawing
from PIL import Image
from scipy.spatial.transform import Rotation

from spt_jax._camera import PinholeCamera
from spt_jax.body import load_body
from spt_jax.keypoints import LAYOUTS
from spt_jax.show import render_overlay
from spt_jax.show.overlay import read_image

SIZE = (160, 120)
PAPER = np.array([246, 244, 240])
BLUE, ORANGE = (0, 114, 178), (230, 159, 0)


@pytest.fixture
def camera(rng):
    """Off center, with two focal lengths, turned and moved."""
    rotation = Rotation.from_rotvec([2.8, 0.4, -0.3]).as_matrix()
    return PinholeCamera((170.0, 140.0), (61.0, 77.0), rotation, (0.1, 0.3, 3.0))


def ball_at(center, radius=0.03):
    ball = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(center) + radius * np.asarray(ball.vertices), np.asarray(ball.faces)


def ink(picture):
    """How far each pixel is from the empty canvas."""
    return np.abs(picture.astype(float) - PAPER).max(axis=2)


def middle(picture):
    """The middle of all that is not black, from the corner of the first pixel."""
    y, x = np.nonzero(picture.any(axis=2))
    return np.array([x.mean(), y.mean()]) + 0.5


def near(picture, color):
    return np.abs(picture.astype(int) - color).max(axis=2) < 30


@needs_drawing
def test_a_joint_is_drawn_on_the_pixel_where_the_camera_projects_it(camera):
    body = load_body()
    joints = np.asarray(body.joint_template)
    # Three times as fine, so that a small ball has a middle.
    camera = PinholeCamera(3 * camera.focal, 3 * camera.center, camera.rotation, camera.translation)
    night = np.zeros((480, 640, 3), np.uint8)
    pixels = np.asarray(camera.project(joints))
    for name in ("left_wrist", "right_wrist", "left_ankle", "head", "pelvis"):
        joint = body.joint_names.index(name)
        assert (pixels[joint] > 5).all() and (pixels[joint] < [635, 475]).all()
        picture = render_overlay(night, *ball_at(joints[joint]), camera, opacity=1.0)
        np.testing.assert_allclose(middle(picture), pixels[joint], atol=0.15)


@needs_drawing
def test_edges_fall_where_they_should_to_the_pixel():
    # 2 m away 1 m is 50 pixels across and 25 down: from 30 to 130 and from 20 to 70.
    x, y = (30 - 55) / 50, (20 - 45) / 25
    corners = np.array([[x, y, 2], [x + 2, y, 2], [x + 2, y + 2, 2], [x, y + 2, 2]], float)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    picture = render_overlay(SIZE, corners, faces, PinholeCamera((100.0, 50.0), (55.0, 45.0)))
    drawn = ink(picture) > 5
    expected = np.zeros((120, 160), bool)
    expected[20:70, 30:130] = True
    np.testing.assert_array_equal(drawn, expected)


@needs_drawing
def test_what_is_near_hides_what_is_far_in_a_picture_of_several(camera):
    origin = np.asarray(-camera.rotation.T @ camera.translation)
    sight = np.array([0.0, 0.0, 1.0]) @ np.asarray(camera.rotation)
    far, faces = ball_at(origin + 3 * sight, 0.3)
    close, _ = ball_at(origin + 2 * sight, 0.1)
    both = render_overlay(SIZE, [far, close], faces, camera)
    swapped = render_overlay(SIZE, [close, far], faces, camera)
    x, y = np.round(np.asarray(camera.center)).astype(int)
    assert np.abs(both[y, x].astype(int) - swapped[y, x]).max() > 15  # the near one's own color
    first, second = (render_overlay(SIZE, points, faces, camera) for points in (far, close))
    np.testing.assert_array_equal(ink(both) > 5, (ink(first) > 5) | (ink(second) > 5))
    stacked = render_overlay(SIZE, np.stack([far, close]), faces, camera)
    np.testing.assert_array_equal(stacked, both)


@needs_drawing
def test_the_photograph_stays_around_the_body_and_shows_through_it(camera, rng, tmp_path):
    photograph = rng.integers(0, 255, (120, 160, 3), np.uint8)
    target = -np.asarray(camera.rotation.T @ camera.translation)
    ball, faces = ball_at(target + 2 * np.asarray(camera.rotation)[2], 0.3)
    covered = render_overlay(np.zeros_like(photograph), ball, faces, camera).any(axis=2)
    Image.fromarray(photograph).save(tmp_path / "a.png")
    half = render_overlay(tmp_path / "a.png", ball, faces, camera, opacity=0.5)
    np.testing.assert_array_equal(half[~covered], photograph[~covered])
    whole = render_overlay(photograph, ball, faces, camera, opacity=1.0)
    y, x = np.nonzero(np.logical_and.reduce([covered, near(whole, (213, 201, 188))]))
    np.testing.assert_allclose(half[y, x], (0.5 * photograph + 0.5 * whole)[y, x], atol=1)
    assert len(y) > 100
    nothing = render_overlay(photograph, ball, faces, camera, opacity=0.0)
    np.testing.assert_array_equal(nothing, photograph)


@needs_drawing
def test_a_body_behind_the_camera_or_around_it_is_not_drawn_over_the_picture():
    camera = PinholeCamera(100.0, (80.0, 60.0))
    ball, faces = ball_at((0, 0, -2))
    assert not (ink(render_overlay(SIZE, ball, faces, camera)) > 5).any()
    assert not (ink(render_overlay(SIZE, [], faces, camera)) > 5).any()
    around, _ = ball_at((0, 0, 0), 0.5)
    assert render_overlay(SIZE, around, faces, camera).shape == (120, 160, 3)


@needs_drawing
def test_keypoints_are_dots_in_their_sides_colors_and_missing_ones_are_left_out():
    camera = PinholeCamera(100.0, (80.0, 60.0))
    faces = np.array([[0, 1, 2]])
    layout = LAYOUTS["coco17"]
    points = np.full((17, 2), np.nan)
    confidence = np.zeros(17)
    for name, place in (("left_wrist", (40, 30)), ("right_ankle", (120.0, 90.0))):
        points[layout.names.index(name)] = place
        confidence[layout.names.index(name)] = 1
    picture = render_overlay(SIZE, [], faces, camera, points, confidence, skeleton="coco17")
    for color, place in ((BLUE, (40, 30)), (ORANGE, (120, 90))):
        y, x = np.nonzero(near(picture, color))
        assert len(x) >= 4
        np.testing.assert_allclose([x.mean() + 0.5, y.mean() + 0.5], place, atol=0.3)
    # Nothing else is drawn: no line to what is missing, nothing at (0, 0).
    y, x = np.nonzero(ink(picture) > 5)
    distance = np.hypot(
        *(np.stack([x, y]) + 0.5 - np.array([[40, 30], [120, 90]])[..., None]).transpose(1, 0, 2)
    )
    assert distance.min(axis=0).max() < 6
    # A hidden point is fainter; a line joins two points that the skeleton joins.
    confidence[layout.names.index("left_wrist")] = 0.2
    faint = render_overlay(SIZE, [], faces, camera, points, confidence, skeleton="coco17")
    assert ink(faint)[30, 40] < 0.8 * ink(picture)[30, 40]
    points[layout.names.index("right_knee")] = (120, 30)
    confidence[layout.names.index("right_knee")] = 1
    joined = render_overlay(SIZE, [], faces, camera, points, confidence, skeleton=layout)
    assert ink(joined)[60, 119:121].min() > 60 and ink(picture)[60, 119:121].max() == 0
    # Without a skeleton nothing is left or right.
    plain = render_overlay(SIZE, [], faces, camera, points, confidence)
    assert not near(plain, ORANGE).any() and not near(plain, BLUE).any()


@needs_drawing
def test_rings_mark_where_the_body_has_the_keypoints():
    camera = PinholeCamera(100.0, (80.0, 60.0))
    faces = np.array([[0, 1, 2]])
    seen = np.array([[[40.0, 60.0]], [[100.0, 60.0]]])
    fitted = seen + np.array([[[20.0, 0.0]], [[0.0, 0.0]]])
    alone = render_overlay(SIZE, [], faces, camera, seen)
    both = render_overlay(SIZE, [], faces, camera, seen, None, fitted)
    changed = np.abs(both.astype(int) - alone).max(axis=2) > 20
    assert changed[60, 48:52].all()  # the line between the dot and its ring
    assert changed[50:70, 50:70].sum() > 10 and not changed[60, 59:61].any()  # a ring is hollow
    assert not changed[:50].any() and not changed[70:].any()
    np.testing.assert_array_equal(
        render_overlay(SIZE, [], faces, camera, seen[0], fitted=fitted[0]),
        render_overlay(SIZE, [], faces, camera, seen[:1], fitted=fitted[:1]),
    )


@needs_drawing
def test_the_picture_is_written_and_repeats_to_the_bit(camera, tmp_path):
    ball, faces = ball_at((0, 0, 0), 0.3)
    seen = np.array([[50.0, 50.0]])
    first = render_overlay(SIZE, ball, faces, camera, seen, path=tmp_path / "a.png")
    np.testing.assert_array_equal(first, render_overlay(SIZE, ball, faces, camera, seen))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), first)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_photographs_are_turned_as_their_camera_says(tmp_path):
    image = Image.new("RGB", (40, 20), (200, 100, 50))
    exif = Image.Exif()
    exif[0x0112] = 6  # the top is at the right
    image.save(tmp_path / "a.jpg", exif=exif)
    assert read_image(tmp_path / "a.jpg").shape == (40, 20, 3)
    Image.new("L", (20, 30)).save(tmp_path / "gray.png")
    assert read_image(tmp_path / "gray.png").shape == (30, 20, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(path="a.jpg"), r"path must end in \.png"),
        (dict(image=(9, 30)), "sides of 16 to 8192 pixels: got 9 by 30"),
        (dict(image=np.zeros((30, 30), np.uint8)), r"image must be .* got uint8 \(30, 30\)"),
        (dict(vertices=np.zeros((3, 2))), r"vertices must be \(V, 3\)"),
        (dict(opacity=2.0), "opacity must be from 0 to 1: got 2.0"),
        (dict(keypoints=np.zeros((4, 3))), r"keypoints must be \(K, 2\).*got \(4, 3\)"),
        (dict(confidence=np.ones(4)), "confidence must come with keypoints"),
        (dict(keypoints=np.zeros((4, 2)), fitted=np.zeros((3, 2))), "fitted must be like"),
        (dict(keypoints=np.zeros((4, 2)), skeleton="coco17"), "coco17 has 17 keypoints: got 4"),
        (dict(keypoints=np.zeros((4, 2)), skeleton="cocoa"), "layout must be one of"),
        (dict(keypoints=np.zeros((2, 4, 2)), fitted=np.zeros((1, 4, 2))), "of 2 people.*got 1"),
    ],
)
def test_what_is_refused(change, message, untyped, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    options = dict(
        image=SIZE,
        vertices=np.eye(3),
        faces=np.array([[0, 1, 2]]),
        camera=PinholeCamera(100.0, (80.0, 60.0)),
    )
    with pytest.raises(ValueError, match=message):
        render_overlay(**(options | change))
    assert not list(tmp_path.iterdir())


def test_photographs_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError, match="image must exist"):
        read_image(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"0" * 50)
    with pytest.raises(ValueError, match=r"must be a photograph that opens: got .*a\.png"):
        read_image(tmp_path / "a.png")


def test_what_pillow_warns_of_metadata_is_not_handed_on(tmp_path):
    """A tag with a value too many, as a flipped bit leaves it; the suite takes warnings for errors.

    The fuzz found it: Pillow reads the pixels all the same.
    """
    path = tmp_path / "a.tif"
    pixels = np.arange(20 * 30 * 3, dtype=np.uint8).reshape(20, 30, 3)
    Image.fromarray(pixels).save(path)
    content = bytearray(path.read_bytes())
    # RowsPerStrip: the tag 278, of any type, with one value.
    at = next(
        k for k in range(8, len(content)) if content[k : k + 2] == (278).to_bytes(2, "little")
    )
    content[at + 4] = 9
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="tag 278"), Image.open(path) as image:
        image.load()
    assert read_image(path).shape == (20, 30, 3)
