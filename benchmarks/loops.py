"""Ten thousand calls of which each brings something new: `python -m benchmarks.loops`.

Each kind runs in a process of its own; resident memory after a tenth of the calls, when caches are
full, stands beside that after all of them. It ends with 1 where that grew by more than 5 %.
"""

import gc
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.common import Table, provenance, record_section
from benchmarks.soak import sampled
from spt_jax import (
    RestSurface,
    classify_vertices,
    clear_caches,
    intersection_report,
    load_body,
    load_mocap,
    self_intersection_penalty,
)

_GROWTH = 1.05
_BOX = trimesh.creation.box()
_VERTICES = np.concatenate([_BOX.vertices, _BOX.vertices + np.array([0.6, 0.13, 0.07])])
_FACES = np.concatenate([_BOX.faces, _BOX.faces + 8])
_HALVES = np.repeat([0, 1], 12)

Call = Callable[[np.random.Generator], object]


@dataclass
class Settings:
    """How many calls, and of which kinds."""

    calls: int = 10_000
    kinds: tuple[str, ...] = ()
    """Of the table's first column; all if none is given."""
    record: bool = False
    """Write the table into results.md."""


class Held(NamedTuple):
    """What one kind took and kept."""

    milliseconds: float
    tenth: int  # bytes after a tenth of the calls
    all: int  # bytes after all of them
    cleared: int  # bytes after `clear_caches()`


def _slope(vertices: np.ndarray, faces: np.ndarray, **options: object) -> object:
    def loss(moved: jax.Array) -> jax.Array:
        return self_intersection_penalty(moved, faces, **options)  # type: ignore[arg-type]

    return jax.value_and_grad(loss)(jax.device_put(np.float32(vertices)))


def _directions(rng: np.random.Generator) -> object:
    return _slope(_VERTICES, _FACES, rays=16, directions=rng.normal(size=(3, 3)))


def _directions_on_device(rng: np.random.Generator) -> object:
    turned = rng.normal(size=(3, 3))
    return _slope(_VERTICES, _FACES, rays=16, directions=turned, backend="xla")


def _groups(rng: np.random.Generator) -> object:
    groups = rng.permutation(_HALVES)
    return _slope(_VERTICES, _FACES, face_groups=groups, ignore_groups=((0, 0), (1, 1)))


def _margins(rng: np.random.Generator) -> object:
    return _slope(_VERTICES, _FACES, margin=float(rng.uniform(0.0, 0.1)))


def _faces(rng: np.random.Generator) -> object:
    return _slope(_VERTICES, rng.permutation(_FACES))


def _rest_surfaces(rng: np.random.Generator) -> object:
    faces = rng.permutation(_FACES)
    rest = RestSurface(_VERTICES * rng.uniform(1, 2), faces, distance=float(rng.uniform(0.01, 0.3)))
    classify_vertices(_VERTICES, faces, rest_surface=rest)
    return _slope(_VERTICES, faces, rest_surface=rest)


def _sizes(rng: np.random.Generator) -> object:
    """Other numbers of vertices and triangles, in batches of other sizes, at times with a margin.

    Nothing else of JAX stands around the calls: what that compiles for new shapes, JAX keeps.
    """
    count = int(rng.integers(1, 12))
    more = np.concatenate([_VERTICES + 3.0 * k for k in range(count)])
    faces = np.concatenate([_FACES + len(_VERTICES) * k for k in range(count)])
    vertices = np.concatenate([more, rng.normal(size=(rng.integers(0, 2000), 3))])
    classify_vertices(vertices.astype(np.float32), faces)
    batch = np.float32(np.repeat(vertices[None], rng.integers(1, 4), axis=0))
    self_intersection_penalty(jax.device_put(batch), faces)
    margin = 0.01 if rng.integers(20) == 0 else 0.0
    return _slope(vertices, faces, margin=margin)


def _reports(rng: np.random.Generator) -> object:
    points = _VERTICES + rng.normal(scale=1e-3, size=_VERTICES.shape)
    return intersection_report(points, _FACES, rays=int(rng.integers(8, 64)))


def _programs(rng: np.random.Generator) -> object:
    """A function that is traced and compiled anew."""
    turned = rng.normal(size=(2, 3))
    step = jax.jit(lambda v: self_intersection_penalty(v, _FACES, rays=16, directions=turned))
    return step(jnp.asarray(_VERTICES, "float32"))


def _bodies(rng: np.random.Generator) -> object:
    """Poses and shapes of the body, new in every call; a fold's distance in every one, too."""
    body, mocap = load_body(), load_mocap()
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[rng.integers(len(mocap.names))]))
    shape = jnp.asarray(rng.normal(size=body.num_shape), "float32")
    return self_intersection_penalty(body(pose, shape).vertices, body.faces)


KINDS: dict[str, Call] = {
    "directions": _directions,
    "face groups": _groups,
    "faces": _faces,
    "margins": _margins,
    "sizes of meshes and batches": _sizes,
    "rest surfaces": _rest_surfaces,
    "directions, xla": _directions_on_device,
    "numbers of rays": _reports,
    "poses and shapes": _bodies,
    "programs": _programs,
}
# Of the calls, for those that compile, or measure far more, each time.
_SHARE = {"directions, xla": 0.1, "poses and shapes": 0.1, "programs": 0.1}


def looped(kind: str, calls: int) -> Held:
    """Call it so often; what was held on the way."""
    rng = np.random.default_rng(0)
    held, start = [], time.monotonic()
    for k in range(calls):
        jax.block_until_ready(KINDS[kind](rng))
        if k + 1 in (calls // 10, calls):
            held.append(_resident())
    took = time.monotonic() - start
    clear_caches()
    tenth, full = held
    return Held(1e3 * took / calls, tenth, full, _resident())


def _resident() -> int:
    gc.collect()
    now = sampled(0.0)
    return now.resident + now.children


def main(settings: Settings) -> int:
    """Run the kinds one after the other, print and perhaps record."""
    rows, grown = [], []
    context = multiprocessing.get_context("spawn")
    for kind in settings.kinds or KINDS:
        calls = int(settings.calls * _SHARE.get(kind, 1.0))
        with ProcessPoolExecutor(1, mp_context=context) as process:
            found = process.submit(looped, kind, calls).result()
        per_call = (found.all - found.tenth) / (calls - calls // 10)
        sizes = [f"{count / 1e6:.0f} MB" for count in found[1:]]
        rows.append(
            (kind, f"{calls:,}", f"{found.milliseconds:.1f}", *sizes, f"{per_call / 1e3:+.2f}")
        )
        print(*rows[-1], sep=", ", flush=True)
        if found.all > _GROWTH * found.tenth:
            grown.append(kind)
    header = ("new", "calls", "ms", "after a tenth", "in the end", "cleared", "kB a call")
    table = Table("Memory over calls that bring something new", header, rows)
    table.print()
    for kind in grown:
        print(f"loops: {kind}: memory grew by more than 5 %", file=sys.stderr)
    if settings.record:
        about = f"{len(grown)} of {len(rows)} grew by more than 5 % after a tenth of the calls."
        parts = [provenance("python -m benchmarks.loops --record"), about, table.markdown()]
        record_section("loops", "Loops of calls", "\n\n".join(parts))
    return int(bool(grown))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
