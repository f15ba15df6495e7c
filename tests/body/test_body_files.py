"""load_body on synthetic files of the SMPL family, and on files that are damaged or hostile."""

import os
import pickle
import re
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from helpers_body import (
    Ch,
    chumpy_array,
    slow_body,
    smpl_pose,
    synthetic_smpl,
    with_parents,
    write_official_pkl,
)

from spt_jax.body import load_body
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.files.pickles import RefusedPickleError, read_pickle
from spt_jax.files.stand_ins import plain


@eqx.filter_jit
def _posed(body, *arguments):
    return body(*arguments)


def _assert_moves_as(body, smpl, rng):
    joints = smpl["kintree_table"].shape[1]
    pose, _ = smpl_pose(rng, joints)
    shape, translation = rng.normal(size=body.num_shape), rng.normal(size=3)
    posed = _posed(body, *(jnp.asarray(x) for x in (pose, shape, translation)))
    vertices, joints = slow_body(with_parents(smpl), pose, shape, translation)
    np.testing.assert_allclose(posed.vertices, vertices, atol=1e-10)
    np.testing.assert_allclose(posed.joints, joints, atol=1e-10)


@pytest.mark.parametrize("joints", [52, 55])
def test_npz_moves_as_the_slow_reference(tmp_path, rng, x64, joints):
    smpl = synthetic_smpl(rng, joints)
    np.savez(tmp_path / "model.npz", **smpl, extra=np.array({"not": "read"}, dtype=object))
    body = load_body(tmp_path / "model.npz")
    assert body.joint_names == SMPL_LAYOUTS[joints]
    assert body.parents == tuple(with_parents(smpl)["parents"])
    np.testing.assert_array_equal(body.faces, smpl["f"])
    _assert_moves_as(body, smpl, rng)


def test_official_pkl_moves_as_the_slow_reference(tmp_path, rng, x64, monkeypatch):
    smpl = synthetic_smpl(rng)
    write_official_pkl(tmp_path / "model.pkl", smpl, monkeypatch)
    assert b"chumpy.ch\nCh" in (tmp_path / "model.pkl").read_bytes()
    _assert_moves_as(load_body(str(tmp_path / "model.pkl")), smpl, rng)
    assert not any(name.startswith("chumpy") for name in sys.modules)


def test_reading_a_pickle_imports_neither_chumpy_nor_scipy(tmp_path, rng, monkeypatch):
    write_official_pkl(tmp_path / "model.pkl", synthetic_smpl(rng), monkeypatch)
    code = (
        "import sys\n"
        "from spt_jax.files.pickles import read_pickle\n"
        "from spt_jax.files.stand_ins import plain\n"
        f"values = read_pickle({str(tmp_path / 'model.pkl')!r})\n"
        "assert plain(values['J_regressor']).shape == (24, 60)\n"
        "assert not {'chumpy', 'scipy'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("layout", ["csc", "csr", "coo"])
@pytest.mark.parametrize("kind", ["matrix", "array"])
def test_pickles_of_any_protocol_and_sparse_layout_are_read(tmp_path, rng, protocol, layout, kind):
    dense = rng.random((4, 7)) * (rng.random((4, 7)) < 0.4)
    values = {
        "sparse": getattr(scipy.sparse, f"{layout}_{kind}")(dense),
        "fortran": np.asfortranarray(dense),
        "strings": np.array(["a", "bc"]),
        "objects": np.array([1, "x", None], dtype=object),
        "scalar": np.float64(2.5),
        "others": [1, 2.0, "x", None, True, {3}, (4,), b"bytes"],
    }
    path = tmp_path / "values.pkl"
    path.write_bytes(pickle.dumps(values, protocol))
    got = read_pickle(path)
    np.testing.assert_array_equal(plain(got["sparse"]), dense)
    for name in ("fortran", "strings", "objects"):
        np.testing.assert_array_equal(got[name], values[name])
    assert got["scalar"] == 2.5 and got["others"] == values["others"]


class _Calls:
    """Pickles as a call of a function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def _hostile(target):
    """Pickles that would write or reach something, by the name that must be refused."""
    text = str(target)
    calls = (
        _Calls(open, text, "w"),
        _Calls(os.system, f"echo x > {text}"),
        _Calls(subprocess.call, ["touch", text]),
        _Calls(eval, f"open({text!r}, 'w')"),
        _Calls(getattr, np.ndarray, "tofile"),
        _Calls(np.save, text, np.zeros(1)),
        _Calls(np.loadtxt, text),
        _Calls(np.memmap, text, "uint8", "w+", 0, (1,)),
    )
    return {f"{call.call[0].__module__}.{call.call[0].__name__}": call for call in calls}


@pytest.mark.parametrize("name", list(_hostile("x")))
def test_every_other_name_is_refused_before_anything_runs(tmp_path, rng, name):
    target, path = tmp_path / "written", tmp_path / "model.pkl"
    smpl = synthetic_smpl(rng) | {"v_template": _hostile(target)[name]}
    for protocol in (0, 2, 4):
        path.write_bytes(pickle.dumps(smpl, protocol, fix_imports=False))
        with pytest.raises(RefusedPickleError, match=re.escape(f"asks for {name}.")):
            load_body(path)
        assert not target.exists()
    pickle.loads(pickle.dumps(_Calls(open, str(target), "w"))).close()
    assert target.exists()  # the test's own attack works when nobody stands in its way


@pytest.mark.parametrize(
    "program",
    [
        b"cspt_jax.files.pickles\nread_pickle\n.",
        b"cbuiltins\nobject.__subclasses__\n.",
        b"cnumpy\nndarray.tofile\n.",
        b"\x80\x04\x8c\x05numpy\x8c\x07f2py.os\x93.",
        b"cscipy.sparse\nsave_npz\n.",
        b"cchumpy.ch\nos.system\n.",
    ],
)
def test_a_dotted_or_foreign_name_is_refused(tmp_path, program):
    (tmp_path / "model.pkl").write_bytes(program)
    with pytest.raises(RefusedPickleError, match="nothing was run"):
        load_body(tmp_path / "model.pkl")


@pytest.mark.parametrize(
    "program",
    [
        # Sets attributes on an admitted class, on an admitted function, and on NumPy's array.
        b"cchumpy.ch\nCh\n}S'as_array'\ncbuiltins\nset\nsb.",
        b"ccopyreg\n_reconstructor\n}S'x'\nI1\nsb.",
        b"ccopyreg\n_reconstructor\nN}S'x'\nI1\ns\x86b.",
        b"cnumpy\nndarray\n}S'x'\nI1\nsb.",
        # Rebuilds a class that is no stand-in, and asks for a codec other than Latin-1.
        b"ccopyreg\n_reconstructor\n(cbuiltins\nset\ncbuiltins\nobject\nNtR.",
        b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(cbuiltins\nset\n(I0\ntS'b'\ntR.",
    ],
)
def test_admitted_names_cannot_be_bent(tmp_path, program):
    from spt_jax.files import stand_ins

    before = dict(vars(stand_ins._Chumpy))
    (tmp_path / "model.pkl").write_bytes(program)
    with pytest.raises(ValueError, match="cannot be read as a pickle"):
        read_pickle(tmp_path / "model.pkl")
    assert dict(vars(stand_ins._Chumpy)) == before


@pytest.mark.parametrize("suffix", ["npz", "pkl"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_truncated_files_are_refused_by_name(tmp_path, rng, monkeypatch, suffix, share):
    path = tmp_path / f"model.{suffix}"
    if suffix == "npz":
        np.savez(path, **synthetic_smpl(rng))
    else:
        write_official_pkl(path, synthetic_smpl(rng), monkeypatch)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=rf"model\.{suffix}.*truncated or damaged"):
        load_body(path)


@pytest.mark.parametrize("key", sorted(synthetic_smpl(np.random.default_rng(0), vertices=3)))
def test_a_missing_array_and_a_wrong_shape_are_named(tmp_path, rng, key):
    smpl = synthetic_smpl(rng)
    path = tmp_path / "model.npz"
    np.savez(path, **{name: array for name, array in smpl.items() if name != key})
    if key == "posedirs":
        assert load_body(path).pose_basis is None
    else:
        with pytest.raises(ValueError, match=rf"model\.npz lacks {key};"):
            load_body(path)
    np.savez(path, **(smpl | {key: smpl[key][..., None]}))
    with pytest.raises(ValueError, match="must be real numbers of shape"):
        load_body(path)


def test_object_arrays_in_an_npz_are_named(tmp_path, rng):
    smpl = synthetic_smpl(rng)
    regressor = np.array(scipy.sparse.csc_matrix(smpl["J_regressor"]), dtype=object)
    np.savez(tmp_path / "model.npz", **(smpl | {"J_regressor": regressor}))
    with pytest.raises(ValueError, match=r"J_regressor in .* is an object array"):
        load_body(tmp_path / "model.npz")


def test_contents_that_contradict_themselves_are_named(tmp_path, rng):
    path, smpl = tmp_path / "model.npz", synthetic_smpl(rng)
    np.savez(path, **(smpl | {"f": smpl["f"] + 60}))
    with pytest.raises(ValueError, match=r"f in .* must index into v_template.*0-based"):
        load_body(path)
    table = smpl["kintree_table"].copy()
    table[0, 5] = 99
    np.savez(path, **(smpl | {"kintree_table": table}))
    with pytest.raises(ValueError, match="got 99 for joint 5"):
        load_body(path)
    np.savez(path, **(smpl | {"weights": 2 * smpl["weights"]}))
    with pytest.raises(ValueError, match=r"weights in .* must sum to 1.*got 2\.0000"):
        load_body(path)
    np.savez(path, **(smpl | {"v_template": smpl["v_template"] * np.nan}))
    with pytest.raises(ValueError, match=r"v_template in .* must be finite: got 180 NaN"):
        load_body(path)
    np.savez(
        path,
        **(smpl | {"kintree_table": smpl["kintree_table"][:, :16]}),
    )
    with pytest.raises(ValueError, match=r"J_regressor in .* shape \(16, 60\)"):
        load_body(path)
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(ValueError, match="must hold a dictionary of arrays: got list"):
        load_body(tmp_path / "list.pkl")
    value = Ch()
    value.__dict__.update(y=1)
    with pytest.MonkeyPatch.context() as patch:
        write_official_pkl(tmp_path / "odd.pkl", smpl | {"posedirs": value}, patch)
    with pytest.raises(ValueError, match=r"posedirs in .* cannot be turned into an array"):
        load_body(tmp_path / "odd.pkl")


@pytest.mark.parametrize(("columns", "shapes"), [(400, 300), (20, 10), (16, 16)])
def test_smplx_expressions_are_left_out(tmp_path, rng, columns, shapes):
    smpl = synthetic_smpl(rng, 55, vertices=5, components=columns)
    np.savez(tmp_path / "model.npz", **smpl)
    body = load_body(tmp_path / "model.npz", num_shape=None)
    assert body.num_shape == shapes
    np.testing.assert_allclose(body.shape_basis, smpl["shapedirs"][..., :shapes], rtol=1e-6)
    assert load_body(tmp_path / "model.npz").num_shape == 10
    assert load_body(tmp_path / "model.npz", num_shape=3).num_shape == 3


def test_chumpy_arrays_of_chumpy_arrays(tmp_path, rng, monkeypatch):
    smpl = synthetic_smpl(rng)
    nested = chumpy_array(chumpy_array(smpl["posedirs"]))
    write_official_pkl(tmp_path / "model.pkl", smpl | {"posedirs": nested}, monkeypatch)
    body = load_body(tmp_path / "model.pkl")
    np.testing.assert_allclose(body.pose_basis, smpl["posedirs"], rtol=1e-6)


def test_unknown_sources_are_named(tmp_path):
    with pytest.raises(ValueError, match=r'must be "anny" or the path.*got \'smpl\''):
        load_body("smpl")
    with pytest.raises(ValueError, match=r"got .*model\.fbx"):
        load_body(tmp_path / "model.fbx")
    with pytest.raises(FileNotFoundError, match=r"no body model file at .*model\.npz"):
        load_body(tmp_path / "model.npz")
    with pytest.raises(ValueError, match="num_shape must not be negative: got -1"):
        load_body(num_shape=-1)


def test_dtype_of_the_model(dtype):
    body = load_body(num_shape=2)
    assert body.template.dtype == body.weights.dtype == dtype
    assert load_body(num_shape=2, dtype="float32").shape_basis.dtype == np.float32
    with pytest.raises(TypeError, match="dtype must be floating-point"):
        load_body(dtype="int32")
    if dtype == np.float32:
        with pytest.raises(ValueError, match="jax_enable_x64"):
            load_body(dtype="float64")


def _damaged(smpl):
    """By what a message must say: the same model with one array damaged."""

    def at(name, place, value, kind=None):
        array = smpl[name].astype(kind or smpl[name].dtype)
        array[place] = value
        return {name: array}

    weights = smpl["weights"].copy()
    weights[3, :2] += [-0.25, 0.25]
    return {
        "f in .* must hold whole numbers: got 1.5": at("f", (0, 0), 1.5, float),
        "f in .* must index into v_template: got indices -1 to": at("f", (0, 0), -1, np.int64),
        "f in .* beyond all indices": at("f", (0, 0), 1e30, float),
        "kintree_table in .* whole numbers": at("kintree_table", (0, 1), 0.5, float),
        "weights in .* must not be negative: got -": {"weights": weights},
        r"weights in .* must sum to 1 .*got 1\.\d+ for vertex 2": at("weights", (2, 5), 0.9),
        "weights in .* must be real numbers.*complex": {"weights": smpl["weights"] * 1j},
        r"J_regressor in .* must sum to 1 .*got [23]\.\d+ for joint 4": at(
            "J_regressor", (4, 0), 2.0
        ),
        r"posedirs in .* must be finite: got 1 NaN": at("posedirs", (0, 0, 0), np.nan),
        r"shapedirs in .* must be finite": at("shapedirs", (0, 0, 0), np.inf),
        r"v_template in .* must be within 1000 of zero.*got 1e\+300": at(
            "v_template", (0, 0), 1e300
        ),
        r"posedirs in .* must be within": at("posedirs", (0, 0, 0), -1e30),
    }


@pytest.mark.parametrize("message", list(_damaged(synthetic_smpl(np.random.default_rng(0)))))
def test_damaged_models_are_refused_by_their_array(tmp_path, message):
    smpl = synthetic_smpl(np.random.default_rng(0))
    np.savez(tmp_path / "model.npz", **(smpl | _damaged(smpl)[message]))
    with pytest.raises(ValueError, match=message):
        load_body(tmp_path / "model.npz")


def test_indices_stored_as_floats_are_read(tmp_path, rng):
    smpl = synthetic_smpl(rng)
    np.savez(tmp_path / "model.npz", **(smpl | {"f": smpl["f"].astype(np.float32)}))
    np.testing.assert_array_equal(load_body(tmp_path / "model.npz").faces, smpl["f"])


def _pickled(rng, **changed):
    return pickle.dumps(synthetic_smpl(rng) | changed, 4)


def test_sizes_that_a_pickle_announces_are_not_believed(tmp_path, rng):
    path = tmp_path / "model.pkl"
    sparse = scipy.sparse.csc_matrix(np.eye(3))
    nested = [0.0] * 10
    for _ in range(12):
        nested = [nested] * 10
    endless = [0.0]
    endless.append(endless)
    huge, lying = scipy.sparse.csc_matrix((2, 2)), scipy.sparse.csc_matrix(np.eye(3))
    huge._shape = (24, 10**13)
    lying.indptr = np.array([0, 10**12, 10**12, 3])
    header = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"
    for content, message in (
        (
            _pickled(rng, J_regressor=huge),
            "J_regressor .*a sparse matrix of shape .24, 1",
        ),
        (_pickled(rng, J_regressor=lying), "J_regressor in .* other entries than it has"),
        (_pickled(rng, v_template=nested), "v_template in .* more entries than the limit"),
        (_pickled(rng, v_template=endless), "v_template in .* more entries than the limit"),
        (header + b"(M\xff\xffM\xff\xfftU\x01b\x87R.", "rebuilt from nothing: got an announced"),
        (b"\x80\x02}r\xff\xff\xff\x7f.", "its reference 1 the number 2147483647"),
        (b"\x80\x04\x8e" + b"\xff" * 7 + b"\x0f" + b"x.", "model.pkl cannot be read"),
        (b"\x80\x04\x95" + b"\xff" * 7 + b"\x0f" + b"}.", "model.pkl cannot be read"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            load_body(path)
    assert plain(sparse) is sparse
    path.write_bytes(_pickled(rng))
    with pytest.raises(ValueError, match=r"model file .*model\.pkl' must not take more than 99"):
        load_body(path, max_bytes=99)


def test_an_array_of_objects_that_announces_more_than_it_has_is_refused(tmp_path):
    """NumPy would read beyond the list's end: a crash of the process, not an error."""
    content = pickle.dumps({"f": np.array([None] * 3, object)}, protocol=2)
    damaged = content.replace(b"K\x03\x85", b"J\xff\xff\xff\x1f\x85")
    assert damaged != content
    (tmp_path / "x.pkl").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"x\.pkl cannot be read.*has 3 objects"):
        read_pickle(tmp_path / "x.pkl")


def test_an_array_is_not_made_by_its_class(tmp_path):
    """`numpy.ndarray((2**40,))` would be a terabyte."""
    (tmp_path / "x.pkl").write_bytes(b"cnumpy\nndarray\n((L1099511627776L\ntt\x52.")
    with pytest.raises(ValueError, match=r"x\.pkl cannot be read"):
        read_pickle(tmp_path / "x.pkl")
