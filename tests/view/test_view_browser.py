"""The live view in a real browser: headless Chromium opens it, bends a joint and sets it free.

SPT_JAX_VIEW_PICTURE=benchmarks/figures/view.png has it leave the README's picture.
"""

import contextlib
import http.server
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
import trimesh

from spt_jax.io.mesh_files import read_mesh
from spt_jax.io.pose_files import read_poses

pytest.importorskip("viser", reason="the live view needs viser")

import viser
from helpers_view import served

playwright = pytest.importorskip(
    "playwright.sync_api", reason="the browser test needs playwright: pip install playwright"
)

_CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
_ARGUMENTS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
)
_SECONDS = 90  # for what takes about ten on an idle core

pytestmark = pytest.mark.skipif(
    _CHROMIUM is None, reason="no Chromium is installed: apt-get install chromium"
)


@pytest.fixture
def url():
    """Where `spt-jax view` serves, which ends by Ctrl-C with exit code 0."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "spt_jax", "view", "--port", str(port)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith(f"open http://127.0.0.1:{port}/?token="), line
        yield line.split()[1]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def opened_page(width, height, *arguments):
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=_CHROMIUM, args=[*_ARGUMENTS, *arguments])
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(1000 * _SECONDS)
            yield page
        finally:
            browser.close()


@pytest.fixture
def page(url):
    picture = "SPT_JAX_VIEW_PICTURE" in os.environ
    width, height = (1160, 740) if picture else (700, 500)  # software draws the pixels
    with opened_page(width, height) as page:
        page.goto(url)
        page.wait_for_selector("#spt-figures")
        yield page


def volume(page):
    return float(page.get_attribute("#spt-figures", "data-volume"))


def wait_for_volume(page, condition):
    page.wait_for_function(
        f"(v => {condition})(Number(document.querySelector('#spt-figures').dataset.volume))"
    )


def type_into(page, label, number):
    """Into the box beside a slider, as a person would."""
    box = page.locator(
        f"xpath=//label[text()='{label}']/ancestor::div[contains(@class,'mantine-Flex-root')][1]"
        "//input[contains(@class,'NumberInput-input')]"
    )
    box.fill(str(number))
    box.press("Tab")


def test_a_joint_bent_in_the_browser_comes_free(page, tmp_path):
    first = volume(page)
    assert 1e-4 < first < 3e-4  # 193 cm^3: a fist in the belly
    assert "cm³" in page.inner_text("#spt-figures")
    _leave_picture(page)

    type_into(page, "z (degrees)", 80)
    wait_for_volume(page, f"v > 0 && v != {first!r}")
    bent = volume(page)
    assert "192.87" not in page.inner_text("#spt-figures")

    page.evaluate(
        "window.seen = []; window.look = () => {"
        " const f = document.querySelector('#spt-figures').dataset;"
        " seen.push([f.status, Number(f.volume)]); setTimeout(look, 30); }; look()"
    )
    page.get_by_role("button", name="Untangle").click()
    page.wait_for_function(
        "/^(intersection-free|not inters|That)/"
        ".test(document.querySelector('#spt-figures').dataset.status)"
    )
    assert page.get_attribute("#spt-figures", "data-status") == "intersection-free"
    assert volume(page) == 0
    assert page.inner_text("#spt-figures").startswith("0.00 cm³")
    steps = {at for status, at in page.evaluate("seen") if "step" in status}
    assert len(steps) >= 3 and min(steps) < bent  # it was seen to come free, step by step

    with page.expect_download() as saved:
        page.get_by_role("button", name="Save GLB").click()
    saved.value.save_as(tmp_path / "body.glb")
    assert len(read_mesh(tmp_path / "body.glb")[1]) == 24_540
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save pose").click()
    saved.value.save_as(tmp_path / "pose.npz")
    pose = read_poses(tmp_path / "pose.npz").pose
    assert pose.shape == (1, 52, 3) and np.abs(pose).max() > 0.1

    (tmp_path / "broken.npz").write_bytes(b"not an archive")
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="Open a file").click()
    chooser.value.set_files(tmp_path / "broken.npz")
    page.get_by_text("must be an .npz archive: got 'broken.npz'").first.wait_for()
    assert volume(page) == 0  # what was shown is still there

    page.get_by_role("button", name="Reset").click()
    wait_for_volume(page, f"Math.abs(v - {first!r}) < 1e-9")


def _leave_picture(page):
    path = os.environ.get("SPT_JAX_VIEW_PICTURE")
    if not path:
        return
    for close in page.locator(".mantine-Notification-closeButton").all():  # of software WebGL
        close.click()
    page.wait_for_timeout(3000)
    page.screenshot(path=path)


@contextlib.contextmanager
def http_server_with(text):
    """The port of a server whose every page holds this."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


# What a page of another site can try. Even the token, which it cannot know, does not help it.
_ATTACK = """
async address => {
    const heard = await new Promise(done => {
        const socket = new WebSocket("ws://" + address, ["viser-v" + VERSION]);
        socket.onmessage = () => done("message");
        socket.onopen = () => done("open");
        socket.onclose = event => done("closed " + event.code);
    });
    const read = await fetch("http://" + address).then(r => r.text(), e => e.name);
    return [heard, read];
}
"""


def test_a_page_of_another_site_does_not_reach_the_view(tmp_path):
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "ball.ply")
    rebound = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    # Chromium would ask the user first whether the site may look for this machine's servers.
    permitted = "--disable-features=LocalNetworkAccessChecks"
    with served(tmp_path / "ball.ply") as view, opened_page(300, 200, rebound, permitted) as page:
        port, query = view.server.get_port(), f"?token={view.access.token}"
        attack = _ATTACK.replace("VERSION", json.dumps(viser.__version__))
        with http_server_with("<p>evil</p>") as evil:
            page.goto(f"http://127.0.0.1:{evil}")  # another site by its port alone
            heard, read = page.evaluate(attack, f"127.0.0.1:{port}/{query}")
            assert (heard, read) == ("closed 1006", "TypeError")
            page.goto(f"http://evil.example:{evil}")
            heard, read = page.evaluate(attack, f"127.0.0.1:{port}/{query}")
            assert (heard, read) == ("closed 1006", "TypeError")
        # The same name, made to resolve to this machine: the view's page would be of its own site.
        answer = page.goto(f"http://evil.example:{port}/{query}")
        assert answer.status == 403 and "Host must name this machine" in page.content()
        heard, read = page.evaluate(attack, f"evil.example:{port}/{query}")
        assert heard == "closed 1006" and read.startswith("Host must name this machine")
        assert not view.server._websock_server._live_connections
        page.goto(view.url)  # and its own page does
        page.wait_for_selector("#spt-figures")
