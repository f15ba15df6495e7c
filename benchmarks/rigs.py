"""Rigs beside the embedded body: `python -m benchmarks.rigs [--record]`, about three minutes.

The embedded body is written as a .glb and read again, and real poses are freed on both. An octopus
of eight arms, 41 joints and 30,000 triangles, made here, curls up until its arms are in each other;
its motion is written as an animation, read, freed frame by frame, and written back.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.common import FIGURES, Table, provenance, record_section
from spt_jax import BodyModel, intersection_report, load_body, load_mocap, load_rig, untangle_pose
from spt_jax.io import write_rig
from spt_jax.show import render_before_after

_ARMS, _LINKS, _LENGTH = 8, 5, 0.9
_POSES = 8


@dataclass
class Settings:
    """What is run.

    Attributes:
        record: write the tables into benchmarks/results.md, and the picture beside it.
    """

    record: bool = False


def main(settings: Settings) -> None:
    """Measure and draw."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tables = [embedded(folder), octopus_motion(folder, settings.record)]
    for table in tables:
        table.print()
    if settings.record:
        text = (__doc__ or "").split("\n\n", 1)[1]
        parts = [provenance("python -m benchmarks.rigs --record"), text]
        parts += [table.markdown() for table in tables]
        record_section("rigs", "Rigs beside the embedded body", "\n\n".join(parts))


def embedded(folder: Path) -> Table:
    """The same poses on the embedded body and on the rig that it becomes."""
    body, mocap = load_body(num_shape=0), load_mocap()
    names = [name for name in mocap.names if name.startswith(("cartwheel/", "crawl/"))]
    poses = body.pose_from_smpl(mocap.pose[[mocap.names.index(name) for name in names]])
    colliding = []
    rest = body.rest_surface
    for pose in poses[::5]:
        report = intersection_report(body(pose).vertices, body.faces, rest_surface=rest)
        if report.intersecting_pairs:
            colliding.append(pose)
    file = folder / "body.glb"
    write_rig(file, body)
    start = time.process_time()
    rig = load_rig(file)
    loading = time.process_time() - start
    rows = []
    for title, model in (("embedded body", body), ("the same as a rig", rig.body)):
        untangle_pose(model, colliding[0])  # compiles
        found, seconds = [], []
        for pose in colliding[:_POSES]:
            start = time.process_time()
            found.append((pose, untangle_pose(model, pose)))
            seconds.append(time.process_time() - start)
        moved = [
            float(jnp.sqrt(jnp.mean(jnp.sum((model(pose).vertices - r.vertices) ** 2, axis=-1))))
            for pose, r in found
        ]
        free = sum(bool(r.is_free) for _, r in found)
        rows.append(
            (
                title,
                f"{free} of {len(found)}",
                f"{1e3 * np.median(moved):.2f}",
                f"{np.median(seconds):.2f}",
                f"{loading:.2f}" if model is rig.body else "",
            )
        )
    header = ("", "free", "moved, mm rms", "a pose, s of processor", "load, s of processor")
    return Table("Real poses, one after the other", header, rows)


def octopus() -> BodyModel:
    """Eight arms of five links each on a head, closed and in one piece."""
    parts = [trimesh.creation.icosphere(subdivisions=4, radius=0.28)]
    parts[0].apply_translation([0, 0.1, 0])
    joints, parents, names = [np.zeros(3)], [-1], ["head"]
    segments = [(np.zeros(3), np.array([0, 0.2, 0]))]
    for arm in range(_ARMS):
        angle = 2 * np.pi * (arm + 0.5) / _ARMS
        out = np.array([np.cos(angle), -0.25, np.sin(angle)])
        out /= np.linalg.norm(out)
        first = 0.1 * out
        along = np.linspace(0, _LENGTH, 80)
        radius = 0.085 - 0.06 * along / _LENGTH
        radius *= np.sqrt(np.clip(1 - ((along - _LENGTH / 2) / (_LENGTH / 2)) ** 16, 0, 1))
        tube = trimesh.creation.revolve(np.column_stack([radius, along]), sections=20)
        turn = np.asarray(trimesh.geometry.align_vectors([0, 0, 1], out))
        turn[:3, 3] = first
        parts.append(tube.apply_transform(turn))
        for link in range(_LINKS):
            joints.append(first + out * (0.18 + 0.8 * _LENGTH * link / _LINKS))
            parents.append(0 if link == 0 else len(joints) - 2)
            names.append(f"arm {arm} link {link}")
            segments.append((joints[-1], joints[-1] + out * 0.8 * _LENGTH / _LINKS))
    mesh = trimesh.boolean.union(parts, engine="manifold")
    while len(mesh.faces) < 28_000:
        mesh = mesh.subdivide_to_size(mesh.edges_unique_length.max() * 0.8)
        mesh.merge_vertices()
    points = np.asarray(mesh.vertices)
    far = np.stack([_distance(points, *segment) for segment in segments], axis=1)
    # The head is a ball, and all of it is the head's.
    far[:, 0] = np.maximum(np.linalg.norm(points - [0, 0.1, 0], axis=1) - 0.285, 0)
    weights = np.exp(-((far / 0.045) ** 2) + (far.min(axis=1, keepdims=True) / 0.045) ** 2)
    weights[weights < 0.02] = 0
    return BodyModel(
        template=jnp.asarray(points, jnp.float32),
        shape_basis=jnp.zeros((len(points), 3, 0)),
        joint_template=jnp.asarray(np.array(joints), jnp.float32),
        joint_shape_basis=jnp.zeros((len(joints), 3, 0)),
        weights=jnp.asarray(weights / weights.sum(axis=1, keepdims=True), jnp.float32),
        faces=jnp.asarray(mesh.faces, jnp.int32),
        parents=tuple(parents),
        joint_names=tuple(names),
    )


def _distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = end - start
    share = np.clip((points - start) @ way / (way @ way), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * way, axis=1)


def curling(body: BodyModel, frames: int) -> np.ndarray:
    """Arms that bend sideways and down, farther in every frame."""
    pose = np.zeros((frames, body.num_joints, 3))
    bend = np.linspace(0, 1, frames)
    for joint in range(1, body.num_joints):
        arm = (joint - 1) // _LINKS
        angle = 2 * np.pi * (arm + 0.5) / _ARMS
        across = np.array([-np.sin(angle), 0, np.cos(angle)])
        pose[:, joint] = bend[:, None] * (0.38 * across + [0, 0.3 * (-1) ** arm, 0])
    return pose


def octopus_motion(folder: Path, draw: bool) -> Table:
    """A motion of the octopus through a file, freed, and back."""
    body = octopus()
    file = folder / "octopus.glb"
    write_rig(file, body, curling(body, 7), frames_per_second=24.0, name="curl")
    start = time.process_time()
    rig = load_rig(file)
    loading = time.process_time() - start
    start = time.process_time()
    rest = rig.body.rest_surface
    surface = time.process_time() - start
    clip = rig.clip("curl")
    pose, before, after, seconds = clip.pose.copy(), [], [], []
    for row in range(len(pose)):
        start = time.process_time()
        result = untangle_pose(rig.body, clip.pose[row].astype(np.float32))
        seconds.append(time.process_time() - start)
        pose[row] = np.asarray(result.pose)
        before.append(int(result.before.intersecting_pairs))
        after.append(int(result.after.intersecting_pairs))
    (written,) = rig.write(folder / "freed.glb", clip.with_pose(pose))
    again = load_rig(folder / "freed.glb").clip(written)
    assert np.abs(again.pose - pose).max() < 1e-5
    if draw:
        pair = [rig.body(p[-1].astype(np.float32)).vertices for p in (clip.pose, pose)]
        labels = [intersection_report(v, rig.body.faces, rest_surface=rest).labels for v in pair]
        where = FIGURES / "rig.png"
        render_before_after(
            np.asarray(pair[0]),
            np.asarray(pair[1]),
            np.asarray(rig.body.faces),
            *labels,
            titles=("as animated", "freed"),
            size=(560, 460),
            view=(25.0, 35.0),
            path=where,
        )
    colliding = [k for k, count in enumerate(before) if count]
    later = seconds[colliding[0] + 1 :]
    row = (
        f"{len(rig.body.faces):,}",
        str(rig.body.num_joints),
        f"{loading:.2f}",
        f"{surface:.2f}",
        f"{len(colliding)} of {len(pose)}",
        str(sum(bool(count) for count in after)),
        f"{np.median(later):.2f}" if later else "",
    )
    header = (
        "triangles",
        "joints",
        "load, s",
        "rest surface, s",
        "frames that collide",
        "after",
        "a frame, s",
    )
    return Table("The octopus; seconds of processor, compiling left out", header, [row])


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
