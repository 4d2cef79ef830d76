"""A benchmark's report: the same tables and figures as Markdown and as one HTML page."""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caryatid.benchmark.figures import (
    Figure,
    curves_of,
    draw_conditions,
    draw_group,
    is_removal,
    looks_of,
    table_views,
)
from caryatid.benchmark.statistics import summarise
from caryatid.benchmark.store import ResultStore, describe_provenance, import_pandas
from caryatid.benchmark.suites import SUITES
from caryatid.config import StatisticsConfig
from caryatid.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

NONE = "–"
"""Where there is no figure."""
BY_VIEW = (
    ("f1", "F1", 3),
    ("edge_f1", "F1 of edges", 3),
    ("mean_iou", "Mean IoU", 3),
    ("path", "Path [m]", 2),
)
"""Measures with a column for each view: name, heading, digits."""
REMOVAL = (("unharmed", "Scenes taken apart without harm", 3), ("lifts", "Lifts without harm", 3))
NOTES = (
    "Means are over scenes; the seeds of a scene are averaged first. In brackets: the {confidence:g} % "
    "interval of the percentile bootstrap over scenes, {resamples:,} resamples; a single scene has none. "
    "Failed episodes are counted and listed, and are in no mean. An episode that ends before its last "
    "view keeps what it had.",
    "Differences are paired: a method minus the one it is compared with, over the scenes and seeds both "
    "have. Bold: the interval excludes 0.",
    "Until F1 reaches a threshold: the share of the episodes that ever reach it; the median over all "
    "episodes of the first view that does, and of the path up to there. An episode that never does counts "
    "as longer than any other, so the median is “not reached” where half of them do not. “Mean curve” is "
    "where the curve of mean F1 over mean path first reaches it, straight between views; an end of its "
    "interval is “not reached” where that many resamples do not reach it.",
    "F1 along the path: the area under F1 over the path travelled, divided by its length. F1 holds until "
    "the next view. The length is the median of the methods' mean paths; where an episode ends before, "
    "its last F1 holds.",
)
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>Benchmark</title><style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 1320px; margin: 0 auto; padding: 0 28px; }}
h1, h2 {{ border-bottom: 1px solid #8885; }} .table {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 13.5px; margin: 6px 0 18px; }}
th, td {{ text-align: left; border-bottom: 1px solid #8885; padding: 4px 18px 4px 0; }}
figure {{ display: inline-block; width: min(100%, 620px); margin: 8px 12px 8px 0; vertical-align: top; }}
figure img {{ width: 100%; background: #fff; }} figcaption {{ font-size: 13px; opacity: .75; }}
</style></head><body>
{body}
</body></html>
"""


@dataclass(frozen=True, eq=False, slots=True)
class SuiteResult:
    """What is known of one suite, without its episodes: what tables and figures are made of.

    Attributes:
        name: Of the suite.
        reference: Method the others are compared with.
        planned: Episodes it is to have.
        episodes: Episodes it has, including the failed ones.
        scenes: Number of scenes.
        seeds: Number of seeds.
        failures: Method, condition, scene, seed and error of each failed episode.
        summary: As `summarise` returns it.
    """

    name: str
    reference: str
    planned: int
    episodes: int
    scenes: int
    seeds: int
    failures: list[list[str]]
    summary: pd.DataFrame

    @property
    def methods(self) -> list[str]:
        """Labels of the methods, in order."""
        return list(self.summary["method"].unique())

    def f1(self) -> dict[str, dict[str, list[float]]]:
        """Mean F1 after each view of each method under each condition."""
        rows = self.summary[(self.summary["family"] == "") & (self.summary["quantity"] == "f1")]
        found: dict[str, dict[str, list[float]]] = {c: {} for c in self.summary["condition"].unique()}
        for (condition, method), own in rows.groupby(["condition", "method"], sort=False):
            found[condition][method] = own["value"].tolist()
        return found


def summarise_store(
    store: ResultStore, reference: str | None = None, config: StatisticsConfig | None = None
) -> list[SuiteResult]:
    """Summarise every suite of which something is done.

    Args:
        store: The results.
        reference: Method the others are compared with, in the suites that have it, in place of the suite's.
        config: Resamples, confidence, thresholds.

    Raises:
        InputError: No suite has such a method, or pandas is not installed.
    """
    tables = {name: store.table(name) for name in sorted(store.suites, key=[*SUITES, *store.suites].index)}
    check_reference(reference, {m: None for table in tables.values() for m in table["method"]})
    results = []
    for name, table in tables.items():
        if not len(table):
            continue
        known, methods = SUITES.get(name), set(table["method"])
        wanted = (reference, known.reference if known else None, table["method"].iloc[0])
        chosen = str(next(method for method in wanted if method in methods))
        gap = known.gap if known and known.gap and methods.issuperset(known.gap) else None
        failed = table[table["error"].notna()]
        failures = [
            [
                row.method,
                row.condition,
                Path(row.scene).name,
                str(row.seed),
                row.error.replace(row.scene, Path(row.scene).name),
            ]
            for row in failed.itertuples()
        ]
        episodes = len(table[["method", "condition", "scene", "seed"]].drop_duplicates())
        results.append(
            SuiteResult(
                name, chosen, len(store.suites[name]), episodes, table["scene"].nunique(),
                table["seed"].nunique(), failures, summarise(table, reference=chosen, gap=gap, config=config),
            )
        )  # fmt: skip
    return results


def check_reference(reference: str | None, methods: Collection[str]) -> None:
    """Refuse to compare with a method that is not there.

    Raises:
        InputError: The reference is none of the methods.
    """
    if reference is not None and reference not in methods:
        names = ", ".join(methods) or "none yet"
        raise InputError(f"--reference {reference}", "there is no such method", f"choose one of {names}")


def write_tables(store: ResultStore, folder: Path) -> list[str]:
    """Write the rows of each suite as `SUITE.csv` and, where pyarrow is installed, `SUITE.parquet`.

    Returns:
        What the user should know: how to get what was left out.
    """
    missing = []
    for name in store.suites:
        table = store.table(name)
        table.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
        try:
            table.to_parquet(folder / f"{name}.parquet", index=False)
        except ImportError:
            missing = ['no Parquet without pyarrow: pip install "caryatid[benchmark]"']
    return missing


def write_results(results: Sequence[SuiteResult], about: dict[str, str], path: Path) -> None:
    """Write what tables and figures are made of as compressed JSON, small enough to be committed."""
    suites = [
        {name: getattr(result, name) for name in SuiteResult.__slots__ if name != "summary"}
        | {"summary": result.summary.to_csv(index=False, float_format="%.7g", lineterminator="\n")}
        for result in results
    ]
    text = json.dumps({"about": about, "suites": suites}, ensure_ascii=False)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def read_results(path: Path) -> tuple[list[SuiteResult], dict[str, str]]:
    """Read what `write_results` wrote: the suites, and which code on which machine made them."""
    pandas = import_pandas()
    known = json.loads(gzip.decompress(path.read_bytes()))
    suites = []
    for suite in known["suites"]:
        summary = pandas.read_csv(
            io.StringIO(suite["summary"]), keep_default_na=False, na_values={n: [""] for n in ("low", "high")}
        )
        suites.append(SuiteResult(**suite | {"summary": summary}))
    return suites, known["about"]


def write_page(results: Sequence[SuiteResult], about: dict[str, str], folder: Path, command: str) -> Path:
    """Write `index.html`, which loads nothing from anywhere, and each suite's figures as SVG and PNG."""
    body = []
    for suite, block in _blocks(results, about, command):
        if isinstance(block, Figure):
            (folder / suite).mkdir(parents=True, exist_ok=True)
            (folder / suite / f"{block.name}.svg").write_text(block.svg, encoding="utf-8")
            (folder / suite / f"{block.name}.png").write_bytes(block.png)
        body.append(_html(block))
    page = folder / "index.html"
    page.write_text(PAGE.format(body="\n".join(body)), encoding="utf-8")
    return page


def write_document(results: Sequence[SuiteResult], about: dict[str, str], path: Path, command: str) -> None:
    """Write a Markdown document, and its figures into a folder of its name beside it."""
    folder, parts = path.with_suffix(""), []
    folder.mkdir(parents=True, exist_ok=True)
    for suite, block in _blocks(results, about, command):
        if isinstance(block, Figure):
            file = f"{suite}-{block.name}.svg"
            (folder / file).write_text(block.svg, encoding="utf-8")
            parts.append(f"![{_plain(block.title)}]({folder.name}/{file})\n\n*{_plain(block.caption)}*")
        else:
            parts.append(_markdown(block))
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


@dataclass(frozen=True, slots=True)
class _Heading:
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class _Table:
    title: str
    head: list[str]
    rows: list[list[str]]


_Block = _Heading | _Table | Figure | str


def _blocks(
    results: Sequence[SuiteResult], about: dict[str, str], command: str
) -> Iterator[tuple[str, _Block]]:
    """What a report shows, from top to bottom, each with the name of its suite."""
    yield "", _Heading(1, "Benchmark")
    yield "", f"Run by {describe_provenance(about)}. This page is generated by `{command}`."
    for result in results:
        yield from ((result.name, block) for block in _suite_blocks(result))
    config = StatisticsConfig()
    yield "", _Heading(2, "How to read it")
    for note in NOTES:
        yield "", note.format(confidence=100.0 * config.confidence, resamples=config.resamples)


def _suite_blocks(result: SuiteResult) -> Iterator[_Block]:
    known, summary, looks = SUITES.get(result.name), result.summary, looks_of(result.methods)
    yield _Heading(2, result.name)
    failed = f"{len(result.failures)} failed" if result.failures else "none failed"
    yield (
        f"{known.what if known else ''} {_count(result.episodes, 'episode')} of "
        f"{_count(len(result.methods), 'method')} in {_count(result.scenes, 'scene')} with "
        f"{_count(result.seeds, 'seed')}; {failed}."
    ).strip()
    if result.planned > result.episodes:
        missing = _count(result.planned - result.episodes, "episode")
        yield f"Not finished: {missing} of {result.planned:,} to be run."
    conditions = list(summary["condition"].unique())
    if len(conditions) > 1:
        yield draw_conditions(summary, looks)
    for (condition, family), group in summary.groupby(["condition", "family"], sort=False):
        only = f", {family} scenes only" if family else ""
        yield _Heading(3, f"{result.name}: {condition}{only}")
        scenes = max(group[group["quantity"] == "scenes"]["value"], default=0)
        label = family if len(conditions) < 2 else f"{family} {condition}"
        told = _count(int(scenes), f"{family} scene" if family else "scene")
        if len(conditions) < 2:
            yield from draw_group(group, label, told, result.reference, looks)
        if not family or len(conditions) < 2:
            yield from _tables(group, result.reference, brief=bool(family) or len(conditions) > 1)
    if result.failures:
        yield _Table("Failed episodes", ["method", "condition", "scene", "seed", "error"], result.failures)


def _tables(group: pd.DataFrame, reference: str, *, brief: bool) -> Iterator[_Table]:
    removal = is_removal(group)
    measures = REMOVAL if removal else BY_VIEW[:1] if brief else BY_VIEW
    for measure, title, digits in measures:
        if curves := curves_of(group, measure):
            counts = {m: _counts(group, m, ("scenes", "episodes", "failed")) for m in curves}
            yield _by_view(f"{title}: mean and interval after so many views", curves, digits, counts)
    main, title, _ = measures[0]
    if differences := curves_of(group, f"{main} difference"):
        counts = {m: _counts(group, m, ("paired scenes", "paired episodes")) for m in differences}
        yield _by_view(f"{title} minus that of {reference}, paired", differences, 3, counts, signed=True)
    if gaps := curves_of(group, "gap"):
        yield _by_view("Share of the gap that is closed", gaps, 2, {}, signed=False)
    if removal:
        return
    values = {(r.method, r.quantity, r.at): (r.value, r.low, r.high) for r in group.itertuples()}

    def say(method: str, quantity: str, at: float, digits: int) -> str:
        return _estimate(*values.get((method, quantity, at), (math.nan,) * 3), digits)

    thresholds = sorted({r.at for r in group[group["quantity"] == "share"].itertuples()}, reverse=True)
    methods = list(curves_of(group, "f1"))
    if thresholds:
        rows = []
        for at in thresholds:
            for method in methods:
                share = values.get((method, "share", at), (math.nan,))[0]
                figures = (
                    ("median views", 0),
                    ("median path", 2),
                    ("mean views", 0),
                    ("mean path", 2),
                    ("path ratio", 2),
                )
                cells = [say(method, quantity, at, digits) for quantity, digits in figures]
                rows.append([method, f"{at:.2f}", f"{100.0 * share:.0f} %", *cells])
        head = [
            "method",
            "F1",
            "episodes that reach it",
            "median views",
            "median path [m]",
            "views, mean curve",
        ]
        yield _Table(
            "Until F1 reaches a threshold", [*head, "path, mean curve [m]", f"… by that of {reference}"], rows
        )
    if methods:
        rows = []
        for method in methods:
            cells = [say(method, "area", 0, 3)]
            for kind in ("planning", "perception"):
                low, middle, high = (
                    values.get((method, kind, q), (math.nan,))[0] for q in (0.025, 0.5, 0.975)
                )
                cells += [_time(middle), f"{_time(low)} – {_time(high)}"]
            rows.append([method, *cells])
        budget = max(
            (value[0] for (_, quantity, _), value in values.items() if quantity == "budget"), default=0.0
        )
        head = ["method", f"F1 along the path, over {budget:.2f} m"]
        head += [
            f"{kind}, {what}" for kind in ("planning", "perception") for what in ("median", "middle 95 %")
        ]
        yield _Table(
            "F1 along the path, and time to choose a view (planning) and to see one (perception)", head, rows
        )


def _by_view(
    title: str, curves: dict[str, pd.DataFrame], digits: int, counts: dict[str, str], *, signed: bool = False
) -> _Table:
    views = [v for v in table_views(curves) if not signed or v > 1] or [1]
    rows = []
    for method, curve in curves.items():
        cells = []
        for view in views:
            value, low, high = (
                curve.loc[view, ["value", "low", "high"]] if view in curve.index else (math.nan,) * 3
            )
            cell = _estimate(value, low, high, digits, signed=signed)
            cells.append(f"**{cell}**" if signed and (low > 0.0 or high < 0.0) else cell)
        rows.append([method, *cells, *([counts[method]] if counts else [])])
    last = {3: ["scenes / episodes / failed"], 2: ["scenes / episodes"]}.get(
        len(next(iter(counts.values()), "").split("/"))
    )
    return _Table(
        title, ["method", *(f"view {view:.0f}" for view in views), *(last if counts and last else [])], rows
    )


def _counts(group: pd.DataFrame, method: str, names: Sequence[str]) -> str:
    own = group[group["method"] == method].set_index("quantity")["value"]
    return " / ".join(f"{own.get(name, 0):.0f}" for name in names)


def _number(value: float, digits: int, *, signed: bool = False) -> str:
    if math.isnan(value):
        return NONE
    if math.isinf(value):
        return "not reached"
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else text.lstrip("+-")


def _estimate(value: float, low: float, high: float, digits: int, *, signed: bool = False) -> str:
    text = _number(value, digits, signed=signed)
    if math.isnan(low) or math.isinf(low) or text == NONE:
        return text
    return f"{text} [{_number(low, digits, signed=signed)}, {_number(high, digits, signed=signed)}]"


def _time(seconds: float) -> str:
    """A time in the unit it is best read in, with three digits."""
    if math.isnan(seconds):
        return NONE
    for size, unit in ((1.0, "s"), (1e-3, "ms")):
        if seconds >= 0.9995 * size:
            return f"{seconds / size:#.3g} {unit}".replace(". ", " ")
    return f"{1e6 * seconds:.0f} µs"


def _count(number: int, one: str) -> str:
    return f"{number:,} {one}" + ("" if number == 1 else "s")


def _plain(text: str) -> str:
    """Text that means nothing but itself in Markdown, bold figures aside."""
    return re.sub(r"([\\_<>|~]|\](?=[(\[]))", r"\\\1", " ".join(text.split()))


def _markdown(block: Any) -> str:
    if isinstance(block, _Heading):
        return f"{'#' * block.level} {_plain(block.text)}"
    if isinstance(block, _Table):
        lines = [block.head, ["---"] * len(block.head), *block.rows]
        cells = ["| " + " | ".join(_plain(cell) for cell in line) + " |" for line in lines]
        return "\n".join([f"**{_plain(block.title)}.**", "", *cells])
    return _plain(block)


def _html(block: Any) -> str:
    if isinstance(block, _Heading):
        return f"<h{block.level}>{html.escape(block.text)}</h{block.level}>"
    if isinstance(block, Figure):
        data = base64.b64encode(block.svg.encode()).decode()
        title, caption = html.escape(block.title), html.escape(block.caption)
        image = f'<img alt="{title}" src="data:image/svg+xml;base64,{data}">'
        return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
    if isinstance(block, _Table):
        rows = [f"<tr>{''.join(f'<th>{html.escape(name)}</th>' for name in block.head)}</tr>"]
        for row in block.rows:
            cells = (re.sub(r"^\*\*(.*)\*\*$", r"<b>\1</b>", html.escape(cell)) for cell in row)
            rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
        return f'<h4>{html.escape(block.title)}</h4><div class="table"><table>{"".join(rows)}</table></div>'
    return f"<p>{html.escape(block)}</p>"
