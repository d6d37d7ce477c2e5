"""A local web server that shows the body in a browser. The server sends a page and the surface of the body, and
computes one step for each picture. Other computers cannot connect to this server."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Content
from liverjax.play.pulling import Playing, pulled


class PlayServer(ThreadingHTTPServer):
    """Web server that shows the same body in all open pages."""

    daemon_threads = True

    def __init__(self, playing: Playing, port: int):
        super().__init__(("127.0.0.1", port), Answer)
        self.first = self.playing = playing
        self.one_at_a_time = threading.Lock()

    @property
    def address(self) -> str:
        """Address (URL) of the page."""
        return f"http://127.0.0.1:{self.server_address[1]}/"


class Answer(BaseHTTPRequestHandler):
    """Handler of four requests: GET / and GET /surface, POST /step with {node, to, stiffness}, and POST /rest."""

    protocol_version = "HTTP/1.1"  # in this version, one connection serves all steps
    server: PlayServer

    def do_GET(self) -> None:
        """Send the page, or the surface as JSON."""
        if self.path == "/":
            page = resources.files("liverjax.play").joinpath("page.html").read_bytes()
            self._send(200, "text/html; charset=utf-8", page)
        elif self.path == "/surface":
            self._send(200, "application/json", json.dumps(surface(self.server.playing)).encode())
        else:
            self._send(404, "text/plain", b"there is /, /surface, /step and /rest")

    def do_POST(self) -> None:
        """Compute a step, or go back to the first state. Send the positions (n, 3) [m] of the surface nodes as
        float32."""
        try:
            asked = json.loads(self.rfile.read(int(self.headers.get("Content-Length") or 0)) or b"{}")
        except ValueError:
            return self._send(400, "text/plain", b"the body of a request must be JSON")
        if self.path not in ("/step", "/rest") or not isinstance(asked, dict):
            return self._send(404, "text/plain", b"POST /step or /rest with a JSON object")
        with self.server.one_at_a_time:
            try:
                self.server.playing = self.server.first if self.path == "/rest" else stepped(self.server.playing, asked)
            except InputError as error:
                return self._send(400, "text/plain; charset=utf-8", str(error).encode())
            playing = self.server.playing
        code = "" if playing.code in (status.CONVERGED, status.ONE_STEP) else status.advice(playing.code)
        headers = {"X-Time": f"{playing.time:.9g}", "X-Failed": code}
        self._send(200, "application/octet-stream", on_surface(playing).tobytes(), headers)

    def _send(self, code: int, kind: str, content: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(code)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Print nothing. The method of the base class would print thirty lines per second."""


def stepped(playing: Playing, asked: Content) -> Playing:
    """Return the body after one step. `asked`: the JSON object of the request."""
    return pulled(playing, asked.get("node"), asked.get("to"), asked.get("stiffness", playing.stiffness))


def on_surface(playing: Playing) -> np.ndarray:
    """Return the positions (n, 3) [m] of the surface nodes as float32."""
    return playing.positions[playing.nodes].astype("<f4")


def surface(playing: Playing) -> dict[str, object]:
    """Return the data that a page needs once: nodes, triangles and positions of the surface, size of the body, and
    stiffness of the spring."""
    return {
        "nodes": playing.nodes.tolist(),
        "triangles": playing.triangles.ravel().tolist(),
        "points": on_surface(playing).ravel().tolist(),
        "size": playing.size,
        "stiffness": playing.stiffness,
        "timed": playing.scene.solve.dt is not None,
    }
