"""A self-intersection penalty for triangle meshes and body models in JAX."""

from spt_jax.body import BodyModel as BodyModel
from spt_jax.body import PosedBody as PosedBody
from spt_jax.body import load_body as load_body
from spt_jax.body import load_mocap as load_mocap
from spt_jax.classes import VertexClasses as VertexClasses
from spt_jax.classes import classify_vertices as classify_vertices
from spt_jax.groups import Scene as Scene
from spt_jax.groups import between_groups as between_groups
from spt_jax.groups import join_bodies as join_bodies
from spt_jax.groups import within_groups as within_groups
from spt_jax.mesh_check import MeshCheck as MeshCheck
from spt_jax.mesh_check import check_mesh as check_mesh
from spt_jax.penalty import paper_penalty as paper_penalty
from spt_jax.penalty import self_intersection_penalty as self_intersection_penalty
from spt_jax.report import IntersectionReport as IntersectionReport
from spt_jax.report import intersection_report as intersection_report
from spt_jax.rest_surface import RestSurface as RestSurface
from spt_jax.untangle.mesh import UntangleMeshResult as UntangleMeshResult
from spt_jax.untangle.mesh import untangle_mesh as untangle_mesh
from spt_jax.untangle.pose import UntangleResult as UntangleResult
from spt_jax.untangle.pose import untangle_pose as untangle_pose
