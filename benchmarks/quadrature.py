"""How well 512 x 512 rays measure a body's overlap: `python -m benchmarks.quadrature`."""

from dataclasses import dataclass

import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.untangle import LEAST_OVERLAP, colliding_frames
from spt_jax import load_body, load_mocap
from spt_jax.arguments import as_directions
from spt_jax.overlap.measure import Sampling, measure

REFERENCE_RAYS = 2048


@dataclass
class Settings:
    """Which frames are measured, and how finely."""

    frames: int = 50
    seed: int = 0
    rays: int = 512
    record: bool = False
    """Write the table into results.md."""


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    frames = colliding_frames(body, mocap, settings.frames, settings.seed)
    apart, off, mean_off, sizes = [], [], [], []
    with progress() as bar:
        task = bar.add_task("measuring", total=len(frames))
        for frame in frames:
            pose = body.pose_from_smpl(mocap.pose[frame])
            vertices = np.asarray(body(pose).vertices, np.float64)
            fine, plain = (
                np.array(measure(vertices, faces, Sampling(rays, as_directions(3))).volumes)
                for rays in (REFERENCE_RAYS, settings.rays)
            )
            reference = fine.mean()
            sizes.append(reference)
            apart.append(np.ptp(plain) / reference)
            off.append(np.abs(plain / reference - 1).max())
            mean_off.append(abs(plain.mean() / reference - 1))
            bar.advance(task)
    rows = []
    large = np.array(sizes) > 1e-4
    for name, values in (
        ("largest difference between two directions, %", apart),
        (f"largest difference of one direction to {REFERENCE_RAYS} rays, %", off),
        (f"difference of the mean of three to {REFERENCE_RAYS} rays, %", mean_off),
    ):
        values = 100 * np.array(values)
        rows.append(
            (
                name,
                *(f"{x:.2f}" for x in np.percentile(values, [50, 90, 100])),
                f"{np.sum(values <= 1)} of {len(values)}",
                f"{np.sum(values[large] <= 1)} of {np.sum(large)}",
            )
        )
    table = Table(
        f"{len(frames)} mocap frames with more than {LEAST_OVERLAP * 1e6:.0f} cm^3 of overlap, "
        f"{settings.rays} x {settings.rays} rays",
        ("difference", "median", "90 %", "maximum", "within 1 %", "of those over 100 cm^3"),
        rows,
    )
    table.print()
    if settings.record:
        command = (
            f"python -m benchmarks.quadrature --frames {settings.frames} --seed {settings.seed} "
            f"--rays {settings.rays} --record"
        )
        record_section(
            "quadrature",
            "The rays' quadrature error",
            f"{provenance(command)}\n\n{table.markdown()}",
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
