"""Files read and written: meshes, poses and keypoints."""

from spt_jax.body.files import load_body as load_body
from spt_jax.body.pickles import RefusedPickleError as RefusedPickleError
from spt_jax.keypoints.files import KeypointFile as KeypointFile
from spt_jax.keypoints.files import read_keypoints as read_keypoints
from spt_jax.mesh_files import MeshFile as MeshFile
from spt_jax.mesh_files import open_mesh as open_mesh
from spt_jax.mesh_files import read_mesh as read_mesh
from spt_jax.mesh_files import write_mesh as write_mesh
from spt_jax.pose_files import MotionFile as MotionFile
from spt_jax.pose_files import Track as Track
from spt_jax.pose_files import load_poses as load_poses
from spt_jax.pose_files import open_poses as open_poses
from spt_jax.pose_files import read_poses as read_poses
from spt_jax.pose_files import write_poses as write_poses

__all__ = [
    "KeypointFile",
    "MeshFile",
    "MotionFile",
    "RefusedPickleError",
    "Track",
    "load_body",
    "load_poses",
    "open_mesh",
    "open_poses",
    "read_keypoints",
    "read_mesh",
    "read_poses",
    "write_mesh",
    "write_poses",
]
