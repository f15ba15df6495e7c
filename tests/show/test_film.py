"""Motions as animated pictures and films: what a reader of them sees is what was drawn."""

import sys
import types

import numpy as np
import pytest
import trimesh
from PIL import Image

from spt_jax.show import write_film

_SIZE = (48, 64)


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=1)


@pytest.fixture(scope="module")
def growing(ball):
    return np.stack([k * ball.vertices for k in (0.2, 0.4, 0.6, 0.8, 1.0)])


def dark(picture):
    """How many pixels of the left and the right panel are not background."""
    grey = np.asarray(Image.fromarray(np.asarray(picture)).convert("L"), int)
    left = grey[:, : _SIZE[0]] < grey[0, 0] - 30
    right = grey[:, -_SIZE[0] :] < grey[0, 0] - 30
    return int(left.sum()), int(right.sum())


@pytest.mark.parametrize(("suffix", "milliseconds"), [(".gif", 40), (".webp", 40)])
def test_an_animated_picture_plays_all_frames_side_by_side(
    tmp_path, ball, growing, suffix, milliseconds
):
    path = tmp_path / f"ball{suffix}"
    motions = [growing, growing[::-1]]
    write_film(path, motions, ball.faces, frames_per_second=25.0, size=_SIZE)
    sizes = []
    with Image.open(path) as picture:
        assert getattr(picture, "n_frames", 1) == 5 and picture.info.get("loop", 0) == 0
        for k in range(5):
            picture.seek(k)
            picture.load()
            assert picture.info["duration"] == milliseconds
            sizes.append(dark(picture.convert("RGB")))
    left, right = np.array(sizes).T
    assert (np.diff(left) > 0).all() and (np.diff(right) < 0).all()
    np.testing.assert_allclose(left, right[::-1], rtol=0.2, atol=8)


def test_a_film_gets_even_sides_and_the_rate(tmp_path, ball, growing, monkeypatch):
    """In place of what writes films, something that keeps what it is handed."""
    handed = {}

    def mimwrite(path, pictures, **options):
        handed.update(options, pictures=list(pictures))
        path.write_bytes(b"film")

    module = types.SimpleNamespace(mimwrite=mimwrite)
    monkeypatch.setitem(sys.modules, "imageio", types.SimpleNamespace(v2=module))
    monkeypatch.setitem(sys.modules, "imageio.v2", module)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", types.SimpleNamespace())
    write_film(tmp_path / "a.mp4", [growing], ball.faces, frames_per_second=24.0, size=(47, 63))
    assert (tmp_path / "a.mp4").read_bytes() == b"film"
    assert len(handed["pictures"]) == 5 and handed["fps"] == 24.0
    assert all(p.shape == (62, 46, 3) for p in handed["pictures"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio's reader
def test_a_film_that_a_player_reads(tmp_path, ball, growing):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "ball.mp4"
    write_film(path, [growing, growing[::-1]], ball.faces, frames_per_second=20.0, size=_SIZE)
    with imageio.get_reader(path) as reader:
        assert reader.get_meta_data()["fps"] == 20.0
        sizes = [dark(picture) for picture in reader]
    left, right = np.array(sizes).T
    assert len(sizes) == 5 and (np.diff(left) > 0).all() and (np.diff(right) < 0).all()


def test_what_cannot_be_filmed_is_refused_and_leaves_nothing(tmp_path, ball, growing, monkeypatch):
    still = [growing, growing[:2]]
    for path, motions, options, message in (
        ("a.avi", [growing], {}, r"must end in \.gif, \.webp or \.mp4"),
        ("a.gif", [], {}, "at least one"),
        ("a.gif", still, {}, r"same number of frames: got \[5, 2\]"),
        ("a.gif", [growing], {"frames_per_second": 0.0}, "must be positive"),
        ("a.gif", [growing], {"labels": [np.zeros((2, len(ball.vertices)))]}, "one for each"),
    ):
        with pytest.raises(ValueError, match=message):
            write_film(tmp_path / path, motions, ball.faces, size=_SIZE, **options)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match="pip install imageio imageio-ffmpeg"):
        write_film(tmp_path / "a.mp4", [growing], ball.faces, size=_SIZE)
    assert not list(tmp_path.iterdir())
