"""The body model: blend shapes, a kinematic tree and linear blend skinning in JAX."""

from .files import load_body as load_body
from .mocap import Mocap as Mocap
from .mocap import load_mocap as load_mocap
from .model import BodyModel as BodyModel
from .model import PosedBody as PosedBody
