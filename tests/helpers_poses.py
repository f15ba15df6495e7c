"""Pose files of every structure, written from the bundled motion capture as its authors write them.

Nothing here uses the readers. Each writer returns the content of a file and what must be read.
"""

import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spt_jax.body import load_mocap


@dataclass
class Made:
    """A file's content, and by track's name what must be read of it."""

    content: bytes
    suffix: str
    poses: dict[str, np.ndarray]
    translation: dict[str, Any] = field(default_factory=dict)
    shape: dict[str, Any] = field(default_factory=dict)
    gender: str | None = None
    frame_rate: float | None = None


def motion(frames: int, joints: int, start: int = 0) -> np.ndarray:
    """Frames of the bundled mocap in one of SMPL's layouts; what it lacks turns a little."""
    mocap = load_mocap().pose[start : start + frames].astype(np.float64)
    rng = np.random.default_rng(joints + start)
    pose = 0.2 * rng.normal(size=(frames, joints, 3))
    pose[:, :22] = mocap
    return pose


def as_matrix(pose):
    return Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(*pose.shape[:-1], 3, 3)


def as_quaternion(pose):
    """In the order wxyz."""
    xyzw = Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat()
    return xyzw[:, [3, 0, 1, 2]].reshape(*pose.shape[:-1], 4)


def as_two_rows(pose):
    return as_matrix(pose)[..., :2, :].reshape(*pose.shape[:-1], 6)


def as_two_columns(pose):
    return as_matrix(pose)[..., :2].reshape(*pose.shape[:-1], 6)


def flat(pose):
    return pose.reshape(len(pose), -1)


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


_Pickler: Any = pickle._Pickler  # pyright: ignore[reportAttributeAccessIssue]


class _Joblib(_Pickler):
    """joblib.dump without compression: arrays' bytes stand behind a wrapper that describes them."""

    def save(self, obj, save_persistent_id=True):
        if type(obj) is not np.ndarray or obj.dtype.hasobject:
            return super().save(obj, save_persistent_id)
        order = "F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"
        state = {"subclass": np.ndarray, "shape": obj.shape, "order": order, "dtype": obj.dtype}
        state |= {"allow_mmap": True, "numpy_array_alignment_bytes": 16}
        self.write(pickle.GLOBAL + b"joblib.numpy_pickle\nNumpyArrayWrapper\n")
        self.write(pickle.EMPTY_TUPLE + pickle.NEWOBJ)
        super().save(state)
        self.write(pickle.BUILD)
        padding = 16 - (self.file.tell() + 1) % 16
        self.file.write(bytes([padding]) + b"\xff" * padding + obj.tobytes(order))


def joblib(value, compress: Callable[[bytes], bytes] = bytes):
    file = io.BytesIO()
    pickler = _Joblib(file, protocol=3)
    pickler.file = file
    pickler.dump(value)
    return compress(file.getvalue())


_STORAGES = {"f4": "FloatStorage", "f8": "DoubleStorage", "i8": "LongStorage"}


class _Torch(_Pickler):
    """torch.save's pickle: arrays become tensors, whose numbers stand beside it."""

    def __init__(self, file, arrays):
        super().__init__(file, protocol=2)
        self.arrays = arrays

    def save(self, obj, save_persistent_id=True):
        if type(obj) is not np.ndarray:
            return super().save(obj, save_persistent_id)
        self.write(pickle.GLOBAL + b"torch._utils\n_rebuild_tensor_v2\n" + pickle.MARK)
        self.write(pickle.MARK)
        super().save("storage")
        kind = _STORAGES[obj.dtype.str[1:]]
        self.write(pickle.GLOBAL + f"torch\n{kind}\n".encode())
        for value in (str(len(self.arrays)), "cpu", obj.size):
            super().save(value)
        self.write(pickle.TUPLE + pickle.BINPERSID)
        self.arrays.append(np.ascontiguousarray(obj))
        steps = tuple(s // obj.itemsize for s in self.arrays[-1].strides)
        for value in (0, obj.shape, steps, False):
            super().save(value)
        self.write(pickle.GLOBAL + b"collections\nOrderedDict\n" + pickle.EMPTY_TUPLE)
        self.write(pickle.REDUCE + pickle.TUPLE + pickle.REDUCE)


def torch_archive(value):
    pickled, arrays = io.BytesIO(), []
    _Torch(pickled, arrays).dump(value)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("hmr4d_results/data.pkl", pickled.getvalue())
        archive.writestr("hmr4d_results/byteorder", "little")
        for k, array in enumerate(arrays):
            archive.writestr(f"hmr4d_results/data/{k}", array.tobytes())
        archive.writestr("hmr4d_results/version", "3\n")
    return file.getvalue()


def _beside(frames, start=0):
    rng = np.random.default_rng(90 + start)
    return rng.normal(size=(frames, 3)), rng.normal(size=10)


def amass():
    pose, (trans, _) = motion(4, 52), _beside(4)
    betas = np.linspace(-1, 1, 16)
    content = npz(
        poses=flat(pose), trans=trans, betas=betas, dmpls=np.zeros((4, 8)), gender="female",
        mocap_framerate=120.0,
    )  # fmt: skip
    return Made(content, ".npz", {"": pose}, {"": trans}, {"": betas}, "female", 120.0)


def amass_smplx():
    pose, (trans, betas) = motion(4, 55), _beside(4)
    content = npz(
        poses=flat(pose), root_orient=pose[:, 0], pose_body=flat(pose[:, 1:22]),
        pose_jaw=pose[:, 22], pose_eye=flat(pose[:, 23:25]), pose_hand=flat(pose[:, 25:]),
        trans=trans, betas=betas, num_betas=np.array(10), gender=np.array("neutral"),
        mocap_frame_rate=30.0, surface_model_type="smplx", mocap_time_length=0.1,
    )  # fmt: skip
    return Made(content, ".npz", {"": pose}, {"": trans}, {"": betas}, "neutral", 30.0)


def moyo():
    pose, (trans, betas) = motion(3, 55), _beside(3)
    value = {"fullpose": flat(pose), "trans": trans, "betas": betas, "gender": "neutral"}
    content = pickle.dumps(value | {"mocap_frame_rate": 60.0}, protocol=2)
    return Made(content, ".pkl", {"": pose}, {"": trans}, {"": betas}, "neutral", 60.0)


def smplifyx():
    pose, (_, betas) = motion(1, 55), _beside(1)
    pose[:, 25:] = 0
    value = {
        "camera_rotation": np.eye(3)[None], "camera_translation": np.ones((1, 3)),
        "betas": betas[None], "global_orient": pose[:, 0], "body_pose": flat(pose[:, 1:22]),
        "left_hand_pose": np.ones((1, 12)), "right_hand_pose": np.ones((1, 12)),
        "jaw_pose": pose[:, 22], "leye_pose": pose[:, 23], "reye_pose": pose[:, 24],
        "expression": np.full((1, 10), 0.2),
    }  # fmt: skip
    return Made(pickle.dumps(value, protocol=2), ".pkl", {"": pose}, {}, {"": betas[None]})


def prox():
    made, (trans, _) = smplifyx(), _beside(1)
    value = pickle.loads(made.content) | {"transl": trans, "pose_embedding": np.zeros((1, 32))}
    return Made(pickle.dumps(value), ".pkl", made.poses, {"": trans}, made.shape)


def vposer():
    pose, (trans, betas) = motion(3, 52), _beside(3)
    content = npz(
        root_orient=pose[:, 0], pose_body=flat(pose[:, 1:22]), pose_hand=flat(pose[:, 22:]),
        trans=trans, betas=betas,
    )  # fmt: skip
    return Made(content, ".npz", {"": pose}, {"": trans}, {"": betas})


def hmr2():
    pose, betas = motion(3, 24), np.ones((3, 10))
    content = npz(
        global_orient=as_matrix(pose[:, :1]), body_pose=as_matrix(pose[:, 1:]), betas=betas
    )
    return Made(content, ".npz", {"": pose}, {}, {"": betas})


def six_rows():
    pose = motion(3, 24)
    return Made(npz(pose=as_two_rows(pose)), ".npz", {"": pose})


def six_columns():
    pose = motion(3, 24)
    return Made(npz(pose=flat(as_two_columns(pose))), ".npz", {"": pose})


def quaternions():
    pose = motion(3, 22)
    return Made(npz(poses=flat(as_quaternion(pose))), ".npz", {"": pose})


def quaternions_xyzw():
    pose = motion(3, 22)
    return Made(npz(poses=as_quaternion(pose)[..., [1, 2, 3, 0]]), ".npz", {"": pose})


def parts_json():
    pose, (trans, betas) = motion(2, 22), _beside(2)
    value = {"global_orient": pose[:, 0], "body_pose": pose[:, 1:], "transl": trans, "betas": betas}
    content = json.dumps({key: array.tolist() for key, array in value.items()}).encode()
    return Made(content, ".json", {"": pose}, {"": trans}, {"": betas})


def phalp():
    import zlib

    poses = {"1": motion(3, 24), "4": motion(2, 24, 50)}
    cameras = {name: _beside(len(pose), int(name))[0] for name, pose in poses.items()}
    value = {}
    for frame in range(3):
        there = [("1", frame), *([("4", frame - 1)] if frame else [])]
        value[f"img/{frame:06d}.jpg"] = {
            "time": frame, "shot": 0, "frame_path": f"img/{frame:06d}.jpg",
            "tid": [int(name) for name, _ in there], "tracked_time": [0 for _ in there],
            "camera": [cameras[name][k] for name, k in there],
            "bbox": [np.zeros(4) for _ in there], "mask": [None for _ in there],
            "smpl": [
                {
                    "global_orient": as_matrix(poses[name][k, :1]),
                    "body_pose": as_matrix(poses[name][k, 1:]),
                    "betas": np.full(10, 0.5, np.float32),
                }
                for name, k in there
            ],
        }  # fmt: skip
    shapes = {name: np.full((len(pose), 10), 0.5) for name, pose in poses.items()}
    content = joblib(value, lambda content: zlib.compress(content, 3))
    return Made(content, ".pkl", poses, cameras, shapes)


def vibe():
    poses = {"1": motion(3, 24), "2": motion(4, 24, 80)}
    value = {
        int(name): {
            "pred_cam": np.ones((len(pose), 3)), "verts": np.zeros((len(pose), 5, 3)),
            "pose": flat(pose), "betas": np.ones((len(pose), 10)),
            "joints3d": np.zeros((len(pose), 49, 3)), "frame_ids": np.arange(7, 7 + len(pose)),
        }
        for name, pose in poses.items()
    }  # fmt: skip
    return Made(
        joblib(value), ".pkl", poses, {}, {n: np.ones((len(p), 10)) for n, p in poses.items()}
    )


def wham():
    pose, (trans, _) = motion(3, 24), _beside(3)
    in_camera = pose.copy()
    in_camera[:, 0] = (
        Rotation.from_rotvec([0.1, 2.0, 0.3]) * Rotation.from_rotvec(pose[:, 0])
    ).as_rotvec()
    one = {
        "pose": flat(in_camera), "trans": trans + 5, "pose_world": flat(pose),
        "trans_world": trans, "betas": np.ones((3, 10)), "verts": np.zeros((3, 5, 3)),
        "frame_ids": np.arange(3),
    }  # fmt: skip
    return Made(joblib({0: one}), ".pkl", {"0": pose}, {"0": trans}, {"0": np.ones((3, 10))})


def gvhmr():
    pose, (trans, betas) = motion(3, 22), _beside(3)
    one = {"body_pose": flat(pose[:, 1:]), "betas": np.tile(betas, (3, 1))}
    world = one | {"global_orient": pose[:, 0], "transl": trans}
    camera = one | {"global_orient": pose[:, 1], "transl": trans + 3}
    value = {
        "smpl_params_global": world, "smpl_params_incam": camera, "K_fullimg": np.eye(3),
        "net_outputs": {"static_conf_logits": np.zeros((1, 3, 6))},
    }  # fmt: skip
    shape = {"": np.tile(betas, (3, 1))}
    return Made(torch_archive(value), ".pt", {"": pose}, {"": trans}, shape)


def tram():
    pose, (trans, _) = motion(3, 24), _beside(3)
    value = {
        "pred_cam": np.ones((3, 3)), "pred_pose": flat(as_two_columns(pose)),
        "pred_shape": np.ones((3, 10)), "pred_rotmat": as_matrix(pose),
        "pred_trans": trans[:, None], "img_focal": 600.0, "img_center": np.array([3.0, 4.0]),
    }  # fmt: skip
    file = io.BytesIO()
    np.save(file, np.array(value, dtype=object), allow_pickle=True)
    return Made(file.getvalue(), ".npy", {"": pose}, {"": trans}, {"": np.ones((3, 10))})


def romp():
    pose, (trans, _) = motion(2, 24), _beside(2)
    results = {
        "cam": np.ones((2, 3)), "smpl_thetas": flat(pose), "smpl_betas": np.ones((2, 10)),
        "cam_trans": trans, "joints": np.zeros((2, 71, 3)), "center_confs": np.ones(2),
    }  # fmt: skip
    content = npz(results=np.array(results, dtype=object))
    names = ("0", "1")
    return Made(
        content, ".npz", {n: pose[k : k + 1] for k, n in enumerate(names)},
        {n: trans[k : k + 1] for k, n in enumerate(names)}, {n: np.ones((1, 10)) for n in names},
    )  # fmt: skip


def bev_video():
    poses = {"3": motion(3, 24), "8": motion(3, 24, 60)}
    shifts = {name: _beside(3, int(name))[0] for name in poses}
    results, sequences = {}, {}
    for frame in range(3):
        names = list(poses)[:: 1 if frame % 2 else -1]
        results[f"{frame:08d}.jpg"] = {
            "smpl_thetas": np.stack([flat(poses[name])[frame] for name in names]),
            "smpl_betas": np.ones((2, 11)), "track_ids": np.array([int(n) for n in names]),
            "cam_trans": np.stack([shifts[name][frame] for name in names]),
        }  # fmt: skip
    for name in poses:
        sequences[np.int64(name)] = {
            "frame_id": [0, 1, 2], "smpl_thetas": list(flat(poses[name])),
            "cam_trans": list(shifts[name]),
        }  # fmt: skip
    content = npz(
        results=np.array(results, dtype=object), sequence_results=np.array(sequences, dtype=object)
    )
    return Made(content, ".npz", poses, shifts, {name: np.ones((3, 10)) for name in poses})


def slahmr():
    poses = {"0": motion(3, 22), "1": motion(3, 22, 40)}
    shifts = {name: _beside(3, int(name))[0] for name in poses}
    content = npz(
        trans=np.stack(list(shifts.values())),
        root_orient=np.stack([pose[:, 0] for pose in poses.values()]),
        pose_body=np.stack([flat(pose[:, 1:]) for pose in poses.values()]),
        betas=np.ones((2, 16)), latent_pose=np.zeros((2, 3, 32)), intrins=np.ones(4),
        cam_R=np.tile(np.eye(3), (2, 3, 1, 1)), cam_t=np.zeros((2, 3, 3)),
    )  # fmt: skip
    return Made(content, ".npz", poses, shifts, {name: np.ones(16) for name in poses})


def bedlam():
    poses = {"rp_aaron": motion(2, 55), "rp_alison": motion(2, 55, 20)}
    rows = [(name, k) for k in range(2) for name in poses]
    world = np.stack([poses[name][k] for name, k in rows])
    camera = world.copy()
    camera[:, 0] = world[:, 1]
    content = npz(
        imgname=np.array([f"seq_000000/seq_000000_{5 * k:04d}.png" for _, k in rows]),
        pose_cam=flat(camera), pose_world=flat(world), shape=np.ones((4, 11)),
        trans_cam=np.zeros((4, 3)), trans_world=world[:, 2], cam_int=np.zeros((4, 3, 3)),
        cam_ext=np.zeros((4, 4, 4)), gender=np.array(["neutral"] * 4),
        sub=np.array([name for name, _ in rows]), gtkps=np.zeros((4, 127, 2)),
    )  # fmt: skip
    shifts = {name: poses[name][:, 2] for name in poses}
    return Made(content, ".npz", poses, shifts, {n: np.ones((2, 11)) for n in poses}, "neutral")


def aistpp():
    pose, (trans, _) = motion(3, 24), _beside(3)
    value = {
        "smpl_poses": flat(pose), "smpl_trans": 93.0 * trans, "smpl_scaling": np.array([93.0]),
        "smpl_loss": 0.1,
    }  # fmt: skip
    return Made(pickle.dumps(value, protocol=5), ".pkl", {"": pose}, {"": trans})


def threedpw():
    poses = {"0": motion(3, 24), "1": motion(3, 24, 70)}
    shifts = {name: _beside(3, int(name))[0] for name in poses}
    value = {
        "sequence": "downtown_arguing_00", "poses": [flat(pose) for pose in poses.values()],
        "trans": list(shifts.values()), "betas": [np.ones(10), np.ones(300)],
        "genders": ["m", "m"], "poses_60Hz": [np.zeros((6, 72))] * 2,
        "cam_poses": np.tile(np.eye(4), (3, 1, 1)), "img_frame_ids": np.arange(3),
    }  # fmt: skip
    shape = {"0": np.ones(10), "1": np.ones(300)}
    return Made(pickle.dumps(value, protocol=2), ".pkl", poses, shifts, shape, "male")


def easymocap():
    poses = {"0": motion(1, 24), "5": motion(1, 55, 30)}
    poses["5"][:, 25:] = 0
    trans, betas = _beside(1)
    people = []
    for name, pose in poses.items():
        written = flat(pose[:, :24] if name == "0" else pose[:, :22]).copy()
        written[:, :3] = 0
        if name == "5":
            written = np.concatenate([written, np.full((1, 12), 0.3), flat(pose[:, 22:25])], axis=1)
        one = {"Rh": pose[:, 0], "Th": trans, "poses": written, "shapes": betas[None]}
        people.append({"id": int(name), **{key: array.tolist() for key, array in one.items()}})
    content = json.dumps(people).encode()
    return Made(
        content, ".json", poses, dict.fromkeys(poses, trans), dict.fromkeys(poses, betas[None])
    )  # fmt: skip


def mmhuman3d():
    pose, (trans, betas) = motion(3, 55), _beside(3)
    smplx = {
        "global_orient": pose[:, 0], "body_pose": pose[:, 1:22], "jaw_pose": pose[:, 22],
        "leye_pose": pose[:, 23], "reye_pose": pose[:, 24], "left_hand_pose": pose[:, 25:40],
        "right_hand_pose": pose[:, 40:], "transl": trans, "betas": np.tile(betas, (3, 1)),
        "expression": np.zeros((3, 10)),
    }  # fmt: skip
    content = npz(
        __key_strict__=np.array(False), __temporal_len__=np.array(3),
        smplx=np.array(smplx, dtype=object), meta=np.array({"gender": "male"}, dtype=object),
        image_path=np.array(["a", "b", "c"]),
    )  # fmt: skip
    return Made(content, ".npz", {"": pose}, {"": trans}, {"": np.tile(betas, (3, 1))}, "male")


def motion_x():
    pose, (trans, betas) = motion(3, 55), _beside(3)
    pose[:, 23:25] = 0
    frames = np.concatenate(
        [flat(pose[:, :22]), flat(pose[:, 25:]), pose[:, 22], np.zeros((3, 150)), trans,
         np.tile(betas, (3, 1))], axis=1,
    )  # fmt: skip
    file = io.BytesIO()
    np.save(file, frames)
    return Made(file.getvalue(), ".npy", {"": pose}, {"": trans}, {"": np.tile(betas, (3, 1))})


_BONES = (
    (-1, 0, 0, 0), (0, 9, -8, 0), (0, -9, -8, 0), (0, 0, 12, 0), (1, 0, -40, 0), (2, 0, -40, 0),
    (3, 0, 13, 0), (4, 0, -42, 0), (5, 0, -42, 0), (6, 0, 5, 0), (7, 0, -5, 12), (8, 0, -5, 12),
    (9, 0, 21, 0), (9, 8, 11, 0), (9, -8, 11, 0), (12, 0, 9, 0), (13, 10, 3, 0), (14, -10, 3, 0),
    (16, 26, 0, 0), (17, -26, 0, 0), (18, 25, 0, 0), (19, -25, 0, 0),
)  # fmt: skip
_SMPL_NAMES = (
    *("Pelvis", "L_Hip", "R_Hip", "Spine1", "L_Knee", "R_Knee", "Spine2", "L_Ankle", "R_Ankle"),
    *("Spine3", "L_Foot", "R_Foot", "Neck", "L_Collar", "R_Collar", "Head", "L_Shoulder"),
    *("R_Shoulder", "L_Elbow", "R_Elbow", "L_Wrist", "R_Wrist"),
)
_MIXAMO_NAMES = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot"),
    *("RightFoot", "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder"),
    *("RightShoulder", "Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand"),
    "RightHand",
)


def bvh(order="ZXY", names=_SMPL_NAMES, prefix="", bones=_BONES, turned=None, pose=None):
    """A skeleton in centimetres; `turned` has what turns SMPL's rest pose into the file's."""
    pose, (trans, _) = motion(3, 22) if pose is None else pose, _beside(3)
    parents = [bone[0] for bone in bones]
    lines, angles = ["HIERARCHY"], []
    turned = turned or {}
    unturned = np.eye(3)

    def write(k, depth):
        space = "\t" * depth
        kind = "ROOT" if k == 0 else "JOINT"
        lines.append(f"{space}{kind} {prefix}{names[k]}")
        lines.append(space + "{")
        x, y, z = bones[k][1:]
        lines.append(f"{space}\tOFFSET {x} {y} {z}")
        turns = " ".join(f"{axis}rotation" for axis in order)
        moves = "Xposition Yposition Zposition " if k == 0 else ""
        lines.append(f"{space}\tCHANNELS {6 if k == 0 else 3} {moves}{turns}")
        above = turned.get(parents[k], unturned)
        matrix = above @ as_matrix(pose[:, k]) @ turned.get(k, unturned).T
        if k == 0:
            angles.append(100.0 * trans)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Gimbal lock")
            angles.append(Rotation.from_matrix(matrix).as_euler(order, degrees=True))
        children = [child for child, parent in enumerate(parents) if parent == k]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.extend([f"{space}\tEnd Site", space + "\t{", f"{space}\t\tOFFSET 0 1 0"])
            lines.append(space + "\t}")
        lines.append(space + "}")

    write(0, 0)
    rows = np.concatenate(angles, axis=1)
    lines += ["MOTION", "Frames: 3", "Frame Time: 0.0083333333333333"]
    lines += [" ".join(f"{number:.15g}" for number in row) for row in rows]
    content = ("\n".join(lines) + "\n").encode()
    return Made(content, ".bvh", {"": pose}, {"": trans}, frame_rate=120.0)


def bvh_mixamo():
    return bvh("XYZ", _MIXAMO_NAMES, "mixamorig:")


def bvh_a_pose():
    """The arms hang by forty degrees at rest."""
    turns = {}
    bones = list(_BONES)
    for arm, elbow, wrist, sign in ((16, 18, 20, -1), (17, 19, 21, 1)):
        turn = Rotation.from_rotvec([0, 0, sign * np.radians(40)]).as_matrix()
        for joint in (arm, elbow):
            turns[joint] = turn
        for joint in (elbow, wrist):
            bones[joint] = (bones[joint][0], *(turn @ bones[joint][1:]).tolist())
    return bvh(bones=tuple(bones), turned=turns)


def in_own_axes(turned):
    """The bones where each joint has axes of its own."""
    return tuple(
        (parent, *(turned[parent] @ away).tolist()) if parent >= 0 else (parent, *away)
        for parent, *away in _BONES
    )


def bvh_lafan():
    """Axes as LAFAN1 has them: x along the bones, so that in the zero pose all lie along it.

    Written from what one of its frames shows in a T pose: where x, y and z of each joint point.
    """
    left, up, front = np.eye(3)
    fall = np.radians(25)
    foot = (np.cos(fall) * front - np.sin(fall) * up, np.cos(fall) * up + np.sin(fall) * front)
    axes = (
        ((0, 3, 6, 9, 12, 15), (up, front, left)),
        ((1, 2, 4, 5), (-up, front, -left)),
        ((7, 8), (*foot, -left)),
        ((10, 11), (front, up, -left)),
        ((13, 16, 18, 20), (left, -front, up)),
        ((14, 17, 19, 21), (-left, -front, -up)),
    )
    names = tuple(name.replace("ToeBase", "Toe") for name in _MIXAMO_NAMES)
    turned = {k: np.stack(rows) for joints, rows in axes for k in joints}
    return bvh("ZYX", names, bones=in_own_axes(turned), turned=turned)


def bvh_first_frame():
    """Any axes; the first frame is a T pose that faces elsewhere, and one bone is not known."""
    random = Rotation.random(22, random_state=7).as_matrix()
    names = tuple("Thorax" if name == "Spine2" else name for name in _MIXAMO_NAMES)
    pose = motion(3, 22)
    pose[0] = 0
    pose[0, 0, 1] = 0.7
    pose[:, 9] = 0
    return bvh("ZYX", names, "", in_own_axes(random), dict(enumerate(random)), pose)


def bvh_z_up():
    """Rests in a T pose with z up, the front towards -y."""
    turned = dict.fromkeys(range(22), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    return bvh(bones=in_own_axes(turned), turned=turned)


MADE = {
    made.__name__: made
    for made in (
        amass, amass_smplx, moyo, smplifyx, prox, vposer, hmr2, six_rows, six_columns, quaternions,
        quaternions_xyzw, parts_json, phalp, vibe, wham, gvhmr, tram, romp, bev_video, slahmr,
        bedlam, aistpp, threedpw, easymocap, mmhuman3d, motion_x, bvh, bvh_mixamo, bvh_a_pose,
        bvh_lafan, bvh_first_frame, bvh_z_up,
    )
}  # fmt: skip
