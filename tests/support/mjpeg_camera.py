"""A camera on the network: side-by-side pictures over HTTP, as long as somebody reads them."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

_BETWEEN_S = 0.05


def _part(width: int, height: int) -> bytes:
    wall = np.random.default_rng(1).integers(0, 255, (height, width + 8, 3), np.uint8)
    both = np.hstack([wall[:, :width], wall[:, 8:]])
    _, file = cv2.imencode(".jpg", both)
    body = file.tobytes()
    return (
        f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        + body
        + b"\r\n"
    )


@contextmanager
def mjpeg_camera(width: int, height: int) -> Iterator[str]:
    """Its address; each view has this size."""
    part = _part(width, height)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            try:
                while True:
                    self.wfile.write(part)
                    time.sleep(_BETWEEN_S)  # a camera has a rate
            except OSError:
                pass  # the reader has left

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/camera.mjpg"
        finally:
            server.shutdown()
            thread.join()
