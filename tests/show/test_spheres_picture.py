"""Pictures of spheres: colored by part, red where they collide."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from PIL import Image
from test_pictures import needs_drawing, red

from spt_jax.fit.spheres.model import BodySpheres
from spt_jax.show.spheres import render_spheres

SIZE = (160, 160)


@needs_drawing
def test_the_picture_shows_the_body_its_spheres_and_collisions_in_red(tmp_path):
    body = embedded_body()
    spheres = BodySpheres.fit(body)
    rest = render_spheres(body, spheres, size=SIZE, path=tmp_path / "spheres.png")
    assert rest.shape == (160, 326, 3) and rest.dtype == np.uint8
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "spheres.png")), rest)
    assert red(rest) == 0
    color = np.ptp(rest.astype(int), axis=2) > 45
    assert color[:, :160].sum() == 0 and color[:, 166:].sum() > 500

    pose = jnp.zeros((52, 3)).at[body.joint_names.index("left_shoulder"), 1].set(-1.2)
    pose = pose.at[body.joint_names.index("left_elbow"), 1].set(-2.5)
    colliding = render_spheres(body, spheres, pose, jnp.zeros(10), size=SIZE)
    assert red(colliding[:, :160]) == 0 and red(colliding[:, 166:]) > 50
    # The forearm is inside the chest: from behind it shows through.
    assert red(render_spheres(body, spheres, pose, size=SIZE, view="back")) > 50


def test_errors_come_before_any_drawing(tmp_path):
    body = embedded_body()
    spheres = BodySpheres.fit(body)
    with pytest.raises(ValueError, match=r"path must end in \.png"):
        render_spheres(body, spheres, path=tmp_path / "spheres.jpg")
    with pytest.raises(ValueError, match="size must be at least 16"):
        render_spheres(body, spheres, size=(8, 100))
    assert not list(tmp_path.iterdir())
