"""How far `untangle_mesh` frees posed bodies: `python -m benchmarks.untangle_mesh`."""

import time
from dataclasses import dataclass

import ipctk
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import load_body, load_mocap
from spt_jax.untangle.mesh import untangle_mesh


@dataclass
class Settings:
    """Which frames are freed."""

    frames: int = 200
    record: bool = False
    """Write the tables into results.md."""


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    edges = ipctk.edges(faces)

    def intersects(vertices: np.ndarray) -> bool:
        points = vertices.astype(np.float64)
        return bool(ipctk.has_intersections(ipctk.CollisionMesh(points, edges, faces), points))

    frames = np.linspace(0, len(mocap.pose) - 1, settings.frames).round().astype(int)
    rows, still = [], []
    with progress() as bar:
        task = bar.add_task("freeing", total=len(frames))
        for frame in frames:
            pose = body.pose_from_smpl(jnp.asarray(mocap.pose[frame]))
            vertices = np.asarray(body(pose).vertices, np.float32)
            start = time.perf_counter()
            result = untangle_mesh(vertices, faces)
            seconds = time.perf_counter() - start
            shift = 1e3 * np.linalg.norm(result.vertices - vertices, axis=1)
            if intersects(result.vertices):
                still.append(mocap.names[frame])
            rows.append(
                (
                    intersects(vertices),
                    result.is_free,
                    1e6 * result.before.volume,
                    1e6 * result.after.volume,
                    result.before.intersecting_pairs,
                    shift.max(),
                    1e2 * result.relative_displacement,
                    shift[shift > 0].mean() if shift.any() else 0.0,
                    result.moved,
                    result.flipped_triangles,
                    result.inverted_parts,
                    result.steps,
                    seconds,
                )
            )
            bar.advance(task)
    columns = np.array(rows, float).T
    names = (
        "volume before, cm^3",
        "volume after, cm^3",
        "intersecting pairs before",
        "largest displacement, mm",
        "the same against the body's size, %",
        "mean displacement of what moves, mm",
        "vertices moved",
        "triangles turned over",
        "parts turned inside out",
        "steps",
        "seconds",
    )
    table = Table(
        f"{len(frames)} mocap frames spread evenly over all, 12,272 vertices, float32",
        ("figure", "minimum", "5 %", "median", "95 %", "maximum"),
        [
            (name, *(f"{x:.4g}" for x in np.percentile(values, [0, 5, 50, 95, 100])))
            for name, values in zip(names, columns[2:], strict=True)
        ],
    )
    counts = Table(
        "Counts",
        ("what", "frames"),
        [
            ("with intersections before, by ipctk", str(int(columns[0].sum()))),
            ("with intersections after, by ipctk", str(len(still))),
            ("intersection-free after, by its own account", str(int(columns[1].sum()))),
        ],
    )
    table.print()
    counts.print()
    listed = f"Not intersection-free: {', '.join(still) or 'none'}."
    print(listed)
    if settings.record:
        command = f"python -m benchmarks.untangle_mesh --frames {settings.frames} --record"
        parts = [
            provenance(command),
            "Default settings of `untangle_mesh`, on the poses as captured: collisions and folds "
            "together. Judged by `ipctk.has_intersections` on the float32 vertices.",
            table.markdown(),
            counts.markdown(),
            listed,
        ]
        record_section("untangle-mesh", "Freeing meshes by their vertices", "\n\n".join(parts))


if __name__ == "__main__":
    main(tyro.cli(Settings))
