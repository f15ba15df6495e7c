import builtins
import os

import numpy as np
import pytest
import trimesh
from helpers_show import needs_drawing
from PIL import Image

from spt_jax.show import offscreen, plot_curves, render_before_after, render_mesh, render_strip
from spt_jax.show.framing import frame, view_axes
from spt_jax.show.offscreen import SOFTWARE, import_extra, offscreen_window

SIZE = (96, 128)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.array(mesh.vertices), np.array(mesh.faces)


def red(picture):
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return ((r > g + 70) & (r > b + 70)).sum()


def blue(picture):
    r, _, b = picture.astype(int).transpose(2, 0, 1)
    return (b > r + 50).sum()


def labels_where(mask):
    return mask.astype(np.int8)


@needs_drawing
def test_a_mesh_is_drawn_and_only_labels_are_colored(ball, tmp_path):
    vertices, faces = ball
    plain = render_mesh(vertices, faces, size=SIZE, path=tmp_path / "a.png")
    assert plain.shape == (128, 96, 3) and plain.dtype == np.uint8
    assert len(np.unique(plain.reshape(-1, 3), axis=0)) > 50
    assert red(plain) == blue(plain) == 0
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), plain)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    front = labels_where(vertices[:, 2] > 0.9)
    assert red(render_mesh(vertices, faces, front, size=SIZE)) > 20
    assert blue(render_mesh(vertices, faces, -front, size=SIZE)) > 20
    np.testing.assert_array_equal(render_mesh(vertices, faces, 0 * front, size=SIZE), plain)


@needs_drawing
def test_labels_inside_the_body_shine_through(ball):
    vertices, faces = ball
    both = np.concatenate([vertices, 0.3 * vertices])
    labels = labels_where(np.arange(len(both)) >= len(vertices))
    picture = render_mesh(both, np.concatenate([faces, faces + len(vertices)]), labels, size=SIZE)
    hidden = red(picture)
    # The inner ball's disc, 0.3 of a radius of 48 / 1.08 pixels, and its outline.
    assert np.pi * 13**2 * 0.8 < hidden < np.pi * 16**2


@needs_drawing
def test_one_labelled_vertex_is_seen(ball):
    vertices, faces = ball
    labels = labels_where(np.arange(len(vertices)) == np.argmax(vertices[:, 2]))
    assert red(render_mesh(vertices, faces, labels, size=SIZE)) >= 4


@needs_drawing
def test_each_panel_is_drawn_like_a_first_one(ball):
    vertices, faces = ball
    front = labels_where(vertices[:, 2] > 0.9)
    flat = vertices * [1, 0.5, 1]
    meshes, labels = [vertices, flat, vertices], [front, None, None]
    row = render_strip(meshes, faces, labels, size=SIZE, view="front")
    panels = [row[:, i * 102 : i * 102 + 96] for i in range(3)]
    assert row.shape == (128, 3 * 102 - 6, 3)
    np.testing.assert_array_equal(panels[0], render_mesh(vertices, faces, front, size=SIZE))
    np.testing.assert_array_equal(panels[2], render_mesh(vertices, faces, size=SIZE))
    assert red(panels[0]) and not red(panels[1]) and not np.array_equal(panels[1], panels[2])


@needs_drawing
def test_before_and_after_share_the_camera(ball, tmp_path):
    vertices, faces = ball
    moved = vertices + np.array([3.0, 0, 0])
    picture = render_before_after(
        vertices, moved, faces, labels_where(vertices[:, 0] > 2), None, size=SIZE, view="front"
    )
    title = picture.shape[0] - 128
    assert title > 0 and picture.shape[1] == 2 * 102 - 6
    columns = [
        np.flatnonzero((picture[title:, start : start + 96] != [246, 244, 240]).any(axis=(0, 2)))
        for start in (0, 102)
    ]
    # One scale, and each where it stands: the first at the left edge, the second at the right.
    assert columns[0].max() < 50 and columns[1].min() > 45
    assert abs(np.ptp(columns[0]) - np.ptp(columns[1])) <= 1
    assert abs(columns[0].min() - (95 - columns[1].max())) <= 1


@needs_drawing
def test_pairs_stack_as_rows(ball):
    vertices, faces = ball
    labels = labels_where(vertices[:, 2] > 0.9)
    picture = render_before_after(
        [vertices] * 2, [vertices] * 2, faces, [labels, None], [None, labels], size=SIZE
    )
    rows = picture[-(2 * 128 + 6) :]
    for i, j, expected in [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 1)]:
        panel = rows[i * 134 : i * 134 + 128, j * 102 : j * 102 + 96]
        assert (red(panel) > 0) == bool(expected)
    with pytest.raises(ValueError, match="one length: got 2, 1, 2, 1"):
        render_before_after([vertices] * 2, [vertices], faces, [None] * 2, [None], size=SIZE)


@needs_drawing
def test_pictures_repeat_to_the_bit_and_leave_the_environment_alone(ball, capfd):
    vertices, faces = ball
    before = dict(os.environ)
    first, second = (render_mesh(vertices, faces, size=SIZE, title="a $b$") for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert dict(os.environ) == before
    captured = capfd.readouterr()
    assert not captured.err and not captured.out


def test_what_is_refused(ball, tmp_path):
    vertices, faces = ball
    with pytest.raises(ValueError, match=r"must end in \.png"):
        render_mesh(vertices, faces, path=tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="titles must hold 2 strings: got 1"):
        render_strip([vertices] * 2, faces, titles=["a"])
    with pytest.raises(ValueError, match="labels must be nested like meshes"):
        render_strip([vertices] * 2, faces, [None])
    with pytest.raises(ValueError, match="at least one mesh"):
        render_strip([], faces)
    with pytest.raises(ValueError, match="at least 16 by 16"):
        render_mesh(vertices, faces, size=(0, 9))
    with pytest.raises(ValueError, match="view must be"):
        frame([vertices], faces, [np.zeros(len(vertices), np.int8)], "side", 1.0)
    assert not list(tmp_path.iterdir())


def test_view_axes():
    np.testing.assert_allclose(view_axes(0, 0), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(view_axes(90, 0), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(view_axes(0, 90)[2], [0, 1, 0], atol=1e-12)
    axes = view_axes(33, 21)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize("azimuth", [0, 45, -45, 90, -90, 135, -135, 180])
def test_auto_turns_to_the_labels(ball, azimuth):
    vertices, faces = ball
    towards = view_axes(azimuth, 0)[2]
    labels = labels_where(vertices @ towards > 0.95)
    seen = frame([vertices], faces, [labels], "auto", 1.0).axes[2]
    # The patch is a third seen from one azimuth beside it, which may then be nearer the front.
    assert seen @ towards > 0.65
    assert frame([vertices], faces, [0 * labels], "auto", 1.0).axes[2][2] > 0.9


def test_everything_is_in_the_frame(ball):
    vertices, faces = ball
    labels = np.zeros(len(vertices), np.int8)
    meshes = [vertices, vertices * [3, 1, 1] + [0, 5, 0]]
    for aspect in (0.5, 2.0):
        camera = frame(meshes, faces, [labels] * 2, (30.0, 20.0), aspect)
        x, y, _ = ((np.concatenate(meshes) - camera.target) @ camera.axes.T).T
        assert max(np.abs(y).max(), np.abs(x).max() / aspect) * 1.08 == pytest.approx(
            camera.half_height
        )


def test_curves(tmp_path):
    x = np.arange(1, 50)
    series = {"a": np.exp(-x / 5), "b": np.stack([x, 1.0 / x], axis=1)}
    path = tmp_path / "c.png"
    linear = plot_curves(series, xlabel="step", ylabel="volume", size=(320, 200), path=path)
    logarithmic = plot_curves(series, xlabel="step", ylabel="volume", size=(320, 200), log=True)
    assert linear.shape == logarithmic.shape == (200, 320, 3)
    assert not np.array_equal(linear, logarithmic)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), linear)
    plot_curves({"zero": np.zeros(5), "empty": []}, xlabel="", ylabel="", log=True)
    with pytest.raises(ValueError, match="at least one curve"):
        plot_curves({}, xlabel="", ylabel="")
    with pytest.raises(ValueError, match=r"got \(3, 3\) in 'a'"):
        plot_curves({"a": np.zeros((3, 3))}, xlabel="", ylabel="")


def test_a_missing_extra_is_named(monkeypatch):
    real = builtins.__import__

    def without_pyvista(name, *args, **kwargs):
        if name == "pyvista":
            raise ModuleNotFoundError("No module named 'pyvista'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_pyvista)
    with pytest.raises(ImportError, match=r'need pyvista.*pip install "spt-jax\[viz\]"'):
        import_extra("pyvista")


@pytest.mark.skipif(os.name != "posix" or os.uname().sysname != "Linux", reason="Linux windows")
def test_where_no_window_can_be_made_we_draw_ourselves(monkeypatch):
    pytest.importorskip("vtkmodules")
    # The window that VTK ends at when EGL and X fail; drawing in it without its library crashes.
    monkeypatch.setattr(offscreen, "_OSMESA_NAMES", ())
    monkeypatch.setattr(offscreen, "_EGL", "vtkOSOpenGLRenderWindow")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv(offscreen._WINDOW_VARIABLE, raising=False)
    assert offscreen_window.__wrapped__() == SOFTWARE
