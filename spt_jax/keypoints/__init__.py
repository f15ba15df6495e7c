"""Keypoints: their layouts, their places on a body, and files of them."""

from .entries import Person as Person
from .files import KeypointFile as KeypointFile
from .files import read_keypoints as read_keypoints
from .landmarks import find_landmarks as find_landmarks
from .layouts import LAYOUTS as LAYOUTS
from .layouts import Layout as Layout
from .layouts import as_layout as as_layout
from .layouts import edge_side as edge_side
from .regressor import KeypointRegressor as KeypointRegressor
from .regressor import keypoint_regressor as keypoint_regressor
