"""What one call costs: `python -m benchmarks.speed [--record]`. Medians of repeated calls."""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from spt_jax import (
    classify_vertices,
    load_body,
    load_mocap,
    self_intersection_penalty,
)
from spt_jax.bridge import callback

FRAME = "crawl/0092"


@dataclass
class Settings:
    """How often each call is repeated."""

    repeats: int = 30
    record: bool = False
    """Write the table into results.md."""


def milliseconds(
    call: Callable[[], Any], repeats: int, again: bool = False
) -> tuple[float, float, float]:
    """The 10, 50 and 90 % points of the call's time, after one call that compiles.

    Cached results are dropped before each call, unless it is to be asked `again`.
    """
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        if not again:
            callback.clear_results()
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - start))
    low, middle, high = np.percentile(times, [10, 50, 90])
    return float(low), float(middle), float(high)


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[mocap.names.index(FRAME)]))
    vertices = body(pose).vertices
    frames = np.linspace(0, len(mocap.names) - 1, 16).astype(int)
    batch = body(body.pose_from_smpl(jnp.asarray(mocap.pose[frames]))).vertices
    labels = jax.jit(lambda v: classify_vertices(v, body.faces).labels)

    def penalty(**options):
        return jax.jit(
            jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces, **options).sum())
        )

    through_body = jax.jit(
        jax.value_and_grad(lambda p: self_intersection_penalty(body(p).vertices, body.faces))
    )
    only_body = jax.jit(jax.value_and_grad(lambda p: jnp.sum(body(p).vertices ** 2)))
    default, rest = penalty(), body.rest_surface
    lanes = jax.jit(
        jax.vmap(jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces)))
    )
    for _ in range(8):  # until batches have been worth another process, and that is there
        callback.clear_results()
        jax.block_until_ready(default(batch))
        time.sleep(1.0)
    kinds = {
        "penalty, default (exact, without rays)": default,
        "penalty, folds left out": penalty(rest_surface=rest),
        "penalty, folds left out, margin of 2 mm": penalty(rest_surface=rest, margin=0.002),
        "penalty, 512 x 512 rays, three directions": penalty(rays=512),
        "penalty, 512 x 512 rays, one direction": penalty(rays=512, directions=1),
        "penalty, 256 x 256 rays, three directions": penalty(rays=256),
    }
    calls = {
        "body and its gradient, without the penalty": lambda: only_body(pose),
        "body + penalty, default": lambda: through_body(pose),
        **{name: functools.partial(call, vertices) for name, call in kinds.items()},
        "penalty, default, the same mesh again": lambda: default(vertices),
        "penalty, default, 16 bodies one by one, per mesh": lambda: [default(v) for v in batch],
        "penalty, default, batch of 16, per mesh": lambda: default(batch),
        "penalty, default, vmap over 16, per mesh": lambda: lanes(batch),
        "labels, vertex rule": lambda: labels(vertices),
    }
    rows = []
    for name, call in calls.items():
        share = 16 if "per mesh" in name else 1
        repeats = settings.repeats // (4 if share > 1 else 1)
        times = milliseconds(call, repeats, again="again" in name)
        rows.append((name, *(f"{t / share:.1f}" for t in times)))
    table = Table(
        f"Value and gradient under jit, in milliseconds; {len(vertices)} vertices, "
        f"{len(body.faces)} triangles, frame {FRAME}, float32",
        ("call", "10 %", "median", "90 %"),
        rows,
    )
    table.print()
    if settings.record:
        command = f"python -m benchmarks.speed --repeats {settings.repeats} --record"
        record_section(
            "speed", "The cost of a call", f"{provenance(command)}\n\n{table.markdown()}"
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
