"""A self-intersection penalty for triangle meshes and body models in JAX."""

import importlib.metadata
import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax import datasets as datasets
    from spt_jax import fit as fit
    from spt_jax import io as io
    from spt_jax import keypoints as keypoints
    from spt_jax import metrics as metrics
    from spt_jax import show as show
    from spt_jax import xla as xla
    from spt_jax._caches import clear_caches as clear_caches
    from spt_jax._camera import PinholeCamera as PinholeCamera
    from spt_jax._contact import contact_penalty as contact_penalty
    from spt_jax._geometry import inflate as inflate
    from spt_jax._groups import Scene as Scene
    from spt_jax._groups import between_groups as between_groups
    from spt_jax._groups import join_bodies as join_bodies
    from spt_jax._groups import within_groups as within_groups
    from spt_jax._labels import VertexLabels as VertexLabels
    from spt_jax._labels import classify_vertices as classify_vertices
    from spt_jax._mesh_check import MeshCheck as MeshCheck
    from spt_jax._mesh_check import check_mesh as check_mesh
    from spt_jax._penalty import paper_penalty as paper_penalty
    from spt_jax._penalty import self_intersection_penalty as self_intersection_penalty
    from spt_jax._report import IntersectionReport as IntersectionReport
    from spt_jax._report import intersection_report as intersection_report
    from spt_jax._result import Overlap as Overlap
    from spt_jax._settings import config as config
    from spt_jax._sheets import SheetReport as SheetReport
    from spt_jax._sheets import sheet_penalty as sheet_penalty
    from spt_jax._sheets import sheet_report as sheet_report
    from spt_jax._status import RESULTS as RESULTS
    from spt_jax._steps import Step as Step
    from spt_jax.body import BodyModel as BodyModel
    from spt_jax.body import PosedBody as PosedBody
    from spt_jax.body import RigModel as RigModel
    from spt_jax.body import load_body as load_body
    from spt_jax.body import load_mocap as load_mocap
    from spt_jax.fit.people import Penetration as Penetration
    from spt_jax.fit.people import PeopleResult as PeopleResult
    from spt_jax.fit.people import fit_people as fit_people
    from spt_jax.fit.pose import fit_pose as fit_pose
    from spt_jax.fit.result import FitResult as FitResult
    from spt_jax.io.pose_files import load_poses as load_poses
    from spt_jax.io.rigs.reading import load_rig as load_rig
    from spt_jax.keypoints import KeypointRegressor as KeypointRegressor
    from spt_jax.keypoints import keypoint_regressor as keypoint_regressor
    from spt_jax.keypoints import read_keypoints as read_keypoints
    from spt_jax.rest.surface import RestSurface as RestSurface
    from spt_jax.untangle.contacts import find_contacts as find_contacts
    from spt_jax.untangle.mesh import UntangleMeshResult as UntangleMeshResult
    from spt_jax.untangle.mesh import untangle_mesh as untangle_mesh
    from spt_jax.untangle.motion import MotionResult as MotionResult
    from spt_jax.untangle.motion import MotionStep as MotionStep
    from spt_jax.untangle.motion import untangle_motion as untangle_motion
    from spt_jax.untangle.one_pose import UntangleResult as UntangleResult
    from spt_jax.untangle.pose import untangle_pose as untangle_pose

try:
    __version__ = importlib.metadata.version("spt-jax")
except importlib.metadata.PackageNotFoundError:  # run from a folder of sources
    __version__ = "0+unknown"

__all__ = [
    "RESULTS",
    "BodyModel",
    "FitResult",
    "IntersectionReport",
    "KeypointRegressor",
    "MeshCheck",
    "MotionResult",
    "MotionStep",
    "Overlap",
    "Penetration",
    "PeopleResult",
    "PinholeCamera",
    "PosedBody",
    "RestSurface",
    "RigModel",
    "Scene",
    "SheetReport",
    "Step",
    "UntangleMeshResult",
    "UntangleResult",
    "VertexLabels",
    "__version__",
    "between_groups",
    "check_mesh",
    "classify_vertices",
    "clear_caches",
    "config",
    "contact_penalty",
    "find_contacts",
    "fit_people",
    "fit_pose",
    "inflate",
    "intersection_report",
    "join_bodies",
    "keypoint_regressor",
    "load_body",
    "load_mocap",
    "load_poses",
    "load_rig",
    "paper_penalty",
    "read_keypoints",
    "self_intersection_penalty",
    "sheet_penalty",
    "sheet_report",
    "untangle_mesh",
    "untangle_motion",
    "untangle_pose",
    "within_groups",
]

# Imported when they are first asked for: who only calls the penalty does not wait for optimistix,
# and `spt_jax.overlap`, NumPy and SciPy alone, can be imported without JAX.
__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "BodyModel": "spt_jax.body",
        "PosedBody": "spt_jax.body",
        "RigModel": "spt_jax.body",
        "load_body": "spt_jax.body",
        "load_mocap": "spt_jax.body",
        "clear_caches": "spt_jax._caches",
        "PinholeCamera": "spt_jax._camera",
        "contact_penalty": "spt_jax._contact",
        "inflate": "spt_jax._geometry",
        "Scene": "spt_jax._groups",
        "between_groups": "spt_jax._groups",
        "join_bodies": "spt_jax._groups",
        "within_groups": "spt_jax._groups",
        "VertexLabels": "spt_jax._labels",
        "classify_vertices": "spt_jax._labels",
        "MeshCheck": "spt_jax._mesh_check",
        "check_mesh": "spt_jax._mesh_check",
        "paper_penalty": "spt_jax._penalty",
        "self_intersection_penalty": "spt_jax._penalty",
        "IntersectionReport": "spt_jax._report",
        "intersection_report": "spt_jax._report",
        "RestSurface": "spt_jax.rest.surface",
        "Overlap": "spt_jax._result",
        "config": "spt_jax._settings",
        "SheetReport": "spt_jax._sheets",
        "sheet_penalty": "spt_jax._sheets",
        "sheet_report": "spt_jax._sheets",
        "FitResult": "spt_jax.fit.result",
        "KeypointRegressor": "spt_jax.keypoints",
        "Penetration": "spt_jax.fit.people",
        "PeopleResult": "spt_jax.fit.people",
        "RESULTS": "spt_jax._status",
        "Step": "spt_jax._steps",
        "UntangleMeshResult": "spt_jax.untangle.mesh",
        "UntangleResult": "spt_jax.untangle.one_pose",
        "find_contacts": "spt_jax.untangle.contacts",
        "fit_people": "spt_jax.fit.people",
        "fit_pose": "spt_jax.fit.pose",
        "keypoint_regressor": "spt_jax.keypoints",
        "load_poses": "spt_jax.io.pose_files",
        "load_rig": "spt_jax.io.rigs.reading",
        "read_keypoints": "spt_jax.keypoints",
        "untangle_mesh": "spt_jax.untangle.mesh",
        "MotionResult": "spt_jax.untangle.motion",
        "MotionStep": "spt_jax.untangle.motion",
        "untangle_motion": "spt_jax.untangle.motion",
        "untangle_pose": "spt_jax.untangle.pose",
        # The namespaces.
        "datasets": "",
        "fit": "",
        "io": "",
        "keypoints": "",
        "metrics": "",
        "show": "",
        "xla": "",
    },
)
