"""The browser's view of a recording that is followed: a small server on this machine alone, nothing is kept."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from ..errors import ResourceError
from .follow import Live

POLL_S = 0.05  # the server looks so often whether it shall end
HOME = "127.0.0.1"  # nobody else may look at a patient
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'"


class Page:
    """Serves what `show` was given last. palette : 256 colours as #rrggbb. port 0 = any that is free."""

    def __init__(self, palette: list[str], port: int = 0) -> None:
        self._palette, self._answers = palette, {"/": ("text/html; charset=utf-8", _page())}
        self.show(Live())
        try:
            self._server: Any = ThreadingHTTPServer((HOME, port), self._handler())
        except OSError as e:
            raise ResourceError(f"port {port} cannot be used ({e.strerror})", hint="choose another") from None
        threading.Thread(target=self._server.serve_forever, args=(POLL_S,), daemon=True).start()

    @property
    def address(self) -> str:
        """Where the browser finds it."""
        return f"http://{HOME}:{self._server.server_address[1]}/"

    def show(self, live: Live) -> None:
        """Answer with this state from now on."""
        state = {"frames": live.frames, "rate_hz": live.rate_hz, "advice": live.advice(), "urgent": live.lost}
        text = json.dumps(state | {"ended": live.ended, "palette": self._palette})
        self._answers["/state.json"] = "application/json", text.encode()
        self._answers["/points.bin"] = "application/octet-stream", live.points.tobytes()

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        def answer(request: BaseHTTPRequestHandler) -> None:
            # a page from elsewhere whose name was made to lead here asks under that name
            asked = request.path if request.headers.get("Host") == self.address[len("http://") : -1] else ""
            kind, data = self._answers.get(asked, ("", b""))
            request.send_response(200 if kind else 404)
            request.send_header("Content-Type", kind or "text/plain")
            request.send_header("Content-Length", str(len(data)))
            request.send_header("Content-Security-Policy", POLICY)
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            request.wfile.write(data)

        quiet = {"log_message": lambda *_: None}  # nothing on the terminal
        return type("Handler", (BaseHTTPRequestHandler,), {"do_GET": answer, **quiet})


def _page() -> bytes:
    return Path(__file__).with_name("page.html").read_bytes()
