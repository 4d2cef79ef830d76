"""What a report says, before it is a page or a print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from caryatid.io.json_files import DECIMALS
from caryatid.viz.page import Figure, ViewPage
from caryatid.viz.rows import settings_rows
from caryatid.viz.summary import changes

if TYPE_CHECKING:
    from caryatid.evaluation.scores import Score


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """How the graph after a view compares with the truth: vertices and edges together.

    Attributes:
        f1: Of precision and recall [1].
        precision: Share of what was found that is true [1].
        recall: Share of what is true that was found [1].
    """

    f1: float
    precision: float
    recall: float


@dataclass(frozen=True, slots=True)
class Report:
    """All a report says.

    Attributes:
        title: Its heading.
        pages: The views, in order, one at least.
        settings: Names and values of the run's settings.
        scores: Score after each view, or empty where the truth is not known.
        strip: Pictures of the objects being taken away, in order.
    """

    title: str
    pages: tuple[ViewPage, ...]
    settings: tuple[tuple[str, str], ...] = ()
    scores: tuple[ScoreRow, ...] = ()
    strip: tuple[Figure, ...] = ()

    @property
    def changes(self) -> list[str]:
        """What each view changed; nothing of the first."""
        return [changes(a, b) for a, b in zip([None, *self.pages[:-1]], self.pages, strict=True)]

    @property
    def contacts(self) -> list[Contact]:
        """The contact sheet: the views that have a picture."""
        scores = [f"F1 {score.f1:.3f}" for score in self.scores] or [""] * len(self.pages)
        reasons = ["the first view", *(page.reason for page in self.pages[:-1])]
        return [
            Contact(page.number, page.thumbnail, score, f"{reason[:1].upper()}{reason[1:]}")
            for page, score, reason in zip(self.pages, scores, reasons, strict=True)
            if page.thumbnail
        ]


@dataclass(frozen=True, slots=True)
class Contact:
    """One picture of the contact sheet.

    Attributes:
        number: Of the view, as its folder in the run has it.
        svg: Its picture.
        score: Score after the view, or empty.
        reason: Why the view was taken; empty where nobody chose it.
    """

    number: str
    svg: str
    score: str
    reason: str


def compose_report(
    pages: Sequence[ViewPage],
    *,
    title: str,
    settings: Mapping[str, object],
    scores: Sequence[Score] | None = None,
    strip: Sequence[Figure] = (),
) -> Report:
    """Put together what a report says.

    Args:
        pages: The views, in order.
        title: Heading of the report.
        settings: Names and values of the run's settings; mappings and dataclasses in it are flattened.
        scores: Score after each view, where the truth is known; as many as pages.
        strip: Pictures of the objects being taken away, in order.

    Raises:
        ValueError: There are scores, but not one for each page, or there is no page.
    """
    if not pages:
        raise ValueError("a report needs one view at least")
    if scores is not None and len(scores) != len(pages):
        raise ValueError(f"{len(scores)} scores for {len(pages)} views")
    rows = [ScoreRow(_rounded(s.f1), _rounded(s.precision), _rounded(s.recall)) for s in scores or ()]
    kept = [
        replace(
            page,
            timings={stage: _rounded(seconds) for stage, seconds in page.timings.items()},
            angle_travelled=_rounded(page.angle_travelled),
            path_travelled=_rounded(page.path_travelled),
        )
        for page in pages
    ]
    return Report(title, tuple(kept), tuple(settings_rows(settings)), tuple(rows), tuple(strip))


def _rounded(value: float) -> float:
    """A number as JSON keeps it, so that a stored report gives the same pages."""
    return round(float(value), DECIMALS)
