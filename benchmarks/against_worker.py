"""One side of `benchmarks.against`: measures the calls that it is asked for by name and number.

It imports the tree that it is given, not its own, so it uses nothing but the public API and the
function that clears cached results, whatever that tree calls it.
"""

import functools
import inspect
import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

sys.path.insert(0, sys.argv[1])

import spt_jax

try:
    from spt_jax.bridge import callback
except ImportError:  # a tree from before the folder
    from spt_jax import host as callback

clear_results = vars(callback).get("clear_results") or vars(callback)["forget"]

# Frames that collide, to be untangled.
COLLIDING = (
    "backflip/0000",
    "cartwheel/0142",
    "crawl/0013",
    "crawl/0158",
    "getup_facedown/0113",
    "jump/0085",
    "punch/0018",
    "punch/0051",
    "roll/0050",
    "roll/0083",
    "roll/0107",
    "spinkick/0054",
)
_FRAMES = 60
_STEP = 1e-3  # metres: the farthest that a vertex moves between two calls
_MARGIN = 0.002


class World:
    """The body in every frame, and a step from there."""

    def __init__(self):
        self.body, mocap = spt_jax.load_body(), spt_jax.load_mocap()
        rows = np.linspace(0, len(mocap.names) - 1, _FRAMES).astype(int)
        self.pose = self.body.pose_from_smpl(jnp.asarray(mocap.pose[rows]))
        colliding = jnp.array([mocap.names.index(name) for name in COLLIDING])
        self.colliding = self.body.pose_from_smpl(jnp.asarray(mocap.pose[colliding]))
        self.vertices = self.body(self.pose).vertices
        self.box = trimesh.creation.box()

    def near(self, k: int):
        """The body of frame k with its joints turned until its farthest vertex is 1 mm away."""
        turn = np.random.default_rng(k).normal(size=self.pose[k].shape).astype(np.float32)
        turn[0] = 0.0
        least, most = 0.0, 1e-2
        for _ in range(12):
            middle = (least + most) / 2
            moved = self.body(self.pose[k] + middle * turn).vertices - self.vertices[k]
            far = float(jnp.linalg.norm(moved, axis=1).max()) > _STEP
            least, most = (least, middle) if far else (middle, most)
        return self.body(self.pose[k] + least * turn).vertices

    def scene(self, k: int, people: int, gap: float):
        """People in a row, the first in frame k, so near that two are in each other or clear."""
        rows = (k + np.arange(people) * 7) % _FRAMES
        place = jnp.arange(people, dtype=jnp.float32)[:, None] * jnp.array([[gap, 0.0, 0.0]])
        vertices = self.body(self.pose[rows], translation=place).vertices
        return spt_jax.join_bodies(vertices, self.body.faces).vertices

    def faces(self, people: int):
        """Of so many bodies."""
        vertices = jnp.stack([self.vertices[0]] * people)
        return spt_jax.join_bodies(vertices, self.body.faces).faces


@functools.cache
def _penalty(faces, **options):
    def loss(vertices):
        return spt_jax.self_intersection_penalty(vertices, faces.array, **options)

    return jax.jit(jax.value_and_grad(loss))


def _labels(faces, vertices):
    found = spt_jax.classify_vertices(vertices, faces)
    # Before its first release, VertexLabels had another field name.
    return vars(found)["labels" if hasattr(found, "labels") else "label"]


class _Faces:
    """Faces, hashed as the object they are."""

    def __init__(self, array):
        self.array = np.asarray(array)


@functools.cache
def _balls():
    """Vertices of two balls in each other, and their faces: 1,048,576 triangles in all."""
    ball = trimesh.Trimesh(
        np.concatenate([np.eye(3), -np.eye(3)]),
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]],
        process=False,
    )
    vertices, faces = ball.vertices, ball.faces
    for _ in range(8):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    turn = trimesh.transformations.rotation_matrix(1.0, [1.0, 2.0, 3.0])[:3, :3]
    both = np.concatenate([vertices, vertices @ turn.T + [1.67, 0.2, 0.1]])
    return both, _Faces(np.concatenate([faces, faces + len(vertices)]).astype(np.int32))


class Calls:
    """What can be asked for: of each, the meshes before, if any, the mesh, and the call."""

    def __init__(self, world: World):
        self.world = world
        # Before its first release the argument had another name.
        names = inspect.signature(spt_jax.self_intersection_penalty).parameters
        name = "rest_surface" if "rest_surface" in names else "folds"
        rest = {name: world.body.rest_surface}
        one, two, five = (_Faces(world.faces(n)) for n in (1, 2, 5))
        box = _Faces(world.box.faces)
        self.kinds = {
            "default": (self._cold, _penalty(one)),
            "default_warm": (self._warm, _penalty(one)),
            "folds": (self._cold, _penalty(one, **rest)),
            "folds_warm": (self._warm, _penalty(one, **rest)),
            "margin_warm": (self._warm, _penalty(one, **rest, margin=_MARGIN)),
            "rays512": (self._cold, _penalty(one, rays=512, directions=1)),
            "rays512x3": (self._cold, _penalty(one, rays=512)),
            "rays2048": (self._cold, _penalty(one, rays=2048, directions=1)),
            "scene": (lambda k: ((), world.scene(k, 2, 0.45)), _penalty(two)),
            "five": (lambda k: ((), world.scene(k, 5, 2.5)), _penalty(five)),
            "box": (self._boxes, _penalty(box)),
        }
        self._classify = jax.jit(functools.partial(_labels, one.array))

    def _cold(self, k: int):
        return (), self.world.vertices[k]

    def _warm(self, k: int):
        # The third call of a search, each a step from the last.
        now, after = self.world.vertices[k], self.world.near(k)
        return (2 * now - after, now), after

    def _boxes(self, k: int):
        size = jnp.array([1.0 + 0.01 * k, 1.0, 1.0], jnp.float32)
        return (), jnp.asarray(self.world.box.vertices, jnp.float32) * size

    def prepared(self, name: str, k: int):
        """What is to be timed: a call without arguments."""
        world = self.world
        if name == "labels":
            vertices = jax.block_until_ready(world.vertices[k % _FRAMES])
            return lambda: (self._classify(vertices),)
        if name == "untangle":
            pose = world.colliding[k % len(COLLIDING)]
            before = np.asarray(world.body(pose).vertices)

            def untangled():
                found = spt_jax.untangle_pose(world.body, pose)
                moved = np.linalg.norm(np.asarray(found.vertices) - before, axis=1)
                return moved.mean(), np.append(moved, float(found.after.volume))

            return untangled
        if name == "million":
            both, faces = _balls()
            vertices, call = jnp.asarray(both, jnp.float32) * (1 + 0.001 * k), _penalty(faces)
        else:
            meshes, call = self.kinds[name]
            before, vertices = meshes(k % _FRAMES)
            for mesh in before:
                jax.block_until_ready(call(jax.block_until_ready(mesh)))
        vertices = jax.block_until_ready(vertices)
        return lambda: call(vertices)


def main() -> None:
    """Answer each line with [milliseconds, [numbers that identify the result], the processor's]."""
    if not str(spt_jax.__file__).startswith(sys.argv[1]):
        sys.exit(f"spt_jax must be imported from {sys.argv[1]}: got {spt_jax.__file__}.")
    if hasattr(spt_jax, "config"):  # before its first release, processes were always started
        spt_jax.config.processes = "auto"
    calls = Calls(World())
    for line in sys.stdin:
        name, number = line.split()
        call = calls.prepared(name, int(number))
        clear_results()
        start, used = time.perf_counter(), time.process_time()
        found = jax.block_until_ready(call())
        taken, used = time.perf_counter() - start, time.process_time() - used
        told = [float(f(np.asarray(x, np.float64))) for x in found for f in (np.sum, np.ptp)]
        print(json.dumps([1e3 * taken, told, 1e3 * used]), flush=True)


if __name__ == "__main__":
    main()
