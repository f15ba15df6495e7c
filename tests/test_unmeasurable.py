"""Meshes that have no surface to measure: what everybody says who measures one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import box, join, sampling, sphere

from spt_jax import (
    classify_vertices,
    intersection_report,
    self_intersection_penalty,
    untangle_mesh,
)
from spt_jax.cli.main import main
from spt_jax.overlap.measure import Unmeasurable, measure
from spt_jax.overlap.triangles import near_triangles
from spt_jax.view.scene import Scene

VERTICES, FACES = join(box(), box(center=(0.5, 0.1, 0.2)))


def broken(kind, dtype):
    """Two boxes that overlap, and what is wrong with them."""
    vertices = VERTICES.copy()
    if kind == "partly NaN":
        vertices[3] = np.nan
    elif kind == "one infinity":
        vertices[3, 1] = -np.inf
    elif kind == "wholly NaN":
        vertices[:] = np.nan
    elif kind == "far away":
        vertices += 1e5 if dtype == np.float32 else 1e14
    elif kind == "near overflow":
        vertices *= 2e38 if dtype == np.float32 else 1e300
    else:
        vertices *= 1e-41 if dtype == np.float32 else 1e-310
    return vertices.astype(dtype)


SAID = {
    "partly NaN": "vertices must be finite: got NaN or infinity in 1 of 16",
    "one infinity": "vertices must be finite: got NaN or infinity in 1 of 16",
    "wholly NaN": "vertices must be finite: got NaN or infinity in 16 of 16",
    "far away": "vertices must not be farther from the origin than rounding allows",
    "near overflow": "vertices must be of a size whose cube is a number",
    "denormal": "vertices must be of a size whose cube is a number",
}
# In single precision these are measured: in double precision.
MEASURED = ("near overflow", "denormal")


@pytest.mark.parametrize("rays", [None, 32])
@pytest.mark.parametrize("kind", SAID)
def test_everybody_says_so(kind, rays, dtype):
    vertices = broken(kind, dtype)
    loss = lambda v: self_intersection_penalty(v, FACES, rays=rays)  # noqa: E731
    value, gradient = jax.value_and_grad(loss)(jnp.asarray(vertices))
    labels = np.asarray(classify_vertices(jnp.asarray(vertices), FACES, rays=rays).labels)
    scene = Scene.of_mesh(vertices, FACES, "boxes")
    scene.paper = rays is not None
    reading = scene.read()
    assert not np.abs(gradient).any() and reading.vertices.shape == vertices.shape
    if kind == "denormal":  # zeros by the time XLA hands them over
        assert value == 0 and not labels.any()
    else:
        assert np.isnan(value)  # of a size whose cube is no float32, too
    if dtype == np.float32 and kind in MEASURED:
        measured = intersection_report(vertices, FACES, rays=rays)
        assert not measured.is_free and measured.intersecting_pairs > 0 and measured.num_penetrating
        assert reading.error is None and not reading.is_free
        assert untangle_mesh(vertices, FACES).after.volume <= measured.volume
        return
    assert not labels.any()
    with pytest.raises(Unmeasurable, match=SAID[kind]):
        measure(np.float64(vertices), FACES, sampling(rays), rounding=float(np.finfo(dtype).eps))
    with pytest.raises(Unmeasurable, match=SAID[kind]):
        intersection_report(vertices, FACES, rays=rays)
    finite = bool(np.isfinite(vertices).all())
    with pytest.raises(ValueError, match=SAID[kind] if finite else "with NaN or infinity"):
        untangle_mesh(vertices, FACES)
    assert reading.error.startswith(SAID[kind]) and not reading.is_free
    assert np.isnan(reading.volume) and not reading.labels.any()


def test_the_others_of_a_batch_are_measured(dtype):
    batch = jnp.asarray(np.stack([VERTICES.astype(dtype), broken("partly NaN", dtype)]))
    loss = lambda v: self_intersection_penalty(v, FACES)  # noqa: E731
    values, gradients = jax.vmap(jax.value_and_grad(loss))(batch)
    assert values[0] == pytest.approx(0.36, rel=1e-5) and np.isnan(values[1])
    assert np.abs(gradients[0]).any() and not np.abs(gradients[1]).any()


@pytest.fixture
def crumpled(monkeypatch):
    """As if two boxes in each other were too many pairs to be listed."""
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS", 0)
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS_EACH", 0)
    return sphere(subdivisions=2), sphere(center=(1.2, 0.0, 0.0), subdivisions=2)


@pytest.mark.parametrize("command", ["check", "untangle", "view"])
@pytest.mark.parametrize("kind", ["far away", "near overflow", "denormal", "crumpled"])
def test_a_mesh_file_is_an_error_of_one_line(command, kind, tmp_path, capsys, request):
    if command == "view":
        pytest.importorskip("viser", reason="the live view needs viser")
    said = SAID.get(kind, "vertices must be a surface whose triangles mostly lie apart")
    if kind == "crumpled":
        mesh = join(*request.getfixturevalue("crumpled"))
    else:
        mesh = broken(kind, np.float64), FACES
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh[0].tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh[1] + 1).tolist()]
    file = tmp_path / "mesh.obj"
    file.write_text("\n".join(lines))
    words = {
        "check": ["check", str(file)],
        "untangle": ["untangle", str(file), "--out", str(tmp_path / "out")],
        "view": ["view", str(file), "--port", "18790", "--quiet"],
    }[command]
    assert main(words) == 2
    seen = capsys.readouterr()
    assert seen.err.startswith("spt-jax: ") and seen.err.count("\n") == 1 and said in seen.err
    assert seen.out == "" and not list(tmp_path.glob("out/*"))
    if command == "check":
        assert main([*words, "--json"]) == 2
        assert said in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_many_spheres_in_one_place_end_with_a_result(suffix, tmp_path, capsys):
    copies = join(*[sphere(subdivisions=1)] * 20)
    nested = join(*(sphere(1.0 - k / 41, subdivisions=1) for k in range(40)))
    for vertices, faces in (copies, nested):
        file = tmp_path / f"spheres{suffix}"
        trimesh.Trimesh(vertices, faces, process=False).export(file)
        code = main(["check", str(file)])
        seen = capsys.readouterr()
        # An .stl joins what lies in one place, and is refused then in one line.
        assert code in (1, 2) and seen.err.count("\n") <= 1
        assert ("it self-intersects" in seen.out) == (code == 1)
        assert main(["untangle", str(file), "--out", str(tmp_path / "out")]) == code
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("options", [{}, {"value": "ratio"}, {"gradient": "vertex"}])
def test_rays_list_no_pairs_where_none_are_asked_for(options, monkeypatch):
    """What is too crumpled to be listed has a volume by rays, and NaN where labels need a list."""
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS", 0)
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS_EACH", 0)
    vertices, faces = join(box(), box(center=(0.5, 0.2, 0.3)))
    step = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, rays=32, **options))
    value, gradient = step(jnp.asarray(vertices, "float32"))
    if options:
        assert np.isnan(value) and not np.asarray(gradient).any()
    else:
        assert value == pytest.approx(0.5 * 0.8 * 0.7, rel=0.1) and np.asarray(gradient).any()
