"""What robots record, bags and TUM RGB-D folders, turned into recordings of a few good views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.late import imported_late

if TYPE_CHECKING:
    from caryatid.recordings.bag_footage import Topics
    from caryatid.recordings.choosing import choose_views
    from caryatid.recordings.importing import Imported, import_recording
    from caryatid.recordings.transforms import TransformTree

__all__ = ["Imported", "Topics", "TransformTree", "choose_views", "import_recording"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "bag_footage": ["Topics"],
            "choosing": ["choose_views"],
            "importing": ["Imported", "import_recording"],
            "transforms": ["TransformTree"],
        },
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
