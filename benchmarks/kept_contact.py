"""Contact that `untangle_pose` keeps: `python -m benchmarks.kept_contact`.

Frames of motion capture in which something collides and parts are in contact: how much farther
apart each two parts are afterwards than they were, or than the margin where they were nearer, with
and without `contacts="found"`.
"""

import time
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import config, contact_penalty, find_contacts, load_body, load_mocap, untangle_pose

_MARGIN, _LOST = 0.002, 0.005


@dataclass
class Settings:
    """How many frames."""

    frames: int = 40
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


def _gaps(body: Any, vertices: Any, pairs: Any) -> np.ndarray:
    vertices = jnp.asarray(vertices)
    return np.sqrt([float(contact_penalty(vertices, body.faces, [pair])) for pair in pairs])


def _freed(body: Any, pose: Any, given: np.ndarray, pairs: Any, contacts: str | None) -> tuple:
    start = time.process_time()
    result = untangle_pose(body, pose, contacts=contacts)
    seconds = time.process_time() - start
    limit = np.maximum(_gaps(body, given, pairs), _MARGIN)
    lost = _gaps(body, result.vertices, pairs) - limit
    moved = np.linalg.norm(np.asarray(result.vertices) - given, axis=1).mean()
    return lost, bool(result.is_free), moved, int(result.steps), seconds


def _row(name: str, found: list[tuple]) -> tuple[str, ...]:
    lost = np.concatenate([one[0] for one in found])
    worst = np.array([one[0].max() for one in found])
    moved, steps, seconds = (np.median([one[k] for one in found]) for k in (2, 3, 4))
    return (
        name,
        f"{np.count_nonzero(lost <= _LOST)} of {len(lost)}",
        f"{1e3 * np.median(np.maximum(worst, 0)):.1f}",
        f"{1e3 * np.percentile(worst, 90):.1f}",
        f"{1e3 * worst.max():.1f}",
        f"{sum(one[1] for one in found)} of {len(found)}",
        f"{1e3 * moved:.1f}",
        f"{steps:.0f}",
        f"{seconds:.2f}",
    )


def main(settings: Settings) -> None:
    """Free them with and without, print, record."""
    config.processes = 1
    body, mocap = load_body(), load_mocap()
    rows: dict[str, list[tuple]] = {"let go": [], 'contacts="found"': []}
    with progress() as bar:
        task = bar.add_task("frames in contact", total=settings.frames)
        for index in np.random.default_rng(settings.seed).permutation(len(mocap.names)):
            pose = body.pose_from_smpl(jnp.asarray(mocap.pose[index]))
            given = np.asarray(body(pose).vertices)
            pairs = find_contacts(body, given)
            if not pairs or untangle_pose(body, pose).before.intersecting_pairs == 0:
                continue
            rows["let go"].append(_freed(body, pose, given, pairs, None))
            rows['contacts="found"'].append(_freed(body, pose, given, pairs, "found"))
            bar.advance(task)
            if len(rows["let go"]) == settings.frames:
                break
    table = Table(
        f"{len(rows['let go'])} frames that collide and have contact within 20 mm",
        (
            "contact",
            f"pairs of parts kept within {1e3 * _LOST:.0f} mm",
            "farthest of a frame, mm, median",
            "90 %",
            "largest",
            "free",
            "moved, mm, median",
            "steps, median",
            "seconds of a core, median",
        ),
        [_row(name, found) for name, found in rows.items()],
    )
    table.print()
    if settings.record:
        command = f"python -m benchmarks.kept_contact --frames {settings.frames} --record"
        text = (
            f"{provenance(command)} Farther than they were, or than the margin of 2 mm where they "
            "were nearer or intersected."
        )
        record_section("kept-contact", "Contact that is kept", f"{text}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
