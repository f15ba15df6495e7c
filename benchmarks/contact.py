"""What contact costs against general position: `python -m benchmarks.contact [--record]`.

Solids whose sides lie in one plane, or that share edges and corners, and beside each the same
solids in each other by a little; value and gradient under jit, in turn, in processor time. No shape
comes twice, or near another: all are stretched by a sixteenth more at each call.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import self_intersection_penalty
from spt_jax.bridge import callback

Mesh = tuple[np.ndarray, np.ndarray]

# In what solids that touch are moved to be in general position: nowhere near any of their edges.
_ASIDE = np.array([-0.031, 0.0173, 0.0229])


@dataclass
class Settings:
    """How often each shape is measured."""

    repeats: int = 15
    record: bool = False
    """Write the table into results.md."""


def box(divisions: int, center=(0.0, 0.0, 0.0)) -> Mesh:
    """A unit box, each of its sides cut into squares, each in two triangles."""
    vertices, faces = trimesh.creation.box().vertices, trimesh.creation.box().faces
    for _ in range(divisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
    return vertices + np.array(center), faces


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    count = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    faces = [faces + start for (_, faces), start in zip(meshes, count, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _turned(mesh: Mesh) -> Mesh:
    turn = trimesh.transformations.rotation_matrix(1.0, [1.0, 2.0, 3.0])[:3, :3]
    return mesh[0] @ turn.T, mesh[1]


def _both_turned(meshes: tuple[Mesh, Mesh]) -> tuple[Mesh, Mesh]:
    return _turned(meshes[0]), _turned(meshes[1])


def _pair(divisions: int, place, aside=_ASIDE) -> tuple[Mesh, Mesh]:
    """Two boxes that touch, the second at a place, and the same two in each other."""
    first, second = box(divisions), box(divisions, place)
    return joined(first, second), joined(first, (second[0] + aside, second[1]))


def _loose(count: int) -> Mesh:
    """Boxes in each other at random, each with its six neighbors and some of the others."""
    random, side = np.random.default_rng(0), round(count ** (1 / 3))
    places = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    shifted = places + random.uniform(-0.1, 0.1, places.shape)
    return joined(*(box(0, place) for place in 0.9 * shifted))


def _lattice(count: int) -> Mesh:
    side = round(count ** (1 / 3))
    places = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    return joined(*(box(0, place) for place in places.astype(float)))


def _cans() -> tuple[Mesh, Mesh]:
    can = trimesh.creation.cylinder(1.0, 1.0, sections=256)
    lid = np.array([0.0, 0.0, 1.0])
    lower, upper, moved = (
        (can.vertices + place, can.faces) for place in (0 * lid, lid, lid + _ASIDE[[1, 2, 0]])
    )
    return joined(lower, upper), joined(lower, moved)


def cases() -> dict[str, tuple[Mesh, Mesh]]:
    """Of each kind the solids in contact, and the same in general position."""
    flush, half = _pair(4, (1.0, 0.0, 0.0)), _pair(4, (0.5, 0.0, 0.0))
    boxes = _lattice(1000), _loose(1000)
    return {
        "two boxes of 12, a side in common": _pair(0, (1.0, 0.0, 0.0)),
        "two boxes of 3,072, a side in common": flush,
        "two boxes of 3,072, a side in common, turned": _both_turned(flush),
        "a box half in a box, four sides in one plane": half,
        "a box half in a box, four sides in one plane, turned": _both_turned(half),
        "a box on a box's corner": _pair(4, (0.5, 0.5, 1.0)),
        "two cans of 256 sides on each other": _cans(),
        "1,000 boxes, each side on another's": boxes,
        "1,000 boxes, each side on another's, turned": _both_turned(boxes),
    }


@functools.lru_cache(maxsize=4)
def _penalty(faces: bytes) -> Callable:
    array = np.frombuffer(faces, np.int64).reshape(-1, 3)
    loss = functools.partial(self_intersection_penalty, faces=array)
    return jax.jit(jax.value_and_grad(loss))


def _used(mesh: Mesh, turn: int) -> float:
    """Milliseconds of processor time of one call."""
    vertices, faces = mesh
    call = _penalty(faces.astype(np.int64).tobytes())
    # Along all axes alike, so that what touches stays in contact in float32.
    given = jax.block_until_ready(jnp.asarray(vertices * (1 + turn / 16), jnp.float32))
    callback.clear_results()
    start = time.process_time()
    jax.block_until_ready(call(given))
    return 1e3 * (time.process_time() - start)


def main(settings: Settings) -> None:
    rows = []
    with progress() as bar:
        found = cases()
        task = bar.add_task("shapes", total=len(found))
        for name, (touching, loose) in found.items():
            times = [
                [_used(mesh, k) for mesh in (touching, loose)] for k in range(settings.repeats + 1)
            ]
            contact, general = np.array(times[1:]).T
            ratio = np.percentile(contact / general, [10, 50, 90])
            figures = (np.median(contact), np.median(general), *ratio)
            rows.append((name, f"{len(touching[1]):,}", *(f"{x:.2f}" for x in figures)))
            bar.advance(task)
    table = Table(
        "Value and gradient under jit, milliseconds of processor time",
        ("solids", "triangles", "in contact", "in each other", "ratio 10 %", "median", "90 %"),
        rows,
    )
    table.print()
    if settings.record:
        command = "python -m benchmarks.contact --record"
        record_section("contact", "Contact", f"{provenance(command)}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
