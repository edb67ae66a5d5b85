"""The viewer refuses other sites and other names, and survives crowds and malformed messages."""

import contextlib
import socket
import types

import numpy as np
import pytest

from experiments.viewer import session

serving = pytest.importorskip("experiments.viewer.server", exc_type=ModuleNotFoundError)

viser = pytest.importorskip("viser")
exceptions = pytest.importorskip("websockets.exceptions")
client = pytest.importorskip("websockets.sync.client")

_PROTOCOL = f"viser-v{viser.__version__}"


class _Page:
    """A page that draws nothing."""

    def __init__(self, client, subject, turns):
        pass

    def close(self):
        pass


@pytest.fixture(scope="module")
def port():
    with pytest.MonkeyPatch.context() as patch:
        view = types.SimpleNamespace(pose=np.eye(4)[:3], fov=1.0)
        patch.setattr(serving, "Page", _Page)
        patch.setattr(session, "first_viewpoint", lambda subject: view)
        config = types.SimpleNamespace(centre=(0.0, 0.0, 0.0))
        subject = types.SimpleNamespace(name="<script>", model=types.SimpleNamespace(config=config))
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            free = probe.getsockname()[1]
        server = serving.serve(subject, host="127.0.0.1", port=free)
        yield server.get_port()
        server.stop()


def _open(port, **options):
    return client.connect(f"ws://127.0.0.1:{port}", subprotocols=[_PROTOCOL], **options)


def _get(port, host):
    with socket.create_connection(("127.0.0.1", port), timeout=10) as link:
        link.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        return int(link.makefile("rb").readline().split()[1])


def _answers(port):
    with _open(port) as page:
        return len(page.recv(timeout=10)) > 0


def test_a_page_of_this_server_is_served(port):
    assert _get(port, f"localhost:{port}") == _get(port, f"127.0.0.1:{port}") == 200
    with _open(port, origin=f"http://127.0.0.1:{port}") as page:
        assert len(page.recv(timeout=10)) > 0


def test_it_listens_to_this_machine_alone(port):
    with socket.socket() as other:
        other.bind(("127.0.0.2", port))  # free: the server has not taken every address


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_pages_of_other_sites_are_refused(port, origin):
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        _open(port, origin=origin)
    assert _answers(port)


def test_other_names_of_this_machine_are_refused(port):
    assert _get(port, "evil.example") == 403  # a name of theirs that leads to 127.0.0.1


@pytest.mark.parametrize("message", [b"", b"\xc1", b"\x80", b"\x81\xa4type\xa4Quit", "text"])
def test_a_malformed_message_closes_its_page_alone(port, message):
    with _open(port) as page, contextlib.suppress(exceptions.ConnectionClosed):
        page.send(message)
        while True:
            page.recv(timeout=10)
    assert _answers(port)


def test_a_large_message_closes_its_page_alone(port):
    with _open(port) as page, pytest.raises(exceptions.ConnectionClosed):
        page.send(b"x" * (2 * serving._LONGEST_MESSAGE))
        while True:
            page.recv(timeout=10)
    assert _answers(port)


def test_it_survives_200_connections_of_which_some_never_read(port):
    with contextlib.ExitStack() as stack:
        slow = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(100)
        ]
        for link in slow[:50]:
            link.sendall(b"GET / HT")
        opened, refused = 0, 0
        for _ in range(100):
            try:
                stack.enter_context(_open(port))
                opened += 1
            except exceptions.InvalidStatus:
                refused += 1
        assert opened >= 1 and refused >= 1 and opened + refused == 100
        assert opened <= serving._MOST_PAGES
    assert _get(port, f"localhost:{port}") == 200


@pytest.mark.parametrize(
    ("headers", "host", "pages", "served"),
    [
        ({"Host": "[::1]:8080"}, "::1", 0, True),
        ({"Host": "machine:8080"}, "0.0.0.0", 0, True),
        ({"Host": "machine:8080", "Origin": "https://machine:8080"}, "0.0.0.0", 0, True),
        ({"Host": "machine:8080", "Origin": "http://machine"}, "0.0.0.0", 0, False),
        ({}, "127.0.0.1", 0, False),
        ({"Host": "localhost", "Upgrade": "WebSocket"}, "localhost", 32, False),
        ({"Host": "localhost"}, "localhost", 32, True),
    ],
)
def test_refusals(headers, host, pages, served):
    assert (serving.refusal(headers, host=host, pages=pages) is None) == served
