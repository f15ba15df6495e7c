"""Keypoints: their layouts, their places on a body, and files of them."""

from spt_jax.keypoints.entries import Person as Person
from spt_jax.keypoints.files import KeypointFile as KeypointFile
from spt_jax.keypoints.files import read_keypoints as read_keypoints
from spt_jax.keypoints.landmarks import find_landmarks as find_landmarks
from spt_jax.keypoints.layout import Layout as Layout
from spt_jax.keypoints.layout import edge_side as edge_side
from spt_jax.keypoints.layouts import LAYOUTS as LAYOUTS
from spt_jax.keypoints.layouts import as_layout as as_layout
from spt_jax.keypoints.making_regressors import AnyLayout as AnyLayout
from spt_jax.keypoints.making_regressors import keypoint_regressor as keypoint_regressor
from spt_jax.keypoints.regressor import KeypointRegressor as KeypointRegressor
from spt_jax.keypoints.tracks import find_tracks as find_tracks
