"""The public names and signatures; a change here is a change for every user."""

import inspect

import spt_jax

NAMES = [
    "BodyModel",
    "IntersectionReport",
    "MeshCheck",
    "PosedBody",
    "UntangleResult",
    "VertexClasses",
    "check_mesh",
    "classify_vertices",
    "intersection_report",
    "load_body",
    "load_mocap",
    "paper_penalty",
    "self_intersection_penalty",
    "untangle_pose",
]
PARAMETERS = {
    "self_intersection_penalty": "vertices, faces, *, value='volume', gradient='boundary',"
    " rays=512, directions=3, margin=0.0, face_groups=None, ignore_groups=(), folds=None,"
    " backend='auto'",
    "paper_penalty": "vertices, faces, *, rays=512, normalize=True",
    "classify_vertices": "vertices, faces, *, rays=512, directions=3, rule='triangle'",
    "intersection_report": "vertices, faces, *, rays=512, directions=3",
    "check_mesh": "vertices, faces",
    "load_body": "source='anny', *, num_shape=10, dtype=None",
    "load_mocap": "",
    "untangle_pose": "body, pose, *, shape=None, translation=None, rays=256, directions=3,"
    " weights=(0.01, 0.1, 1.0, 10.0, 100.0), steps_per_weight=25, tolerance=1e-09, solver=None,"
    " on_step=None",
}


def bare_signature(function) -> str:
    signature = inspect.signature(function)
    parameters = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    return str(inspect.Signature(parameters))[1:-1]


def test_names():
    public = [
        name
        for name, value in vars(spt_jax).items()
        if not name.startswith("_") and not inspect.ismodule(value)
    ]
    assert sorted(public) == NAMES


def test_signatures():
    assert {name: bare_signature(getattr(spt_jax, name)) for name in PARAMETERS} == PARAMETERS


def test_everything_public_is_documented():
    for name in NAMES:
        assert len(inspect.getdoc(getattr(spt_jax, name)).splitlines()) >= 1, name
    for name in PARAMETERS:
        doc = inspect.getdoc(getattr(spt_jax, name))
        assert "Returns:" in doc and "Example:" in doc, name
