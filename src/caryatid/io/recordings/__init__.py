"""What robots record, bags and TUM RGB-D folders, turned into recordings of a few good views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.io.recordings.bag_footage import Topics
    from caryatid.io.recordings.frame_filter import choose_views
    from caryatid.io.recordings.importing import Imported, import_recording
    from caryatid.io.recordings.transform_tree import TransformTree

__all__ = ["Imported", "Topics", "TransformTree", "choose_views", "import_recording"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "bag_footage": ["Topics"],
            "frame_filter": ["choose_views"],
            "importing": ["Imported", "import_recording"],
            "transform_tree": ["TransformTree"],
        },
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
