"""A server on the loopback interface that misbehaves as it is told."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest


@dataclass
class Served:
    """One file: its bytes, and what the server does wrong with it."""

    data: bytes = b""
    tag: str = '"v1"'
    ranges: bool = True
    break_after: list[int] = field(default_factory=list)  # bytes before each broken connection
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    chunked: bool = False  # sent without its length
    page: str = ""  # sent instead, unless the request carries `confirm=`

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.data).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def do_GET(self):
        site = self.server.site
        path, _, query = self.path.partition("?")
        site.requests.append((self.path, dict(self.headers)))
        served = site.files.get(path)
        if served is None:
            self._send(404, b"nothing here", {})
            return
        if served.status != 200:
            self._send(served.status, b"", served.headers)
            return
        if served.page and "confirm=" not in query:
            self._send(200, served.page.encode(), {"Content-Type": "text/html"})
            return
        headers = dict(served.headers)
        if served.tag:
            headers["ETag"] = served.tag
        start = 0
        asked = self.headers.get("Range")
        fresh = self.headers.get("If-Range") in (None, served.tag)
        if asked and served.ranges and fresh:
            start = int(asked.removeprefix("bytes=").rstrip("-"))
            if start >= len(served.data):
                self._send(416, b"", {"Content-Range": f"bytes */{len(served.data)}"})
                return
            end = len(served.data) - 1
            headers["Content-Range"] = f"bytes {start}-{end}/{len(served.data)}"
        body = served.data[start:]
        keep = served.break_after.pop(0) if served.break_after else None
        if served.chunked:
            self._send_chunks(206 if start else 200, body, headers, keep)
        else:
            self._send(206 if start else 200, body, headers, keep)

    def _send(self, status, body, headers, keep=None):
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body if keep is None else body[:keep])
        if keep is not None:
            self.wfile.flush()
            self.close_connection = True

    def _send_chunks(self, status, body, headers, keep):
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        for at in range(0, len(body if keep is None else body[:keep]), 50_000):
            chunk = body[at : at + 50_000]
            self.wfile.write(b"%x\r\n" % len(chunk) + chunk + b"\r\n")
        if keep is None:
            self.wfile.write(b"0\r\n\r\n")
        self.wfile.flush()
        self.close_connection = True


class Site:
    """Files by path, and the requests that came."""

    def __init__(self, address):
        self.root = address
        self.files: dict[str, Served] = {}
        self.requests: list[tuple[str, dict[str, str]]] = []

    def serve(self, path, data=b"", **wrong):
        self.files[path] = Served(data, **wrong)
        return f"{self.root}{path}"

    def asked(self, header):
        return [headers.get(header) for _, headers in self.requests]


@pytest.fixture
def site():
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.site = Site(f"http://127.0.0.1:{server.server_port}")
    thread = threading.Thread(target=lambda: server.serve_forever(poll_interval=0.02))
    thread.start()
    yield server.site
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(autouse=True)
def _online(monkeypatch):
    """Neither a proxy nor the user's own setting reaches these tests."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", "DROIDW_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("no_proxy", "*")
