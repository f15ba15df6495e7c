"""`spt-jax fit`: files in, files out, and what is said of bad ones."""

import io
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers_body import synthetic_smpl
from PIL import Image
from rich.console import Console

from spt_jax import RESULTS
from spt_jax._report import IntersectionReport
from spt_jax._status import OUTSIDE
from spt_jax.body import load_body
from spt_jax.cli import fitted
from spt_jax.cli.annotated import read_camera, select_people
from spt_jax.cli.fitting import scenes_of
from spt_jax.cli.main import main
from spt_jax.fit import pose as fitting
from spt_jax.fit import pose_prior
from spt_jax.fit.people import Penetration, PeopleResult
from spt_jax.fit.result import FitResult
from spt_jax.io.pose_files import read_poses
from spt_jax.keypoints import LAYOUTS
from spt_jax.show.overlay import read_image

COCO = LAYOUTS["coco17"]


@pytest.fixture
def calls(monkeypatch):
    """The options of every call of a stand-in for fit_pose: bodies at rest, 4 m away."""
    made = []

    def stand_in(body, keypoints, camera, *, layout, confidence, **options):
        made.append(dict(layout=layout, robust=options["terms"].robust, **options))
        where = jnp.array([0.0, 0.0, 4.0])
        flip = jnp.array([1.0, -1.0, -1.0])
        return FitResult(
            pose=jnp.zeros((body.num_joints, 3)).at[0, 0].set(jnp.pi),
            shape=jnp.full(body.num_shape, 0.5),
            translation=where,
            vertices=body.template * flip[None] + where[None],
            joints=body.joint_template * flip[None] + where[None],
            # Three pixels to the right, in the pixels that it was given.
            keypoints=keypoints + jnp.array([[3.0, 0.0]]),
            steps=jnp.array(7),
            terms={"reprojection": jnp.sum(confidence), "total": jnp.sum(confidence)},
            status=RESULTS.successful,
        )

    monkeypatch.setattr("spt_jax.fit.pose.fit_pose", stand_in)
    return made


def person(rng, center=(320, 240), size=200, missing=0):
    points = np.round(np.array(center) + rng.uniform(-size / 2, size / 2, (17, 2)))
    rows = np.concatenate([points, np.full((17, 1), 2.0)], axis=1)
    rows[:missing] = 0
    return rows


def coco_file(path, people, sizes):
    """`people`: pairs of image number and rows; `sizes`: of each image."""
    content = {
        "images": [
            {"id": k, "file_name": f"{k:012d}.jpg", "width": w, "height": h}
            for k, (w, h) in sizes.items()
        ],
        "annotations": [
            {
                "id": 900 + n,
                "image_id": k,
                "category_id": 1,
                "iscrowd": 0,
                "num_keypoints": int((rows[:, 2] > 0).sum()),
                "keypoints": rows.astype(int).ravel().tolist(),
                "bbox": [0.0, 0.0, 10.0, 10.0],
                "area": 100.0,
            }
            for n, (k, rows) in enumerate(people)
        ],
        "categories": [{"id": 1, "name": "person", "keypoints": list(COCO.official)}],
    }
    path.write_text(json.dumps(content))
    return str(path)


def files_in(folder):
    return sorted(file.name for file in folder.iterdir())


def without_pictures(monkeypatch):
    monkeypatch.setattr(fitted, "draw", lambda *_: ([], "no time"))


def test_a_coco_file_of_several_people_and_images(calls, tmp_path, capsys, rng):
    pytest.importorskip("pyvista")
    people = [(139, person(rng)), (7, person(rng, missing=9)), (139, person(rng, size=90))]
    file = coco_file(tmp_path / "a.json", people, {139: (640, 480), 7: (427, 640)})
    out = tmp_path / "out"
    assert main(["fit", file, "--out", str(out)]) == 0
    names = ["000000000139/0", "000000000007/1", "000000000139/2"]
    report = json.loads((out / "report.json").read_text())
    meshes = [name.replace("/", "_") + ".glb" for name in names]
    pictures = ["000000000139.png", "000000000007.png"]
    assert report["meshes"] == meshes
    drawn = report["pictures"]
    assert drawn == (pictures if report["pictures_left_out"] is None else [])
    assert files_in(out) == sorted([*meshes, *drawn, "poses.npz", "report.json"])
    if drawn:
        assert read_image(out / pictures[0]).shape == (480, 640, 3)
        assert read_image(out / pictures[1]).shape == (640, 427, 3)

    # Squares that bend at the same share of each person.
    sides = [np.ptp(rows[rows[:, 2] > 0, :2], axis=0).max() for _, rows in people]
    np.testing.assert_allclose([call["robust"] for call in calls], 0.1 * np.array(sides))
    assert [call["regularizer"].name for call in calls] == ["spt"] * 3
    poses = read_poses(out / "poses.npz")
    assert poses.names == names and poses.pose.shape == (3, 52, 3) and poses.shape is None
    np.testing.assert_allclose(poses.translation, [[0, 0, 4]] * 3)
    # As glTF has it: y up, in front of a camera that looks along -z.
    mesh = trimesh.load_mesh(out / meshes[0], process=False)
    assert np.asarray(mesh.vertices)[:, 2].max() < -3 and mesh.bounds[1][1] > 0

    assert {"jax", "numpy", "spt-jax"} <= set(report["versions"])
    assert [one["name"] for one in report["people"]] == names
    for one, (_, rows) in zip(report["people"], people, strict=True):
        np.testing.assert_allclose(list(one["reprojection_error"].values()), 3, rtol=1e-4)
        assert one["points_seen"] == (rows[:, 2] > 0).sum() and one["reason"] == "converged"
        assert one["camera"]["source"] == "estimated" and one["distance"] == pytest.approx(4, abs=1)
        assert one["intersection"]["volume"] >= 0 and one["terms"]["total"] > 0
    assert report["people"][1]["camera"]["center"] == [213.5, 320]
    captured = capsys.readouterr()
    assert "3 people" in captured.out and "the camera is not known" in captured.err


def test_people_cameras_photographs_and_shape_are_as_asked_for(
    calls, tmp_path, capsys, rng, monkeypatch
):
    pytest.importorskip("PIL")
    seen = []

    def keep(folder, people, faces):
        seen.extend(people)
        return [], None

    monkeypatch.setattr("spt_jax.cli.fitted.draw", keep)
    file = coco_file(
        tmp_path / "a.json",
        [(1, person(rng)), (2, person(rng)), (2, person(rng)), (3, person(rng))],
        dict.fromkeys((1, 2, 3), (64, 48)),
    )
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    Image.new("RGB", (64, 48)).save(photographs / "000000000002.jpg")
    words = ["fit", file, "--out", str(tmp_path / "out"), "--quiet", "--image", str(photographs)]
    words += ["--people", "3,000000000002", "--focal", "900", "--fit-shape", "--robust", "12.5"]
    assert main(words) == 0
    assert [one.name for one in seen] == [
        "000000000003/3",
        "000000000002/1",
        "000000000002/2",
    ]
    assert [one.given.photograph for one in seen] == [
        None,
        photographs / "000000000002.jpg",
        photographs / "000000000002.jpg",
    ]
    assert calls[0]["robust"] == 12.5 and calls[0]["start"].fit_shape
    for one in seen:
        np.testing.assert_allclose(one.errors, 3, rtol=1e-4)
        assert np.asarray(one.given.camera.focal).tolist() == [900, 900]
        assert np.asarray(one.given.camera.center).tolist() == [32, 24]
    assert read_poses(tmp_path / "out" / "poses.npz").shape.shape == (3, 10)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert any("no photograph of 000000000003" in note for note in report["notes"])
    assert capsys.readouterr() == ("", "")


def test_the_report_as_json_and_no_robust_loss(calls, tmp_path, rng, monkeypatch, capsys):
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    people = [(1, person(rng)) for _ in range(3)]
    file = coco_file(tmp_path / "a.json", people, {1: (640, 480)})
    out = tmp_path / "out"
    words = ["--json", "--robust", "off", "--regularizer", "none"]
    assert main(["fit", file, "--out", str(out), *words]) == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert report == json.loads((out / "report.json").read_text())
    assert [call["robust"] for call in calls] == [None] * 3
    assert calls[0]["regularizer"].name == report["settings"]["regularizer"] == "none"
    assert [one["name"] for one in report["people"]] == [f"000000000001/{k}" for k in range(3)]
    assert "Pictures were left out: no time" in captured.err


def test_people_of_an_image_together(calls, tmp_path, rng, monkeypatch, capsys):
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    before = Penetration(*(jnp.asarray(x) for x in (2e-6, 1e-6, 9, 4)))
    scenes = []

    def together(body, keypoints, camera, **options):
        scenes.append((len(keypoints), options))
        rows = [
            fitting.fit_pose(body, row, camera, **options | {"confidence": trust})
            for row, trust in zip(keypoints, options["confidence"], strict=True)
        ]
        people = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
        after = jax.tree.map(jnp.zeros_like, before)
        return PeopleResult(people=people, before=before, after=after, steps=jnp.array(3))

    monkeypatch.setattr("spt_jax.fit.people.fit_people", together)
    # Two images, the people of the first on both sides of the other's.
    people = [(1, person(rng)), (2, person(rng, missing=9)), (1, person(rng, missing=2))]
    file = coco_file(tmp_path / "a.json", people, dict.fromkeys((1, 2), (640, 480)))
    out = tmp_path / "out"
    assert main(["fit", file, "--out", str(out), "--together"]) == 0
    ((count, options),) = scenes
    assert count == 2
    sides = [np.ptp(rows[rows[:, 2] > 0, :2], axis=0).max() for k, rows in people if k == 1]
    np.testing.assert_allclose(options["terms"].robust, 0.1 * np.array(sides), rtol=1e-6)
    report = json.loads((out / "report.json").read_text())
    names = ["000000000001/0", "000000000001/2", "000000000002/1"]
    assert [one["name"] for one in report["people"]] == names
    for one, k in zip(report["people"], (0, 2, 1), strict=True):
        assert one["terms"]["total"] == (people[k][1][:, 2] > 0).sum()
    (scene,) = report["scenes"]
    assert scene["image"] == "000000000001" and scene["people"] == names[:2]
    assert scene["before"] == {
        "is_free": False,
        "volume_between": pytest.approx(2e-6),
        "volume_within": pytest.approx(1e-6),
        "intersecting_pairs_between": 9,
        "intersecting_pairs_within": 4,
    }
    assert scene["after"].pop("is_free") and set(scene["after"].values()) == {0}
    text = " ".join(capsys.readouterr().out.split())
    assert "2 people together" in text
    assert "left out as folds: 6.00 cm³ and 9 intersecting pairs" in text


@pytest.mark.parametrize("words", [[], ["--fold-distance", "0.1"]])
def test_what_is_a_fold_reaches_the_fit_and_the_report(
    words, calls, tmp_path, rng, monkeypatch, capsys
):
    without_pictures(monkeypatch)
    reports, scenes = [], []

    def report(vertices, *_, rest_surface):
        reports.append(rest_surface)
        return no_overlap(vertices)

    def together(body, keypoints, camera, **options):
        scenes.append(options.pop("scene").fold_distance)
        rows = [
            fitting.fit_pose(body, row, camera, **options | {"confidence": trust})
            for row, trust in zip(keypoints, options["confidence"], strict=True)
        ]
        people = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
        nothing = Penetration(*(jnp.asarray(x) for x in (0.0, 0.0, 0, 0)))
        return PeopleResult(people=people, before=nothing, after=nothing, steps=jnp.array(3))

    monkeypatch.setattr("spt_jax._report.intersection_report", report)
    monkeypatch.setattr("spt_jax.fit.people.fit_people", together)
    people = [(1, person(rng)), (1, person(rng)), (2, person(rng))]
    file = coco_file(tmp_path / "a.json", people, dict.fromkeys((1, 2), (640, 480)))
    out = tmp_path / "out"
    assert main(["fit", file, "--out", str(out), "--together", *words]) == 0
    expected = 0.1 if words else None
    usual = load_body().rest_surface
    wanted = usual.within(0.1) if words else usual
    assert scenes == [expected] and reports == [wanted] * 3
    assert all(call["regularizer"].rest_surface == wanted for call in calls)
    settings = json.loads((out / "report.json").read_text())["settings"]
    assert settings["fold_distance"] == expected


def test_a_scene_has_one_layout():
    def of(layout):
        person = SimpleNamespace(layout=layout)
        return SimpleNamespace(image="a", person=person)

    with pytest.raises(ValueError, match=r"share a layout: got \['body25', 'coco17'\] in a"):
        scenes_of([of("coco17"), of("body25")])


def no_overlap(vertices, *_, **__):
    """In place of a report, where none is looked at."""
    return IntersectionReport(
        volume=0.0,
        total_volume=2e-6,
        solid_volume=0.0,
        directions=(),
        volumes=(),
        labels=np.zeros(len(vertices), np.int8),
        intersecting_pairs=0,
        total_intersecting_pairs=3,
        rays=None,
        crossings=(),
        exact=True,
    )


def test_somebody_who_cannot_be_fitted_is_named(tmp_path, rng, monkeypatch, capsys, calls):
    without_pictures(monkeypatch)
    from spt_jax.fit import pose

    stand_in = pose.fit_pose

    def loses_the_second(body, keypoints, camera, **options):
        found = stand_in(body, keypoints, camera, **options)
        bad = options["confidence"][0] == 0
        vertices = jnp.where(bad, jnp.nan, found.vertices)
        terms = {"total": jnp.where(bad, jnp.nan, 1.0)}
        status = RESULTS.not_finite if bad else RESULTS.nonlinear_max_steps_reached
        return FitResult(**(vars(found) | dict(vertices=vertices, terms=terms, status=status)))

    monkeypatch.setattr("spt_jax.fit.pose.fit_pose", loses_the_second)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    people = [(1, person(rng)), (1, person(rng, missing=1))]
    file = coco_file(tmp_path / "a.json", people, {1: (640, 480)})
    out = tmp_path / "out"
    assert main(["fit", file, "--out", str(out)]) == 1
    captured = capsys.readouterr()
    assert "000000000001/1 could not be fitted" in captured.err and "not finite" in captured.out
    assert files_in(out) == ["000000000001_0.glb", "poses.npz", "report.json"]
    second = json.loads((out / "report.json").read_text())["people"][1]
    assert second["terms"]["total"] is None and second["intersection"] is None


def test_keypoints_of_smpl_on_a_body_file(calls, tmp_path, rng, monkeypatch, capsys):
    without_pictures(monkeypatch)
    np.savez(tmp_path / "model.npz", **synthetic_smpl(rng, joints=24))
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    np.savez(tmp_path / "a.npz", keypoints=rng.uniform(50, 200, (24, 2)))
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps([[500, 0, 100, 0], [0, 400, 90, 0], [0, 0, 1, 0]]))
    words = ["fit", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out"), "--layout", "smpl24"]
    words += ["--body", str(tmp_path / "model.npz"), "--camera", str(camera)]
    assert main(words) == 0
    assert calls[0]["layout"] == "smpl24"
    (one,) = json.loads((tmp_path / "out" / "report.json").read_text())["people"]
    assert one["name"] == "a/0" and one["camera"]["source"] == "file"
    np.testing.assert_allclose(one["camera"]["focal"], [500, 400], rtol=1e-5)
    assert read_poses(tmp_path / "out" / "poses.npz").pose.shape == (1, 24, 3)
    assert "the camera is not known" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--people", "5"], "people must be rows 0 to 1, ranges of them or names such as 'a/0'"),
        (["--layout", "body25"], "person 0 in "),
        (["--layout", "cocoa"], "layout must be one of"),
        (["--robust", "0"], "robust must be a positive number of pixels, auto or off: got 0"),
        (["--camera", "missing.json"], "camera file must exist: got 'missing.json'"),
        (["--camera", "c.json", "--focal", "900"], "camera must be given as a file, or by focal"),
        (["--camera", "c.json"], "camera file c.json must hold a 3 x 4 matrix, or focal and c"),
        (["--focal", "-3"], "focal must be positive: got -3"),
        (["--image", "missing.jpg"], "image must exist: got 'missing.jpg'"),
        (["--image", "c.json"], "image must be a photograph that opens: got 'c.json'"),
        (["--image", "small.png"], "must be 640 by 480 pixels, as the keypoint file says: got 20"),
        (["--body", "missing.npz"], "no body model file at missing.npz"),
        (["--out", "c.json"], "out must be a folder that can be written"),
    ],
)
def test_bad_input(words, message, calls, tmp_path, capsys, rng, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.json").write_text('{"focal": 3}')
    Image.new("RGB", (20, 30)).save(tmp_path / "small.png")
    content = {"layout": "coco17", "width": 640, "height": 480}
    content["people"] = [person(rng).tolist(), person(rng).tolist()]
    (tmp_path / "a.json").write_text(json.dumps(content))
    before = files_in(tmp_path)
    assert main(["fit", "a.json", *([] if "--out" in words else ["--out", "out"]), *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.startswith("spt-jax: ")
    assert captured.err.count("\n") == 1 and captured.out == "" and calls == []
    assert files_in(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["annotations"][1]["keypoints"].__setitem__(4, "x"), "person 1 (id 901)"),
        (lambda c: c["annotations"][0]["keypoints"].pop(), "person 0 (id 900)"),
        (lambda c: c["annotations"][1]["keypoints"].__setitem__(5, 3), "v"),
        (lambda c: c.__setitem__("annotations", []), "must hold people with visible points"),
        (lambda c: c["images"][0].__setitem__("width", -1), "width of image 0"),
    ],
)
def test_the_entry_that_is_wrong_is_named(change, message, calls, tmp_path, capsys, rng):
    path = tmp_path / "a.json"
    coco_file(path, [(1, person(rng)), (1, person(rng))], {1: (640, 480)})
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    assert main(["fit", str(path), "--out", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and str(path) in captured.err
    assert files_in(tmp_path) == ["a.json"] and calls == []


def test_interrupted_while_it_fits(tmp_path, rng, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("spt_jax.fit.pose.fit_pose", interrupt)
    file = coco_file(tmp_path / "a.json", [(1, person(rng))], {1: (640, 480)})
    assert main(["fit", file, "--out", str(tmp_path / "out"), "--focal", "700"]) == 130
    assert capsys.readouterr().err == "spt-jax: interrupted; no file is left half-written\n"
    assert files_in(tmp_path / "out") == []


def test_cameras_from_files(tmp_path):
    matrix = np.array([[800.0, 0, 320, 640], [0, 700, 240, 480], [0, 0, 1, 2]])
    (tmp_path / "m.json").write_text(json.dumps({"matrix": matrix.tolist()}))
    np.savez(tmp_path / "m.npz", matrix=matrix)
    np.savez(tmp_path / "f.npz", focal=[800, 700], center=[320, 240], translation=[0, 0, 2.0])
    (tmp_path / "f.json").write_text('{"focal": [800, 700], "center": [320, 240]}')
    for name, depth in (("m.json", 2), ("m.npz", 2), ("f.npz", 2), ("f.json", 0)):
        camera = read_camera(tmp_path / name)
        np.testing.assert_allclose(camera.focal, [800, 700], rtol=1e-5)
        np.testing.assert_allclose(camera.center, [320, 240], rtol=1e-5)
        np.testing.assert_allclose(camera.translation, [0, 0, depth], atol=1e-5)
    for text in ("[[1, 2], [3]]", '{"matrix": "x"}', "{", '{"focal": 3, "center": null}', "3"):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(ValueError, match=r"bad\.json"):
            read_camera(tmp_path / "bad.json")
    (tmp_path / "bad.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"camera file must be an \.npz archive: got .*bad\.npz"):
        read_camera(tmp_path / "bad.npz")


def test_a_camera_with_distortion_is_refused(tmp_path):
    (tmp_path / "c.json").write_text('{"focal": 800, "center": [3, 4], "dist_coeffs": [0, 0.1]}')
    with pytest.raises(ValueError, match=r"c\.json must have no distortion: got 'dist_coeffs'"):
        read_camera(tmp_path / "c.json")
    (tmp_path / "c.json").write_text('{"focal": 800, "center": [3, 4], "k1": 0, "dist": [[0, 0]]}')
    np.testing.assert_allclose(read_camera(tmp_path / "c.json").focal, 800)


def test_a_focal_length_in_millimetres_ends_with_1(calls, tmp_path, rng, monkeypatch, capsys):
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    monkeypatch.setattr("spt_jax.io.mesh_files.write_mesh", lambda *_, **__: None)
    file = coco_file(tmp_path / "a.json", [(1, person(rng))], {1: (640, 480)})
    out = tmp_path / "out"
    assert main(["fit", file, "--out", str(out), "--focal", "35"]) == 1
    captured = capsys.readouterr()
    said = "000000000001/0: focal length outside any photograph: what is seen is more than 70"
    assert said in captured.err and "focal length" in captured.out
    (one,) = json.loads((out / "report.json").read_text())["people"]
    assert one["status"] == "outside_focal_length" and one["reason"].startswith(
        "focal length outside any photograph"
    )


def test_what_a_file_has_and_is_not_used_is_said(calls, tmp_path, rng, monkeypatch, capsys):
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    points = rng.uniform(50, 400, (133, 2)).round(1)
    one = {"keypoints": points.tolist(), "keypoint_scores": [0.5] * 16 + [0.04] + [0.9] * 116}
    (tmp_path / "a.json").write_text(json.dumps([one]))
    assert main(["fit", str(tmp_path / "a.json"), "--out", str(tmp_path / "out")]) == 0
    said = "points of the face, which are not used: 68"
    assert said in " ".join(capsys.readouterr().err.split())
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert any(said in note for note in report["notes"])
    # All scores reach the fit: the stand-in sums them.
    assert report["people"][0]["terms"]["total"] == pytest.approx(16 * 0.5 + 0.04 + 48 * 0.9)


def test_what_the_body_has_not_is_said_and_names_are_mapped(
    calls, tmp_path, rng, monkeypatch, capsys
):
    """A body of 24 joints has no fingers."""
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    names = ["paw", "left_elbow", "left_index1", "right_ring_tip", "left_knee"]
    points = rng.uniform(50, 400, (5, 2)).round(1).tolist()
    content = {"names": names, "people": [points], "width": 640, "height": 480}
    (tmp_path / "a.json").write_text(json.dumps(content))
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.uint32)
    np.savez(tmp_path / "body.npz", **synthetic_smpl(rng, joints=24) | {"f": faces})
    words = ["fit", str(tmp_path / "a.json"), "--body", str(tmp_path / "body.npz")]
    words += ["--out", str(tmp_path / "out"), "--map", "right_wrist=paw"]
    assert main(words) == 0
    err = " ".join(capsys.readouterr().err.split())
    assert "points of fingers, which the body has not: 2" in err
    (call,) = calls
    assert call["layout"] == "right_wrist,left_elbow,left_index1,right_ring_tip,left_knee"
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["people"][0]["points_seen"] == 3
    assert report["settings"]["map"] == "right_wrist=paw"
    assert main([*words[:-1], "right_wrist"]) == 2
    assert "map must be such as left_wrist=lpaw" in capsys.readouterr().err
    assert main([*words[:-1], "left_index1=paw,left_index1=left_knee"]) == 2
    assert "map must say each name once" in capsys.readouterr().err
    content |= {"names": names[2:4], "people": [points[:2]]}
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert main([*words[:-2]]) == 2
    assert "got points of fingers alone, on a body without" in capsys.readouterr().err


@pytest.mark.parametrize("width", [72, 80, 120])
@pytest.mark.parametrize("status", ["not_finite", "unseen", *OUTSIDE])
def test_the_status_is_never_cut_away(status, width):
    reason = RESULTS[getattr(RESULTS, status)]
    given = {"name": "a_long_name_of_a_photograph_0123456789/12", "errors": np.full(17, 123.4)}
    given |= {
        "distance": 123.45,
        "overlap": no_overlap([]),
        "outside": status in OUTSIDE,
        "reason": reason,
    }
    people = [SimpleNamespace(**given), SimpleNamespace(**given | {"overlap": None})]
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(fitted.people_table(people))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    columns = [line.split("│")[2] for line in lines if line.startswith("│")]
    assert " ".join(" ".join(columns).split()) == " ".join([reason.split(":")[0]] * 2)
    names = [line.split("│")[1].strip() for line in lines if line.startswith("│")]
    assert "".join(names) == given["name"] * 2


def test_select_people():
    names, images = ["a/0", "b/1", "a/2", "c/3"], ["a", "b", "a", "c"]
    assert select_people(names, images, "all") == [0, 1, 2, 3]
    assert select_people(names, images, "c, a,a/2,1") == [3, 0, 2, 1]
    assert select_people(names, images, "1-2") == [1, 2]
    with pytest.raises(ValueError, match=r"people must be rows 0 to 3, .* got 'd'"):
        select_people(names, images, "a,d")


def test_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["fit", "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0 and "usage: spt-jax fit" in text
    assert all(word in text for word in ("--layout", "--camera", "--robust", "--quiet"))


def test_a_folder_of_frames_becomes_a_motion_a_track(calls, tmp_path, rng, monkeypatch, capsys):
    """Two people pass by; each frame's prior lies near the pose of the frame before."""
    without_pictures(monkeypatch)
    monkeypatch.setattr("spt_jax._report.intersection_report", no_overlap)
    frames = tmp_path / "frames"
    frames.mkdir()
    shapes = rng.uniform(0, 100, (2, 18, 2))
    for number in range(3):
        people = [shapes[0] + 50 + 9 * number, shapes[1] + 400 - 9 * number][:: (-1) ** number]
        flat = [np.concatenate([one, np.full((18, 1), 0.9)], 1).ravel().tolist() for one in people]
        content = {"people": [{"pose_keypoints_2d": one} for one in flat]}
        (frames / f"walk_{number}_keypoints.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    words = ["fit", str(frames), "--out", str(out), "--frames-per-second", "25", "--fit-shape"]
    assert main(words) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["motions"] == ["track_0.npz", "track_1.npz"]
    for name in report["motions"]:
        motion = read_poses(out / name)
        assert motion.pose.shape == (3, 52, 3) and motion.frame_rate == 25
        assert list(motion.names) == ["walk_0", "walk_1", "walk_2"]
    # The stand-in finds the same pose each time: the next frame's prior is drawn to it.
    usual = pose_prior(load_body().joint_names).mean
    first, later = calls[:2], calls[2:]
    for call in first:
        np.testing.assert_array_equal(call["terms"].prior.mean, usual)
        assert call["start"].fit_shape
    for call in later:
        drawn = np.abs(call["terms"].prior.mean[1:22])
        assert drawn.max() < np.abs(usual[1:22]).max() and not call["start"].fit_shape
        np.testing.assert_array_equal(call["start"].shape, np.full(10, 0.5))


def test_a_map_is_not_dropped_where_a_folder_is_a_data_set(tmp_path, capsys):
    (tmp_path / "a.json").write_text("[]")
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "out"), "--map", "nose=snout"]) == 2
    assert "map is for a single file: got it with a folder" in capsys.readouterr().err
