"""Pose files read and written, whoever's structure they have."""

from spt_jax.io.poses.reading import STRUCTURES as STRUCTURES
from spt_jax.io.poses.reading import SUFFIXES as SUFFIXES
from spt_jax.io.poses.reading import choose as choose
from spt_jax.io.poses.reading import is_pose_file as is_pose_file
from spt_jax.io.poses.reading import load_poses as load_poses
from spt_jax.io.poses.reading import open_poses as open_poses
from spt_jax.io.poses.reading import read_motion as read_motion
from spt_jax.io.poses.track import MotionFile as MotionFile
from spt_jax.io.poses.track import Track as Track
from spt_jax.io.poses.whole import JOINT_COUNTS as JOINT_COUNTS
from spt_jax.io.poses.writing import check_joints as check_joints
from spt_jax.io.poses.writing import read_poses as read_poses
from spt_jax.io.poses.writing import write_poses as write_poses
