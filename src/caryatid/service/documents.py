"""What requests and answers of the service look like."""

from __future__ import annotations

import base64
import binascii
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from caryatid.errors import InputError
from caryatid.sessions import Capture

Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Matrix3 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
Matrix4 = Annotated[list[Row4], Field(min_length=4, max_length=4)]
Base64 = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]

MOST_CANDIDATES = 100_000
"""Candidates a robot may name [1]; more than the view sphere has."""


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Problem(_Document):
    """What went wrong, in one sentence."""

    detail: str = Field(description="What, where, and what can be done about it")


class NewSession(_Document):
    """A session to begin."""

    name: Name = Field(description="What it is to be called")
    segmentation: Literal["labels", "auto"] | None = Field(
        None, description="Where parts come from; null = labels where the first view has them"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Seed of every random choice")
    planner: str = Field("support", description="Who chooses the next view")
    settings: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="As `caryatid config --json` lists them: stage → name → value",
    )


class SessionAnswer(_Document):
    """A session."""

    name: str = Field(description="What it is called")
    views: int = Field(description="How many it has")
    segmentation: Literal["labels", "auto"] | None = Field(description="Where parts come from")
    seed: int = Field(description="Seed of every random choice")
    planner: str = Field(description="Who chooses the next view")


class SessionList(_Document):
    """All sessions."""

    sessions: list[str] = Field(description="Their names")


class Camera(_Document):
    """The camera of a view."""

    K: Matrix3 = Field(description="Pinhole matrix [px]")
    T_world_camera: Matrix4 = Field(description="Pose [m], OpenCV camera frame, world z up")
    depth_scale: FiniteFloat = Field(1.0, gt=0.0, description="Millimetres of one unit of a depth PNG")


class NewView(_Document):
    """A view; its images are files in base64."""

    camera: Camera = Field(description="Where it was taken, and with what")
    depth: Base64 = Field(description="16-bit PNG, or .npy (H, W) of floats in metres; 0 = no reading")
    rgb: Base64 | None = Field(None, description="PNG, JPEG, or .npy (H, W, 3) of uint8")
    labels: Base64 | None = Field(
        None, description="Grey PNG, or .npy (H, W) of whole numbers: the object of each pixel, 0 = nothing"
    )
    number: int | None = Field(
        None,
        ge=0,
        description="Which view it is to be, 0 the first; asked again, it is not added again",
    )

    def capture(self) -> Capture:
        """The view, not decoded yet.

        Raises:
            InputError: An image is no base64, or the pose is none.
        """
        images = {
            key: _decoded(key, text)
            for key, text in (("depth", self.depth), ("rgb", self.rgb), ("labels", self.labels))
            if text is not None
        }
        name = "view" if self.number is None else f"view {self.number}"
        return Capture.from_camera(images, self.camera.model_dump(), "camera", name)


class ViewAnswer(_Document):
    """What came of a view."""

    view: int = Field(description="Which it is, 0 the first")
    changed: bool = Field(description="Whether it changed the graph")
    graph: dict[str, Any] = Field(description="graph.json")


class UndoAnswer(_Document):
    """What is left."""

    views: int = Field(description="How many are left")
    graph: dict[str, Any] = Field(description="graph.json")


class Candidates(_Document):
    """Views a robot reaches."""

    T_world_camera: list[Matrix4] = Field(
        max_length=MOST_CANDIDATES, description="Poses [m], OpenCV camera frame, world z up"
    )
    path_length: list[Annotated[FiniteFloat, Field(ge=0.0)]] | None = Field(
        None, max_length=MOST_CANDIDATES, description="Way to each [m]; null = straight lines"
    )


class Gaze(_Document):
    """Where the head looks, against the platform [rad]."""

    yaw: float = Field(description="To the left")
    pitch: float = Field(description="Upwards")


class NextAnswer(_Document):
    """Where to look next."""

    view: int = Field(description="Which it would be, 0 the first")
    T_world_camera: list[list[float]] = Field(description="Pose [m], OpenCV camera frame, world z up")
    candidate: int = Field(description="Which of the candidates it is")
    platform: list[float] | None = Field(description="x, y, yaw [m, rad]; null with candidates")
    camera_height: float | None = Field(description="Over the floor [m]; null with candidates")
    gaze: Gaze | None = Field(description="How the head turns; null with candidates")
    expected_gain: float = Field(description="Saliency s of eq. 3")
    cost: float = Field(description="Cost h of the way, eq. 3")
    score: float = Field(description="c = s − h, eq. 3")
    why: str = Field(description="One sentence for a person to read")
    stop: str | None = Field(description="Why looking on may not pay, or null")


def _decoded(key: str, text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise InputError(key, "is no base64", "encode the bytes of the file") from None
