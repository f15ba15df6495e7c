"""`backend="xla"` against the host, and what it costs: `python -m benchmarks.device [--record]`.

On whatever device JAX runs: on a GPU the times are that GPU's.
"""

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import load_body, load_mocap, self_intersection_penalty
from spt_jax.xla.settings import DEFAULT_RAYS, Xla, buffer_sizes, bytes_needed

# Overlaps smaller than this, in m^3, are left out where differences are parts of the volume.
_LEAST = 1e-6


@dataclass
class Settings:
    """Which frames are measured."""

    frames: int = 40
    """Of the embedded motion capture, at equal distances."""
    batch: int = 4
    """Meshes of a batch that is timed; 64 on a GPU."""
    record: bool = False
    """Write the tables into results.md."""


def _calls(faces, **options) -> tuple[Any, Any]:
    """Value and gradient on the host and on the device, of a list of meshes."""

    def call(backend):
        def loss(v):
            return self_intersection_penalty(v, faces, backend=backend, **options)

        return jax.jit(jax.value_and_grad(loss))

    return call("numpy"), call("xla")


def compared(meshes, faces, asked: dict[str, Any], given: dict[str, Any], task) -> list[str]:
    """Differences of the device from the host, as parts: median, and the largest."""
    host, device = _calls(faces, **asked)[0], _calls(faces, **given)[1]
    volumes, gradients, disagree = [], [], 0
    for mesh in meshes:
        (volume, gradient), (found, slope) = host(mesh), device(mesh)
        disagree += bool((volume > 0) != (found > 0))
        if volume > _LEAST:
            volumes.append(abs(float(found / volume) - 1))
            gradients.append(float(jnp.linalg.norm(slope - gradient) / jnp.linalg.norm(gradient)))
        task()
    worst = [f"{f(x):.1e}" for x in (volumes, gradients) for f in (np.median, np.max)]
    return [f"{len(volumes)} of {len(meshes)}", *worst, f"{disagree}"]


def agreement(settings: Settings) -> Table:
    """How far the device's results are from the host's."""
    body, mocap = load_body(), load_mocap()
    frames = np.linspace(0, len(mocap.names) - 1, settings.frames).astype(int)
    meshes = body(body.pose_from_smpl(jnp.asarray(mocap.pose[frames]))).vertices
    rays = {"rays": DEFAULT_RAYS}
    folds = {"rest_surface": body.rest_surface, "rays": DEFAULT_RAYS}
    kinds = {
        f"{DEFAULT_RAYS} rays, both": (rays, rays),
        f"exact on the host, {DEFAULT_RAYS} rays here": ({}, {}),
        f"folds left out, {DEFAULT_RAYS} rays, both": (folds, folds),
    }
    rows = []
    with progress() as bar:
        task = bar.add_task("frames", total=len(kinds) * len(meshes))
        for name, (asked, given) in kinds.items():
            found = compared(meshes, body.faces, asked, given, lambda: bar.advance(task))
            rows.append([name, *found])
    return Table(
        f"Device (float32) against host, {len(meshes)} frames: differences as parts, of overlaps "
        f"above {1e6 * _LEAST:.0f} cm^3",
        ("rays", "frames", "volume, median", "largest", "gradient, median", "largest", "0 or not"),
        rows,
    )


def price(settings: Settings) -> Table:
    """Time and memory, and operations and bytes by XLA's own count."""
    body, mocap = load_body(), load_mocap()
    frames = np.linspace(0, len(mocap.names) - 1, settings.batch).astype(int)
    batch = body(body.pose_from_smpl(jnp.asarray(mocap.pose[frames]))).vertices

    def loss(v):
        return self_intersection_penalty(v, body.faces, backend="xla").sum()

    one = jax.jit(jax.value_and_grad(loss)).lower(batch[0])
    start = time.perf_counter()
    one = one.compile()
    compiling = time.perf_counter() - start
    memory, counted = one.memory_analysis(), one.cost_analysis() or {}
    many = jax.jit(jax.value_and_grad(loss))

    def milliseconds(call, mesh, repeats=7):
        jax.block_until_ready(call(mesh))
        taken = []
        for _ in range(repeats):
            start = time.perf_counter()
            jax.block_until_ready(call(mesh))
            taken.append(1e3 * (time.perf_counter() - start))
        return float(np.median(taken))

    space = buffer_sizes(Xla(), DEFAULT_RAYS)
    bound = bytes_needed(space, len(batch[0]), len(body.faces), 4)
    rows = [
        ("one body, ms", f"{milliseconds(one, batch[0]):.1f}"),
        (
            f"a batch of {settings.batch}, ms a body",
            f"{milliseconds(many, batch) / len(batch):.1f}",
        ),
        ("compiling, s", f"{compiling:.1f}"),
        ("memory, MB", f"{memory.temp_size_in_bytes / 1e6:.0f}" if memory else "unknown"),
        ("its bound in settings.bytes_needed, MB", f"{bound / 1e6:.0f}"),
        ("operations of one strip, 1e9", f"{counted.get('flops', np.nan) / 1e9:.2f}"),
        ("bytes of one strip, 1e9", f"{counted.get('bytes accessed', np.nan) / 1e9:.2f}"),
    ]
    where = jax.devices()[0]
    return Table(
        f"Value and gradient of the embedded body with {DEFAULT_RAYS} rays in three directions on "
        f"{where.platform} ({where.device_kind}), float32",
        ("", ""),
        rows,
    )


def main(settings: Settings) -> None:
    """Print both tables, and record them."""
    tables = [agreement(settings), price(settings)]
    for table in tables:
        table.print()
    if settings.record:
        command = f"python -m benchmarks.device --frames {settings.frames} --record"
        body = "\n\n".join([provenance(command), *(table.markdown() for table in tables)])
        record_section("device", "The device path", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
