"""The people of a keypoint file, each with an image and a camera, for `spt-jax fit`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.cli.motions import select_frames
from spt_jax.files.archives import read_npz
from spt_jax.files.limits import read_json

if TYPE_CHECKING:
    from spt_jax._camera import PinholeCamera
    from spt_jax.keypoints import KeypointFile, Person

_SUFFIXES = (".jpg", ".jpeg", ".png", ".JPG", ".JPEG", ".PNG")
_DISTORTION = ("dist", "k1", "k2", "k3", "p1", "p2", "radial", "tangential")


@dataclass(frozen=True)
class Annotated:
    """One person of the file.

    Attributes:
        name: "IMAGE/ROW", the row counted from 0 over all people of the file.
        person: the keypoints.
        image: the image's name without its suffix; people of one image share it.
        size: (width, height) of the image, or what the points suggest.
        photograph: the file, or None.
        camera: of the image.
        camera_source: "file", "options", or "estimated".
    """

    name: str
    person: "Person"
    image: str
    size: tuple[int, int]
    photograph: Path | None
    camera: "PinholeCamera"
    camera_source: str


def gather(
    path: Path,
    file: "KeypointFile",
    *,
    people: str,
    image: Path | None,
    camera: Path | None,
    focal: float | None,
    center: tuple[float, float] | None,
    max_bytes: int | None = None,
) -> tuple[list[Annotated], list[str]]:
    """The people asked for, and what is to be noted about them.

    `max_bytes` is what the camera's file, and the pixels of a photograph, may take.

    Raises:
        ValueError, TypeError, OSError: people that the file lacks, a camera or an image that is
            none, photographs of another size than the file says.
    """
    if not file.people:
        left = ", ".join(f"{count} with {why}" for why, count in file.skipped.items())
        raise ValueError(f"{path} must hold people with visible points: got {left or 'nobody'}.")
    if camera is not None and (focal is not None or center is not None):
        raise ValueError("camera must be given as a file, or by focal and center: got both.")
    given = None if camera is None else read_camera(camera, max_bytes=max_bytes)
    images = _image_names([person.image for person in file.people], path)
    names = [f"{image_name}/{row}" for row, image_name in enumerate(images)]
    rows = select_people(names, images, people)
    notes = [f"left out: {count} people with {why}" for why, count in file.skipped.items()]
    notes += [f"{path}: {note}" for note in file.notes]

    from spt_jax.show.overlay import LARGEST

    photographs, sizes = {}, {}
    for row in rows:
        if images[row] not in photographs:
            found = _photograph(image, file.people[row].image, len(set(images)))
            if image is not None and found is None:
                notes.append(f"no photograph of {images[row]} in {image}; a blank canvas is drawn")
            same = [p for p, name in zip(file.people, images, strict=True) if name == images[row]]
            width, height = sizes[images[row]] = _size(images[row], same, found, max_bytes)
            if found is not None and not 16 <= min(width, height) <= max(width, height) <= LARGEST:
                notes.append(f"{found} is {width} by {height} pixels; a blank canvas is drawn")
                found = None
            photographs[images[row]] = found
    gathered = []
    for row in rows:
        size = sizes[images[row]]
        made, source = (given, "file") if given else _camera(size, focal, center)
        gathered.append(
            Annotated(
                names[row],
                file.people[row],
                images[row],
                size,
                photographs[images[row]],
                made,
                source,
            )
        )
    return gathered, notes


def as_map(text: str | None) -> dict[str, str] | None:
    """What `--map left_wrist=lpaw,nose=snout` says.

    Raises:
        ValueError: it says something else.
    """
    if text is None:
        return None
    pairs = [tuple(side.strip() for side in item.split("=")) for item in text.split(",")]
    for pair in pairs:
        if len(pair) != 2 or not all(pair):
            raise ValueError(
                f"map must be such as left_wrist=lpaw,nose=snout: got {'='.join(pair)!r} in "
                f"{text!r}."
            )
    if len({own for own, _ in pairs}) < len(pairs):
        raise ValueError(f"map must say each name once: got {text!r}.")
    return {pair[0]: pair[1] for pair in pairs}


def of_the_body(
    people: Sequence[Annotated], placed: Mapping[str, tuple[bool, ...] | None]
) -> tuple[list[Annotated], list[str]]:
    """The people without the points that lie nowhere on the body, and a note where there are any.

    Args:
        people: those gathered.
        placed: of each layout, whether each of its points lies on the body; None where all do.

    Raises:
        ValueError: somebody has no other points.
    """
    kept, lost = [], 0
    for one in people:
        there = placed[one.person.layout]
        trust = one.person.confidence
        if there is not None:
            trust = np.where(np.array(there), trust, 0.0)
            lost += int(np.sum((trust == 0) & (one.person.confidence > 0)))
            if not trust.any():
                raise ValueError(
                    f"the body must have what is seen of {one.name}: got points of fingers alone, "
                    "on a body without; choose another --body, or other --people."
                )
        kept.append(replace(one, person=one.person._replace(confidence=trust)))
    return kept, [f"points of fingers, which the body has not: {lost}"] if lost else []


def tracks_of(people: Sequence[Annotated]) -> dict[str, int]:
    """The number of each person's track in a sequence, by the person's name."""
    from spt_jax.keypoints import find_tracks

    tracks = find_tracks([one.person for one in people])
    return {people[row].name: number for number, rows in enumerate(tracks) for row in rows}


def read_camera(path: Path, *, max_bytes: int | None = None) -> "PinholeCamera":
    """The camera of a .json or .npz file: `matrix` (3, 4), or `focal` and `center`.

    `rotation` (3, 3) and `translation` (3,), from the world to the camera, may stand beside `focal`
    and `center`; a .json file may hold the matrix alone. `max_bytes` is what the file may take.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError, TypeError: it holds no camera; the message names the file and the entry.
    """
    from spt_jax._camera import PinholeCamera

    what = "camera file"
    if path.suffix.lower() == ".npz":
        content: Any = read_npz(path, what=what, max_bytes=max_bytes).arrays
    else:
        content = read_json(path, what, max_bytes=max_bytes)
    content = {"matrix": content} if isinstance(content, list) else content
    if not isinstance(content, dict) or not (
        "matrix" in content or {"focal", "center"} <= set(content)
    ):
        seen = sorted(content) if isinstance(content, dict) else type(content).__name__
        raise ValueError(
            f"camera file {path} must hold a 3 x 4 matrix, or focal and center: got {seen}."
        )
    for name in content:
        if name.startswith(_DISTORTION) and np.any(np.asarray(content[name], object) != 0):
            raise ValueError(
                f"camera file {path} must have no distortion: got {name!r}; undistort the "
                "keypoints first, and leave it out."
            )
    try:
        if "matrix" in content:
            return PinholeCamera.from_matrix(np.asarray(content["matrix"]))
        names = ("focal", "center", "rotation", "translation")
        parts: list[Any] = [content.get(name) for name in names]
        return PinholeCamera(*(part if part is None else np.asarray(part) for part in parts))
    except (TypeError, ValueError) as error:
        raise ValueError(f"camera file {path}: {error}") from error


def select_people(names: Sequence[str], images: Sequence[str], wanted: str) -> list[int]:
    """Rows of the people asked for: "all", names, images, rows and ranges of them.

    Raises:
        ValueError: something that is none of these.
    """
    rows: list[int] = []
    for item in map(str.strip, wanted.split(",")):
        if item in images and item not in names:
            rows += [row for row, image in enumerate(images) if image == item]
            continue
        try:
            rows += select_frames(names, item)
        except ValueError as error:
            raise ValueError(str(error).replace("frames must", "people must", 1)) from error
    return list(dict.fromkeys(rows))


def _image_names(images: Sequence[str | int | None], path: Path) -> list[str]:
    """A name for each person's image: without folder and suffix, if those are unique."""
    short = {
        image: path.stem
        if image is None
        else Path(image).stem
        if isinstance(image, str)
        else f"{image}"
        for image in dict.fromkeys(images)
    }
    taken = list(short.values())
    names = {
        image: re.sub(r"[^\w.-]+", "_", stem if taken.count(stem) == 1 else f"{image}").lstrip(".")
        or "image"
        for image, stem in short.items()
    }
    return [names[image] for image in images]


def _photograph(given: Path | None, image: str | int | None, count: int) -> Path | None:
    if given is None:
        return None
    if given.is_file():
        if count > 1:
            raise ValueError(
                f"image must be a folder for a file of {count} images: got {str(given)!r}."
            )
        return given
    if not given.is_dir():
        raise FileNotFoundError(f"image must exist: got {str(given)!r}; check the spelling.")
    # COCO's results name an image by its id, its files by that in twelve digits.
    stems = [f"{image:012d}", f"{image}"] if isinstance(image, int) else [f"{image}"]
    names = [stem + suffix for stem in stems for suffix in ("", *_SUFFIXES)]
    return next((given / name for name in names if (given / name).is_file()), None)


def _size(
    image: str, people: Sequence["Person"], photograph: Path | None, max_bytes: int | None
) -> tuple[int, int]:
    """Of the file, else of the photograph, else of an image with the points in its middle."""
    from spt_jax.keypoints.image_size import guessed_image_size, stated_image_size

    stated = stated_image_size(people)
    seen = None if photograph is None else _photograph_size(photograph, max_bytes)
    if seen is not None:
        width, height = seen
        if stated is not None and stated != (width, height):
            raise ValueError(
                f"the photograph of {image} must be {stated[0]} by {stated[1]} pixels, as the "
                f"keypoint file says: got {width} by {height} in {photograph}."
            )
        return width, height
    return stated or guessed_image_size(people)


def _photograph_size(path: Path, max_bytes: int | None) -> tuple[int, int] | None:
    from spt_jax.show.overlay import read_image

    try:
        height, width, _ = read_image(path, max_bytes=max_bytes).shape
    except ImportError:  # without Pillow no picture is drawn; that says why
        return None
    return width, height


def _camera(
    size: tuple[int, int], focal: float | None, center: tuple[float, float] | None
) -> tuple["PinholeCamera", str]:
    from spt_jax._camera import PinholeCamera

    width, height = map(float, size)
    estimated = PinholeCamera.from_field_of_view(width, height)
    if focal is None and center is None:
        return estimated, "estimated"
    middle = (width / 2, height / 2) if center is None else center
    return PinholeCamera(float(estimated.focal[0]) if focal is None else focal, middle), "options"
