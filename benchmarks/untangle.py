"""How far `untangle_pose` frees real poses: `python -m benchmarks.untangle`."""

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import load_body, load_mocap, self_intersection_penalty, untangle_pose

LEAST_OVERLAP = 1e-5  # m^3; the issue's own threshold for a frame that counts


@dataclass
class Settings:
    """Which frames are untangled."""

    frames: int = 100
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


def colliding_frames(body, mocap, count: int, seed: int) -> list[int]:
    """The first `count` frames of a seeded shuffle whose overlap exceeds LEAST_OVERLAP."""
    volume = jax.jit(
        lambda pose: self_intersection_penalty(body(pose).vertices, body.faces, rays=512)
    )
    chosen = []
    for frame in np.random.default_rng(seed).permutation(len(mocap.pose)):
        if volume(body.pose_from_smpl(mocap.pose[frame])) > LEAST_OVERLAP:
            chosen.append(int(frame))
        if len(chosen) == count:
            break
    return chosen


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    frames = colliding_frames(body, mocap, settings.frames, settings.seed)
    rows = []
    with progress() as bar:
        task = bar.add_task("untangling", total=len(frames))
        for frame in frames:
            pose = body.pose_from_smpl(jnp.asarray(mocap.pose[frame]))
            start = time.perf_counter()
            result = jax.block_until_ready(untangle_pose(body, pose))
            seconds = time.perf_counter() - start
            moved = jnp.linalg.norm(result.vertices - body(pose).vertices, axis=-1)
            rows.append(
                (
                    float(result.before.volume),
                    float(result.after.volume),
                    float(result.before.ratio),
                    float(result.after.ratio),
                    float(result.steps),
                    seconds,
                    float(moved.mean()),
                    bool(jnp.isfinite(result.pose).all() & jnp.isfinite(result.vertices).all()),
                )
            )
            bar.advance(task)
    before, after, ratio_before, ratio_after, steps, seconds, moved, finite = map(
        np.array, zip(*rows, strict=True)
    )
    reduction = 1 - after / before
    quartiles = [
        ("volume before, cm^3", before * 1e6),
        ("volume after, cm^3", after * 1e6),
        ("volume reduction, %", reduction * 100),
        ("vertices in self-intersection before, %", ratio_before * 100),
        ("vertices in self-intersection after, %", ratio_after * 100),
        ("mean vertex displacement, mm", moved * 1e3),
        ("steps", steps),
        ("seconds (the first frame compiles)", seconds),
    ]
    table = Table(
        f"{len(frames)} mocap frames with more than {LEAST_OVERLAP * 1e6:.0f} cm^3 of overlap",
        ("figure", "minimum", "5 %", "median", "95 %", "maximum"),
        [
            (name, *(f"{x:.4g}" for x in np.percentile(values, [0, 5, 50, 95, 100])))
            for name, values in quartiles
        ],
    )
    counts = Table(
        "Counts",
        ("what", "frames"),
        [
            ("reduced by 99 % or more", str(int(np.sum(reduction >= 0.99)))),
            ("reduced by 99.9 % or more", str(int(np.sum(reduction >= 0.999)))),
            ("increased", str(int(np.sum(after > before)))),
            ("with a value that is not finite", str(int(np.sum(~finite)))),
        ],
    )
    table.print()
    counts.print()
    worst = np.argsort(reduction)[:5]
    names = ", ".join(f"{mocap.names[frames[k]]} ({reduction[k] * 100:.2f} %)" for k in worst)
    print("least reduced:", names)
    if settings.record:
        body_text = "\n\n".join(
            [
                provenance(
                    f"python -m benchmarks.untangle --frames {settings.frames} "
                    f"--seed {settings.seed} --record"
                ),
                "Default settings of `untangle_pose`; volumes at 512 x 512 rays, three directions; "
                "folds at armpits and groins count.",
                table.markdown(),
                counts.markdown(),
                f"Least reduced: {names}.",
            ]
        )
        record_section("untangle", "Untangling real poses", body_text)


if __name__ == "__main__":
    main(tyro.cli(Settings))
