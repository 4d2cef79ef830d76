"""`caryatid import`: what a robot recorded becomes a recording of a few good views."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import DEFAULTS, SAID, General, Settings, Views, defaults_to

Topic = Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="TOPIC"), SAID]


@dataclass(frozen=True, kw_only=True)
class Import:
    """Turn a robot's recording into a scene folder of sharp views, each from another viewpoint.

    Reads bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or a folder with metadata.yaml), and folders of the
    TUM RGB-D benchmark, which need no topics. Depth must be registered to the colour.

    To try:
      caryatid import pour.bag --out pour
      caryatid import pour.bag --depth /depth/image --info /depth/camera_info --tf map --out pour
      caryatid import rgbd_dataset_freiburg1_desk --out desk
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Bag, or folder with depth.txt."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Scene folder to write, in the BOP format; must be new or empty."""
    depth: Topic = None
    """Depth images: 16UC1 or mono16 [mm], 32FC1 [m], or compressed as PNG. Without: lists them."""
    info: Topic = None
    """Camera of the depth images (CameraInfo)."""
    rgb: Topic = None
    """Colour images that depth is registered to; images then also tell how sharp a frame is."""
    tf: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FRAME"), SAID] = None
    """Frame to be the world, level with z up, such as map or base_link. Without: one frame, no pose."""
    camera: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.json"), SAID] = None
    """Camera of a TUM RGB-D folder: fx, fy, cx, cy [px]. Without: as published, by the folder's name."""
    level: Annotated[bool, SAID] = False
    """Turn the world so that the table, which most views must show, is level: for poses whose z does not
    point up."""
    views: Annotated[Views, defaults_to(DEFAULTS.recording.max_views)] = None
    """Views at the most."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)
    general: tyro.conf.OmitArgPrefixes[General] = field(default_factory=General)

    def __call__(self) -> int:
        """Run the command."""
        config = self.settings.settings()
        from caryatid.cli.importing import run_import

        return run_import(self, config)
