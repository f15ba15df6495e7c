"""Whether this machine draws off screen: pictures of meshes are tested only where it does."""

import pytest

from spt_jax.show.offscreen import RenderingUnavailable, offscreen_window


def _draws() -> bool:
    try:
        offscreen_window()
    except (ImportError, RenderingUnavailable):
        return False
    return True


needs_drawing = pytest.mark.skipif(not _draws(), reason="nothing can draw off screen here")
