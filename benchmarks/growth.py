"""How cost and memory grow with bodies, rays and triangles; the paper's Tables 2 and 3 beside."""

import time
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh

from benchmarks.common import Table, progress
from spt_jax import join_bodies, load_body, load_mocap
from spt_jax._query import as_directions, as_rays
from spt_jax.overlap.measure import Sampling, measure

# Milliseconds of one iteration, on another machine, in the paper's Tables 2 and 3.
PAPER_BODIES = {1: 56.76, 2: 89.80, 3: 119.25, 4: 149.58, 5: 186.76}
PAPER_RAYS = {128: 53.84, 256: 54.96, 512: 56.76, 1024: 58.32, 2048: 59.28}
SUBDIVISIONS = range(3, 9)  # 1,024 triangles to 1,048,576
FRAMES = ("crawl/0092", "walk/0010", "run/0010", "jump/0020", "punch/0017")
# Metres between bodies that stand in a row: clear of each other, and so near that they are in each
# other and some of their overlaps overlap, which takes rays.
_CLEAR, _NEAR = 2.5, 0.45


class Growth(NamedTuple):
    """The tables, and what is drawn: cost by triangles."""

    tables: list[Table]
    triangles: list[int]
    milliseconds: list[float]
    megabytes: list[float]


def cost(vertices, faces, rays, directions, repeats) -> float:
    """Median milliseconds of value and gradient, in NumPy alone, after one call.

    Each call's mesh is larger than the last one's: of one that is near it, lists would be known.
    """
    sampling = Sampling(as_rays(rays), as_directions(directions))
    taken = []
    for k in range(repeats + 1):
        given = vertices * (1 + k / 16)
        start = time.perf_counter()
        found = measure(given, faces, sampling)
        _ = found.volume, found.gradient("boundary", "vertex")
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken[1:]))


def peak_megabytes(vertices, faces) -> float:
    """The most memory that one call holds beyond its input, as Python's allocators see it."""
    measured = Sampling(None, as_directions(3))
    tracemalloc.start()
    found = measure(vertices, faces, measured)
    _ = found.volume, found.gradient("boundary", "vertex")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak / 1e6


def measure_growth(repeats: int) -> Growth:
    """All of it."""
    body, mocap = load_body(), load_mocap()
    rows = [mocap.names.index(name) for name in FRAMES]
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[jnp.array(rows)]))
    along = jnp.arange(len(FRAMES), dtype=jnp.float32)[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    clear, near = (body(pose, translation=gap * along).vertices for gap in (_CLEAR, _NEAR))
    with progress() as bar:
        task = bar.add_task("growth", total=len(FRAMES) + len(PAPER_RAYS) + len(SUBDIVISIONS))
        people = []
        for count in range(1, len(FRAMES) + 1):
            apart, together = (
                (np.asarray(scene.vertices, np.float64), np.asarray(scene.faces, np.int64))
                for scene in (join_bodies(v[:count], body.faces) for v in (clear, near))
            )
            ours = [cost(*mesh, None, 3, repeats) for mesh in (apart, together)]
            ours.append(cost(*apart, 512, 1, repeats))
            people.append((count, *ours, PAPER_BODIES[count]))
            bar.advance(task)
        one = np.asarray(clear[0], np.float64), np.asarray(body.faces, np.int64)
        rays = []
        for count, theirs in PAPER_RAYS.items():
            rays.append((count, cost(*one, count, 1, repeats), theirs))
            bar.advance(task)
        sizes = []
        for subdivisions in SUBDIVISIONS:
            mesh = two_balls(subdivisions)
            sizes.append((len(mesh[1]), cost(*mesh, None, 3, repeats), peak_megabytes(*mesh)))
            bar.advance(task)
    first, auto = people[0], cost(*one, None, 3, repeats)
    tables = [
        Table(
            "Bodies in one scene (the paper's Table 3, on its machine), milliseconds and times one",
            ("bodies", "default, apart", "in each other", "512 x 512, apart", "paper"),
            [
                (f"{n}", *(f"{x:.1f} ({x / x1:.2f})" for x, x1 in zip(r, first[1:], strict=True)))
                for n, *r in people
            ],
        ),
        Table(
            "Rays of one direction (the paper's Table 2), milliseconds and times 128 x 128",
            ("rays", "ours", "paper"),
            [
                (f"{n} x {n}", f"{x:.1f} ({x / rays[0][1]:.2f})", f"{y:.1f} ({y / 53.84:.2f})")
                for n, x, y in rays
            ]
            + [("default, exact to rounding", f"{auto:.1f} ({auto / rays[0][1]:.2f})", "")],
        ),
        Table(
            "Two balls in each other, by triangles: default",
            ("triangles", "milliseconds", "memory, MB"),
            [(f"{n:,}", f"{x:.1f}", f"{y:.0f}") for n, x, y in sizes],
        ),
    ]
    return Growth(tables, *([row[k] for row in sizes] for k in range(3)))


def two_balls(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Two balls of 8 * 4^subdivisions triangles each, a third of a radius in each other.

    Octahedra that were subdivided and blown up: no triangle is a sliver, however many there are.
    """
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    upper = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    lower = np.array([[1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    faces = np.concatenate([upper, lower])
    for _ in range(subdivisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    # Turned, so that no triangle of one is that of the other moved along an axis.
    turn = trimesh.transformations.rotation_matrix(1.0, [1.0, 2.0, 3.0])[:3, :3]
    second = vertices @ turn.T + [1.67, 0.2, 0.1]
    return np.concatenate([vertices, second]), np.concatenate([faces, faces + len(vertices)])


def draw_growth(grown: Growth, path: Path) -> None:
    """Cost and memory against triangles, on logarithmic axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    for axes, values, what in zip(
        figure.subplots(1, 2),
        (grown.milliseconds, grown.megabytes),
        ("milliseconds", "memory, MB"),
        strict=True,
    ):
        axes.loglog(grown.triangles, values, "o-", color="#0072B2")
        linear = np.array(grown.triangles, float)
        axes.loglog(
            grown.triangles,
            values[-1] * linear / linear[-1],
            "--",
            color="#999999",
            label="in proportion",
        )
        axes.set_xlabel("triangles")
        axes.set_ylabel(what)
        axes.grid(visible=True, which="major", alpha=0.3)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
