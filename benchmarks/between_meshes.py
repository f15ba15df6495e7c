"""Volume, depth and contact of two meshes, exact and by voxels.

Run as `python -m benchmarks.between_meshes`.

Voxels are counted as papers do: a grid over the second mesh, a voxel for each center inside it, the
depth of a vertex from the distance transform of the grid. Each estimate is made with eight
grids that lie differently, because nobody chooses where a grid lies.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import igl
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from scipy.ndimage import distance_transform_edt

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_body
from spt_jax.metrics import between_meshes

PITCHES = (0.01, 0.005, 0.002)
GRIDS = 8
CONTACT = 0.005


@dataclass
class Settings:
    """Whether the table is kept."""

    record: bool = False
    """Write the table into results.md."""


class Pair(NamedTuple):
    """Two closed meshes in metres, and the volume of their intersection where it is known."""

    name: str
    first: trimesh.Trimesh
    second: trimesh.Trimesh
    known: float | None = None


def pairs() -> list[Pair]:
    """Solids with known answers, and a hand at two objects."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.03)
    shifted = ball.copy().apply_translation([0.0, 0.0, 0.058])
    box = trimesh.creation.box([0.06, 0.06, 0.06])
    finger = trimesh.creation.capsule(height=0.05, radius=0.008, count=[48, 48])
    # Its round tip reaches 2 mm into the side of the box.
    top = 0.03 - finger.bounds[0, 2] - 0.002
    pressed = finger.copy().apply_translation([0.0, 0.0, top])
    body = load_body()
    posed = body(jnp.zeros((body.num_joints, 3)))
    skin = trimesh.Trimesh(posed.vertices, body.faces, process=False)
    palm = np.asarray(posed.joints[body.joint_names.index("right_middle1")])
    can = trimesh.creation.cylinder(radius=0.033, height=0.12, sections=64)
    can.apply_translation(palm + np.array([0.0, -0.038, 0.0]))
    rod = trimesh.creation.cylinder(radius=0.006, height=0.2, sections=48)
    rod.apply_translation(palm + np.array([0.01, -0.012, 0.0]))
    radius, distance = 0.03, 0.058
    lens = np.pi / 12 * (4 * radius + distance) * (2 * radius - distance) ** 2
    cap = np.pi * 0.002**2 * (0.008 - 0.002 / 3)
    return [
        Pair("two balls of 3 cm, 2 mm in each other", ball, shifted, lens),
        Pair("a finger tip pressed 2 mm into a box", pressed, box, cap),
        Pair("a hand at a can", skin, can),
        Pair("a hand at a rod", skin, rod),
    ]


def voxels(pair: Pair, pitch: float, shift: np.ndarray) -> tuple[float, float, float]:
    """Volume in cm^3, largest depth in mm and contact ratio as voxels have it."""
    first, second = pair.first, pair.second
    low = second.bounds[0] - 4 * pitch + shift * pitch
    count = np.ceil((second.bounds[1] - low) / pitch + 4).astype(int)
    axes = [low[k] + pitch * (np.arange(count[k]) + 0.5) for k in range(3)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = _inside(second, centers)
    both = np.zeros(len(centers), bool)
    both[inside] = _inside(first, centers[inside])
    grid = inside.reshape(tuple(count))
    within = np.asarray(distance_transform_edt(grid)) * pitch
    outside = np.asarray(distance_transform_edt(~grid)) * pitch
    cell = np.floor((np.asarray(first.vertices) - low) / pitch).astype(int)
    there = ((cell >= 0) & (cell < count)).all(axis=1)
    at = tuple(cell[there].T)
    depth = float(within[at].max(initial=0.0))
    contact = np.count_nonzero(outside[at] <= CONTACT) / len(first.vertices)
    return 1e6 * both.sum() * pitch**3, 1e3 * depth, contact


def _inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    if not len(points):
        return np.zeros(0, bool)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return np.asarray(igl.fast_winding_number(vertices, faces, points)) > 0.5


def table() -> Table:
    """A row for each pair and quantity."""
    rng = np.random.default_rng(0)
    shifts = rng.random((GRIDS, 3))
    rows = []
    for pair in pairs():
        found = between_meshes(
            np.asarray(pair.first.vertices),
            np.asarray(pair.first.faces),
            np.asarray(pair.second.vertices),
            np.asarray(pair.second.faces),
            contact_distance=CONTACT,
        )
        estimates = [np.array([voxels(pair, p, shift) for shift in shifts]) for p in PITCHES]
        known = "" if pair.known is None else f"{1e6 * pair.known:.4f}"
        quantities: list[tuple[str, str, str, Callable[[float], str]]] = [
            ("volume, cm^3", known, f"{found.volume_in_cubic_centimeters:.4f}", "{:.3f}".format),
            ("largest depth, mm", "", f"{1e3 * found.largest_depth:.2f}", "{:.1f}".format),
            ("contact ratio", "", f"{found.contact_ratio:.2%}", "{:.2%}".format),
        ]
        for k, (name, formula, exact, shown) in enumerate(quantities):
            ranges = [f"{shown(e[:, k].min())} to {shown(e[:, k].max())}" for e in estimates]
            rows.append((f"{pair.name}: {name}", formula, exact, *ranges))
    heads = [f"voxels of {1e3 * pitch:g} mm" for pitch in PITCHES]
    return Table(
        f"Two meshes, exactly and by voxels: least and most of {GRIDS} grids",
        ("pair", "of the round solids", "between_meshes", *heads),
        rows,
    )


def main(settings: Settings) -> None:
    """Print the table."""
    found = table()
    found.print()
    if settings.record:
        command = "python -m benchmarks.between_meshes --record"
        text = (
            "Balls and finger are polyhedra a little inside the formula's round solids. Depths by "
            "voxels are the distance transform's, of the vertices of the first mesh; contact is "
            f"within {1e3 * CONTACT:g} mm."
        )
        body = "\n\n".join([provenance(command), text, found.markdown()])
        record_section("between_meshes", "Between meshes", body)


if __name__ == "__main__":
    main(tyro.cli(Settings))
