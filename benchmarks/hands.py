"""How far `untangle_pose` frees hands: `python -m benchmarks.hands`.

The hand is the embedded body's left one, cut at the wrist as MANO's is, so that a fan closes it.
Its poses are the colliding ones of the tests' library, and some of them closed further; two hands
are a scene of it and of the right hand that is its mirror image, whose fingers pass through each
other. Whether a finger is left within
another is not for us to say: `oracles.py` lists the edges that pass through triangles farther away
along the rest surface than a crease of that finger reaches.
"""

import json
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from benchmarks.oracles import RestGraph, far_crossings
from spt_jax import load_body, untangle_pose
from spt_jax.body import BodyGroup, BodyModel

LIBRARY = Path(__file__).parents[1] / "tests" / "data" / "hands.json"
FREED, WITHIN = 0.95, 0.015  # the targets: share of poses, and metres that a fingertip moves
_FURTHER, _HOW_MANY = 1.15, 9
_MOVED = 1e-3
# Second hands: how far their fingers reach into the first one's, how far they are turned about the
# fingers' own axis, and how far they are shifted across.
_PAIRS = [
    (reach, turn, across)
    for reach in (0.03, 0.06)
    for turn, across in ((0.0, 0.011), (0.5, 0.0), (1.57, 0.0))
]


@dataclass
class Settings:
    """What is done with the figures."""

    record: bool = False
    """Write the tables into results.md."""


class Case(NamedTuple):
    """One pose: far crossings before and after, and how far each fingertip moved, in metres."""

    name: str
    before: int
    after: int
    tips: np.ndarray
    seconds: float


@cache
def left_hand() -> BodyModel:
    """The embedded body's left hand, open at the wrist."""
    body = load_body(num_shape=0)
    names = body.joint_names
    wrist = names.index("left_wrist")
    kept = [wrist, *(k for k, n in enumerate(names) if n.startswith("left_") and k >= 22)]
    faces = np.asarray(body.faces)[np.isin(body.part_groups, kept)]
    used, faces = np.unique(faces, return_inverse=True)
    weights = np.asarray(body.weights)[used][:, kept]
    rest = weights.sum(axis=1, keepdims=True)
    weights[:, :1] += 1 - rest  # what the forearm moves, the wrist does here
    joints = np.asarray(body.joint_template)[kept]
    return BodyModel(
        template=jnp.asarray(np.asarray(body.template)[used] - joints[0]),
        shape_basis=jnp.zeros((len(used), 3, 0)),
        joint_template=jnp.asarray(joints - joints[0]),
        joint_shape_basis=jnp.zeros((len(kept), 3, 0)),
        weights=jnp.asarray(weights),
        faces=jnp.asarray(faces.reshape(-1, 3), jnp.int32),
        parents=(-1, *(kept.index(body.parents[k]) for k in kept[1:])),
        joint_names=tuple(names[k] for k in kept),
    )


@cache
def two_hands() -> BodyGroup:
    """The left hand and its mirror image, the right one."""
    left = left_hand()
    mirror = jnp.array([-1.0, 1.0, 1.0])
    right = left.replaced(
        {
            "template": left.template * mirror,
            "joint_template": left.joint_template * mirror,
            "faces": left.faces[:, ::-1],
            "joint_names": tuple(name.replace("left", "right") for name in left.joint_names),
        }
    )
    return BodyGroup([left, right])


def poses() -> dict[str, np.ndarray]:
    """By name, the hand's poses."""
    names = [name.removeprefix("left_") for name in left_hand().joint_names]
    found = {}
    for title, rows in json.loads(LIBRARY.read_text())["colliding"].items():
        pose = np.zeros((len(names), 3), np.float32)
        for name, angles in rows.items():
            pose[names.index(name)] = angles
        found[title] = pose
    further = {f"{title}, closed further": _FURTHER * p for title, p in list(found.items())}
    return found | dict(list(further.items())[:_HOW_MANY])


def pairs() -> dict[str, np.ndarray]:
    """By name, poses of two hands that face each other, fingers through fingers."""
    hand, group, found = left_hand(), two_hands(), {}
    length = float(np.asarray(hand.template)[:, 0].max())
    for reach, turn, across in _PAIRS:
        second = np.zeros((2, len(hand.joint_names), 3), np.float32)
        second[1, 0] = turn, 0.0, 0.0
        place = np.array([[0, 0, 0], [2 * length - reach, 0, across]], np.float32)
        name = f"two hands, {100 * reach:.0f} cm into each other, turned by {np.rad2deg(turn):.0f}"
        found[name] = np.asarray(group.pose_of(second, place))
    return found


@cache
def tips() -> np.ndarray:
    """Of each finger the vertex farthest from its last joint."""
    hand = left_hand()
    owner, rest = np.asarray(hand.weights).argmax(axis=1), np.asarray(hand.template)
    found = []
    for joint, name in enumerate(hand.joint_names):
        if name.endswith("3"):
            own = np.flatnonzero(owner == joint)
            away = np.linalg.norm(rest[own] - np.asarray(hand.joint_template)[joint], axis=1)
            found.append(own[away.argmax()])
    return np.array(found)


def freed(name: str, body, pose: np.ndarray, count: int) -> Case:
    """One pose of so many hands, untangled and judged."""
    hand = left_hand()
    faces = np.asarray(body.faces, np.int64)
    own = [np.asarray(one.template, np.float64) for one in getattr(body, "everyone", [body])]
    rest = np.concatenate(own)
    graph = RestGraph.of(rest, faces, np.tile(hand.rest_surface.distances, count))
    vertices = np.asarray(body(jnp.asarray(pose)).vertices, np.float64)
    start = time.process_time()
    found = jax.block_until_ready(untangle_pose(body, jnp.asarray(pose)))
    seconds = time.process_time() - start
    after = np.asarray(found.vertices, np.float64)
    at = (np.arange(count)[:, None] * len(hand.template) + tips()).ravel()
    moved = np.linalg.norm((after - vertices)[at], axis=1)
    return Case(
        name,
        far_crossings(vertices, faces, graph).num_far,
        far_crossings(after, faces, graph).num_far,
        moved,
        seconds,
    )


def tables(cases: list[Case], what: str) -> list[Table]:
    """How many came free, at what price, and each of them."""
    colliding = [case for case in cases if case.before]
    free = sum(not case.after for case in colliding)
    every = np.concatenate([case.tips for case in colliding])
    return [
        Table(
            f"{what}: {len(cases)} poses, {len(colliding)} of which collide",
            ("what", "is so", "target"),
            [
                (
                    "no finger is left within another",
                    f"{free} of {len(colliding)} ({free / len(colliding):.0%})",
                    f"{FREED:.0%}",
                ),
                (
                    "fingertips moved, median",
                    f"{1e3 * np.median(every):.1f} mm",
                    f"{1e3 * WITHIN:g} mm",
                ),
                (
                    "the same of those that moved by more than 1 mm",
                    f"{1e3 * np.median(every[every > _MOVED]):.1f} mm",
                    f"{1e3 * WITHIN:g} mm",
                ),
                (
                    "processor time, median",
                    f"{np.median([case.seconds for case in colliding]):.2f} s",
                    "",
                ),
            ],
        ),
        Table(
            what,
            ("pose", "crossings before", "after", "fingertips moved, median", "farthest"),
            [
                (
                    case.name,
                    str(case.before),
                    str(case.after),
                    f"{1e3 * np.median(case.tips):.1f} mm",
                    f"{1e3 * case.tips.max():.1f} mm",
                )
                for case in cases
            ],
        ),
    ]


def main(settings: Settings) -> None:
    """Untangle all hands, print the tables, and record them where that is asked for."""
    hand = left_hand()
    one = [freed(name, hand, pose, 1) for name, pose in poses().items()]
    two = [freed(name, two_hands(), pose, 2) for name, pose in pairs().items()]
    parts = [*tables(one, "One hand"), *tables(two, "Two hands")]
    for table in parts:
        table.print()
    if settings.record:
        record_section(
            "hands",
            "Hands",
            "\n\n".join(
                [
                    provenance("python -m benchmarks.hands --record"),
                    "Default settings of `untangle_pose`. The hand is the embedded body's, cut at "
                    "the wrist as MANO's is. Crossings are ipctk's, of edges with triangles that "
                    "are farther away along the hand at rest than a crease there reaches.",
                    *(table.markdown() for table in parts),
                ]
            ),
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
