"""Robots: rigid parts that joints move, from URDF files."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int

from spt_jax._groups import Pairs

_MOVING = ("revolute", "continuous", "prismatic")
_MESHES = {".stl", ".obj", ".dae", ".ply", ".off", ".glb", ".gltf"}
_MOST_BYTES = 64 * 1024**2  # of a URDF file; a humanoid's has 0.1 MB


class Robot(eqx.Module):
    """Rigid parts in one scene, as a function of the joints' values.

    Attributes:
        rest_vertices: of all parts, each in the frame of its link, in metres.
        faces: indices into them.
        face_groups: of each face, the number of its link.
        link_names: in the order of these numbers.
        joint_names: of the joints that move, in the order of their values.
        lower, upper: limits of these; infinite where there are none.
    """

    rest_vertices: Float[Array, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    face_groups: Int[np.ndarray, "F"]
    link_names: tuple[str, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    lower: Float[np.ndarray, "N"]
    upper: Float[np.ndarray, "N"]
    _link_of: Int[np.ndarray, "V"]
    _joints: tuple = eqx.field(static=True)

    @property
    def neighbor_pairs(self) -> Pairs:
        """Each link with itself and with those that a joint connects it with.

        They touch or overlap by design; for `ignore_groups`. Links without faces are as if they
        were not there: what hangs on one is next to what that hangs on.
        """
        solid = {int(k) for k in np.unique(self.face_groups)}
        above = {child: parent for parent, child, *_ in self._joints}
        pairs = {(k, k) for k in solid}
        for child in solid:
            parent = above.get(child, -1)
            while parent >= 0 and parent not in solid:
                parent = above.get(parent, -1)
            if parent >= 0:
                pairs.add((min(child, parent), max(child, parent)))
        return tuple(sorted(pairs))

    def __call__(self, values: Float[Array, "*batch N"]) -> Float[Array, "*batch V 3"]:
        """The parts' vertices at some joint values, in radians and metres.

        Differentiation: every mode.
        """
        return jnp.vectorize(self._placed, signature="(n)->(v,3)")(jnp.asarray(values))

    def _placed(self, values):
        dtype = values.dtype
        turn = {0: jnp.eye(3, dtype=dtype)}
        place = {0: jnp.zeros(3, dtype)}
        for parent, child, origin, kind, axis, at, factor, offset in self._joints:
            origin, axis = np.asarray(origin, dtype), np.asarray(axis, dtype)
            turn[child] = turn[parent] @ origin[:3, :3]
            place[child] = turn[parent] @ origin[:3, 3] + place[parent]
            if kind not in _MOVING:
                continue
            value = factor * values[at] + offset
            if kind == "prismatic":
                place[child] = place[child] + turn[child] @ (value * axis)
            else:
                turn[child] = turn[child] @ _rotation(axis, value)
        turns = jnp.stack([turn[k] for k in range(len(self.link_names))])[self._link_of]
        places = jnp.stack([place[k] for k in range(len(self.link_names))])[self._link_of]
        return jnp.einsum("vij,vj->vi", turns, self.rest_vertices.astype(dtype)) + places


def _rotation(axis, angle):
    x, y, z = axis
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], axis.dtype)
    return (
        jnp.eye(3, dtype=axis.dtype)
        + jnp.sin(angle) * across
        + (1 - jnp.cos(angle)) * (across @ across)
    )


def load_robot(path: str | Path) -> Robot:
    """A robot's collision geometry from a URDF file, with the extra `robots` (yourdfpy).

    Boxes, cylinders and spheres become meshes; mesh files are read by trimesh, beside the URDF file
    or, for `package://`, in a folder above it. A link without collision geometry has no faces.

    Args:
        path: of the file.

    Raises:
        ImportError: yourdfpy is not installed.
        FileNotFoundError: there is no such file, or a mesh that it names is not there.
        ValueError: the file is no URDF, its joints form no tree, or it has a joint of a kind
            that has no single value (planar, floating); a mesh of a format unknown here.

    Example:
        >>> from spt_jax.io import load_robot  # doctest: +SKIP
        >>> robot = load_robot("panda.urdf")  # doctest: +SKIP
        >>> loss = lambda q: self_intersection_penalty(  # doctest: +SKIP
        ...     robot(q), robot.faces, face_groups=robot.face_groups,
        ...     ignore_groups=robot.neighbor_pairs)
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path must be a URDF file: got {str(path)!r}, which is not there.")
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(
            f"path must be a URDF file of at most {_MOST_BYTES:,} bytes: got {path.name} of "
            f"{path.stat().st_size:,}; a mesh is named by the file, not part of it."
        )
    try:
        import yourdfpy
    except ImportError:
        raise ImportError(
            "load_robot needs yourdfpy, which is not installed: pip install 'spt-jax[robots]'."
        ) from None
    try:
        ElementTree.parse(path)  # yourdfpy mends what is broken, and says nothing
        model = yourdfpy.URDF.load(
            str(path), build_scene_graph=False, load_meshes=False, load_collision_meshes=False
        ).robot
    except Exception as error:  # lxml and yourdfpy raise many kinds
        raise ValueError(f"{path.name} must be a URDF file: {error}") from error
    links, joints = _tree(model, path.name)
    moving = [joint for joint in model.joints if joint.type in _MOVING and joint.mimic is None]
    numbers = {joint.name: k for k, joint in enumerate(moving)}
    rows = tuple(_row(joint, links, numbers, path.name) for joint in joints)
    by_name = {link.name: link for link in model.links}
    meshes = [_mesh(by_name[name], path) for name in links]
    counts = [len(mesh.vertices) for mesh in meshes]
    starts = np.cumsum([0, *counts[:-1]])
    limits = np.array([_limits(joint) for joint in moving]).reshape(-1, 2)
    return Robot(
        jnp.asarray(np.concatenate([mesh.vertices for mesh in meshes]), jnp.float32),
        np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]).astype(np.int64),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
        tuple(links),
        tuple(numbers),
        limits[:, 0],
        limits[:, 1],
        np.repeat(np.arange(len(meshes)), counts),
        rows,
    )


def _tree(model: Any, name: str) -> tuple[dict[str, int], list[Any]]:
    """The links by number, the root first, and the joints, each after the one of its parent."""
    named = {link.name for link in model.links}
    children = {joint.child for joint in model.joints}
    roots = [link.name for link in model.links if link.name not in children]
    if len(roots) != 1 or len(children) != len(model.joints) or not children < named:
        raise ValueError(
            f"{name} must have joints that form one tree: got the roots {roots} and "
            f"{len(model.joints)} joints to {len(children)} links."
        )
    links, order = {roots[0]: 0}, []
    while True:
        ready = [j for j in model.joints if j.parent in links and j.child not in links]
        if not ready:
            break
        for joint in ready:
            links[joint.child] = len(links)
            order.append(joint)
    if len(links) != len(named):
        raise ValueError(f"{name} must have joints that form one tree: got a circle of them.")
    return links, order


def _row(joint: Any, links: dict[str, int], numbers: dict[str, int], name: str) -> tuple:
    if joint.type not in (*_MOVING, "fixed"):
        raise ValueError(
            f"{name} must have joints of one value each: got joint {joint.name!r} of type "
            f"{joint.type!r}; make it fixed, or move the scene's vertices yourself."
        )
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin)
    axis = np.array([1.0, 0, 0]) if joint.axis is None else np.asarray(joint.axis, np.float64)
    axis = axis / max(np.linalg.norm(axis), np.finfo(float).tiny)
    at, factor, offset = numbers.get(joint.name, -1), 1.0, 0.0
    if joint.mimic is not None:
        at = numbers.get(joint.mimic.joint, -1)
        factor, offset = float(joint.mimic.multiplier or 1.0), float(joint.mimic.offset or 0.0)
        if at < 0:
            raise ValueError(
                f"{name} must have joints that mimic moving ones: {joint.name!r} mimics "
                f"{joint.mimic.joint!r}."
            )
    rows = tuple(map(tuple, origin.tolist()))
    ends = links[joint.parent], links[joint.child]
    return (*ends, rows, joint.type, tuple(axis.tolist()), at, factor, offset)


def _limits(joint: Any) -> tuple[float, float]:
    limit = joint.limit
    if joint.type == "continuous" or limit is None:
        return -np.inf, np.inf
    low = -np.inf if limit.lower is None else float(limit.lower)
    return low, np.inf if limit.upper is None else float(limit.upper)


def _mesh(link: Any, path: Path) -> trimesh.Trimesh:
    parts = []
    for collision in link.collisions:
        shape = collision.geometry
        if shape.box is not None:
            part = trimesh.creation.box(extents=np.asarray(shape.box.size, np.float64))
        elif shape.cylinder is not None:
            part = trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length)
        elif shape.sphere is not None:
            part = trimesh.creation.icosphere(subdivisions=2, radius=shape.sphere.radius)
        else:
            part = trimesh.load_mesh(_found(shape.mesh.filename, path))
            assert isinstance(part, trimesh.Trimesh)  # of a scene, all its meshes in one
            scale = 1.0 if shape.mesh.scale is None else shape.mesh.scale
            part.vertices = part.vertices * np.asarray(scale, np.float64)
        if collision.origin is not None:
            part.apply_transform(collision.origin)
        parts.append(trimesh.Trimesh(part.vertices, part.faces))
    if not parts:
        return trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    whole: Any = trimesh.util.concatenate(parts)
    return whole


def _found(name: str, path: Path) -> Path:
    """A mesh's file: beside the URDF file, or below a folder above it."""
    inside = name.split("://", 1)[-1]
    if Path(inside).suffix.lower() not in _MESHES:
        listed = ", ".join(sorted(_MESHES))
        raise ValueError(f"{path.name} must name mesh files ({listed}): got {name!r}.")
    tails = [inside, inside.partition("/")[2]] if "://" in name else [inside]
    for folder in (path.resolve().parent, *path.resolve().parents):
        for tail in tails:
            if tail and (folder / tail).is_file():
                return folder / tail
    raise FileNotFoundError(
        f"{path.name} must name meshes that are there: got {name!r}, found neither beside it nor "
        "in a folder above it."
    )
