"""The body model: blend shapes, a kinematic tree and linear blend skinning in JAX."""

from spt_jax.body.adapt import adapt as adapt
from spt_jax.body.base import AbstractBody as AbstractBody
from spt_jax.body.base import PosedBody as PosedBody
from spt_jax.body.expressions import expression_as_shape as expression_as_shape
from spt_jax.body.files import load_body as load_body
from spt_jax.body.group import BodyGroup as BodyGroup
from spt_jax.body.hands import Hand as Hand
from spt_jax.body.mocap import Mocap as Mocap
from spt_jax.body.mocap import load_mocap as load_mocap
from spt_jax.body.model import BodyModel as BodyModel
from spt_jax.body.rig import RigModel as RigModel
