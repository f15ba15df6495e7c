"""The price and the exactness of second derivatives: `python -m benchmarks.second_order`.

On posed bodies: processor time of a value with its gradient and of the same with one product of the
Hessian, the two in turn, and how far products are from central differences of the gradient.
"""

import statistics
import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import config, load_body, load_mocap, self_intersection_penalty
from spt_jax.bridge.callback import clear_results
from spt_jax.overlap.host_curvature import curvatures

_STEP = 1e-9  # of the differences, in metres for a velocity of about one


@dataclass
class Settings:
    """How many poses, and how often each call is repeated."""

    frames: int = 12
    repeats: int = 7
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


def _ways(body: Any) -> dict[str, dict[str, Any]]:
    return {
        "every overlap": {},
        "folds left out": {"rest_surface": body.rest_surface},
        "folds left out, 2 mm of margin": {"rest_surface": body.rest_surface, "margin": 0.002},
    }


def _colliding(body: Any, settings: Settings) -> np.ndarray:
    """Vertices of frames in which something counts."""
    mocap, found = load_mocap(), []
    pose_of = jax.jit(lambda pose: body(pose).vertices)
    for index in np.random.default_rng(settings.seed).permutation(len(mocap.names)):
        vertices = np.asarray(pose_of(body.pose_from_smpl(mocap.pose[index])), np.float64)
        if self_intersection_penalty(vertices, body.faces, rest_surface=body.rest_surface) > 1e-7:
            found.append(vertices)
        if len(found) == settings.frames:
            break
    return np.stack(found)


def _timed(function: Any, *arguments: Any) -> float:
    clear_results()
    curvatures.clear()
    start = time.process_time()
    jax.block_until_ready(function(*arguments))
    return time.process_time() - start


def _row(name: str, options: dict[str, Any], body: Any, meshes: np.ndarray, settings: Settings):
    faces = np.asarray(body.faces)

    def loss(vertices, **more):
        return self_intersection_penalty(vertices, faces, **options, **more)

    plain = jax.jit(jax.grad(loss))
    gradient = jax.jit(jax.grad(lambda vertices: loss(vertices, second_order=True)))
    both = jax.jit(lambda x, v: jax.jvp(gradient, (x,), (v,)))
    first, second, off, askew = [], [], [], []
    for number, vertices in enumerate(meshes):
        waves = np.random.default_rng(number).standard_normal((2, 3, 3)) * 8
        moves = [np.sin(vertices @ wave) for wave in waves]
        product = [np.asarray(both(vertices, move)[1]) for move in moves]
        h = _STEP
        near, far = (
            np.asarray(gradient(vertices + s * moves[0]) - gradient(vertices - s * moves[0]))
            for s in (h, 2 * h)
        )
        expected = (8 * near - far) / (12 * h)
        off.append(np.linalg.norm(product[0] - expected) / np.linalg.norm(expected))
        size = np.linalg.norm(product[0]) * np.linalg.norm(moves[1])
        askew.append(abs(np.vdot(product[0], moves[1]) - np.vdot(product[1], moves[0])) / size)
        single = jnp.asarray(vertices, jnp.float32)
        move = jnp.asarray(moves[0], jnp.float32)
        jax.block_until_ready((plain(single), both(single, move)))  # compiled
        for _ in range(settings.repeats):
            first.append(_timed(plain, single))
            second.append(_timed(both, single, move))
    ratio = statistics.median(b / a for a, b in zip(first, second, strict=True))
    return (
        name,
        f"{1e3 * statistics.median(first):.1f}",
        f"{1e3 * statistics.median(second):.1f}",
        f"{ratio:.2f}",
        f"{np.median(off):.0e}",
        f"{max(off):.0e}",
        f"{max(askew):.0e}",
    )


def main(settings: Settings) -> None:
    """Time, compare, print."""
    jax.config.update("jax_enable_x64", True)
    config.processes = 1
    body = load_body()
    meshes = _colliding(body, settings)
    rows, ways = [], _ways(body)
    with progress() as bar:
        task = bar.add_task("second derivatives", total=len(ways))
        for name, options in ways.items():
            rows.append(_row(name, options, body, meshes, settings))
            bar.advance(task)
    table = Table(
        f"{len(meshes)} posed bodies of {len(body.faces):,} triangles",
        (
            "what counts",
            "gradient, ms",
            "with a product, ms",
            "ratio",
            "off differences, median",
            "at most",
            "asymmetry, at most",
        ),
        rows,
    )
    table.print()
    if settings.record:
        command = f"python -m benchmarks.second_order --frames {settings.frames} --record"
        body_text = (
            f"{provenance(command)} Processor time, medians, the two turn about; differences are "
            f"of fourth order with steps of {_STEP:g}, in float64, and are themselves that far off."
        )
        record_section("second-order", "Second derivatives", f"{body_text}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
