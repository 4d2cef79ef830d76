"""A scene as one JSON document and flat arrays, and back: what is read goes on exactly as what was written.

A scene is made of a few classes, of arrays, and of plain numbers, texts and containers. Everything in it is
written by the rules below, so that what a class gains later is written too; a class that is not listed is an
error. What the configuration gives or what is only remembered to save time is left out and made anew.

In the document a number, a text, true, false and null stand for themselves; everything else is a list that
begins with a letter: what it is.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config, SegmentationMethod
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject, Stability, Support, SupportGraph
from caryatid.objects.fusion import Evidence
from caryatid.objects.models import ObjectModels, _Parts
from caryatid.objects.points import ObjectPoints, _Seen
from caryatid.scene import Scene
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.joint_registration import Placement, ViewRegistration
from caryatid.sensing.pose_graph import Ties
from caryatid.sensing.registration import RegisteredView
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import VoxelMap

VALUES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(Box, Cloud, Cylinder, Evidence, Placement, RegisteredView, SceneObject, Sphere, Stability),
        *(Support, SupportGraph, SupportSurface, Ties, Uncertainty, VoxelMap, _Parts, _Seen),
    )
}
"""Dataclasses, written field by field."""

MODELS: dict[str, tuple[type, dict[str, Any]]] = {
    "Scene": (Scene, {"config": None, "seed": None, "segmentation": None}),
    "ObjectModels": (ObjectModels, {"_seed": None}),
    "ObjectPoints": (ObjectPoints, {"_thinned": dict}),
    "ViewRegistration": (ViewRegistration, {}),
}
"""Classes that change, written attribute by attribute; but for some, made anew by what stands here."""

SHARED = (SceneObject, Support)
"""What there are many of, which never change: each is turned into text once and kept for the next time."""

SMALL = 36
"""Arrays of up to so many numbers stand in the document itself [1]: poses and sizes."""

Arrays = dict[str, NDArray[Any]]


class SceneWriter:
    """Writes one scene again and again as it grows; remembers the text of what does not change."""

    def __init__(self) -> None:
        self._texts: dict[int, tuple[object, str]] = {}

    def write(self, scene: Scene) -> tuple[str, Arrays]:
        """Turn a scene into text and flat arrays (N,) by type.

        Raises:
            TypeError: It holds something that is not listed above.
        """
        encoder = _Encoder(scene.config, self._texts)
        document = encoder.encode(scene)
        self._texts = encoder.used
        texts = ",".join(text for _, text in encoder.used.values())
        arrays = {
            kind: np.concatenate([part.ravel(order="K") for part in parts])
            for kind, parts in encoder.parts.items()
        }
        return f'{{"scene":{json.dumps(document, separators=(",", ":"))},"shared":[{texts}]}}', arrays


def read_scene(
    text: str, arrays: Arrays, config: Config, segmentation: SegmentationMethod | None, seed: int
) -> Scene:
    """Make a scene of what `SceneWriter.write` gave.

    Args:
        text: The document.
        arrays: Flat arrays by type.
        config: The settings it was made with.
        segmentation: The one it was made with.
        seed: The one it was made with.

    Raises:
        ValueError, KeyError, TypeError, IndexError: This was written by no `SceneWriter`, or another one's.
    """
    document = json.loads(text)
    scene = _Decoder(config, seed, arrays, document["shared"]).decode(document["scene"])
    if not isinstance(scene, Scene):
        raise TypeError("the document holds no scene")
    scene.config, scene.segmentation, scene.seed = config, segmentation, seed
    return scene


class _Encoder:
    """Attributes: parts: large arrays by type; used: text of each shared object, by its identity."""

    def __init__(self, config: Config, known: dict[int, tuple[object, str]]) -> None:
        self.parts: dict[str, list[NDArray[Any]]] = {}
        self.used: dict[int, tuple[object, str]] = {}
        self._sizes: dict[str, int] = {}
        self._numbers: dict[int, int] = {}
        self._known = known
        self._small = False
        self._config = config
        self._stages = {type(getattr(config, f.name)): f.name for f in fields(config)}

    def encode(self, value: Any) -> Any:
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind in SHARED:
            return ["i", self._number(value)]
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, np.generic):
            return ["n", value.dtype.str, value.item()]
        if kind in (list, tuple):
            return ["l" if kind is list else "t", *map(self.encode, value)]
        if kind in (dict, Counter):
            pairs = [[self.encode(k), self.encode(v)] for k, v in value.items()]
            return ["c" if kind is Counter else "d", *pairs]
        if kind is Config or kind in self._stages:
            return ["s", self._stages.get(kind, "")]
        if kind is ViewSphere:
            return ["v", self.encode(value.centre_world)]
        if kind.__name__ in VALUES and is_dataclass(value):
            return self._value(value)
        if kind.__name__ in MODELS:
            left_out = MODELS[kind.__name__][1]
            kept = {name: item for name, item in vars(value).items() if name not in left_out}
            return ["m", kind.__name__, *([name, self.encode(item)] for name, item in kept.items())]
        raise TypeError(f"a scene holds a {kind.__qualname__}, which scene_state cannot write")

    def _value(self, value: Any) -> list[Any]:
        parts = (self.encode(getattr(value, f.name)) for f in fields(value))
        return ["o", type(value).__name__, *parts]

    def _number(self, value: object) -> int:
        """Place of a shared object among the texts."""
        key = id(value)
        if key not in self._numbers:
            held = self._known.get(key)
            if held is None or held[0] is not value:
                self._small = True
                held = value, json.dumps(self._value(value), separators=(",", ":"))
                self._small = False
            self._numbers[key] = len(self._numbers)
            self.used[key] = held
        return self._numbers[key]

    def _array(self, value: NDArray[Any]) -> list[Any]:
        order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        about = [value.dtype.str, value.shape, order, value.flags.writeable]
        if self._small or value.size <= SMALL:
            return ["a", *about, value.ravel(order="C").tolist()]
        start = self._sizes.get(value.dtype.str, 0)
        self._sizes[value.dtype.str] = start + value.size
        whole = value if value.flags.forc else np.ascontiguousarray(value)
        self.parts.setdefault(value.dtype.str, []).append(whole)
        return ["b", *about, start]


class _Decoder:
    def __init__(self, config: Config, seed: int, arrays: Arrays, shared: list[Any]) -> None:
        self._config = config
        self._seed = seed
        self._arrays = arrays
        self._shared = [self.decode(document) for document in shared]

    def decode(self, document: Any) -> Any:
        if not isinstance(document, list):
            return document
        kind, *rest = document
        match kind:
            case "i":
                return self._shared[rest[0]]
            case "a" | "b":
                return self._array(kind == "a", *rest)
            case "n":
                return np.dtype(rest[0]).type(rest[1])
            case "l":
                return [self.decode(item) for item in rest]
            case "t":
                return tuple(self.decode(item) for item in rest)
            case "s":
                return getattr(self._config, rest[0]) if rest[0] else self._config
            case "d" | "c":
                pairs = {self.decode(k): self.decode(v) for k, v in rest}
                return pairs if kind == "d" else Counter(pairs)
            case "v":
                return ViewSphere.around(self.decode(rest[0]), self._config.active)
            case "o":
                return VALUES[rest[0]](*(self.decode(item) for item in rest[1:]))
            case "m":
                return self._model(rest[0], rest[1:])
        raise ValueError(f"'{kind}' begins nothing that is known")

    def _model(self, name: str, attributes: list[Any]) -> Any:
        kind, left_out = MODELS[name]
        model: Any = object.__new__(kind)
        for attribute, make in left_out.items():
            setattr(model, attribute, self._seed if make is None else make())
        for attribute, item in attributes:
            setattr(model, attribute, self.decode(item))
        return model

    def _array(
        self, small: bool, dtype: str, shape: list[int], order: Any, writeable: bool, data: Any
    ) -> NDArray[Any]:
        if small:
            values = np.array(data, dtype=dtype).reshape(shape)
            array = np.array(values, order=order)
        else:
            flat = self._arrays[dtype][data : data + int(np.prod(shape))]
            array = flat.copy().reshape(shape, order=order)
        array.flags.writeable = writeable
        return array
