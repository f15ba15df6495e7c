"""Pose files of every structure: what went in is read, and stands there again when written."""

import base64
import io
import pickle
import zlib

import helpers_poses as made
import numpy as np
import pytest
from helpers_poses import MADE, as_matrix

from spt_jax.files.pickles import RefusedPickleError
from spt_jax.io.pose_files import STRUCTURES, load_poses, open_poses
from spt_jax.io.poses.containers import open_container


@pytest.fixture(params=MADE)
def written(request, tmp_path):
    """A file of one structure, and what it was made of."""
    one = MADE[request.param]()
    file = tmp_path / f"{request.param}{one.suffix}"
    file.write_bytes(one.content)
    return file, one


def named(one, file):
    """What went in, by the names that tracks have."""
    return {name or file.stem: pose for name, pose in one.poses.items()}


def assert_rotations(found, wanted, atol=1e-6):
    np.testing.assert_allclose(as_matrix(found), as_matrix(wanted), atol=atol)


def test_what_went_in_is_read(written):
    file, one = written
    tracks = load_poses(file)
    assert [track.name for track in tracks] == list(named(one, file))
    for track, key in zip(tracks, one.poses, strict=True):
        assert track.pose.shape == one.poses[key].shape and track.pose.dtype == np.float64
        assert_rotations(track.pose, one.poses[key])
        for field in ("translation", "shape"):
            wanted, found = getattr(one, field).get(key), getattr(track, field)
            assert (found is None) == (wanted is None)
            if wanted is not None:
                np.testing.assert_allclose(found, wanted, atol=1e-9)
        assert track.gender == one.gender
        assert track.frame_rate == (one.frame_rate and pytest.approx(one.frame_rate))
        assert len(track.names) == len(track.pose) == len(set(track.names))
        assert all(name.startswith(file.stem) for name in track.names)


def test_other_poses_stand_in_the_files_own_structure(written, tmp_path, rng):
    file, _ = written
    opened = open_poses(file)
    new = {}
    for track in opened.tracks:
        pose = track.pose.copy()
        pose[-1, [0, 5, 18]] += 0.3 * rng.normal(size=(3, 3))
        new[track.name] = pose
    out = tmp_path / f"new{file.suffix}"
    opened.write(out, new)
    again = open_poses(out)
    assert again.structure == opened.structure
    for track, before in zip(again.tracks, opened.tracks, strict=True):
        pose = new[before.name]
        assert_rotations(track.pose, pose)
        # What did not change is the same to the bit.
        same = (pose == before.pose).all(axis=-1)
        np.testing.assert_array_equal(track.pose[same], before.pose[same])
        for field in ("translation", "shape", "frame_rate", "gender"):
            np.testing.assert_equal(getattr(track, field), getattr(before, field))
    keys = (open_container(out).tree, open_container(file).tree)
    if isinstance(keys[0], dict):
        assert list(keys[0]) == list(keys[1])


def test_nothing_changes_where_the_poses_are_the_same(written, tmp_path):
    file, _ = written
    opened = open_poses(file)
    out = tmp_path / f"same{file.suffix}"
    assert opened.write(out, {track.name: track.pose for track in opened.tracks}) == ()
    one, other = open_container(file).tree, open_container(out).tree
    np.testing.assert_equal(other, one)


def test_every_structure_of_the_table_is_made(tmp_path):
    found = set()
    for name, make in MADE.items():
        one = make()
        (tmp_path / f"{name}{one.suffix}").write_bytes(one.content)
        found.add(open_poses(tmp_path / f"{name}{one.suffix}").structure)
    np.save(tmp_path / "bare.npy", np.zeros((2, 66)))
    np.savez(tmp_path / "raw.npz", pred_smpl_params=np.array(_hmr2(), object))
    found |= {open_poses(tmp_path / name).structure for name in ("bare.npy", "raw.npz")}
    assert found == {structure.name for structure in STRUCTURES}


def _hmr2():
    matrices = as_matrix(made.motion(2, 24))
    return {"global_orient": matrices[:, :1], "body_pose": matrices[:, 1:]}


def test_copies_of_the_poses_move_along(tmp_path):
    for make, name in ((made.wham, "w.pkl"), (made.gvhmr, "g.pt"), (made.bedlam, "b.npz")):
        (tmp_path / name).write_bytes(make().content)
    opened = open_poses(tmp_path / "w.pkl")
    pose = opened.tracks[0].pose.copy()
    pose[1, 0] += [0.2, 0.1, -0.3]
    pose[1, 16] = [0.5, 0.0, 0.1]
    assert opened.write(tmp_path / "w2.pkl", {"0": pose}) == ("w2.pkl keeps what followed from the "
                                                              "poses before: verts",)  # fmt: skip
    before, after = (open_container(tmp_path / n).tree[0]["pose"] for n in ("w.pkl", "w2.pkl"))
    np.testing.assert_allclose(after[1, 48:51], [0.5, 0.0, 0.1], atol=1e-12)
    # Turned by as much about its own axes in the camera as in the world.
    old, new = (as_matrix(array[1, :3]) for array in (before, after))
    world = [as_matrix(array[1, 0]) for array in (opened.tracks[0].pose, pose)]
    np.testing.assert_allclose(old.T @ new, world[0].T @ world[1], atol=1e-12)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])

    opened = open_poses(tmp_path / "g.pt")
    pose = opened.tracks[0].pose.copy()
    pose[2, 7] = 0.25
    opened.write(tmp_path / "g2.pt", {"g": pose})
    tree = open_container(tmp_path / "g2.pt").tree
    for part in ("smpl_params_global", "smpl_params_incam"):
        np.testing.assert_allclose(tree[part]["body_pose"][2, 18:21], 0.25, atol=1e-12)

    opened = open_poses(tmp_path / "b.npz")
    pose = opened.tracks[1].pose.copy()
    pose[1, 3] = -0.1
    opened.write(tmp_path / "b2.npz", {"rp_alison": pose})
    tree = open_container(tmp_path / "b2.npz").tree
    np.testing.assert_allclose(tree["pose_cam"][3, 9:12], -0.1, atol=1e-12)
    np.testing.assert_allclose(tree["pose_world"][3, 9:12], -0.1, atol=1e-12)


def test_people_are_chosen_by_name_or_number(tmp_path):
    file = tmp_path / "p.pkl"
    file.write_bytes(made.phalp().content)
    assert [track.name for track in load_poses(file, people="4")] == ["4"]
    assert [track.name for track in load_poses(file, people=[1, "1"])] == ["1"]  # a name first
    assert [track.name for track in load_poses(file, people=0)] == ["1"]
    with pytest.raises(ValueError, match=r"people must be among '1', '4', or numbers.*got '9'"):
        load_poses(file, people=9)


def test_what_is_not_used_is_said(tmp_path):
    for make, name in ((made.vibe, "v.pkl"), (made.smplifyx, "s.pkl"), (made.threedpw, "t.pkl")):
        (tmp_path / name).write_bytes(make().content)
    assert "not used: joints3d, pred_cam, verts" in open_poses(tmp_path / "v.pkl").notes
    opened = open_poses(tmp_path / "s.pkl")
    assert any("12 components of MANO's hand" in note for note in opened.notes)
    assert "not used: camera_rotation, camera_translation" in opened.notes
    (track,) = opened.tracks
    assert track.left_hand.shape == track.right_hand.shape == (1, 12)
    assert track.expression.shape == (1, 10)
    assert "poses_60Hz" in open_poses(tmp_path / "t.pkl").unused


def test_frames_have_the_files_numbers(tmp_path):
    file = tmp_path / "v.pkl"
    file.write_bytes(made.vibe().content)
    first = load_poses(file)[0]
    assert first.names[0] == "v/1/0007" and first.frames.tolist() == [7, 8, 9]


@pytest.mark.parametrize("suffix", ["", ".dat", ".PKL"])
def test_what_a_file_is_called_does_not_matter(tmp_path, suffix):
    file = tmp_path / f"file{suffix}"
    file.write_bytes(made.wham().content)
    assert open_poses(file).structure == "VIBE, PyMAF or WHAM"


@pytest.mark.parametrize("form", ["vector", "matrix"])
def test_three_rows_of_three_are_what_the_body_says(tmp_path, form):
    pose = made.motion(3 if form == "vector" else 1, 22)
    if form == "vector":
        np.savez(tmp_path / "a.npz", global_orient=pose[:, 0], body_pose=pose[:, 1:])
    else:
        matrices = as_matrix(pose[0])
        np.savez(tmp_path / "a.npz", global_orient=matrices[0], body_pose=matrices[1:])
    assert_rotations(load_poses(tmp_path / "a.npz")[0].pose, pose)


def test_one_row_for_all_frames_becomes_a_row_each_where_it_must(tmp_path):
    parts = {"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 63))}
    np.savez(tmp_path / "a.npz", **parts, jaw_pose=np.full((1, 3), 0.1))
    opened = open_poses(tmp_path / "a.npz")
    pose = opened.tracks[0].pose.copy()
    np.testing.assert_allclose(pose[:, 22], 0.1)
    pose[1, 22] = 0.3
    opened.write(tmp_path / "b.npz", {"a": pose})
    np.testing.assert_allclose(load_poses(tmp_path / "b.npz")[0].pose, pose, atol=1e-15)


def saved(value, protocol=4):
    return pickle.dumps(value, protocol=protocol)


BODY = {"global_orient": np.zeros((2, 3)), "body_pose": np.zeros((2, 63))}
REFUSED = [
    ("x.pkl", saved({"a": 1, "b": 2}), r"in a structure that is known.*keys 'a', 'b'.*AMASS"),
    ("x.json", b'{"people": [{"pose_keypoints_2d": []}]}', "spt-jax fit"),
    ("x.json", b'[{"keypoints": [1, 2]}]', "looks like keypoints"),
    ("x.pkl", saved({"v_template": 1, "f": 2}), "looks like a body model, which --body takes"),
    ("x.bin", b"\x00\x01\x02", r"begins like none of them.*x\.bin|x\.bin.*begins like none"),
    ("x.pkl", saved(BODY | {"body_pose": np.zeros((2, 32))}), "a code of VPoser"),
    ("x.pkl", saved(BODY | {"body_pose": np.zeros((2, 60))}), r"body_pose must hold.*\(2, 60\)"),
    ("x.pkl", saved(BODY | {"global_orient": np.zeros((4, 3))}), "one number of frames"),
    ("x.pkl", saved(BODY | {"transl": np.zeros((5, 3))}), r"transl must have shape .*\(5, 3\)"),
    ("x.pkl", saved(BODY | {"fps": -1.0}), "fps must be one positive number"),
    ("x.pkl", saved({0: {"pose": np.full((1, 72), np.nan)}}), r"\[0\]\.pose must be finite"),
    ("x.pkl", saved({k: {"pose": np.zeros((1, 72))} for k in (1, "1")}), "'1' more than once"),
    ("x.pkl", saved({0: {"pose": "abc"}}), r"\[0\]\.pose must hold numbers: got str"),
    ("x.pkl", saved(MADE["wham"]), "asks for helpers_poses.wham"),
    ("x.pkl", saved(BODY)[:-40], "must be a whole pickle"),
    ("x.npz", made.npz(pose=np.full((2, 24, 3, 3), 0.4)), "pose must hold rotation matrices"),
    ("x.npz", made.npz(pose=np.full((2, 24, 6), 0.4)), "may be in either of two orders"),
    ("x.npz", made.npz(pose=np.full((2, 24, 4), 0.1)), "quaternions of length 1"),
    ("x.npz", made.npz(poses=np.array([np.zeros((2, 70))] * 2 + [None], object)[:2],
                       trans=np.zeros((2, 2, 3))), r"poses\[0\] must hold frames"),
    ("x.json", b'[{"Rh": [[0, 0, 0]], "poses": [[0, 1]], "Th": [[0, 0, 0]]}]', "frames of 63, 66"),
    ("x.json", b'[{"Rh": [[0, 0, 0]], "poses": [[0], [0, 1]]}]', "rows of different lengths"),
    ("x.json", b'{"global_orient": [[0, 0,', "must be JSON"),
    ("x.bvh", b"HIERARCHY\nROOT a\n{ OFFSET 0 0 0 CHANNELS 0", "it is cut"),
    ("x.bvh", made.bvh().content[:-400], r"MOTION must hold 3 frames of 69 numbers"),
    ("x.bvh", made.bvh().content.replace(b"L_Hip", b"Bone7"), "without left_hip"),
    ("x.bvh", made.bvh().content.replace(b"OFFSET 26 0 0", b"OFFSET 0 26 0"), "T or A pose"),
    ("x.pt", made.torch_archive({"state_dict": {"w": np.zeros(3)}}), "'state_dict'"),
    ("x.pkl", zlib.compress(saved(BODY))[:-9], "must unpack"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), REFUSED)
def test_what_is_refused_says_why(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_poses(tmp_path / name)
    text = str(caught.value)
    assert name in text and "mesh" not in text and "\n" not in text


class Call:
    """Pickled, a call of a function that was not asked for."""

    def __init__(self, function, *given):
        self.made = function, given

    def __reduce__(self):
        return self.made


@pytest.mark.parametrize("where", ["pickle", "npz", "npy", "torch", "joblib", "zlib"])
def test_nothing_that_a_file_names_is_run(tmp_path, where):
    called = tmp_path / "called"
    value = {"global_orient": Call(open, str(called), "w"), "body_pose": np.zeros((1, 63))}
    held = np.array(value, dtype=object)
    content = {
        "pickle": lambda: pickle.dumps(value),
        "npz": lambda: made.npz(results=held),
        "npy": lambda: _npy(held),
        "torch": lambda: made.torch_archive(value),
        "joblib": lambda: made.joblib(value),
        "zlib": lambda: zlib.compress(pickle.dumps(value)),
    }[where]()
    (tmp_path / "x.pkl").write_bytes(content)
    with pytest.raises(ValueError, match=r"asks for|cannot be read|that is known"):
        load_poses(tmp_path / "x.pkl")
    assert not called.exists()


def _npy(value):
    file = io.BytesIO()
    np.save(file, value, allow_pickle=True)
    return file.getvalue()


def bomb_of_a_storage():
    value = made.torch_archive({"pose": np.zeros(4)})
    return value.replace(b"K\x04", b"K\xff")  # more numbers than there are bytes


def bomb_of_a_tensor():
    """A tensor of a terabyte, whose stride is 0."""
    value = made.torch_archive({"pose": np.zeros(4)})
    return value.replace(b"K\x04\x85", b"J\xff\xff\xff\x7f\x85").replace(b"K\x01\x85", b"K\x00\x85")


def bomb_of_objects():
    """An array of objects that announces more of them than it has."""
    whole = pickle.dumps(np.array([None] * 3, object), protocol=2)
    return whole.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85")


def bomb_of_zlib():
    return zlib.compress(bytes(300_000_000), 9)


@pytest.mark.parametrize(
    "bomb", [bomb_of_a_storage, bomb_of_a_tensor, bomb_of_objects, bomb_of_zlib]
)
def test_announced_sizes_are_not_believed(tmp_path, bomb):
    import resource

    (tmp_path / "x.pkl").write_bytes(bomb())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"x\.pkl"):
        load_poses(tmp_path / "x.pkl", max_bytes=50_000_000)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


def test_a_pickle_may_not_change_what_reads_it(tmp_path):
    """A state for one of the functions that a pickle may call is refused."""
    attack = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n}X\x09\x00\x00\x00max_bytesK\x01s\x86b."
    (tmp_path / "x.pkl").write_bytes(attack)
    with pytest.raises(ValueError, match=r"gives a state|whole pickle"):
        load_poses(tmp_path / "x.pkl")


#: By torch 2.14.1: {"a": arange(6.).reshape(2, 3), "b": {"c": eye(3)[:, :2].t(), "n": 5,
#: "h": ones(3, bfloat16)}, "l": [tensor(3)], "p": Parameter(ones(2))}, packed by zlib.
TORCH_ZIP = (
    "c-p0v%Wl&^6ow~p>joEk;nq^1+zO;nQajGA6li53voL}Z1gelw<R+%EaFZTqQZ53i5^5=|-~m9q0Bd%z=$1{9KrGm?"
    "KnM^UmMoaDOYlr+1FaLsndJQc`DQ%lc+3!*5Q;=l-O+(IBh$?n?HOyZU}7^iecjQuHgttKX2W*@MaM%#U_vO5%R~{&"
    "Rk7_<q?~I_RBfk_!&a$Mc5^dv3Bu9ncnb-xkVtdV0>PI^x>GjsMgK<$nmj`pn#Tol%}-ZBG(-$77Yt;C4PhQ4hG2x|"
    "VZ(!bzU(+w9^2(oMLO>mEY~WWw)0p5sXq&?7&c~Mljk-8ZFiyFN6kY=k&qOHqMu2D&Z1~+z_7WNVT%!>m#q(q)My)q"
    "?OEvZf=keCG<)BQu*0`mo`mMjLP^!;(c^{1VJC4HFzll4!W`^2LUYjTJMY1;Hw*i!UZey2ufhSw^K7{^S@Y}jqEt9Y"
    "{6ZKG5x@R^-{&xfXcqcSFJc;wtZ*x)P1l^Vu;of{lv#oV3=q>WhGX6m%t4Go4*KRY1|<ve1#h6<heQ^V)!3NP61nm9"
    "+qs`aPtUOx_fi)csqLlMwX!>9;@phoR>)n`wP9{c{nw#Th!@{K+@o`#=gJU0DE$XwdH>~1$DS-rStYD%>RLEb2?{WB"
    "13rgIitwrcoq<)DxP`4U-LC7Lzhh(USd?Mz<i{N%$s(@G(1uPiRXr%{+VOP&_^z`f<YSb)$vI2TXQPy;>(Qsj-Q<t%"
    "21Elak)mr+^zZq-+<~KhOj%woKH1$zMtu!f_OdK-UE8%P%j^h!(G0JL7Z%sB{_6VHUs(2~1P|Xo|3Xtn8W5ad2@<-N"
    "L2JMNbiMr*cyvL0+c<wa8m{H9^?>wR0aS@*UV1utsd4@FqWGT%;7z?^xi;wlw@v!|$k_#5i~T2vEGLu7kgQ~qYFt*6"
    "LvlKkmQzESR3@dShSG60qok7QOp;PY&lK)N2}jhU3{lt`XRwcU)RFVgVO||<fL)C8Y#6Q7d3lpy6YF72mVzdAos;(o"
    "Hlj|(Co7=(2FS~UU89YWzY`GGyLfG|%2{o(iPI{)Hdw!`_6M(x^V(qLvD(YcoL1$v!Kz`k?|E&4*9P}}JEI*J5npAz"
    "IJg~q8S$Hd`0s@>W{Bdz@3In()s(H=^;Ouv-fa2ZrbO>sTJp#K6T4aTHLYH}ANva#byGS"
)
#: The same function with _use_new_zipfile_serialization=False.
TORCH_LEGACY = (
    "c-nQ6NpI6o5XZe_A%>Q+Q`WL4EWz2F<kSkGUR*YF@ujj{=czU_cK-HrC6FTJlG5@SIB?{v@ez<XFt*#Msf_LS?3p+I"
    "|7PaBsq|g(|Nhwgv-auN`_<-Ddh=VRc><wst_XrKjzS(fp>OT6DE7htA_bUBwBmc5`^;j&$g=}T2c|+!{$<Rp*!#+2"
    "$P<+6W|^F^8%7*uT{2~|ynv&km&{VC5eB=c>ZK$(W{TvsAv!#a9JgsD-1B3_ir7x#`6G+7APysIudP6;*Uf4wPLcL5"
    "gPi}OZ2F<iKjuyaC3Bf#hMj@dQoDVv(;aFm%2^)HIH5c$Z#k+TbU~MNc^_wVSr_+FJ9MaIpE;Z=j+J-Oh(&Dl+H<%9"
    "rD5PK$2kK_S+YA=p5T0*xPuj!@^WSO6t~-HciOn%R`eS2F3x$EbTNHhK6F#rD;!r1T+5^aT-VFlmy6Y0^r*mBS%oca"
    "UgM1g*0A5|X#?COmQ1W$DNCN=wl2<aC+FPdSTk@h$>e?9-^POl!WQkyT>arm^?|DPG*!hTQWr`6F{w8ix#|;+x`BqB"
    "sgCjVKU+AqBl|PsEK=~Suvz_HtJ`nmIUyuMyvUk0Lo+SlWsXugS_aw&nbG-%u7O^9g0|BWRIuS<(QZgZRJo{^rJ@#;"
    "S+gRXyr%0kZO}twO5^87ZE@{%?1C*VtWDSDxs~4Hk#+3-2O|UF4*"
)
#: By joblib 1.6.0: {0: {"c": arange(4.), "f": asfortranarray(arange(6.).reshape(2, 3)),
#: "o": array([1, None], object)}}.
JOBLIB = (
    "c-n<g%SyvQ6iwO&qb*vWRQ!R8khKe;k%9{cBDirSVUkXrXkJVbN<g75sx6EwZ~o4Y@DJ)FY1P<;2WIBXaPK{L&K)<h"
    "52?fxAhEh!wt?^72bSwtnxA-KYKD&e;1b~5Mt(hK45v2?haq9`4#&@sXQ@$Q*)EPE;7XANe9a%=JXQp8C89VafEp9Q"
    "12zz;T<!}#h*R-S*OyGh)`q7ro4&#|bWxqlXJ8n{<y@fHkQ9T(H?ZplBh&M62vdGk_F1Tz*mdrFkNB}^r7?*BwG&I7"
    "FCbO$*;^33JXAe9S-fz02vjLQM^)OSEmTAG7oeM5z5v>$`?NEqhk5bl{0G(gs$SJ;>s7ryJwxAm!HV8QsL?H<wZm&y"
    "6;B@jc+wM|(9W#vXRKsz%c=*3Gn#1!jA&ls#!fjB-ZB}n13!vcV#mdVR;Pxf3G`(PN?EyRsQ!CU|2H+e%`*)msFp<9"
    "7u}`dDF"
)


@pytest.mark.parametrize("text", [TORCH_ZIP, TORCH_LEGACY])
def test_what_pytorch_itself_wrote_is_read(tmp_path, text):
    (tmp_path / "x.pt").write_bytes(zlib.decompress(base64.b85decode(text)))
    tree = open_container(tmp_path / "x.pt").tree
    np.testing.assert_array_equal(tree["a"], np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(tree["b"]["c"], np.eye(3)[:, :2].T)
    np.testing.assert_array_equal(tree["b"]["h"], np.ones(3))
    np.testing.assert_array_equal(tree["p"], np.ones(2))
    assert tree["b"]["n"] == 5 and tree["l"][0] == 3


def test_what_joblib_itself_wrote_is_read(tmp_path):
    (tmp_path / "x.pkl").write_bytes(zlib.decompress(base64.b85decode(JOBLIB)))
    (tree,) = open_container(tmp_path / "x.pkl").tree.values()
    np.testing.assert_array_equal(tree["c"], np.arange(4.0))
    np.testing.assert_array_equal(tree["f"], np.arange(6.0).reshape(2, 3))
    assert tree["f"].flags.f_contiguous and tree["o"].tolist() == [1, None]


def test_pickles_written_are_read_by_an_older_numpy(tmp_path):
    """NumPy 1 does not know `numpy._core`, which NumPy 2 names."""
    for make in (made.wham, made.aistpp, made.threedpw):
        (tmp_path / "x.pkl").write_bytes(make().content)
        opened = open_poses(tmp_path / "x.pkl")
        opened.write(tmp_path / "y.pkl", {})
        content = (tmp_path / "y.pkl").read_bytes()
        assert b"numpy._core" not in content and b"numpy.core.multiarray" in content
        plain = pickle.loads(content)
        np.testing.assert_equal(plain, opened.container.tree)


def test_what_python_2_wrote_is_read_without_a_warning(tmp_path):
    """Its NumPy wrote 0 and 1 in a dtype, and strings where there are bytes now."""
    pose = np.zeros((2, 72))
    content = pickle.dumps({"smpl_poses": pose}, protocol=0)
    content = content.replace(b"I00\n", b"I0\n").replace(b"I01\n", b"I1\n")
    assert b"I0\n" in content and content[:1] == b"("
    (tmp_path / "x.pkl").write_bytes(content)
    np.testing.assert_array_equal(load_poses(tmp_path / "x.pkl")[0].pose, pose.reshape(2, 24, 3))


def test_a_number_of_any_length_is_refused_in_one_line(tmp_path):
    (tmp_path / "x.json").write_text('{"global_orient": [1' + "0" * 400 + '], "body_pose": []}')
    with pytest.raises(ValueError, match=r"body_pose must hold|global_orient must hold numbers"):
        load_poses(tmp_path / "x.json")


def test_refusals_are_of_one_kind():
    assert issubclass(RefusedPickleError, ValueError)


def places_of(axes, offsets, parents):
    """Where joints are, from the root, whose axes these are."""
    places = np.zeros((len(parents), 3))
    for k, parent in enumerate(parents):
        if parent >= 0:
            places[k] = places[parent] + axes[parent] @ offsets[k]
    return places


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (made.bvh_lafan, "x of the skeleton's joints is taken to run along its bones"),
        (made.bvh_first_frame, "the first frame is taken for the T pose"),
        (made.bvh_z_up, "the skeleton rests with z up and -y in front"),
    ],
)
def test_whatever_axes_a_skeleton_has_its_body_moves_as_it_does(tmp_path, make, said):
    """Joints are where the file's own offsets and angles place them."""
    file = tmp_path / "x.bvh"
    file.write_bytes(make().content)
    opened = open_poses(file)
    assert any(note.startswith(said) for note in opened.notes), opened.notes
    assert any("centimetres" in note for note in opened.notes)
    tree = open_container(file).tree
    joints = [joint for joint in tree["joints"] if joint.channels]
    rows = [k for k, joint in enumerate(tree["joints"]) if joint.channels]
    parents = [rows.index(joint.parent) if joint.parent >= 0 else -1 for joint in joints]
    order = "".join(channel[0] for channel in joints[1].channels)
    (track,) = opened.tracks
    for pose, row in zip(track.pose, tree["motion"], strict=True):
        axes, turned = [], []
        for k, parent in enumerate(parents):
            turn = as_euler_matrix(order, row[3 + 3 * k : 6 + 3 * k])
            axes.append(axes[parent] @ turn if parent >= 0 else turn)
        for k, parent in enumerate(p for p, *_ in made._BONES):
            turn = as_matrix(pose[k])
            turned.append(turned[parent] @ turn if parent >= 0 else turn)
        places = places_of(axes, [joint.offset for joint in joints], parents)
        wanted = places_of(turned, [b[1:] for b in made._BONES], [b[0] for b in made._BONES])
        found = {tuple(place.round(4) + 0.0) for place in places}
        assert found == {tuple(place.round(4) + 0.0) for place in wanted}
        assert len(found) == 22


def as_euler_matrix(order, degrees):
    matrix = np.eye(3)
    for axis, angle in zip(order, np.radians(degrees), strict=True):
        one, other = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
        turn = np.eye(3)
        turn[[one, other], [one, other]] = np.cos(angle)
        turn[other, one], turn[one, other] = np.sin(angle), -np.sin(angle)
        matrix = matrix @ turn
    return matrix
