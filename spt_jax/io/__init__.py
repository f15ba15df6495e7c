"""Files read and written: bodies, meshes, poses and keypoints."""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.body.files import load_body as load_body
    from spt_jax.files.pickles import RefusedPickleError as RefusedPickleError
    from spt_jax.io.mesh_files import MeshFile as MeshFile
    from spt_jax.io.mesh_files import open_mesh as open_mesh
    from spt_jax.io.mesh_files import read_mesh as read_mesh
    from spt_jax.io.mesh_files import write_mesh as write_mesh
    from spt_jax.io.pose_files import MotionFile as MotionFile
    from spt_jax.io.pose_files import Track as Track
    from spt_jax.io.pose_files import load_poses as load_poses
    from spt_jax.io.pose_files import open_poses as open_poses
    from spt_jax.io.pose_files import read_poses as read_poses
    from spt_jax.io.pose_files import write_poses as write_poses
    from spt_jax.io.rigs.bvh import write_bvh as write_bvh
    from spt_jax.io.rigs.clips import Clip as Clip
    from spt_jax.io.rigs.exporting import write_rig as write_rig
    from spt_jax.io.rigs.reading import RigFile as RigFile
    from spt_jax.io.rigs.reading import load_rig as load_rig
    from spt_jax.io.rigs.reading import load_rigs as load_rigs
    from spt_jax.io.robots import Robot as Robot
    from spt_jax.io.robots import load_robot as load_robot
    from spt_jax.keypoints.files import KeypointFile as KeypointFile
    from spt_jax.keypoints.files import read_keypoints as read_keypoints

__all__ = [
    "Clip",
    "KeypointFile",
    "MeshFile",
    "MotionFile",
    "RefusedPickleError",
    "RigFile",
    "Robot",
    "Track",
    "load_body",
    "load_poses",
    "load_rig",
    "load_rigs",
    "load_robot",
    "open_mesh",
    "open_poses",
    "read_keypoints",
    "read_mesh",
    "read_poses",
    "write_bvh",
    "write_mesh",
    "write_poses",
    "write_rig",
]

__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "load_body": "spt_jax.body.files",
        "RefusedPickleError": "spt_jax.files.pickles",
        "MeshFile": "spt_jax.io.mesh_files",
        "open_mesh": "spt_jax.io.mesh_files",
        "read_mesh": "spt_jax.io.mesh_files",
        "write_mesh": "spt_jax.io.mesh_files",
        "MotionFile": "spt_jax.io.pose_files",
        "Track": "spt_jax.io.pose_files",
        "load_poses": "spt_jax.io.pose_files",
        "open_poses": "spt_jax.io.pose_files",
        "read_poses": "spt_jax.io.pose_files",
        "write_poses": "spt_jax.io.pose_files",
        "write_bvh": "spt_jax.io.rigs.bvh",
        "Clip": "spt_jax.io.rigs.clips",
        "write_rig": "spt_jax.io.rigs.exporting",
        "RigFile": "spt_jax.io.rigs.reading",
        "Robot": "spt_jax.io.robots",
        "load_robot": "spt_jax.io.robots",
        "load_rig": "spt_jax.io.rigs.reading",
        "load_rigs": "spt_jax.io.rigs.reading",
        "KeypointFile": "spt_jax.keypoints.files",
        "read_keypoints": "spt_jax.keypoints.files",
    },
)
