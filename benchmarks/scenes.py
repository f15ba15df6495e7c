"""What scenes of many bodies cost: `python -m benchmarks.scenes`.

Bodies in different poses stand in a square, so near that neighbors are in each other; and arms of a
robot of twelve links each, likewise. Processor time of a value with its gradient.
"""

import statistics
import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import config, join_bodies, load_body, load_mocap, self_intersection_penalty

_APART = 0.45  # metres between neighbors
_LINKS = 12


@dataclass
class Settings:
    """How many bodies, and how often each scene is measured, each time moved."""

    counts: tuple[int, ...] = (10, 25, 50, 100)
    repeats: int = 3
    record: bool = False
    """Write the table into results.md."""


def _places(count: int, apart: float) -> np.ndarray:
    side = int(np.ceil(np.sqrt(count)))
    at = np.stack(np.divmod(np.arange(count), side), axis=1) * apart
    return np.stack([at[:, 0], np.zeros(count), at[:, 1]], axis=1)


def people(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Bodies in a scene: vertices of each, and the faces of one."""
    body, mocap = load_body(), load_mocap()
    rows = np.linspace(0, len(mocap.names) - 1, count).astype(int)
    poses = body.pose_from_smpl(jnp.asarray(mocap.pose[rows]))
    parts = [np.asarray(body(poses[k : k + 10]).vertices) for k in range(0, count, 10)]
    return np.concatenate(parts) + _places(count, _APART)[:, None], np.asarray(body.faces)


def robots(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Chains of capsules, each turned against the last, as one mesh each."""
    rng, found = np.random.default_rng(count), []
    link = trimesh.creation.capsule(height=0.2, radius=0.04, count=[16, 16])
    for _ in range(count):
        frame, links = np.eye(4), []
        for _ in range(_LINKS):
            links.append(trimesh.transform_points(link.vertices, frame))
            frame = frame @ trimesh.transformations.translation_matrix([0, 0, 0.2])
            turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
            frame = frame @ turn
        found.append(np.concatenate(links))
    faces = np.concatenate([link.faces + k * len(link.vertices) for k in range(_LINKS)])
    return np.stack(found) + _places(count, _APART)[:, None], faces


def _measured(make: Any, count: int, settings: Settings) -> tuple[int, float, float]:
    vertices, faces = make(count)
    scene = join_bodies(jnp.asarray(vertices, jnp.float32), faces)
    groups = np.asarray(scene.face_groups)
    corners = np.asarray(scene.faces)

    def loss(v):
        return self_intersection_penalty(v, corners, face_groups=groups)

    both = jax.value_and_grad(loss)
    rng, taken, value = np.random.default_rng(0), [], 0.0
    for _ in range(settings.repeats):
        shift = 0.02 * rng.standard_normal((count, 1, 3)).astype(np.float32)
        moved = scene.vertices + jnp.asarray(np.repeat(shift, vertices.shape[1], 1).reshape(-1, 3))
        start = time.process_time()
        value, gradient = jax.block_until_ready(both(moved))
        taken.append(time.process_time() - start)
        assert np.isfinite(gradient).all()
    return len(corners), float(value), statistics.median(taken)


def main(settings: Settings) -> None:
    """Measure, print, record."""
    config.processes = 1
    rows = []
    with progress() as bar:
        task = bar.add_task("scenes", total=2 * len(settings.counts))
        for name, make in (("bodies", people), (f"robot arms of {_LINKS} links", robots)):
            first = 0.0
            for count in settings.counts:
                triangles, volume, seconds = _measured(make, count, settings)
                first = first or seconds / count
                rows.append(
                    (
                        f"{count} {name}",
                        f"{triangles:,}",
                        f"{1e3 * volume:.2f}",
                        f"{1e3 * seconds:.0f}",
                        f"{1e3 * seconds / count:.1f}",
                        f"{seconds / count / first:.2f}",
                    )
                )
                bar.advance(task)
    header = ("scene", "triangles", "overlap, l", "ms", "ms each", "each, beside the smallest")
    table = Table("Value and gradient of a scene, processor time", header, rows)
    table.print()
    if settings.record:
        text = (
            f"{provenance('python -m benchmarks.scenes --record')} Medians of {settings.repeats}, "
            "every body moved by some centimeters before each."
        )
        record_section("scenes", "Scenes of many bodies", f"{text}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
