import numpy as np
import pytest

from spt_jax.io.pose_files import JOINT_COUNTS, read_poses, write_poses


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("joints", JOINT_COUNTS)
@pytest.mark.parametrize("key", ["poses", "pose"])
@pytest.mark.parametrize("flat", [False, True])
def test_amass_layouts(tmp_path, rng, joints, key, flat):
    pose = rng.normal(size=(4, joints, 3))
    stored = pose.reshape(4, -1) if flat else pose
    trans, betas = rng.normal(size=(4, 3)), rng.normal(size=16)
    file = save(tmp_path / "walk.npz", **{key: stored, "trans": trans, "betas": betas})
    read = read_poses(file)
    np.testing.assert_array_equal(read.pose, pose)
    np.testing.assert_array_equal(read.shape, betas)
    np.testing.assert_array_equal(read.translation, trans)
    assert read.names == ["walk/0000", "walk/0001", "walk/0002", "walk/0003"]


@pytest.mark.parametrize("stored_shape", [(66,), (22, 3), (1, 66), (1, 22, 3)])
def test_a_single_frame_may_lack_its_axis(tmp_path, rng, stored_shape):
    pose = rng.normal(size=(1, 22, 3)).astype(np.float32)
    read = read_poses(save(tmp_path / "one.npz", pose=pose.reshape(stored_shape)))
    assert read.pose.dtype == np.float64 and read.shape is None and read.translation is None
    np.testing.assert_array_equal(read.pose, pose)
    assert read.names == ["one"]


def test_the_projects_own_mocap_layout(tmp_path, rng):
    pose = rng.normal(size=(3, 22, 3)).astype(np.float32)
    names = np.array(["run/0001", "run/0002", "jump/0001"])
    file = save(tmp_path / "m.npz", pose=pose, name=names, joints=np.array(["pelvis"] * 22))
    assert read_poses(file).names == list(names)


def test_smpl_body_pose_has_24_joints(tmp_path, rng):
    body, root = rng.normal(size=(1, 69)), rng.normal(size=(1, 3))
    file = save(
        tmp_path / "smpl.npz",
        body_pose=body,
        global_orient=root,
        betas=np.ones((1, 10)),
        transl=np.arange(3.0),
    )
    read = read_poses(file)
    np.testing.assert_array_equal(read.pose, np.concatenate([root, body], axis=1).reshape(1, 24, 3))
    assert read.shape is not None and read.shape.shape == (1, 10)
    np.testing.assert_array_equal(read.translation, [[0, 1, 2]])


def test_parts_take_their_smplx_places(tmp_path, rng):
    sizes = {
        "global_orient": 1,
        "body_pose": 21,
        "jaw_pose": 1,
        "leye_pose": 1,
        "reye_pose": 1,
        "left_hand_pose": 15,
        "right_hand_pose": 15,
    }
    parts = {key: rng.normal(size=(2, rows, 3)) for key, rows in sizes.items()}
    full = save(tmp_path / "x.npz", **{k: v.reshape(2, -1) for k, v in parts.items()})
    np.testing.assert_array_equal(
        read_poses(full).pose, np.concatenate(list(parts.values()), axis=1)
    )
    some = {k: parts[k] for k in ("global_orient", "body_pose", "right_hand_pose")}
    pose = read_poses(save(tmp_path / "h.npz", **some)).pose
    assert pose.shape == (2, 52, 3)
    assert not pose[:, 22:37].any()
    np.testing.assert_array_equal(pose[:, 37:], parts["right_hand_pose"])
    pose = read_poses(save(tmp_path / "j.npz", **some, jaw_pose=parts["jaw_pose"])).pose
    assert pose.shape == (2, 55, 3)
    np.testing.assert_array_equal(pose[:, 22], parts["jaw_pose"][:, 0])
    np.testing.assert_array_equal(pose[:, 40:], parts["right_hand_pose"])


def test_a_pickled_key_that_is_not_needed_is_left_alone(tmp_path):
    file = save(tmp_path / "a.npz", poses=np.zeros((2, 156)), gender=np.array("male", dtype=object))
    assert read_poses(file).pose.shape == (2, 52, 3)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": np.zeros((5, 70))}, r"poses must hold frames of 22 or 24.*\(5, 70\).*bad\.npz"),
        ({"poses": np.zeros((5, 48))}, r"must hold poses of a body: got 16 .* MANO, in .*bad\.npz"),
        ({"poses": np.zeros((0, 66))}, "at least one frame"),
        ({"pose": np.zeros((23, 3))}, r"got shape \(23, 3\)"),
        ({"poses": np.zeros((5, 24, 3, 3))}, r"poses must hold rotation matrices"),
        ({"poses": np.full((1, 66), np.nan)}, r"poses must be finite: got nan at \(0, 0\)"),
        ({"poses": np.array([["a"] * 66])}, "poses must hold numbers"),
        ({"poses": np.ones((1, 66)) * 1j}, "poses must hold numbers: got complex128"),
        ({"poses": np.full((1, 66), 1e30)}, r"poses must be within 10000 of zero: got 1e\+30 at"),
        ({"poses": np.zeros((1, 66)), "trans": np.full((1, 3), -1e30)}, "trans must be within 1e"),
        ({"poses": np.zeros((1, 66)), "betas": np.full(10, 1e9)}, "betas must be within 10000"),
        (
            {"poses": np.array([{}], dtype=object)},
            r"poses must hold numbers: got other things.*bad\.npz",
        ),
        ({"body_pose": np.zeros((1, 63))}, "keys 'body_pose'; write global_orient, body_pose"),
        ({"vertices": np.zeros((1, 63))}, "structure that is known: .*'vertices'; write"),
        ({"poses": np.zeros((4, 66)), "betas": np.zeros((3, 10))}, r"betas .*\(4, B\).*\(3, 10\)"),
        ({"poses": np.zeros((4, 66)), "trans": np.zeros((3, 3))}, r"trans .*\(4, 3\).*\(3, 3\)"),
        ({"poses": np.zeros((4, 66)), "name": np.array(["a"])}, "name must hold 4 strings"),
        (
            {
                "global_orient": np.zeros((1, 3)),
                "body_pose": np.zeros((1, 69)),
                "jaw_pose": np.ones((1, 3)),
            },
            "21 rows beside separate hands",
        ),
        (
            {
                "global_orient": np.zeros((1, 3)),
                "body_pose": np.zeros((1, 63)),
                "left_hand_pose": np.zeros((1, 46)),
            },
            r"left_hand_pose must hold frames of 15 .*\(1, 46\)",
        ),
        (
            {"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((2, 63))},
            r"one number of frames: got \[3, 2\]",
        ),
    ],
)
def test_what_is_refused_says_why(tmp_path, arrays, message):
    with pytest.raises(ValueError, match=message):
        read_poses(save(tmp_path / "bad.npz", **arrays))


def test_files_of_other_kinds(tmp_path):
    with pytest.raises(FileNotFoundError, match="pose file must exist"):
        read_poses(tmp_path / "missing.npz")
    other = tmp_path / "text.npz"
    other.write_text("not an archive")
    with pytest.raises(ValueError, match=r"must be an \.npz, .*text\.npz"):
        read_poses(other)
    cut = save(tmp_path / "cut.npz", poses=np.ones((9, 66)))
    data = bytearray(cut.read_bytes())
    data[200:400] = bytes(200)
    cut.write_bytes(data)
    with pytest.raises(ValueError, match=r"poses in .*cut\.npz cannot be read"):
        read_poses(cut)


@pytest.mark.parametrize("joints", JOINT_COUNTS)
def test_round_trip(tmp_path, rng, joints):
    pose, trans = rng.normal(size=(3, joints, 3)), rng.normal(size=(3, 3))
    betas = rng.normal(size=(3, 10))
    file = tmp_path / "p.npz"
    write_poses(file, pose, shape=betas, translation=trans, names=["a", "b", "c"])
    read = read_poses(file)
    np.testing.assert_array_equal(read.pose, pose)
    np.testing.assert_array_equal(read.shape, betas)
    np.testing.assert_array_equal(read.translation, trans)
    assert read.names == ["a", "b", "c"]
    with np.load(file) as archive:
        assert archive["poses"].shape == (3, 3 * joints)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


def test_write_refuses_before_it_writes(tmp_path, rng):
    pose = rng.normal(size=(3, 22, 3))
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        write_poses(tmp_path / "p.txt", pose)
    with pytest.raises(ValueError, match="name must hold 3 strings"):
        write_poses(tmp_path / "p.npz", pose, names=["a"])
    with pytest.raises(ValueError, match="poses must be finite"):
        write_poses(tmp_path / "p.npz", np.full((1, 22, 3), np.inf))
    assert not list(tmp_path.iterdir())


def test_an_archive_that_unpacks_to_more_than_the_limit_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", poses=np.zeros((30_000, 66), np.float16))
    with pytest.raises(ValueError, match=r"poses in .*a\.npz' must not take more than 10,000,000"):
        read_poses(tmp_path / "a.npz", max_bytes=10_000_000)
    assert len(read_poses(tmp_path / "a.npz").pose) == 30_000
