"""What data sets call their keypoints, in this package's names."""

import re
from collections.abc import Mapping, Sequence

from spt_jax.keypoints.body_tables import BODIES
from spt_jax.keypoints.whole_tables import WHOLE_BODIES

# Names of Human3.6M's 17 points in MMPose (configs/_base_/datasets/h36m.py).
_ALIASES: dict[str, tuple[str, ...]] = {
    "h36m17": (
        *("root", "right_hip", "right_knee", "right_foot", "left_hip", "left_knee", "left_foot"),
        *("spine", "thorax", "neck_base", "head", "left_shoulder", "left_elbow", "left_wrist"),
        *("right_shoulder", "right_elbow", "right_wrist"),
    ),
}

_LEFT, _RIGHT = ("left", "l", "lft", "lt"), ("right", "r", "rgt", "rt")
# By part, without case, spaces and underscores; those of both sides.
_PAIRED: dict[str, tuple[str, ...]] = {
    "eye": ("eye", "eyes"),
    "ear": ("ear", "ears"),
    "shoulder": ("shoulder", "sho", "shou", "shld", "shldr"),
    "elbow": ("elbow", "elb", "elbo"),
    "wrist": ("wrist", "wri", "wrst"),
    "hip": ("hip", "hips"),
    "knee": ("knee", "kne"),
    "ankle": ("ankle", "ank", "ankl"),
    "foot": ("foot",),
    "big_toe": ("bigtoe", "toe", "toes", "footindex", "hallux"),
    "small_toe": ("smalltoe", "littletoe", "pinkytoe"),
    "heel": ("heel",),
    "collar": ("collar", "clavicle"),
    "hand": ("hand",),
    "hand_root": ("handroot",),
    "middle_tip": ("finger",),
}
_MIDDLE: dict[str, tuple[str, ...]] = {
    "nose": ("nose",),
    "head": ("head", "headcenter", "headcentre"),
    "head_top": ("headtop", "tophead", "topofhead", "topofthehead"),
    "neck": ("neck",),
    "upper_neck": ("upperneck", "headbottom", "bottomhead", "headbase"),
    "thorax": ("thorax", "chest", "sternum"),
    "spine": ("spine", "belly", "torso", "spinemid", "midspine"),
    "pelvis": ("pelvis", "root", "midhip", "hip", "hips", "hipcenter", "hipcentre", "lowerback"),
    "jaw": ("jaw",),
    "spine1": ("spine1",),
    "spine2": ("spine2",),
    "spine3": ("spine3",),
}
_FINGERS: dict[str, tuple[str, ...]] = {
    "thumb": ("thumb",),
    "index": ("index", "indexfinger", "forefinger"),
    "middle": ("middle", "middlefinger"),
    "ring": ("ring", "ringfinger"),
    "pinky": ("pinky", "pinkyfinger", "little", "littlefinger"),
}
# Of a finger from the palm: MediaPipe's words for its joints, and numbers; SMPL counts joints.
_KNUCKLES = {"1": "1", "2": "2", "3": "3", "4": "_tip", "tip": "_tip"}
_KNUCKLES |= {"mcp": "1", "pip": "2", "dip": "3"}
_THUMB = {**_KNUCKLES, "cmc": "1", "mcp": "2", "ip": "3"}


def _table() -> dict[tuple[str, str], str]:
    """By side, "" for the middle, and word: the name."""
    known = {("", word): name for name, words in _MIDDLE.items() for word in words}
    for side in ("left", "right"):
        for name, words in _PAIRED.items():
            known |= {(side, word): f"{side}_{name}" for word in words}
        for finger, words in _FINGERS.items():
            joints = _THUMB if finger == "thumb" else _KNUCKLES
            known |= {
                (side, word + joint): f"{side}_{finger}{at}"
                for word in words
                for joint, at in joints.items()
            }
    return known


_KNOWN = _table()


def known_name(name: str) -> str | None:
    """This package's name of a keypoint; None where it is not known.

    Example:
        >>> from spt_jax.keypoints.vocabulary import known_name
        >>> [known_name(name) for name in ("RBigToe", "lsho", "Left Wrist", "top_head", "tail")]
        ['right_big_toe', 'left_shoulder', 'left_wrist', 'head_top', None]
    """
    words = [word.lower() for word in _words(name)]
    whole = "".join(words)
    if ("", whole) in _KNOWN:
        return _KNOWN["", whole]
    for side, letters in (("left", _LEFT), ("right", _RIGHT)):
        for at in (0, -1):
            if len(words) > 1 and words[at] in letters:
                rest = "".join(words[1:] if at == 0 else words[:-1])
                if (side, rest) in _KNOWN:
                    return _KNOWN[side, rest]
        # A letter that is not set apart, as in "lwri" and "ankleR".
        for rest in (whole.removeprefix(letters[1]), whole.removeprefix(letters[0])):
            if rest != whole and (side, rest) in _KNOWN:
                return _KNOWN[side, rest]
    return None


def _words(name: str) -> list[str]:
    parts = re.split(r"[^A-Za-z0-9]+", name)
    pattern = r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+"
    return [word for part in parts for word in re.findall(pattern, part)]


def places_of(
    names: Sequence[str], given: Mapping[str, str] | None = None
) -> tuple[str | None, ...]:
    """This package's name of each keypoint of a list; None of those that are not known.

    Args:
        names: as a file has them.
        given: by this package's names, the file's: what the user says of some of them.

    Returns:
        The names; "foot" is the ankle where the list has no ankle, as in Human3.6M's.

    Raises:
        ValueError: two keypoints with one name; one given that is not in the list, or under a name
            that is not this package's.

    Example:
        >>> from spt_jax.keypoints.vocabulary import places_of
        >>> places_of(("LWri", "snout"), {"nose": "snout"})
        ('left_wrist', 'nose')
    """
    said = {}
    for own, theirs in (given or {}).items():
        known = known_name(own)
        if known is None:
            raise ValueError(
                f"map must give names of keypoints such as left_wrist=lwri: got {own!r}, which is "
                "none of this package's."
            )
        if theirs not in names:
            raise ValueError(
                f"map must name keypoints of the file: got {theirs!r}; it has {', '.join(names)}."
            )
        said[theirs] = known
    found = [said.get(name) or known_name(name) for name in names]
    for side in ("left", "right"):
        if f"{side}_ankle" not in found:
            found = [f"{side}_ankle" if name == f"{side}_foot" else name for name in found]
    for k, name in enumerate(found):
        if name is not None and name in found[:k]:
            raise ValueError(
                f"keypoints must have different names: got {names[found.index(name)]!r} "
                f"and {names[k]!r}, both {name}; say which with a map."
            )
    return tuple(found)


def layout_of(names: Sequence[str]) -> str | None:
    """The layout that lists exactly these keypoints; None without any.

    Example:
        >>> from spt_jax.keypoints.vocabulary import layout_of
        >>> layout_of(("nose", "head_bottom", "head_top")), layout_of(("nose",))
        (None, None)
    """
    listed = tuple(names)
    for layout in (*BODIES, *WHOLE_BODIES):
        if listed in (layout.names, layout.official, _ALIASES.get(layout.name)):
            return layout.name
    return None
