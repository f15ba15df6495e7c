"""What one call costs: `python -m benchmarks.speed [--record]`. Medians of repeated calls.

Lists of what is near what are kept from call to call, so no shape comes twice. Cold: each call's
shape is larger than the last one's by a sixteenth of the first, and no earlier one is near. Warm:
it is larger by half a thousandth, so no vertex moves by more than a millimetre, as in a search.
Processor time, which other work on the machine lengthens less than the clock.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import (
    classify_vertices,
    load_body,
    load_mocap,
    self_intersection_penalty,
)
from spt_jax.bridge import callback

FRAME = "crawl/0092"
# By how much of the first shape each one is larger than the last.
_FAR, _NEAR = 1 / 16, 5e-4
_UNCOUNTED = 3


@dataclass
class Settings:
    """How often each call is repeated."""

    repeats: int = 30
    record: bool = False
    """Write the table into results.md."""


def larger(mesh: jax.Array, near: bool) -> Callable[[int], jax.Array]:
    """A mesh in ever other sizes, each near the last one or none near any."""
    return lambda k: mesh * (1 + k * (_NEAR if near else _FAR))


def milliseconds(
    call: Callable[[jax.Array], Any],
    shape: Callable[[int], jax.Array],
    repeats: int,
    again: bool = False,
) -> tuple[float, float, float]:
    """The 10, 50 and 90 % points of the call's processor time, once it is compiled.

    Args:
        call: what is measured.
        shape: what each call is given; a search is warm from its third call on.
        repeats: how many calls are counted.
        again: whether every call is given the first shape, whose result is known.
    """
    times = []
    for k in range(repeats + _UNCOUNTED):
        given = jax.block_until_ready(shape(0 if again else k))
        if not again:
            callback.clear_results()
        start = time.process_time()
        jax.block_until_ready(call(given))
        times.append(1e3 * (time.process_time() - start))
    low, middle, high = np.percentile(times[_UNCOUNTED:], [10, 50, 90])
    return float(low), float(middle), float(high)


def _one_by_one(call: Callable[[jax.Array], Any]) -> Callable[[jax.Array], Any]:
    return lambda batch: [call(mesh) for mesh in batch]


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
        jax.value_and_grad(
            lambda p, size: self_intersection_penalty(size * body(p).vertices, body.faces)
        )
    )
    only_body = jax.jit(jax.value_and_grad(lambda p, size: jnp.sum((size * body(p).vertices) ** 2)))
    default, rest = penalty(), body.rest_surface
    lanes = jax.jit(
        jax.vmap(jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces)))
    )
    kinds = {
        "penalty, default (exact, without rays)": default,
        "penalty, folds left out": penalty(rest_surface=rest),
        "penalty, folds left out, margin of 2 mm": penalty(rest_surface=rest, margin=0.002),
        "penalty, 512 x 512 rays, three directions": penalty(rays=512),
        "penalty, 512 x 512 rays, one direction": penalty(rays=512, directions=1),
        "penalty, 256 x 256 rays, three directions": penalty(rays=256),
    }
    one = jnp.ones(())
    calls = {
        "body and its gradient, without the penalty": (lambda size: only_body(pose, size), one),
        "body + penalty, default": (lambda size: through_body(pose, size), one),
        **{name: (call, vertices) for name, call in kinds.items()},
        "penalty, default, the same mesh again": (default, vertices),
        "penalty, default, 16 bodies one by one, per mesh": (_one_by_one(default), batch),
        "penalty, default, batch of 16, per mesh: this process of two": (default, batch),
        "penalty, default, vmap over 16, per mesh: this process of two": (lanes, batch),
        "labels, vertex rule": (labels, vertices),
    }
    rows = []
    with progress() as bar:
        for name, (call, first) in bar.track(calls.items(), description="calls"):
            share = 16 if "per mesh" in name else 1
            repeats = settings.repeats // (4 if share > 1 else 1)
            again = "again" in name
            cold, warm = (
                milliseconds(call, larger(first, near), repeats, again) for near in (False, True)
            )
            rows.append((name, *(f"{t / share:.1f}" for t in (*cold, warm[1]))))
    table = Table(
        "Value and gradient under jit, milliseconds of processor time; "
        f"{len(vertices)} vertices, {len(body.faces)} triangles, frame {FRAME}, float32",
        ("call", "10 %", "median", "90 %", "warm: median"),
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
