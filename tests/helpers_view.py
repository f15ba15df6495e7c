"""A live view to connect to, and a client that speaks to it as viser's page does."""

import contextlib
import http.client
import secrets
import socket
import time
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
import zstandard
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.uri import parse_uri

from spt_jax.view.server import View

PART = 512 * 1024  # of a file, as viser's page cuts it
SECONDS = 30.0  # for what takes less than one on an idle core
_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 3.0),
    "fov": 0.5,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}


@contextlib.contextmanager
def served(path, **options):
    """A view of a file on a port that is free, working."""
    view = View(path, port=0, **options)
    try:
        view.start()
        assert view.worker.wait_until_idle(SECONDS)
        yield view
    finally:
        assert view.stop_serving()


def port_of(view):
    return view.server.get_port()


def unsent_bytes(view):
    """What waits in the view for browsers to take it: the system's own buffers are full."""
    connections = view.server._websock_server._live_connections.values()
    return sum(connection.transport.get_write_buffer_size() for connection in connections)


def wait_until(condition):
    end = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


class Browser:
    """A browser's side of the socket; `open_socket` says what it sends beside the token."""

    def __init__(self, view, **options):
        self._socket = open_socket(view, **options)
        self.messages = []
        self.send(_CAMERA)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()

    def send(self, message):
        self._socket.send(msgspec.msgpack.encode(message))

    def send_raw(self, content):
        self._socket.send(content)

    def read(self, seconds=SECONDS):
        """The messages of one window, all of which are kept."""
        content = self._socket.recv(timeout=seconds)
        size = int.from_bytes(content[8:16], "little")
        plain = zstandard.ZstdDecompressor().decompress(content[16 : 16 + size])
        found = msgspec.msgpack.decode(plain)["messages"]
        self.messages += found
        return found

    def wait_for(self, condition):
        """The first message, also of those that came before, for which this is so."""
        seen = 0
        end = time.monotonic() + SECONDS
        while True:
            for message in self.messages[seen:]:
                if condition(message):
                    return message
            seen = len(self.messages)
            self.read(max(0.0, end - time.monotonic()))

    def widget(self, label):
        """The identifier of what stands beside this label."""
        made = self.wait_for(lambda m: m.get("props", {}).get("label") == label)
        return made["uuid"]

    def set(self, label, value):
        self.send(
            {"type": "GuiUpdateMessage", "uuid": self.widget(label), "updates": {"value": value}}
        )

    def send_file(self, name, content, *, size=None, parts=None):
        """Send a file as viser's page does, or with another size, or with other parts."""
        button = self.widget("Open a file")
        transfer = secrets.token_hex(8)
        cut = [content[start : start + PART] for start in range(0, len(content), PART)]
        parts = list(enumerate(cut)) if parts is None else parts
        self.send(
            {
                "type": "FileTransferStartUpload",
                "source_component_uuid": button,
                "transfer_uuid": transfer,
                "filename": name,
                "mime_type": "",
                "part_count": len(parts),
                "size_bytes": len(content) if size is None else size,
            }
        )
        for index, part in parts:
            self.send(
                {
                    "type": "FileTransferPart",
                    "source_component_uuid": button,
                    "transfer_uuid": transfer,
                    "part_index": index,
                    "content": part,
                }
            )

    def wait_for_notification(self):
        shown = self.wait_for(lambda m: m["type"] == "NotificationShowMessage")
        self.messages.remove(shown)
        return shown["props"]["body"]

    def wait_for_value(self, label, value):
        uuid = self.widget(label)
        self.wait_for(
            lambda m: (
                m["type"] == "GuiUpdateMessage"
                and m["uuid"] == uuid
                and m["updates"].get("value") == value
            )
        )

    def wait_for_end(self):
        """The code with which the view closes the connection."""
        while True:
            try:
                self._socket.recv(timeout=SECONDS)
            except ConnectionClosed as closed:
                assert closed.rcvd is not None
                return closed.rcvd.code


def open_socket(view, *, token=None, query=None, host=None, origin=None, headers=None):
    """A socket as a browser opens it, with any Host, Origin, token and other headers."""
    port = port_of(view)
    token = view.access.token if token is None else token
    query = f"?token={token}" if query is None else query
    return connect(
        f"ws://{host or f'127.0.0.1:{port}'}/{query}",
        sock=socket.create_connection(("127.0.0.1", port), timeout=SECONDS),
        origin=origin,
        additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],
        compression=None,
        max_size=None,
        max_queue=None,  # it answers pings also while a test reads nothing
        proxy=None,
    )


def socket_that_never_reads(view):
    """A connection that opens the view as a browser does and takes nothing after the handshake."""
    away = socket.socket()
    away.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    away.connect(("127.0.0.1", port_of(view)))
    client = ClientProtocol(
        parse_uri(f"ws://127.0.0.1:{port_of(view)}/?token={view.access.token}"),
        subprotocols=[f"viser-v{viser.__version__}"],
    )
    client.send_request(client.connect())
    away.sendall(b"".join(client.data_to_send()))
    while client.state is not State.OPEN:
        # One byte at a time: what follows the handshake is larger than this client takes, and with
        # its first bytes the client would be closing before it was seen to be open.
        part = away.recv(1)
        assert part, client.handshake_exc
        client.receive_data(part)
    client.send_binary(msgspec.msgpack.encode(_CAMERA))
    away.sendall(b"".join(client.data_to_send()))
    return away


def page(view, target, **headers):
    """(status, headers, text) of what the view answers itself; redirections are not followed."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(view), timeout=SECONDS)
    try:
        connection.putrequest("GET", target, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode()
    finally:
        connection.close()


def path_of(url):
    parts = urlsplit(url)
    return f"{parts.path}?{parts.query}"
