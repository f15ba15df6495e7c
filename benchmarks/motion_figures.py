"""Pictures of a motion freed as a whole: `python -m benchmarks.motion_figures [--out DIR]`.

A minute on two cores. Frames of `roll` moving before and after, and the curves of overlap and of
second differences over them, beside those of the same frames freed one by one.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import FIGURES
from spt_jax import classify_vertices, load_body, load_mocap, untangle_motion, untangle_pose
from spt_jax.body import BodyModel
from spt_jax.files.outputs import ensure_folder
from spt_jax.show import plot_curves, write_film

MOTION, FIRST, COUNT = "roll", 40, 32
SIZE = (230, 280)


def _labels(body: BodyModel, vertices: np.ndarray) -> np.ndarray:
    rest = body.rest_surface
    found = [classify_vertices(one, body.faces, rest_surface=rest).labels for one in vertices]
    return np.stack([np.asarray(one) for one in found])


def _second_differences(vertices: np.ndarray) -> np.ndarray:
    """Of each frame but two its number and the largest one of a vertex, in mm."""
    largest = np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=-1).max(axis=1)
    return np.stack([np.arange(1, len(largest) + 1), 1e3 * largest], axis=1)


def main(out: Path = FIGURES) -> None:
    """Draw them.

    Args:
        out: the folder that the pictures go to.
    """
    folder, body, mocap = ensure_folder(out), load_body(), load_mocap()
    rows = [k for k, name in enumerate(mocap.names) if name.split("/")[0] == MOTION]
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[rows[FIRST : FIRST + COUNT]]))
    whole, single = untangle_motion(body, pose), untangle_pose(body, pose)
    skins = {
        "as captured": np.asarray(body(pose).vertices),
        "freed as a whole": np.asarray(body(whole.pose).vertices),
        "freed frame by frame": np.asarray(body(single.pose).vertices),
    }
    before, after = (skins[name] for name in ("as captured", "freed as a whole"))
    labels = [_labels(body, vertices) for vertices in (before, after)]
    hit = np.flatnonzero(~whole.before.is_free)
    plot_curves(
        {
            "as captured": 1e6 * whole.before.volume,
            "freed as a whole": 1e6 * whole.after.volume,
        },
        xlabel="frame",
        ylabel="overlap, cm^3",
        path=folder / "motion_volume.png",
    )
    plot_curves(
        {name: _second_differences(vertices) for name, vertices in skins.items()},
        xlabel="frame",
        ylabel="largest second difference of the skin, mm",
        path=folder / "motion_smoothness.png",
    )
    write_film(
        folder / "motion.webp",
        [before, after],
        body.faces,
        labels,
        frames_per_second=15.0,
        size=SIZE,
    )
    print(f"{len(hit)} of {COUNT} frames collide, {int((~whole.after.is_free).sum())} afterwards")
    print(f"pictures in {folder}")


if __name__ == "__main__":
    tyro.cli(main)
