"""The server of `bokehguide view`, by real sockets: who may connect, who steers, and what ends the work."""

from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError, Future
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from bokehguide.errors import BokehguideError
from bokehguide.view.address import is_loopback, require_address
from bokehguide.view.server import MAX_REQUEST, ViewServer, require_websockets
from bokehguide.view.session import Message
from tests.support.scene_text import BOX_AND_EMITTER
from tests.support.view_page import opened, served


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    (folder / "box.toml").write_text(BOX_AND_EMITTER)
    with served(str(folder / "box.toml"), folder, mode="uniform", spp=1) as running:
        yield running


def get(server: ViewServer, path: str, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    parts = urlsplit(server.address)
    connection = HTTPConnection("127.0.0.1", parts.port, timeout=30)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{parts.port}"})
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


def test_the_page_and_its_files_need_nothing_from_elsewhere(server):
    status, headers, page = get(server, "/")
    assert status == 200 and b"<title>bokehguide view</title>" in page
    assert "default-src 'none'" in headers["Content-Security-Policy"] and headers["Referrer-Policy"] == "no-referrer"
    for name in ("app.js", "connection.js", "controls.js", "panels.js", "stage.js", "style.css", "icon.svg"):
        status, headers, text = get(server, f"/{name}")
        assert status == 200 and text, name
        assert b"http://" not in text.replace(b"http://www.w3.org/2000/svg", b"") and b"https://" not in text


@pytest.mark.parametrize("path", ["/nothing", "/../server.py", "/page/index.html", "/%2e%2e/session.py", "//etc/passwd"])
def test_nothing_else_is_served(path, server):
    assert get(server, path)[0] == 404


def test_the_name_of_another_host_is_refused(server):
    """A name that an attacker's DNS points to this machine."""
    assert get(server, "/", host="evil.example")[0] == 403
    assert get(server, "/", host="localhost:1")[0] == 200


def test_pages_of_other_sites_may_not_connect(server):
    with pytest.raises(InvalidStatus, match="403"), opened(server, origin="http://evil.example"):
        pass
    with opened(server, origin=server.address.rstrip("/")) as page:
        assert page.facts["role"]["steers"]


def test_a_server_for_others_needs_its_token(tmp_path):
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)
    with served(str(tmp_path / "box.toml"), tmp_path, host="0.0.0.0", mode="uniform", spp=1) as server:
        assert server.token and f"token={server.token}" in server.address
        assert [get(server, path)[0] for path in ("/", "/?token=wrong", f"/?token={server.token}")] == [403, 403, 200]
        with opened(server) as page:
            assert page.facts["role"]["steers"]
        port = urlsplit(server.address).port
        for query in ("", "?token=", "?token=wrong"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws://127.0.0.1:{port}/socket{query}")


def test_files_and_long_texts_are_not_accepted(server):
    with opened(server) as page:
        page.send_text(b"a file")
        assert page.until("failure")["failure"] == "files are not accepted"
        page.send_text("x" * (MAX_REQUEST + 1))
        with pytest.raises(ConnectionClosedError):
            while True:
                page.receive()


@pytest.mark.parametrize(
    "text", ["", "[1]", "nonsense", '{"type": 3}', '{"type": "explode"}', '{"type":"move","kind":"fly","x":0,"y":0}']
)
def test_malformed_requests_are_answered_in_a_line(text, server):
    with opened(server) as page:
        page.send_text(text)
        assert "\n" not in page.until("failure")["failure"]
        assert page.change(type="set", name="exposure", value=0.5)["values"]["exposure"] == 0.5


@pytest.mark.parametrize("place", [{}, {"x": "1", "y": 0}, {"x": 1e9, "y": 0}, {"x": None, "y": True}])
def test_places_are_numbers(place, server):
    with opened(server) as page:
        page.send(type="focus", **place)
        assert "fractions of the frame" in page.until("failure")["failure"]


def test_one_browser_steers_and_the_others_watch(server):
    with opened(server) as first, opened(server) as second:
        assert not second.facts["role"]["steers"]
        second.send(type="set", name="f_number", value=2.0)
        assert "another browser steers" in second.until("failure")["failure"]
        first.change(type="set", name="exposure", value=1.25)
        assert second.until("state", lambda facts: facts["values"]["exposure"] == 1.25)
        second.send(type="steer")
        second.until("role", lambda facts: facts["steers"])
        first.until("role", lambda facts: not facts["steers"])
        second.change(type="set", name="exposure", value=-1.0)
    with opened(server) as page:
        assert page.facts["state"]["values"]["exposure"] == -1.0


def test_a_browser_that_leaves_passes_the_wheel_on(server):
    with opened(server) as first, opened(server) as second:
        first.close()
        second.until("role", lambda facts: facts["steers"] and facts["browsers"] == 1)


def test_the_work_ends_when_nobody_watches(server):
    renderer = server.shown.renderer
    with opened(server) as page:
        page.rested()
        assert renderer.ask(lambda job: job.loop.step_number).result(60) == 1
    deadline = time.monotonic() + 60
    with pytest.raises(CancelledError):
        while time.monotonic() < deadline:
            renderer.ask(lambda job: None).result(60)


def test_a_port_in_use_is_an_error_in_a_line(server):
    port = urlsplit(server.address).port
    with pytest.raises(BokehguideError, match=f"cannot listen on 127.0.0.1:{port} .Address already in use.; give another --port"):
        ViewServer(server.shown, port=port).start()
    with pytest.raises(BokehguideError, match=f"cannot listen on 127.0.0.1:{port} .Address already in use."):
        require_address("127.0.0.1", port)
    require_address("127.0.0.1", 0)


class Waiting:
    """An exhibit whose answers come when the server has ended."""

    def __init__(self) -> None:
        self.answer: Future[Message] = Future()
        self.asked = threading.Event()

    def start(self, send) -> None: ...

    def watch(self, watched: bool) -> None: ...

    def greeting(self) -> list[Message]:
        return []

    def handle(self, request) -> Future[Message]:
        self.asked.set()
        return self.answer

    def close(self) -> None:
        self.answer.set_result(Message("note", {"note": "late"}))


def test_an_answer_after_the_end_is_dropped(caplog):
    shown = Waiting()
    server = ViewServer(shown)
    server.start()
    with opened(server) as page:
        page.send(type="hover", x=0.5, y=0.5)
        assert shown.asked.wait(60.0)
        time.sleep(0.2)  # the server takes the answer
        server.close()
    assert not caplog.records


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "websockets.asyncio.server", None)
    with pytest.raises(BokehguideError, match=r"pip install 'bokehguide\[view\]'"):
        require_websockets()


def test_hosts_of_this_machine():
    assert [is_loopback(host) for host in ("127.0.0.1", "localhost", "::1", "127.9.9.9")] == [True] * 4
    assert [is_loopback(host) for host in ("0.0.0.0", "10.0.0.1", "example.org", "", "localhost.evil.example")] == [False] * 5
