"""What `caryatid import` does and says."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from caryatid.cli.import_recording import Import
from caryatid.cli.progress import Progress
from caryatid.config import Config
from caryatid.io.datasets import Topics
from caryatid.io.importing import Imported, import_recording, reasons
from caryatid.io.json_files import json_text
from caryatid.runtime.interrupts import interruptible


@interruptible()
def run_import(options: Import, config: Config) -> int:
    """Import the recording and say what came of it."""
    if options.views is not None:
        config = replace(config, recording=replace(config.recording, max_views=options.views))
    progress = Progress(options.general.quiet or options.general.json)
    topics = Topics(options.depth, options.info, options.rgb, options.tf)
    with progress.working(f"reading {options.source.name}"):
        imported = import_recording(
            options.source,
            options.out,
            topics,
            camera_file=options.camera,
            level=options.level,
            config=config,
        )
    if options.general.json:
        sys.stdout.write(json_text(_document(options, imported)))
    for note in imported.notes:
        progress.say(note)
    skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
    progress.say(f"{options.source.name}: {len(imported.chosen)} views of {imported.read} frames{skipped}")
    progress.say(f"recording: {options.out}, try `caryatid extract {options.out} --out run`")
    return 0


def _document(options: Import, imported: Imported) -> dict[str, Any]:
    return {
        "recording": str(options.out),
        "frames": imported.read,
        "views": [
            {
                "view": index,
                "frame": frame.number,
                "time": frame.time,
                "posed": frame.T_world_camera is not None,
            }
            for index, frame in enumerate(imported.chosen)
        ],
        "skipped": imported.skipped,
        "notes": list(imported.notes),
    }
