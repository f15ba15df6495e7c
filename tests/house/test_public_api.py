"""The public names and signatures; a change here is a change for every user."""

import importlib.metadata
import inspect
import subprocess
import sys

import pytest

import spt_jax

NAMES = [
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
    "RESULTS",
    "RestSurface",
    "RigModel",
    "Scene",
    "SheetReport",
    "Step",
    "UntangleMeshResult",
    "UntangleResult",
    "VertexLabels",
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
PARAMETERS = {
    "sheet_penalty": "vertices, faces, solid_vertices, solid_faces, *, value='area'",
    "sheet_report": "vertices, faces, solid_vertices, solid_faces",
    "self_intersection_penalty": "vertices, faces, *, value='volume', gradient='boundary',"
    " rule='vertex', rays=None, directions=3, margin=0.0, face_groups=None, ignore_groups=(),"
    " rest_surface=None, backend='auto', second_order=False",
    "contact_penalty": "vertices, faces, pairs, *, margin=0.0",
    "paper_penalty": "vertices, faces, *, rays=512, normalize=True, backend='auto'",
    "classify_vertices": "vertices, faces, *, rays=None, directions=3, rule='vertex',"
    " face_groups=None, ignore_groups=(), rest_surface=None, backend='auto'",
    "intersection_report": "vertices, faces, *, rays=None, directions=3, rule='vertex',"
    " face_groups=None, ignore_groups=(), rest_surface=None",
    "check_mesh": "vertices, faces",
    "fit_pose": "body, keypoints, camera, *, layout=None, confidence=None, start=Start(),"
    " terms=Terms(), regularizer='spt', search=Search(), stages=Stages(), on_step=None",
    "fit_people": "body, keypoints, camera, *, layout=None, confidence=None, start=Start(),"
    " terms=Terms(), regularizer='spt', search=Search(), stages=Stages(),"
    " scene=Scene(weights=(0.01, 0.1, 1.0, 10.0, 100.0)), on_step=None",
    "keypoint_regressor": "body, layout, *, count=None, names=None",
    "read_keypoints": "path, *, layout=None, map=None, max_bytes=None",
    "load_body": "source='anny', *, num_shape=10, num_expression=10, dtype=None, max_bytes=None",
    "load_mocap": "",
    "untangle_motion": "body, poses, *, shape=None, translation=None, frames_per_second=30.0,"
    " fade=0.02, fold_distance=None, margin=0.002, feet=20.0, contacts=None, contact_distance=0.02,"
    " contact_weight=20.0, up=(0.0, 1.0, 0.0), tolerance=1e-09, resume=None, on_step=None",
    "untangle_pose": "body, pose, *, shape=None, translation=None, folds='ignore',"
    " fold_distance=None, margin=0.002,"
    " rays=None, directions=3, weights=(0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0),"
    " steps_per_weight=25, tolerance=1e-09, solver=None, contacts=None, contact_distance=0.02,"
    " contact_weight=20.0, on_step=None",
}
# Their docstrings say what there is to say without a list of results.
SHORT = {
    "join_bodies": "vertices, faces",
    "between_groups": "count",
    "within_groups": "count",
    "RestSurface": "rest_vertices, faces, distance=0.3",
}


def bare_signature(function) -> str:
    signature = inspect.signature(function)
    parameters = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    return str(inspect.Signature(parameters))[1:-1]


def test_names():
    public = [
        name
        for name in dir(spt_jax)
        if not name.startswith("_") and not inspect.ismodule(getattr(spt_jax, name))
    ]
    assert sorted(public) == NAMES
    assert sorted(spt_jax.__all__) == sorted([*NAMES, "__version__"])
    with pytest.raises(AttributeError, match="no attribute 'fit_pse'"):
        _ = spt_jax.fit_pse


def test_the_penalty_does_not_wait_for_what_only_fits_need():
    code = "import sys, spt_jax; print('optimistix' in sys.modules, 'scipy.sparse' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert printed.stdout.split() == ["False", "False"], printed.stderr


def test_signatures():
    expected = PARAMETERS | SHORT
    assert {name: bare_signature(getattr(spt_jax, name)) for name in expected} == expected


def test_everything_public_is_documented():
    for name in NAMES:
        assert inspect.getdoc(getattr(spt_jax, name)), name
    for name in PARAMETERS | SHORT:
        doc = inspect.getdoc(getattr(spt_jax, name)) or ""
        assert "Example:" in doc and (name in SHORT or "Returns:" in doc), name


NAMESPACES = {
    "datasets": [
        "Finished",
        "Progress",
        "Resources",
        "Summary",
        "Task",
        "UnknownFileError",
        "clean",
        "fit",
        "measure",
        "run",
    ],
    "fit": [
        "BodySpheres",
        "FitResult",
        "FunctionPosePrior",
        "GaussianPosePrior",
        "JointLimits",
        "Laplacian",
        "MixturePosePrior",
        "MotionFit",
        "Nothing",
        "Penetration",
        "PeopleResult",
        "PosePrior",
        "Regularizer",
        "Scene",
        "Search",
        "SelfIntersection",
        "Spheres",
        "Stages",
        "Start",
        "Terms",
        "Variables",
        "as_regularizer",
        "as_weights",
        "fit_motion",
        "fit_people",
        "fit_pose",
        "joint_limits",
        "mixture_prior",
        "pose_prior",
        "regularizer_names",
    ],
    "io": [
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
    ],
    "metrics": [
        "BetweenMeshes",
        "MotionOverlap",
        "between_meshes",
        "motion_overlap",
        "rejected",
        "write_csv",
    ],
    "xla": ["Xla", "device_usage"],
}


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_namespaces(namespace):
    """They are there without an import of their own, and nothing in them is undocumented."""
    module = getattr(spt_jax, namespace)
    assert module.__all__ == NAMESPACES[namespace]
    for name in module.__all__:
        assert name in dir(module) and inspect.getdoc(getattr(module, name)), name


def test_all_of_it_can_be_imported_at_once_and_has_a_version():
    code = "from spt_jax import *; print(untangle_pose.__name__, __version__)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert printed.stdout.split() == ["untangle_pose", importlib.metadata.version("spt-jax")]
