"""Masks from another program or a learned segmenter, and masks of ignored pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.images import MASK_MODES, decode_image, read_mask, read_npy
from caryatid.io.json_files import read_names
from caryatid.segmentation.observation import label_image, observe
from caryatid.sensing.masks import labels_from_masks
from caryatid.sensing.views import View

MaskSource = Callable[[View], View]
"""Adds masks to a view, as segments of that view alone."""

ONNX: Final = "onnx:"
"""Prefix of a mask source that ends with the file of a model."""


def mask_source(name: str, config: Config, seed: int = 0) -> MaskSource:
    """Return the source of masks: `onnx:FILE`, a model, or a folder. The seed is that of a model's prompts.

    Raises:
        InputError: There is no such file or folder, or the model does not return instance masks.
    """
    if name.startswith(ONNX):
        return OnnxMasks(Path(name.removeprefix(ONNX)), config, seed)
    folder = Path(name)
    if not folder.is_dir():
        raise InputError(name, "no such folder", "give a folder of masks, or onnx:FILE")
    return partial(with_stored_masks, folder, max_pixels=config.recording.max_pixels)


def with_stored_masks(folder: Path, view: View, max_pixels: int) -> View:
    """Return a view with masks from the file named after it: a label image `NAME.png`, or `NAME.npy`.

    NAME is the view's after the last slash. A `.npy` holds labels (H, W) or a stack of masks (N, H, W),
    boolean or scores. `NAME.json` may name the labels of this view, {"1": "mug"}, and `names.json` those of
    views without one.

    Raises:
        InputError: There is no such file, or it is broken or of another size.
    """
    name = view.name.rpartition("/")[2]
    image, array = folder / f"{name}.png", folder / f"{name}.npy"
    if image.exists():
        labels = decode_image(image, modes=MASK_MODES, what="a grey PNG", max_pixels=max_pixels)
    elif array.exists():
        labels = read_npy(array)
    else:
        raise InputError(folder, f"has no masks for '{name}'", f"add {image.name} or {array.name}")
    return replace(view, labels=labels, labels_are="segments", names=read_names(folder, name))


def without_ignored(view: View, ignore: Path, max_pixels: int) -> View:
    """Return a view without the pixels where a mask is not 0, such as those of the robot's own arm.

    The mask is a grey PNG for all views of a camera, or a folder with one NAME.png per view.

    Raises:
        InputError: The mask is missing, broken, or of another size.
    """
    mask = ignore / f"{view.name.rpartition('/')[2]}.png" if ignore.is_dir() else ignore
    return replace(view, ignored=read_mask(mask, max_pixels=max_pixels))


class OnnxMasks:
    """A class-agnostic instance segmenter as an ONNX model, run on the CPU.

    Inputs are float32 and have names; all are optional, but not the first three together. If H and W are
    fixed, images are resized.

    * `image` (1, 3, H, W): RGB in [0, 1].
    * `depth` (1, 1, H, W): depth along the optical axis [m], 0 where there is no reading.
    * `xyz` (1, 3, H, W): points in the camera frame [m], 0 where there is no reading.
    * `boxes` (N, 4): x, y of two corners [px] around our own automatic segments, as prompts.

    Outputs are `masks` and, optionally, `scores` (N,). Masks are (N, H, W), with any extra axes of length 1:
    boolean, scores in [0, 1], or logits, which are above 0 in the mask.

    Raises:
        InputError: There is no such file, or it has other inputs or outputs.
    """

    def __init__(self, path: Path, config: Config, seed: int = 0) -> None:
        from caryatid.segmentation.affinities import open_network

        if not path.is_file():
            raise InputError(path, "the file is missing", "give an ONNX model")
        try:
            self._session = open_network(path)
        except Exception as error:  # onnxruntime's own exceptions have no common base
            reason = f"onnxruntime cannot read it ({' '.join(str(error).split())})"
            raise InputError(path, reason, "export it again") from None
        self._path, self._config, self._seed = path, config, seed
        inputs = {i.name: i for i in self._session.get_inputs()}
        outputs = [o.name for o in self._session.get_outputs()]
        images = [name for name in ("image", "depth", "xyz") if name in inputs]
        if not images or "masks" not in outputs or inputs.keys() - {*images, "boxes"}:
            reason = f"has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}"
            remedy = "export it with inputs image, depth or xyz (and boxes) and outputs masks (and scores)"
            raise InputError(path, reason, remedy)
        self._inputs, self._outputs = set(inputs), [o for o in ("masks", "scores") if o in outputs]
        height, width = inputs[images[0]].shape[2:]
        fixed = isinstance(height, int) and isinstance(width, int)
        self._size: tuple[int, int] | None = (height, width) if fixed else None

    def __call__(self, view: View) -> View:
        """Return the view with the masks of the model.

        Raises:
            InputError: It lacks colour that the model requires, or the model fails or does not return masks.
        """
        height, width = self._size or view.depth.shape
        nearest, given = _pixels((height, width), view.depth.shape), dict[str, NDArray[np.float32]]()
        if "image" in self._inputs:
            if view.rgb is None:
                raise InputError(view.name, "has no colour image, which the model requires", "record colour")
            image = Image.fromarray(view.rgb).resize((width, height), Image.Resampling.BILINEAR)
            rgb = np.asarray(image, dtype=np.float32) / np.float32(255.0)
            given["image"] = rgb.transpose(2, 0, 1)[None]
        if "depth" in self._inputs:
            given["depth"] = view.depth[nearest][None, None]
        if "xyz" in self._inputs:
            given["xyz"] = view.points_camera.astype(np.float32)[nearest].transpose(2, 0, 1)[None]
        if "boxes" in self._inputs:
            scale = np.array([width, height] * 2) / np.array([*view.depth.shape[::-1]] * 2)
            given["boxes"] = (self._prompts(view) * scale).astype(np.float32)
        try:
            results = self._session.run(self._outputs, given)
        except Exception as error:  # onnxruntime's own exceptions have no common base
            reason = f"fails on {view.name} ({' '.join(str(error).split())})"
            raise InputError(self._path, reason, "check its input sizes") from None
        masks = np.asarray(results[0])
        masks = masks.reshape(-1, *masks.shape[-2:]) if masks.ndim > 3 else masks
        if masks.dtype != np.bool_ and masks.size and masks.min() < 0.0:
            masks = masks > 0.0
        if masks.ndim == 3 and masks.shape[1:] != view.depth.shape:
            rows, columns = _pixels(view.depth.shape, masks.shape[1:])
            masks = masks[:, rows, columns]
        scores = np.asarray(results[1]).ravel() if len(results) > 1 else None
        return replace(view, labels=labels_from_masks(masks, scores), labels_are="segments", names=None)

    def _prompts(self, view: View) -> Array:
        """Boxes (N, 4) around the automatic segments of a view [px]."""
        rng = np.random.default_rng(self._seed)
        observation = observe(view, self._config, segmentation="auto", known=(), rng=rng)
        labels = label_image(observation, view)
        boxes = []
        for label in observation.shown_objects:
            rows, columns = np.nonzero(labels == label)
            boxes.append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
        return np.array(boxes, dtype=np.float64).reshape(-1, 4)


def _pixels(size: tuple[int, ...], of: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Rows and columns that make an image of a size (H, W) of one of another, by nearest neighbours."""
    return np.ix_(*(np.arange(n) * m // n for n, m in zip(size, of, strict=True)))
