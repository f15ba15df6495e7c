"""How exact the vertex rule is, and what it costs: `python -m benchmarks.labels [--record]`.

The oracle is libigl's exact winding number a micrometre outside and inside every vertex.
"""

import time
from dataclasses import dataclass

import igl
import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, Int

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import load_body, load_mocap
from spt_jax.overlap.arrays.vectors import area_normals
from spt_jax.overlap.exact import ExactOverlap
from spt_jax.overlap.rays.beam import aim
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import find_overlaps
from spt_jax.overlap.surface import ExactSurface

STEP = 1e-6
RAYS = 512


@dataclass
class Settings:
    """Which frames, evenly over all of the motion capture."""

    frames: int = 100
    record: bool = False
    """Write the tables into results.md."""


def outward(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V"]]:
    """A direction at each vertex that is in front of all of its triangles, and where there is one.

    By the perceptron rule: from the mean normal, lean towards the normal that is most behind.
    """
    normal = area_normals(vertices, faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    of, normal = faces.T.ravel(), np.tile(normal, (3, 1))
    out = np.zeros(vertices.shape)
    np.add.at(out, of, normal)
    bad = np.ones(len(vertices), bool)
    for _ in range(300):
        out[bad] /= np.linalg.norm(out[bad], axis=1, keepdims=True)
        corner = np.flatnonzero(bad[of])
        cosine = np.einsum("ki,ki->k", out[of[corner]], normal[corner])
        order = np.argsort(-cosine)
        worst = np.full(len(vertices), -1)
        worst[of[corner[order]]] = order  # the last one written is the least
        bad[bad] = cosine[worst[bad]] < 0.05
        if not bad.any():
            break
        out[bad] += 0.3 * normal[corner[worst[bad]]]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    behind = np.einsum("ki,ki->k", out[of], normal) <= 0
    return out, np.bincount(of, behind, len(vertices)) == 0


def winding_number(vertices, faces, points) -> Int[np.ndarray, "P"]:
    """The exact winding number at points that are not on the surface."""
    return np.rint(igl.winding_number(vertices, faces, points)).astype(np.int64)


def sides(vertices, faces, vertex: int) -> tuple[set[int], set[int]]:
    """The winding numbers on the outer and inner sides of a vertex's own triangles, next to it."""
    face, turn = np.nonzero(faces == vertex)
    e, f = (vertices[faces[face, (turn + k) % 3]] - vertices[vertex] for k in (1, 2))
    e, f = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (e, f))
    lean = 1e-3 * np.cross(e, f)
    # Next to both edges too: where the triangles cross, a part of one may be on another's side.
    across = [part * e + (1 - part) * f for part in (0.02, 0.5, 0.98)]
    outer, inner = (
        winding_number(
            vertices,
            faces,
            vertices[vertex] + STEP * np.concatenate([w + side * lean for w in across]),
        )
        for side in (1, -1)
    )
    return set(outer.tolist()), set(inner.tolist())


def gap(vertices, faces, vertex: int) -> float:
    """How far the nearest triangle is that does not have the vertex as a corner."""
    others = faces[(faces != vertex).all(axis=1)]
    square, *_ = igl.point_mesh_squared_distance(vertices[[vertex]], vertices, others)
    return float(np.sqrt(np.asarray(square)[0]))


def seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    pose_body = jax.jit(lambda pose: body(body.pose_from_smpl(pose)).vertices)
    frames = np.unique(np.linspace(0, len(mocap.names) - 1, settings.frames).astype(int))
    counts = np.zeros(5, int)  # vertices, classed, without a front, crossed, unequal
    ratios, costs, exceptions = [], [], []
    with progress() as bar:
        task = bar.add_task("comparing", total=len(frames))
        for frame in frames:
            vertices = np.asarray(pose_body(mocap.pose[frame]), np.float64)

            def beam(vertices=vertices):
                beam, points = aim(vertices, np.array([0.0, 0.0, -1.0]), RAYS)
                crossings = cast(beam, points, faces, simple_rays=False)
                return find_overlaps(beam, points, faces, crossings)

            def label(vertices=vertices):
                surface = ExactSurface(vertices, faces, float(np.finfo(np.float64).eps))
                return ExactOverlap(surface).winding

            times = np.array([(seconds(label), seconds(beam)) for _ in range(5)])
            costs.append(1e3 * np.median(times, axis=0))
            ratios.append(np.median(times[:, 0] / times[:, 1]))

            ours = label()
            out, has_front = outward(vertices, faces)
            outside, inside = (
                winding_number(vertices, faces, vertices + side * STEP * out) for side in (1, -1)
            )
            crossed = has_front & (inside != outside + 1)
            unequal = has_front & (outside != ours)
            for vertex in np.flatnonzero(~has_front).tolist():
                outer, inner = sides(vertices, faces, vertex)
                unequal[vertex] = ours[vertex] not in outer or ours[vertex] + 1 not in inner
            counts += [len(ours), *map(np.count_nonzero, (ours, ~has_front, crossed, unequal))]
            for vertex in np.flatnonzero(unequal).tolist():
                millimetres = 1e3 * gap(vertices, faces, vertex)
                outer, _ = sides(vertices, faces, vertex)
                exceptions.append(
                    (
                        f"{mocap.names[frame]}, vertex {vertex}",
                        str(ours[vertex]),
                        str(outside[vertex]) if has_front[vertex] else "none",
                        " or ".join(map(str, sorted(outer))),
                        f"{millimetres:.4f}",
                    )
                )
            bar.advance(task)
    total, classed, frontless, crossed, unequal = counts.tolist()
    rows = [
        ("vertices compared", f"{total:,}"),
        ("of those not in V_0", f"{classed:,}"),
        ("equal to libigl's winding number just outside, %", f"{100 * (1 - unequal / total):.4f}"),
        ("unequal", str(unequal)),
        ("without a front: compared with both sides of their triangles", f"{frontless:,}"),
        ("own triangles cross: compared with the outside alone", f"{crossed:,}"),
        ("time for all vertices, ms, median", f"{np.median(np.array(costs)[:, 0]):.1f}"),
        (
            f"time of one {RAYS} x {RAYS} beam, ms, median",
            f"{np.median(np.array(costs)[:, 1]):.1f}",
        ),
        ("ratio of the two, median", f"{np.median(ratios):.2f}"),
        ("ratio of the two, 90 %", f"{np.percentile(ratios, 90):.2f}"),
    ]
    title = f"{len(frames)} mocap frames of the embedded body"
    tables = [Table(title, ("rule='vertex'", "measured"), rows)]
    if exceptions:
        header = (
            "exception",
            "ours",
            "libigl",
            "libigl at its own triangles' outer sides (two: they cross)",
            "to the nearest other sheet, mm",
        )
        tables.append(Table("Where they differ", header, exceptions))
    for table in tables:
        table.print()
    if settings.record:
        command = f"python -m benchmarks.labels --frames {settings.frames} --record"
        text = "\n\n".join([provenance(command), *(table.markdown() for table in tables)])
        record_section("labels", "Exact vertex labels", text)


if __name__ == "__main__":
    main(tyro.cli(Settings))
