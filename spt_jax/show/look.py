"""The one look of all pictures: colors, type, and how a picture is handed back."""

import io
import os
from typing import Any

import numpy as np
from jaxtyping import UInt8

from spt_jax.files.outputs import atomic_write
from spt_jax.io.mesh_files import BODY_COLOR, INVERTED_COLOR, PENETRATING_COLOR
from spt_jax.show.offscreen import import_extra

Picture = UInt8[np.ndarray, "height width 3"]

INK, PAPER, GRID = "#3b3733", "#ffffff", "#e6e2dc"
#: Behind bodies.
BACKGROUND = (246, 244, 240)
#: Colors of curves in turn: Okabe and Ito's, which every kind of color vision can distinguish.
CURVES = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", INK)
#: Pixels between panels.
GAP = 6
#: Lights in the camera's frame (right, up, towards it) with their intensity: key, fill, head, rim.
LIGHTS = (((-0.7, 1.1, 1.3), 0.66), ((1.2, 0.3, 0.8), 0.32), ((0, 0, 1), 0.24), ((0, 1, -1), 0.2))
MATERIAL = {"ambient": 0.22, "diffuse": 0.92, "specular": 0.1, "specular_power": 18}


class _Shown(np.ndarray):
    """A picture that a notebook shows as such; what is computed from it is a plain array."""

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any] | None:
        if self.ndim != 3 or self.shape[2] != 3 or self.dtype != np.uint8:
            return None
        from PIL import Image

        content = io.BytesIO()
        Image.fromarray(np.asarray(self)).save(content, format="PNG", optimize=True)
        return {
            "image/png": content.getvalue(),
            "text/plain": f"a picture of {self.shape[1]} x {self.shape[0]} pixels",
        }


def hex_color(rgb: tuple[int, int, int]) -> str:
    """As matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


#: Colors of clear, penetrating and inverted vertices, by label.
LABEL_COLORS = {
    0: hex_color(BODY_COLOR),
    1: hex_color(PENETRATING_COLOR),
    -1: hex_color(INVERTED_COLOR),
}


def blank_figure(width: int, height: int) -> tuple[Any, Any]:
    """A matplotlib figure of so many pixels, and its canvas.

    Without pyplot: no global state, and no backend that looks for a display.

    Raises:
        ImportError: the `viz` extra is not installed.
    """
    import_extra("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    return figure, FigureCanvasAgg(figure)


def dress(axes: Any) -> None:
    """Give a plot's axes the look."""
    axes.set_facecolor("white")
    axes.tick_params(colors=INK)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)


def drawn(canvas: Any) -> Picture:
    """What a canvas shows."""
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_texts(picture: Picture, texts: list[tuple[float, float, str, str]]) -> Picture:
    """The picture with lines of text at (x, y) pixels, aligned "left" or "center"."""
    height, width = picture.shape[:2]
    figure, canvas = blank_figure(width, height)
    figure.figimage(picture)
    for x, y, text, align in texts:
        style = {"fontsize": 11, "color": INK, "parse_math": False}
        figure.text(x / width, 1 - y / height, text, ha=align, va="center", **style)
    return drawn(canvas)


def check_size(size: tuple[int, int]) -> None:
    """Raise ValueError for a panel too small to draw in."""
    if min(size) < 16:
        raise ValueError(f"size must be at least 16 by 16 pixels: got {size}")


def check_png(path: str | os.PathLike[str] | None) -> None:
    """Raise ValueError unless the path, if there is one, names a .png file."""
    if path is not None and not os.fspath(path).lower().endswith(".png"):
        raise ValueError(f"path must end in .png: got {os.fspath(path)!r}")


def finished(picture: Picture, path: str | os.PathLike[str] | None) -> Picture:
    """The picture as users get it, written to its file as well.

    Raises:
        OSError: the file's folder is missing or cannot be written.
    """
    if path is not None:
        from PIL import Image

        with atomic_write(path) as temporary:
            Image.fromarray(picture).save(temporary, format="PNG", optimize=True)
    return picture.view(_Shown)
