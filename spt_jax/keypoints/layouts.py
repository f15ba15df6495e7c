"""The orders in which data sets and detectors list keypoints, in one vocabulary of names."""

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.keypoints.body_tables import BODIES
from spt_jax.keypoints.layout import USUAL_PLACES, Layout, make_layout
from spt_jax.keypoints.vocabulary import places_of
from spt_jax.keypoints.whole_tables import WHOLE_BODIES

#: Every layout by its name.
LAYOUTS: dict[str, Layout] = {layout.name: layout for layout in (*BODIES, *WHOLE_BODIES)}


def layouts_of_count(count: int) -> list[str]:
    """The names of the layouts of that many keypoints."""
    return [name for name, layout in LAYOUTS.items() if len(layout.names) == count]


def as_layout(name: str, count: int | None = None) -> Layout:
    """The layout of that name; "smpl" is SMPL's with `count` joints.

    Args:
        name: a key of LAYOUTS, "smpl", or names of keypoints with commas between them, in any of
            the vocabularies that files are read by.
        count: how many keypoints there are, where that is known.

    Returns:
        The layout, which has `count` keypoints.

    Raises:
        TypeError: `name` is no string.
        ValueError: an unknown name; "smpl" without a count or with one that no body of the family
            has; another count than the layout's; a keypoint that is not known, or twice in a list.

    Example:
        >>> from spt_jax.keypoints.layouts import as_layout
        >>> as_layout("smpl", 24).names[22], as_layout("body25").names[8]
        ('left_hand', 'pelvis')
        >>> as_layout("LWri,head_bottom").names
        ('left_wrist', 'upper_neck')
    """
    if not isinstance(name, str):
        raise TypeError(f"a layout must be named by a string: got {name!r}.")
    if name == "smpl":
        if count not in SMPL_LAYOUTS:
            counts = ", ".join(str(known) for known in SMPL_LAYOUTS)
            raise ValueError(
                f'layout "smpl" must have {counts} keypoints: got '
                f'{"no count" if count is None else count}; write "smpl24" for SMPL\'s own.'
            )
        return LAYOUTS[f"smpl{count}"]
    if name not in LAYOUTS and "," not in name:
        known = ", ".join(f'"{key}"' for key in LAYOUTS)
        raise ValueError(
            f'layout must be one of {known}, "smpl" or a list of keypoints with commas between '
            f"them: got {name!r}."
        )
    layout = LAYOUTS[name] if name in LAYOUTS else _listed(name)
    if count is not None and count != len(layout.names):
        raise ValueError(
            f"layout {name} has {len(layout.names)} keypoints: got {count}; name the layout in "
            "which your keypoints are."
        )
    return layout


def _listed(name: str) -> Layout:
    """The layout of a list of keypoints with commas between them."""
    given = [word.strip() for word in name.split(",")]
    found = places_of(given)
    unknown = [word for word, place in zip(given, found, strict=True) if place is None]
    if unknown:
        raise ValueError(
            f"layout must list keypoints that are known: got {', '.join(map(repr, unknown[:5]))}; "
            f"they are called {', '.join(LAYOUTS['halpe26'].names)} and the like."
        )
    places = [place for place in found if place is not None]
    ends = {place: k for k, place in enumerate(places)}
    edges = [(ends[a], ends[b]) for a, b in dict.fromkeys(_LINES) if a in ends and b in ends]
    at = {**USUAL_PLACES, "head": "mid_face"}
    return make_layout(name, places, edges, given, at=at)


# Lines of pictures, by the names of their ends.
_LINES = [
    (layout.names[a], layout.names[b])
    for layout in map(LAYOUTS.__getitem__, ("body25_hands", "coco17", "mpii16", "h36m17"))
    for a, b in layout.edges
]
