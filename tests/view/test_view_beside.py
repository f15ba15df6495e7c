"""A motion and what became of it, side by side in the live view."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="the live view needs viser")

from helpers_view import SECONDS, Browser, served, wait_until

from spt_jax.cli import main as cli
from spt_jax.io.pose_files import write_poses
from spt_jax.view.server import View


@pytest.fixture(scope="module")
def pose_files(tmp_path_factory):
    """Arms that swing in front of the chest, and the same motion at rest."""
    folder = tmp_path_factory.mktemp("beside")
    pose = np.zeros((6, 22, 3), np.float32)
    pose[:, 18, 1] = np.linspace(-1.0, -2.0, 6)
    for name, poses in (("before", pose), ("after", 0.5 * pose), ("short", pose[:4])):
        write_poses(folder / f"{name}.npz", poses)
    return folder


def test_two_files_stand_side_by_side_and_play_frame_by_frame(pose_files):
    before, after = pose_files / "before.npz", pose_files / "after.npz"
    with served(before, beside=after) as view, Browser(view) as browser:
        assert view._beside is not None
        browser.set("Frame", 3)
        wait_until(lambda: view._status.endswith("3"))
        assert view.worker.wait_until_idle(SECONDS)
        np.testing.assert_allclose(view._beside.scene.pose, 0.5 * view.scene.pose, atol=1e-6)
        assert "after.npz" in view.panel._beside.content
        meshes = view._stage._meshes
        first, second = meshes["/surface/clear"].vertices, meshes["/beside/clear"].vertices
        assert np.linalg.norm(second.mean(axis=0) - first.mean(axis=0)) > 0.5  # metres
        seen = set()
        browser.set("Play", True)
        wait_until(lambda: seen.add(int(view.panel.frame.value)) or len(seen) > 3)
        browser.set("Play", False)
        # Another motion has nothing beside it; the first one has, again.
        browser.set("Motion", "walk")
        wait_until(lambda: not view._stage._meshes["/beside/clear"].visible)
        browser.set("Motion", "before.npz")
        wait_until(lambda: view._stage._meshes["/beside/clear"].visible)


@pytest.mark.slow
def test_a_motion_untangled_in_the_view_stands_beside(pose_files):
    with served(None) as view, Browser(view) as browser:
        browser.set("Motion", "walk")
        wait_until(lambda: view._status.startswith("walk/"))
        view._motions["walk"] = files_cut(view._motions["walk"], slice(0, 12))
        browser.send(
            {
                "type": "GuiUpdateMessage",
                "uuid": browser.widget("Untangle motion"),
                "updates": {"value": True},
            }
        )
        wait_until(lambda: view._beside is not None)
        assert view.worker.wait_until_idle(SECONDS)
        assert view._status.startswith("12 of 12 frames are free")


def files_cut(frames, chosen):
    from dataclasses import replace

    return replace(frames, names=frames.names[chosen], pose=frames.pose[chosen])


def test_what_does_not_fit_beside_is_refused(pose_files, tmp_path, capsys):
    with pytest.raises(ValueError, match=r"as many frames as file: got 6 .* and 4"):
        View(pose_files / "before.npz", beside=pose_files / "short.npz", port=0)
    with pytest.raises(ValueError, match="beside must be poses"):
        View(None, beside=pose_files / "short.npz", port=0)
    gone = str(pose_files / "gone.npz")
    assert cli.main(["view", str(pose_files / "before.npz"), "--beside", gone]) == 2
    assert "gone.npz" in capsys.readouterr().err
