"""Motions as animated pictures, or as films where a writer of films is installed."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int, UInt8

from spt_jax.files.outputs import atomic_write
from spt_jax.io.mesh_files import as_mesh_arrays
from spt_jax.show.framing import View, frame
from spt_jax.show.look import GAP, check_size
from spt_jax.show.panel import draw_panel, panel_plotter

# Frames by which the camera is chosen, of each motion.
_AIMED_AT = 12

_PICTURES = {".gif": "GIF", ".webp": "WEBP"}


def write_film(
    path: str | os.PathLike[str],
    motions: Sequence[Float[Array | np.ndarray, "T V 3"]],
    faces: Int[Array | np.ndarray, "F 3"],
    labels: Sequence[Any] | None = None,
    *,
    frames_per_second: float = 30.0,
    size: tuple[int, int] = (300, 380),
    view: View = "front",
) -> None:
    """Write motions that play side by side, such as one before and after it was freed.

    One camera stands still and sees all of them. An animated picture (.gif, .webp) needs nothing
    beyond the extra `viz`; a film (.mp4) needs `imageio` with `imageio-ffmpeg`.

    Args:
        path: of the file: .gif, .webp or .mp4. It appears whole or not at all.
        motions: vertices of each frame, of each panel from left to right; as many frames each.
        faces: vertex indices, the same for all.
        labels: of each panel, labels (T, V) as `classify_vertices` gives them, or None.
        frames_per_second: how fast it plays; a GIF has steps of a hundredth of a second.
        size: (width, height) of one panel in pixels.
        view: as in `render_mesh`.

    Raises:
        ImportError: the `viz` extra is not installed, or nothing that writes films.
        RenderingUnavailable: this machine cannot draw off screen.
        ValueError: no motions, or of different lengths; labels that do not fit; a rate that is not
            positive; another suffix.
        OSError: the file cannot be written.

    Example:
        >>> import numpy as np, pathlib, tempfile, trimesh
        >>> from spt_jax.show import write_film
        >>> ball = trimesh.creation.icosphere()
        >>> growing = np.stack([k * ball.vertices for k in (0.6, 0.8, 1.0)])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "ball.gif"
        ...     write_film(path, [growing, growing[::-1]], ball.faces, size=(32, 32))
        ...     path.read_bytes()[:6]
        b'GIF89a'
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*_PICTURES, ".mp4"):
        raise ValueError(f"path must end in .gif, .webp or .mp4: got {str(path)!r}.")
    if not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
    check_size(size)
    write = _film_writer() if suffix == ".mp4" else None
    pictures = _drawn(_as_panels(motions, faces, labels), size, view)
    with atomic_write(path) as temporary:
        if write is None:
            _write_animated(temporary, pictures, _PICTURES[suffix], frames_per_second)
        else:
            write(temporary, pictures, frames_per_second)


def _as_panels(motions, faces, labels) -> list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Of each frame its panels."""
    lengths = [len(motion) for motion in motions]
    if not lengths or len(set(lengths)) != 1 or not lengths[0]:
        raise ValueError(
            f"motions must be at least one, of the same number of frames: got {lengths}."
        )
    given = [None] * len(motions) if labels is None else list(labels)
    if [len(one) for one in given if one is not None] != [
        lengths[0] for one in given if one is not None
    ] or len(given) != len(motions):
        raise ValueError("labels must be one for each motion: (frames, V), or None.")
    return [
        [
            as_mesh_arrays(motion[k], faces, None if label is None else label[k])
            for motion, label in zip(motions, given, strict=True)
        ]
        for k in range(lengths[0])
    ]


def _drawn(panels, size: tuple[int, int], view: View) -> list[UInt8[np.ndarray, "H W 3"]]:
    width, height = size
    step = max(len(panels) // _AIMED_AT, 1)
    seen = [panel for row in panels[::step] for panel in row]
    camera = frame([p[0] for p in seen], seen[0][1], [p[2] for p in seen], view, width / height)
    found = []
    with panel_plotter(width, height) as plotter:
        for row in panels:
            canvas = np.full((height, len(row) * (width + GAP) - GAP, 3), 255, np.uint8)
            for j, panel in enumerate(row):
                x = j * (width + GAP)
                canvas[:, x : x + width] = draw_panel(plotter, *panel, camera=camera)
            found.append(canvas)
    return found


def _write_animated(path: Path, pictures, kind: str, rate: float) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    images[0].save(
        path,
        format=kind,
        save_all=True,
        append_images=images[1:],
        duration=max(round(1000 / rate), 1),
        loop=0,
    )


def _film_writer():
    try:
        import imageio.v2 as imageio  # pyright: ignore[reportMissingImports]
        import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            ".mp4 needs a writer of films: pip install imageio imageio-ffmpeg; .gif and .webp need "
            "none."
        ) from error

    def write(path: Path, pictures, rate: float) -> None:
        # H.264 wants even sides.
        even = [p[: len(p) // 2 * 2, : p.shape[1] // 2 * 2] for p in pictures]
        imageio.mimwrite(path, even, format="FFMPEG", fps=rate, codec="libx264", macro_block_size=2)

    return write
