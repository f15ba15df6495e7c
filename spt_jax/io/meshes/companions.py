"""Files that a mesh file names: material libraries, and the textures that these name."""

import shutil
from collections.abc import Iterable
from pathlib import Path

from spt_jax.files.outputs import atomic_write

_TEXTURES = ("map_", "bump", "disp", "decal", "refl", "norm")


def copy_companions(mesh: Path, names: Iterable[str], folder: Path) -> list[str]:
    """Copy the files that a mesh names to another folder, and return those that are not there.

    Files outside of the mesh's own folder count as not there: a name must not reach anything else.
    A file that already lies in the folder stays as it is.

    Args:
        mesh: the mesh file.
        names: as it writes them, relative to its folder; an .obj may name several in one line.
        folder: where the copies go.

    Raises:
        OSError: as `atomic_write`.
    """
    home, missing = mesh.parent.resolve(), []
    wanted = [name for line in names for name in _split(home, line)]
    seen: set[str] = set()
    while wanted:
        name = wanted.pop(0)
        if name in seen:
            continue
        seen.add(name)
        source = (home / name).resolve()
        if not source.is_relative_to(home) or not source.is_file():
            missing.append(name)
            continue
        if source.suffix.lower() == ".mtl":
            wanted += _textures(source, home)
        target = folder / source.relative_to(home)
        if target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as temporary:
            shutil.copyfile(source, temporary)
    return missing


def _split(home: Path, line: str) -> list[str]:
    # Names may hold blanks, and blanks may part names.
    return [line] if (home / line).is_file() or " " not in line else line.split()


def _textures(library: Path, home: Path) -> list[str]:
    found = []
    for line in library.read_text(encoding="latin-1").splitlines():
        key, _, rest = line.strip().partition(" ")
        if not key.lower().startswith(_TEXTURES) or not rest.strip():
            continue
        # Options stand before the name, which is the last word unless it holds blanks.
        name = rest.strip() if (home / rest.strip()).is_file() else rest.split()[-1]
        found.append(name.replace("\\", "/"))
    return found
