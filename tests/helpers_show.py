"""Whether pictures can be drawn, and whether the system draws them or `show/software.py`."""

import pytest

from spt_jax.show.offscreen import SOFTWARE, offscreen_window


def _window() -> str | None:
    try:
        return offscreen_window()
    except ImportError:
        return "missing"


needs_drawing = pytest.mark.skipif(_window() == "missing", reason="pyvista is not installed")
needs_opengl = pytest.mark.skipif(_window() in ("missing", SOFTWARE), reason="no OpenGL here")
