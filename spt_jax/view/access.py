"""Who may reach the live view: the address it is served on, and what a request has to carry."""

import hmac
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

# A name or an address in brackets, then perhaps a port; nothing else that a URL may hold.
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+?)\.?(:[0-9]{1,5})?", re.ASCII)
_MOST_FIELDS = 8
# viser's page takes the address of its socket from here.
_SOCKET = "websocket"
_PORTS_TRIED = 100


@dataclass(frozen=True)
class Access:
    """What a request for the page or for the socket has to carry: a Host, an Origin and a token.

    A page of another site cannot know the token, which travels in the query of every address and
    never in a cookie: a browser adds nothing by itself that would open the view. `Host` has to
    name this machine, so that a foreign name that was made to resolve to it (DNS rebinding) is
    refused, and `Origin`, where a browser sends one, has to be the page's own.

    Attributes:
        host: the address to open: as the user wrote it, or localhost where every address is served.
        beyond: whether other machines can reach that address.
        names: the host names that a request may give. Beside them, numeric addresses: those of
            this machine's loopback network, and all of them where `beyond`. They cannot be rebound.
        token: 128 random bits.
    """

    host: str
    beyond: bool
    names: frozenset[str]
    token: str = field(default_factory=lambda: secrets.token_hex(16), repr=False)

    def refusal(self, target: str, headers: Any) -> str | None:
        """Why a request is refused, in one sentence; None where it may go on.

        Args:
            target: path and query, as the request line has them.
            headers: with `get_all(name)`, as `websockets` has them.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return f"Host must name this machine: got {_shown(hosts)}."
        if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
            return f"Origin must be the view's own page: got {_shown(origins)}."
        given = _query(target).get("token", [])
        # Compared as bytes, in a time that does not reveal how much of it is right.
        if len(given) != 1 or not hmac.compare_digest(_as_bytes(given[0]), self.token.encode()):
            return "The token is missing or wrong: open the address that spt-jax view printed."
        return None

    def redirection(self, target: str, headers: Any) -> str | None:
        """Where a request for the page that `refusal` let through goes first; None if to the page.

        viser's page connects to the address given in its query, so it is given the one
        with the token, on the host by which the browser itself came: a forwarded port has another.
        """
        socket_address = f"ws://{headers.get_all('Host')[0].lower()}/?token={self.token}"
        if urlsplit(target).path != "/" or _query(target).get(_SOCKET) == [socket_address]:
            return None
        return f"/?token={self.token}&{_SOCKET}={quote(socket_address, safe='')}"

    def url(self, port: int) -> str:
        """The address to open, token and all."""
        return f"http://{_in_url(self.host)}:{port}/?token={self.token}"

    def url_elsewhere(self, port: int) -> str:
        """The address to open on another machine."""
        host = socket.gethostname() if self.host == "localhost" else self.host
        return f"http://{_in_url(host)}:{port}/?token={self.token}"

    def _is_ours(self, host: str) -> bool:
        match = _HOST.fullmatch(host.lower())
        if match is None:
            return False
        name = match[1].strip("[]")
        address = _numeric(name)
        if address is None:
            return name in self.names
        return self.beyond or address.is_loopback


def access_for(host: str) -> tuple[Access, str]:
    """Who may reach a server on this host, and the numeric address to serve on.

    Raises:
        ValueError: the host is no address of this machine.
    """
    family, numeric = _resolved(host)
    try:
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.bind((numeric, 0))
    except OSError as error:
        raise _no_such_host(host, error) from error
    address = _numeric(numeric)
    beyond = address is None or not address.is_loopback
    names = {"localhost", host.lower()}
    if beyond:
        here = socket.gethostname().lower()
        names |= {here, f"{here}.local"}
    everywhere = address is not None and address.is_unspecified
    return Access("localhost" if everywhere else host, beyond, frozenset(names)), numeric


def free_port(numeric: str, port: int) -> int:
    """The first port from this one on that is free.

    viser looks for one too, and waits for ever where there is none.

    Raises:
        ValueError: none of the next hundred is.
    """
    family = socket.AF_INET6 if ":" in numeric else socket.AF_INET
    last = min(port + _PORTS_TRIED - 1, 65535)
    for candidate in range(port, last + 1):
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            # As asyncio does, or a port would count as taken for a minute after a view has ended.
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind((numeric, candidate))
                return candidate
            except OSError as error:
                reason = error
    raise ValueError(
        f"port must be free: got {port}, and none up to {last} can be used "
        f"({reason}); choose another with --port."  # pyright: ignore[reportPossiblyUnbound]
    )


def _resolved(host: str) -> tuple[int, str]:
    # An empty host would mean every address of this machine.
    if not host.strip():
        raise _no_such_host(host, "it is empty")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise _no_such_host(host, error) from error
    return family, str(address[0])


def _no_such_host(host: str, reason: object) -> ValueError:
    return ValueError(
        f"host must be an address of this machine, such as 127.0.0.1: got {host!r} ({reason})."
    )


def _query(target: str) -> dict[str, list[str]]:
    try:
        return parse_qs(urlsplit(target).query, max_num_fields=_MOST_FIELDS)
    except ValueError:
        return {}


def _numeric(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _as_bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _shown(values: list[str]) -> str:
    return ", ".join(repr(value[:80]) for value in values) or "none"
