"""People who share an image, fitted together: `python -m benchmarks.people`.

Rows of people so near that neighbors are in each other's arms, some before others, are seen by one
camera; keypoints have noise. Each person is fitted alone, and then all of them together. Processor
time, compiled before.
"""

import statistics
import time
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import PinholeCamera, fit_people, fit_pose, load_body, load_mocap
from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle

_FARTHER, _NEARER = 0.32, 0.18  # metres between neighbors, across and in depth
_FOCAL, _AWAY, _PIXELS = 1200.0, 5.0, 3.0


@dataclass
class Settings:
    """How many people, in how many scenes of each kind."""

    counts: tuple[int, ...] = (2, 5, 10)
    scenes: int = 3
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


class Found(NamedTuple):
    """One scene."""

    alone: float
    together: float
    before: int
    after: int
    within: int
    pixels: float
    order: float


def crowd(count: int, rng: np.random.Generator):
    """Poses in the axes of a camera, y down, and places."""
    body, mocap = load_body(), load_mocap()
    rows = rng.choice(len(mocap.names), count, replace=False)
    poses = body.pose_from_smpl(jnp.asarray(mocap.pose[rows]))
    over = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    turned = []
    for pose in poses:
        upright = matrix_from_axis_angle(jnp.array([0.0, rng.uniform(-np.pi, np.pi), 0.0]))
        turned.append(pose.at[0].set(axis_angle_from_matrix(over @ upright)))
    across = _FARTHER * (np.arange(count) - (count - 1) / 2)
    deep = _NEARER * rng.permutation(count)
    places = np.stack([across, np.zeros(count), deep - deep.mean()], axis=1)
    return jnp.stack(turned), jnp.asarray(places, jnp.float32)


def measured(count: int, rng: np.random.Generator) -> Found:
    """One scene fitted both ways."""
    body = load_body()
    poses, places = crowd(count, rng)
    camera = PinholeCamera(_FOCAL, (500.0, 500.0), translation=(0.0, 0.0, _AWAY))
    joints = body(poses, translation=places).joints[:, :22]
    noise = rng.normal(scale=_PIXELS, size=(count, 22, 2))
    seen = camera.project(joints) + jnp.asarray(noise, joints.dtype)
    start = time.process_time()
    jax.block_until_ready(fit_pose(body, seen, camera, layout="smpl").pose)
    alone = time.process_time() - start
    start = time.process_time()
    found = fit_people(body, seen, camera, layout="smpl")
    together = time.process_time() - start
    depth = np.asarray(found.people.translation[:, 2])
    true = np.asarray(places[:, 2])
    first, second = np.triu_indices(count, 1)
    right = np.sign(depth[first] - depth[second]) == np.sign(true[first] - true[second])
    off = jnp.linalg.norm(found.people.keypoints - seen, axis=-1)
    return Found(
        alone,
        together,
        int(found.before.intersecting_pairs_between),
        int(found.after.intersecting_pairs_between),
        int(found.after.intersecting_pairs_within),
        float(off.mean()),
        float(right.mean()),
    )


def main(settings: Settings) -> None:
    """Measure, print, record."""
    rng = np.random.default_rng(settings.seed)
    measured(2, rng)  # compiles
    rows = []
    with progress() as bar:
        task = bar.add_task("scenes", total=settings.scenes * len(settings.counts))
        for count in settings.counts:
            found = []
            for _ in range(settings.scenes):
                found.append(measured(count, rng))
                bar.advance(task)
            ratios = [one.together / one.alone for one in found]
            rows.append(
                (
                    f"{count}",
                    f"{statistics.median(one.before for one in found):.0f}",
                    f"{sum(one.after == 0 for one in found)} of {len(found)}",
                    f"{sum(one.after + one.within == 0 for one in found)} of {len(found)}",
                    f"{statistics.mean(one.pixels for one in found):.1f}",
                    f"{100 * statistics.mean(one.order for one in found):.0f}",
                    f"{statistics.median(one.alone for one in found):.1f}",
                    f"{statistics.median(one.together for one in found):.1f}",
                    f"{statistics.median(ratios):.2f}",
                )
            )
    header = (
        "people",
        "pairs of triangles between, alone",
        "free between, together",
        "free, together",
        "reprojection, pixels",
        "pairs of people in the right order of depth, %",
        "s alone, all of them",
        "s together, the fits alone among it",
        "together / alone",
    )
    table = Table("Rows of people in each other's arms", header, rows)
    table.print()
    if settings.record:
        text = (
            f"{provenance('python -m benchmarks.people --record')} {settings.scenes} scenes of "
            f"each kind, medians; 22 joints with {_PIXELS:.0f} pixels of noise, processor time."
        )
        record_section("people", "People who share an image", f"{text}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
