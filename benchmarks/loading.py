"""How long files take to load: `python -m benchmarks.loading [--record]`.

Bodies and rigs of the sizes that people have, made here; each is loaded several times in one
process, and the first time in a process of its own, where programs are compiled as well. Seconds by
the clock; those of the processor stand beside them, and are the same where nothing else runs.
"""

import os
import pickle
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_body, load_mocap, load_poses, load_rig
from spt_jax.io import read_mesh, write_poses, write_rig

REPEATS = 7
WITHIN = 2.0
LOADERS: dict[str, Callable[[Path], object]] = {
    "body": lambda path: load_body(path).template.block_until_ready(),
    "rig": load_rig,
    "poses": load_poses,
    "mesh": read_mesh,
}


@dataclass
class Settings:
    """What is done with the figures."""

    record: bool = False
    """Put the table into results.md."""


def smplx(components: int = 400) -> dict[str, np.ndarray]:
    """Arrays of the sizes of SMPL-X's files: 10,475 vertices, 55 joints, 486 pose features."""
    body, rng = load_body(num_shape=0), np.random.default_rng(0)
    count, joints = 10_475, 55
    weights = rng.random((count, joints)) ** 8
    regressor = rng.random((joints, count)) ** 8
    faces = np.asarray(body.faces)
    parents = np.array([2**32 - 1, *(max(k - 3, 0) for k in range(1, joints))], np.uint32)
    return {
        "v_template": np.asarray(body.template, np.float64)[:count],
        "shapedirs": rng.normal(size=(count, 3, components)),
        "posedirs": rng.normal(size=(count, 3, 9 * (joints - 1))),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(joints, dtype=np.uint32)]),
        "f": faces[(faces < count).all(axis=1)].astype(np.uint32),
    }


def files(folder: Path) -> list[tuple[str, str, Path]]:
    """What each file is, how it is loaded, and where it lies."""
    body, mocap = load_body(), load_mocap()
    found = []

    def add(what: str, kind: str, name: str) -> Path:
        found.append((what, kind, folder / name))
        return folder / name

    arrays = smplx()
    compressed = add("SMPL-X's arrays, compressed", "body", "smplx.npz")
    np.savez_compressed(compressed, **arrays)  # pyright: ignore[reportArgumentType]
    plain = add("the same, not compressed", "body", "smplx_plain.npz")
    np.savez(plain, **arrays)  # pyright: ignore[reportArgumentType]
    for protocol, what in ((4, "pickled"), (2, "pickled with protocol 2: bytes as text")):
        path = add(f"the same, {what}", "body", f"smplx{protocol}.pkl")
        path.write_bytes(pickle.dumps(arrays, protocol=protocol))
    pose = body.pose_from_smpl(mocap.pose)
    write_rig(
        add("a rig of 24,540 triangles, 10 targets, 1,086 frames", "rig", "rig.glb"), body, pose
    )
    many = np.resize(np.asarray(pose), (120_000, *pose.shape[1:]))
    plain = load_body(num_shape=0)
    write_rig(add("the same, 120,000 frames", "rig", "long.glb"), plain, many, name="long")
    frames = np.resize(mocap.pose, (60_000, 22, 3))
    write_poses(add("60,000 frames in AMASS' layout", "poses", "poses.npz"), frames, frame_rate=30)
    rest, faces = np.asarray(body.template), np.asarray(body.faces)
    count = 16
    scene = np.concatenate([rest + np.array([k, 0, 0]) for k in range(count)])
    corners = np.concatenate([faces + k * len(rest) for k in range(count)])
    for suffix in (".ply", ".obj", ".glb"):
        path = add(f"a mesh of {len(corners):,} triangles, {suffix}", "mesh", f"mesh{suffix}")
        trimesh.Trimesh(scene, corners, process=False).export(path)
    return found


def load(kind: str, path: Path) -> tuple[float, float]:
    """Seconds by the clock and of the processor."""
    start, used = time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of holes
        LOADERS[kind](path)
    return time.perf_counter() - start, time.process_time() - used


_FIRST = """
import sys, pathlib
from benchmarks.loading import load
print(load(sys.argv[1], pathlib.Path(sys.argv[2]))[0])
"""


def main(settings: Settings) -> None:
    """Make the files, load them, print the table, and record it where that is asked for."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for what, kind, path in files(Path(name)):
            words = [sys.executable, "-c", _FIRST, kind, str(path)]
            first = float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
            clock, processor = np.array([load(kind, path) for _ in range(REPEATS)]).T
            rows.append(
                (
                    what,
                    f"{path.stat().st_size / 2**20:,.0f}",
                    f"{first:.2f}",
                    f"{clock.min():.2f}",
                    f"{np.median(clock):.2f}",
                    f"{np.median(processor):.2f}",
                )
            )
    header = ("file", "MiB", "first", "least", "median", "processor")
    title = f"Seconds to load a file, {REPEATS} times; {WITHIN:g} wanted"
    table = Table(title, header, rows)
    table.print()
    if settings.record:
        text = (__doc__ or "").split("\n\n", 1)[1]
        load_average = f"Load of the machine when it ended: {os.getloadavg()[0]:.1f}."
        parts = [provenance("python -m benchmarks.loading --record"), text, load_average]
        record_section("loading", "Loading files", "\n\n".join([*parts, table.markdown()]))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
