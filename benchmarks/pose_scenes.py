"""Mocap frames seen by a camera: the scenes of `benchmarks.pose_table`."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.oracles import RestGraph, far_crossings
from spt_jax import BodyModel, PinholeCamera, load_body, load_mocap, self_intersection_penalty
from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.priors import GaussianPosePrior
from spt_jax.io.pose_files import load_poses

JOINTS = 22
FOCAL, CENTER = 1200.0, (500.0, 500.0)  # pixels; a person of 1.7 m is 400 to 680 pixels tall
NEAREST, FARTHEST = 3.0, 5.0  # metres from the camera to the middle of the joints
NOISE, MISSING = 5.0, 0.1  # pixels; share of the joints
MOST_SHAPE = 2.0  # standard deviations


class Scene(NamedTuple):
    """A body in front of a camera at the origin that looks along z with y down."""

    name: str
    pose: np.ndarray
    shape: np.ndarray
    translation: np.ndarray
    exact: np.ndarray
    noisy: np.ndarray
    seen: np.ndarray  # 0 where the noisy keypoints lack a joint

    @property
    def motion(self) -> str:
        """The motion that the frame is from."""
        return self.name.split("/")[0]


def camera() -> PinholeCamera:
    """The camera of all scenes."""
    return PinholeCamera(FOCAL, CENTER)


def scenes(first: int, count: int, seed: int) -> Iterator[Scene]:
    """`count` scenes without collisions from a seeded shuffle of all frames.

    Scenes 0 to 138 are the table's; weights are tuned on later ones.

    Args:
        first: how many scenes to skip.
        count: how many to make.
        seed: of the shuffle and of all that is random in a scene.
    """
    body, mocap = load_body(), load_mocap()
    order = np.random.default_rng(seed).permutation(len(mocap.names))
    found = 0
    for frame in order:
        scene = _scene(body, mocap.names[frame], mocap.pose[frame], (seed, int(frame)))
        if not _is_free(body, scene):
            continue
        found += 1
        if found > first:
            yield scene
        if found == first + count:
            return


def stored_scenes(path: Path | None, first: int, count: int, seed: int) -> list[Scene]:
    """The same scenes, from a file that holds them, or made and written there; None for neither."""
    if path is not None and path.exists():
        with np.load(path, allow_pickle=False) as data:
            rows = zip(*(data[name] for name in Scene._fields), strict=True)
            found = [Scene(str(name), *arrays) for name, *arrays in rows]
        if len(found) >= first + count:
            return found[first : first + count]
    found = list(scenes(0, first + count, seed))
    if path is not None:
        columns: dict[str, Any] = {n: [getattr(s, n) for s in found] for n in Scene._fields}
        np.savez(path, **columns)
    return found[first:]


def scenes_of_file(path: Path, up: Literal["y", "z"], count: int, seed: int) -> list[Scene]:
    """Scenes without collisions of poses in a file that `load_poses` reads, evenly over its frames.

    Args:
        path: the file.
        up: which of its axes points up.
        count: how many scenes at most.
        seed: of all that is random in a scene.

    Raises:
        ValueError: the file holds no pose without collisions.
    """
    body = load_body()
    frames = []
    for track in load_poses(path):
        poses = np.array(track.pose[:, :JOINTS], np.float32)
        if up == "z":
            down = Rotation.from_euler("x", -90, degrees=True)
            turned = down * Rotation.from_rotvec(poses[:, 0])
            poses[:, 0] = turned.as_rotvec()
        frames += [(f"{path.stem}_{track.name}/{k:04}", pose) for k, pose in enumerate(poses)]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(3 * count, len(frames))).astype(int))
    found = []
    for place in np.random.default_rng(seed).permutation(chosen).tolist():
        name, pose = frames[place]
        scene = _scene(body, name, pose, (seed, place))
        if _is_free(body, scene):
            found.append(scene)
        if len(found) == count:
            break
    if not found:
        raise ValueError(f"{path} must hold a pose without collisions: got none.")
    return found


def prior_without(motion: str) -> GaussianPosePrior:
    """The prior of all motions but one: no fit has seen the motion that it is to find."""
    body, mocap = load_body(), load_mocap()
    others = [k for k, name in enumerate(mocap.names) if name.split("/")[0] != motion]
    return pose_prior(body.joint_names, mocap.pose[others], mocap.joints)


def _scene(body: BodyModel, name: str, frame: np.ndarray, seed: tuple[int, int]) -> Scene:
    rng = np.random.default_rng(seed)
    shape = np.clip(rng.normal(size=body.num_shape), -MOST_SHAPE, MOST_SHAPE).astype(np.float32)
    turn = jnp.array([0.0, rng.uniform(0, 2 * np.pi), 0.0], jnp.float32)
    distance = rng.uniform(NEAREST, FARTHEST)
    pose = body.pose_from_smpl(jnp.asarray(frame))
    # From the world's axes (y up) to the camera's (y down): half a turn about x.
    over = jnp.diag(jnp.array([1.0, -1.0, -1.0], jnp.float32))
    root = over @ matrix_from_axis_angle(turn) @ matrix_from_axis_angle(pose[0])
    pose = pose.at[0].set(axis_angle_from_matrix(root))
    joints = body(pose, shape).joints[:JOINTS]
    translation = jnp.array([0.0, 0.0, distance], jnp.float32) - joints.mean(axis=0)
    exact = np.asarray(camera().project(joints + translation))
    noisy = exact + rng.normal(scale=NOISE, size=exact.shape).astype(np.float32)
    seen = (rng.random(JOINTS) >= MISSING).astype(np.float32)
    return Scene(name, np.asarray(pose), shape, np.asarray(translation), exact, noisy, seen)


def _vertices(body: BodyModel, scene: Scene):
    return body(scene.pose, scene.shape, scene.translation).vertices


def _is_free(body: BodyModel, scene: Scene) -> bool:
    vertices = np.asarray(_vertices(body, scene), np.float64)
    # The penalty is quick and sees what collides; the oracle, which is not ours, confirms.
    if float(_overlap(jnp.asarray(vertices, jnp.float32))) > 1e-9:
        return False
    return not far_crossings(vertices, np.asarray(body.faces, np.int64), _graph()).num_far


@cache
def _graph() -> RestGraph:
    return RestGraph.of_body(load_body())


@cache
def _compiled():
    body = load_body()
    rest = body.rest_surface
    return jax.jit(lambda v: self_intersection_penalty(v, body.faces, rest_surface=rest))


def _overlap(vertices):
    return _compiled()(vertices)
