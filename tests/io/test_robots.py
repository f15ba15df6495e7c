"""Robots from URDF files: places of links, joints, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from spt_jax import self_intersection_penalty
from spt_jax.io import load_robot

ARM = """<robot name="arm">
  <link name="base"><collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision></link>
  <link name="upper"><collision><origin xyz="0.5 0 0"/>
    <geometry><box size="0.8 0.1 0.1"/></geometry></collision></link>
  <link name="fore"><collision><origin xyz="0.5 0 0"/>
    <geometry><mesh filename="package://arm/fore.stl" scale="2 1 1"/></geometry></collision></link>
  <link name="tool"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="slave"/>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="1 0 0"/><axis xyz="0 0 2"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="fore"/><child link="tool"/>
    <origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="copied" type="revolute"><parent link="base"/><child link="slave"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
    <mimic joint="elbow" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "arm").mkdir()
    trimesh.creation.box(extents=(0.4, 0.1, 0.1)).export(tmp_path / "arm" / "fore.stl")
    (tmp_path / "arm" / "arm.urdf").write_text(ARM)
    return load_robot(tmp_path / "arm" / "arm.urdf")


def centers(robot, values):
    vertices = np.asarray(robot(jnp.asarray(values, jnp.float32)))
    used = [np.unique(robot.faces[robot.face_groups == k]) for k in range(5)]
    names = robot.link_names
    return {names[k]: vertices[used[k]].mean(axis=0) for k in range(5) if len(used[k])}


def test_links_are_where_their_joints_say(robot):
    assert robot.joint_names == ("elbow", "shoulder", "slide")
    np.testing.assert_array_equal(robot.lower, [-3, -np.inf, 0])
    found = centers(robot, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(found["upper"], [0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found["fore"], [1.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found["tool"], [2, 0, 0], atol=1e-6)
    found = centers(robot, [np.pi / 2, np.pi / 2, 0.25])
    np.testing.assert_allclose(found["upper"], [0, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(found["fore"], [-0.5, 1, 0], atol=1e-6)
    # The tool's y axis points back along the forearm: turned by a quarter at its joint.
    np.testing.assert_allclose(found["tool"], [-0.75, 1, 0], atol=1e-6)


def test_links_that_a_joint_connects_do_not_count(robot):
    def loss(values):
        return self_intersection_penalty(
            robot(values),
            robot.faces,
            face_groups=robot.face_groups,
            ignore_groups=robot.neighbor_pairs,
        )

    assert loss(jnp.zeros(3)) == 0
    folded = jnp.array([3.0, 0.0, 0.0])  # the tool in the base
    value, gradient = jax.value_and_grad(loss)(folded)
    assert value > 1e-4 and abs(gradient[0]) > 0
    further = loss(folded.at[0].add(0.01)) - loss(folded.at[0].add(-0.01))
    np.testing.assert_allclose(gradient[0], further / 0.02, rtol=0.05)
    assert robot(jnp.stack([folded, 0 * folded])).shape == (2, len(robot.rest_vertices), 3)


@pytest.mark.parametrize(
    ("old", "new", "error", "match"),
    [
        ('type="prismatic"', 'type="floating"', ValueError, "one value each: got joint 'slide'"),
        ("fore.stl", "gone.stl", FileNotFoundError, "meshes that are there: got 'package"),
        ("fore.stl", "fore.py", ValueError, "must name mesh files"),
        ('<child link="tool"/>', '<child link="upper"/>', ValueError, "form one tree"),
        ("</robot>", "", ValueError, "must be a URDF file"),
    ],
)
def test_what_is_refused(tmp_path, old, new, error, match):
    trimesh.creation.box().export(tmp_path / "fore.stl")
    (tmp_path / "arm.urdf").write_text(ARM.replace(old, new))
    with pytest.raises(error, match=match):
        load_robot(tmp_path / "arm.urdf")
    with pytest.raises(FileNotFoundError, match="not there"):
        load_robot(tmp_path / "none.urdf")
