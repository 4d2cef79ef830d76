"""Use a caryatid service from a robot's own software. This file needs only Python: copy it.

>>> robot = RobotClient("http://127.0.0.1:8765")
>>> robot.begin("table", segmentation="auto")
>>> robot.add("table", png16(640, 480, depth_mm_big_endian), K, T_world_camera)
>>> robot.next("table")["T_world_camera"]
"""

from __future__ import annotations

import base64
import http.client
import json
import struct
import time
import urllib.error
import urllib.request
import zlib
from typing import Any

Matrix = list[list[float]]


class RobotClient:
    """Sessions of a service.

    Args:
        address: Address of the service.
        token: Token, if the service requires one.
        patience: Timeout of a request, and of retries while the service is busy or unreachable [s].
    """

    def __init__(self, address: str, token: str | None = None, patience: float = 60.0) -> None:
        self.address = address.rstrip("/")
        self.patience = patience
        self.headers = {"Content-Type": "application/json"}
        if token:
            self.headers["Authorization"] = f"Bearer {token}"

    def begin(self, name: str, **options: Any) -> dict[str, Any]:
        """Create a session; options: segmentation, seed, planner, settings, ignore."""
        return self._ask("POST", "/sessions", {"name": name, **options})

    def add(
        self,
        name: str,
        depth: bytes,
        K: Matrix,
        T_world_camera: Matrix,
        *,
        depth_scale: float = 1.0,
        rgb: bytes | None = None,
        labels: bytes | None = None,
        number: int | None = None,
    ) -> dict[str, Any]:
        """Add a view, images as files of PNG or .npy; returns the graph with it, and whether it changed.

        The view is added once, even where the answer to a first try was lost: its number says which it is.
        """
        images = {"depth": depth, "rgb": rgb, "labels": labels}
        view: dict[str, Any] = {k: base64.b64encode(v).decode() for k, v in images.items() if v is not None}
        view["camera"] = {"K": K, "T_world_camera": T_world_camera, "depth_scale": depth_scale}
        view["number"] = self.session(name)["views"] if number is None else number
        return self._ask("POST", f"/sessions/{name}/views", view)

    def next(
        self, name: str, candidates: list[Matrix] | None = None, refused: list[Matrix] | None = None
    ) -> dict[str, Any]:
        """Return the next best view for the humanoid of the settings, or among these camera poses."""
        if candidates is None and refused is None:
            return self._ask("GET", f"/sessions/{name}/next")
        return self._ask("POST", f"/sessions/{name}/next", {"T_world_camera": candidates, "refused": refused})

    def graph(self, name: str) -> dict[str, Any]:
        """The support graph, as graph.json."""
        return self._ask("GET", f"/sessions/{name}/graph")

    def order(self, name: str, goal: str | None = None, **options: Any) -> dict[str, Any]:
        """Return a safe order in which to remove all objects, or to reach one; options: hands, settings."""
        return self._ask("POST", f"/sessions/{name}/order", {"goal": goal, **options})

    def take(self, name: str, object_id: str, T: Matrix | None = None) -> dict[str, Any]:
        """Report that an object was removed, or moved by a rigid transform T in the world frame."""
        report = {"object": object_id, "T": T, "number": self.session(name)["reports"]}
        return self._ask("POST", f"/sessions/{name}/reports", report)

    def undo(self, name: str) -> dict[str, Any]:
        """Take back the last view, or the report after it."""
        return self._ask("DELETE", f"/sessions/{name}/views/last")

    def session(self, name: str) -> dict[str, Any]:
        """Number of views and reports of a session, and its options."""
        return self._ask("GET", f"/sessions/{name}")

    def _ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.address + path, data, self.headers, method=method)
        begun = time.monotonic()
        while True:
            try:
                with urllib.request.urlopen(request, timeout=self.patience) as answer:
                    document: dict[str, Any] = json.load(answer)
                    return document
            except urllib.error.HTTPError as error:
                if error.code != 503 or time.monotonic() - begun > self.patience:
                    raise RuntimeError(f"{method} {path}: {error.code} {error.read().decode()}") from None
            except (OSError, http.client.HTTPException):
                # No retry: a second undo removes another view. Numbers make views and reports safe to repeat.
                if method == "DELETE" or path == "/sessions" or time.monotonic() - begun > self.patience:
                    raise
            time.sleep(0.2)


def png16(width: int, height: int, samples: bytes) -> bytes:
    """Encode depth [mm] or labels as a 16-bit grey PNG: two bytes a pixel, the high one first, row by row."""
    rows = b"".join(b"\0" + samples[2 * width * y : 2 * width * (y + 1)] for y in range(height))

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 1)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts
