"""Who gets into the live view: real requests and sockets, with what an attacker could send."""

import contextlib
import logging
import re
import socket
from types import SimpleNamespace

import pytest
import trimesh
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus

pytest.importorskip("viser", reason="the live view needs viser")

from helpers_view import Browser, open_socket, page, path_of, port_of, served, wait_until
from viser._messages import ShareUrlRequest

from spt_jax.cli import main as cli
from spt_jax.view.access import access_for, free_port
from spt_jax.view.guarded import start_guarded


@pytest.fixture(scope="module")
def view(tmp_path_factory):
    path = tmp_path_factory.mktemp("access") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=1).export(path)
    with served(path) as running:
        yield running


def verdict(access, *, query="", host="127.0.0.1:8080", origin=()):
    headers = Headers()
    for value in (host,) if isinstance(host, str) else host:
        headers["Host"] = value
    for value in origin:
        headers["Origin"] = value
    return access.refusal(f"/{query or f'?token={access.token}'}", headers)


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "localhost:9999", "LOCALHOST", "[::1]:1", "localhost.:80"]
)
def test_this_machine_s_own_names_are_let_in_at_any_forwarded_port(host):
    access, _ = access_for("127.0.0.1")
    assert verdict(access, host=host) is None
    assert verdict(access, host=host, origin=[f"http://{host.lower()}"]) is None


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example"),
        *("192.168.1.5:8080", "8.8.8.8", "[2001:db8::1]:8080", "0.0.0.0:8080"),
        *("", ":8080", "127.0.0.1:8080@evil.example", "127.0.0.1/evil", "127.0.0.1:99999999"),
        *("127.0.0.1\t", "127.0.0.1 evil", "localhost\u00e9", "[::1", "127.0.0.1:"),
        *((), ("127.0.0.1:8080", "127.0.0.1:8080"), ("127.0.0.1:8080", "evil.example")),
    ],
)
def test_any_other_host_is_refused(host):
    access, _ = access_for("127.0.0.1")
    assert verdict(access, host=host).startswith("Host must name this machine: got ")


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "null", "", "file://", "https://127.0.0.1:8080"),
        *("http://127.0.0.1:8081", "http://127.0.0.1", "http://localhost:8080"),
        *("http://127.0.0.1:8080.evil.example", "http://127.0.0.1:8080/", "ws://127.0.0.1:8080"),
    ],
)
def test_any_other_origin_is_refused(origin):
    access, _ = access_for("127.0.0.1")
    assert verdict(access, origin=["http://127.0.0.1:8080"]) is None
    assert verdict(access, origin=[origin]).startswith("Origin must be the view's own page: got ")
    assert verdict(access, origin=["http://127.0.0.1:8080", origin]) is not None


@pytest.mark.parametrize(
    "query",
    [
        *("?", "?token=", "?token=0", "?other={token}", "?token={token}0", "?Token={token}"),
        *("?token={token}&token={token}", "?token=%FF", "?token=%ED%A0%80", "?token=\u00e9"),
        "?" + "a=1&" * 20 + "token={token}",
        "#token={token}",
    ],
)
def test_any_other_token_is_refused(query):
    access, _ = access_for("127.0.0.1")
    reason = verdict(access, query=query.format(token=access.token))
    assert str(reason).startswith("The token is missing or wrong")
    assert access.token not in str(reason)


def test_each_view_has_a_token_of_its_own_that_nothing_prints():
    first, second = access_for("127.0.0.1")[0], access_for("127.0.0.1")[0]
    assert first.token != second.token and len(bytes.fromhex(first.token)) == 16
    assert first.token not in repr(first)
    assert first.url(8080) == f"http://127.0.0.1:8080/?token={first.token}"


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_view_beyond_this_machine_wants_the_token_and_names_that_nobody_can_rebind(host):
    try:
        access, numeric = access_for(host)
    except ValueError:
        pytest.skip("no such network here")
    assert access.beyond and numeric == host
    here = socket.gethostname()
    for name in ("192.168.1.5:8080", "[2001:db8::1]:8080", here, f"{here}.local:80", "localhost"):
        assert verdict(access, host=name) is None
        assert verdict(access, host=name, query="?token=").startswith("The token is missing")
    assert verdict(access, host="evil.example").startswith("Host must name this machine")
    assert access.url(80).startswith("http://localhost:80/?token=")
    assert access.url_elsewhere(80) == f"http://{here}:80/?token={access.token}"


@pytest.mark.parametrize(
    "host", ["", " ", "no.such.host.invalid", "203.0.113.7", "a" * 300, "\udcff"]
)
def test_a_host_that_is_none_is_refused(host):
    with pytest.raises(ValueError, match="host must be an address of this machine"):
        access_for(host)


def test_a_taken_port_is_passed_over_and_where_none_is_free_it_is_said(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port("127.0.0.1", port) != port
        monkeypatch.setattr("spt_jax.view.access._PORTS_TRIED", 1)
        with pytest.raises(ValueError, match=f"port must be free: got {port}"):
            free_port("127.0.0.1", port)


@pytest.mark.parametrize(
    "options",
    [
        {"query": ""},
        {"token": "0" * 32},
        {"host": "evil.example"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"query": "", "headers": {"Cookie": "token={token}", "Authorization": "token {token}"}},
    ],
    ids=["no token", "wrong token", "foreign host", "foreign origin", "null origin", "cookie"],
)
def test_a_socket_that_should_not_be_gets_nothing(view, options):
    headers = {
        name: value.format(token=view.access.token)
        for name, value in options.get("headers", {}).items()
    }
    with pytest.raises(InvalidStatus) as refused:
        open_socket(view, **options | {"headers": headers})
    assert refused.value.response.status_code == 403
    assert b"viser" not in refused.value.response.body and len(refused.value.response.body) < 200
    assert not view.server.get_clients()


def test_the_page_s_own_socket_gets_the_scene(view):
    port = port_of(view)
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", "localhost:9"):
        with Browser(view, host=host, origin=f"http://{host}") as browser:
            browser.wait_for(lambda message: message.get("name") == "/surface/clear")


def test_the_page_is_handed_out_for_the_token_alone(view):
    assert page(view, "/")[0] == 403
    status, headers, text = page(view, path_of(view.url))
    assert status == 303 and view.access.token not in text
    target = headers["Location"]
    assert target.startswith(path_of(view.url) + "&websocket=ws%3A%2F%2F127.0.0.1")
    status, headers, text = page(view, target)
    assert status == 200 and "<html" in text
    assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["Set-Cookie"] is None and "Access-Control-Allow-Origin" not in headers
    # A socket elsewhere, in a link with the token, is put right.
    elsewhere = f"{path_of(view.url)}&websocket=ws://evil.example"
    assert page(view, elsewhere)[1]["Location"] == target
    for name, value in (("Host", "evil.example"), ("Origin", "http://evil.example")):
        assert page(view, target, **{name: value})[0] == 403
    assert page(view, f"/..%2f..%2f..%2fpyproject.toml?token={view.access.token}")[0] == 404


def test_garbage_before_the_handshake_says_nothing_and_ends_nothing(
    view, capfd, caplog, monkeypatch
):
    # viser filters what is logged, but only from the first page on that it hands out.
    monkeypatch.setattr(logging.getLogger("spt_jax.view.connections"), "filters", [])
    for content in (b"\x16\x03\x01\x02", b"GET / HTTP/1.1\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", port_of(view)), timeout=10) as stranger:
            stranger.sendall(content)
            stranger.shutdown(socket.SHUT_WR)
            answer = b""
            with contextlib.suppress(ConnectionResetError):
                while part := stranger.recv(65536):
                    answer += part
            assert b"200 OK" not in answer and b"101" not in answer
    assert page(view, "/")[0] == 403
    assert capfd.readouterr() == ("", "")
    # Nor where pytest does not take what is logged: a logger without handlers prints tracebacks.
    loggers = {record.name for record in caplog.records if record.levelno >= logging.WARNING}
    assert loggers == {"spt_jax.view.connections"}
    assert all(logging.getLogger(name).handlers for name in loggers)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"nonsense", 1007),
        ("text", 1007),
        (b"\x91" * 100_000, 1007),
        ({"type": "NoSuchMessage"}, 1007),
        ({"type": "GuiUpdateMessage"}, 1007),
        (bytes(2_000_000), 1009),
    ],
    ids=["no msgpack", "text", "nested", "no such message", "no fields", "too long"],
)
def test_what_is_no_message_ends_that_browser_s_connection_alone(view, content, code, capfd):
    with Browser(view) as other, Browser(view) as browser:
        browser.send(content) if isinstance(content, dict) else browser.send_raw(content)
        assert browser.wait_for_end() == code
        assert capfd.readouterr().err.count("\n") <= 1
        other.set("See through", False)
        with Browser(view) as third:
            third.set("See through", True)
            other.wait_for_value("See through", True)


def test_values_that_no_widget_has_are_ignored_in_one_line(view, capfd):
    with Browser(view) as browser:
        uuid = browser.widget("Measure")
        for updates in ({"no_such": 1}, {"value": 7}):
            browser.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})
        browser.send({"type": "ShareUrlRequest"})  # viser would show the view to the whole world
        browser.set("See through", False)
        browser.set("See through", True)
        browser.set("Measure", "paper's ratio")
        wait_until(lambda: view.scene.paper)
    assert ShareUrlRequest not in view.server._websock_server._incoming_handlers
    said = capfd.readouterr().err
    assert "Traceback" not in said and "a browser's message was ignored: " in said


def test_a_viser_that_does_not_ask_the_guard_is_not_served():
    stopped = []
    server = SimpleNamespace(stop=lambda: stopped.append(True))
    other = SimpleNamespace(__version__="9.9", ViserServer=lambda **options: server)
    access, numeric = access_for("127.0.0.1")
    with pytest.raises(ImportError, match=r"check who connects: version 9\.9 does not"):
        start_guarded(other, access, numeric, 0)
    assert stopped == [True]


def test_the_command_prints_the_address_with_the_token_even_when_quiet(
    monkeypatch, capsys, tmp_path
):
    def interrupted(seconds):
        raise KeyboardInterrupt

    trimesh.creation.box().export(tmp_path / "box.ply")
    monkeypatch.setattr("spt_jax.cli.view.time.sleep", interrupted)
    assert cli.main(["view", str(tmp_path / "box.ply"), "--quiet", "--port", "18790"]) == 0
    out, err = capsys.readouterr()
    assert re.fullmatch(
        r"open http://127\.0\.0\.1:\d+/\?token=[0-9a-f]{32} in a browser; .*\n", out
    )
    assert not err
    assert cli.main(["view", "--upload-limit", "0"]) == 2
    assert "upload_limit must be at least 1 MB: got 0" in capsys.readouterr().err
