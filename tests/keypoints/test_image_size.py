"""Sizes of images that people of keypoint files state, or that their keypoints leave."""

import numpy as np
import pytest

from spt_jax.keypoints.entries import Person
from spt_jax.keypoints.image_size import guessed_image_size, stated_image_size


def person(points, **stated):
    points = np.asarray(points, float)
    return Person(points, np.ones(len(points)), "coco17", image="a.jpg", **stated)


def test_the_size_that_the_file_states():
    silent, stating = person([[1, 2]]), person([[1, 2]], width=640, height=480)
    assert stated_image_size([silent, stating, stating]) == (640, 480)
    assert stated_image_size([silent]) is None


def test_people_of_one_image_do_not_state_two_sizes():
    people = [person([[1, 2]], width=w, height=480) for w in (640, 1280)]
    with pytest.raises(ValueError, match=r"got 640 by 480 and 1280 by 480 pixels for 'a\.jpg'"):
        stated_image_size(people)


def test_as_much_room_after_the_keypoints_as_before_them():
    assert guessed_image_size([person([[10, 20]]), person([[300, 400.5]])]) == (310, 421)
    assert guessed_image_size([person([[1, 2], [3, 4]])]) == (64, 64)
