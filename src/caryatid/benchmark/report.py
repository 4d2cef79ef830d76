"""A benchmark's report: tables and figures of its suites, as Markdown and as one HTML page.

The same summary gives the same bytes.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import logging
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.benchmark.statistics import BINS, CONFIDENCE, RESAMPLES, summarise
from caryatid.benchmark.store import ResultStore, describe_provenance, import_pandas
from caryatid.benchmark.suites import SUITES
from caryatid.errors import InputError
from caryatid.io.staging import write_file
from caryatid.viz.tables import count_of

if TYPE_CHECKING:
    import pandas as pd

Column = tuple[str, float]
"""A quantity of the summary and its view, threshold or quantile."""
Curves = dict[str, "pd.DataFrame"]
"""Label of a method → value, low and high by view."""
BY_VIEW = {"f1": "F1", "edge_f1": "F1 of edges", "mean_iou": "Mean IoU", "path": "Path [m]"}
CALIBRATION = {
    "listed brier": "Brier score of the supports in the graph, all scenes together",
    "brier gain": "How much lower it is than with doubtful = 0.5, others = 1",
    "calibration error": "Expected calibration error of the supports in the graph",
    "pooled brier": "Brier score including the true supports that the graph lacks",
}
"""Quality of probabilities: quantities with a column for each view, and their headings."""
REMOVAL = {"unharmed": "Scenes taken apart without harm", "lifts": "Lifts without harm"}
"""Measures with a column for each view, and their headings."""
COUNTS = {("scenes", 0.0): "scenes", ("episodes", 0.0): "episodes", ("failed", 0.0): "failed"}
PAIRED = {("paired scenes", 0.0): "scenes", ("paired episodes", 0.0): "episodes"}
TO_THRESHOLD = {
    "share": "episodes that reach it",
    "mean path": "path, mean curve [m]",
    "path ratio": "… relative to the reference",
}
"""Quantities of a threshold of F1, and their headings."""
DIGITS = dict.fromkeys(("path", "mean path", "path ratio", "gap"), 2)
DIGITS |= dict.fromkeys((name for name, _ in (*COUNTS, *PAIRED)), 0)
"""Decimals of quantities that do not have three."""
NOTES = (
    "Means are over scenes; the seeds of a scene are averaged first. In brackets: the {confidence:g} % "
    "interval of the percentile bootstrap over scenes, {resamples:,} resamples; a single scene has none. "
    "Failed episodes are counted and listed, but excluded from the means. An episode that ends early keeps "
    "its last scores.",
    "Differences are paired: a method minus the reference, over the scenes and seeds of both. Bold: the "
    "interval excludes 0.",
    "Until F1 reaches a threshold: the share of episodes that reach it, and the path after which the curve "
    "of mean F1 over mean path first does, with straight lines between views; an end of its interval is “not "
    "reached” if that many resamples do not reach it.",
    "Probabilities are those of supports between true objects, in all scenes together. The Brier score is "
    "the mean of (p − true)²; 0 is perfect; a support that the graph lacks has p = 0. The expected "
    "calibration error is the mean difference between probability and share of true supports in {bins} "
    "equal bins of probability, weighted by the number of supports in each.",
)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
"""Colours of Okabe and Ito, distinct for any colour vision; without their yellow, too pale for a line."""
MARKERS, DASHES = "os^DvPX", ("-", "--", ":")
STYLE = {
    "font.size": 9.0, "axes.spines.right": False, "axes.spines.top": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "#e3e6e8", "svg.fonttype": "none", "text.parse_math": False,
    "lines.markersize": 5.0, "legend.frameon": False,
}  # fmt: skip
"""matplotlib settings that differ from its defaults; a user's own settings have no effect."""
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>Benchmark</title><style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 1320px; margin: 0 auto; padding: 0 28px; }}
h1, h2 {{ border-bottom: 1px solid #8885; }}
table {{ display: block; overflow-x: auto; border-collapse: collapse; font-size: 13.5px; }}
th, td {{ text-align: left; border-bottom: 1px solid #8885; padding: 4px 18px 4px 0; }}
img {{ width: min(100%, 620px); background: #fff; }}
</style></head><body>
{body}
</body></html>
"""


@dataclass(frozen=True, eq=False, slots=True)
class SuiteResult:
    """Data of one suite for tables and figures: numbers of its episodes, scenes and seeds, and the summary.

    Attributes:
        episodes: Number of finished episodes, including failed ones.
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

    def f1(self) -> dict[str, dict[str, list[float]]]:
        """Mean F1 after each view, by condition and method."""
        return {
            condition: {name: own["value"].tolist() for name, own in curves_of(rows, "f1").items()}
            for condition, rows in conditions_of(self.summary)
        }

    @property
    def measures(self) -> Mapping[str, str]:
        """Measures with a column for each view and their headings, the main one first."""
        lifts = self.summary["value"][self.summary["quantity"] == "lifts"]
        return REMOVAL if (lifts > 0.0).any() else BY_VIEW

    def verdicts(self) -> Iterator[str]:
        """Say of each method whether its main measure at the last view differs from the reference's."""
        main, heading = next(iter(self.measures.items()))
        rows = self.summary.query(f"quantity == '{main} difference' and family == ''")
        for (condition, method), own in rows.groupby(["condition", "method"], sort=False):
            view, *found = own[["at", "value", "low", "high"]].iloc[-1]
            said = "better" if found[1] > 0.0 else "worse" if found[2] < 0.0 else "not told apart"
            figures = f"{heading} at view {view:.0f} {_text(f'{main} difference', *found).strip('*')}"
            yield f"{self.name}, {condition}: {method} against {self.reference}: {figures}, {said}"


def write_report(store: ResultStore, folder: Path, reference: str | None = None) -> list[SuiteResult]:
    """Write tables, figures and a page of all results.

    Returns:
        The suites with at least one episode.

    Raises:
        InputError: pandas is not installed.
    """
    results = summarise_store(store, reference)
    _write_tables(store, folder)
    for result in results:
        for verdict in result.verdicts():
            logging.getLogger(__name__).info(verdict)
    if results:
        command = f"caryatid benchmark --out {folder.name}"
        if reference is not None:
            command += f" --reference {shlex.quote(reference)}"
        write_results(results, store.about, folder / "summary.json.gz")
        _write_page(results, store.about, folder, command)
    return results


def summarise_store(store: ResultStore, reference: str | None = None) -> list[SuiteResult]:
    """Summarise every suite with at least one episode; the reference replaces that of suites that have it.

    Raises:
        InputError: pandas is not installed.
    """
    results = []
    for name in sorted(store.suites, key=[*SUITES, *store.suites].index):
        table, known = store.table(name), SUITES.get(name)
        methods = list(table["method"].unique())
        if not methods:
            continue
        wanted = (reference, known.reference if known else None, *methods)
        chosen = next(method for method in wanted if method in methods)
        failures = []
        for row in table[table["error"].notna()].itertuples():
            scene = Path(row.scene).name
            error = row.error.replace(row.scene, scene)
            failures.append([row.method, row.condition, scene, str(row.seed), error])
        planned, scenes, seeds = len(store.suites[name]), table["scene"].nunique(), table["seed"].nunique()
        episodes = len(table[["method", "condition", "scene", "seed"]].drop_duplicates())
        summary = summarise(table, reference=chosen, gap=known.gap if known else None)
        results.append(SuiteResult(name, chosen, planned, episodes, scenes, seeds, failures, summary))
    return results


def check_reference(reference: str | None, store: ResultStore) -> None:
    """Refuse to compare with a method that no planned suite has.

    Raises:
        InputError: The reference is none of the methods.
    """
    methods = {member.method: None for members in store.suites.values() for member in members}
    if reference is not None and reference not in methods:
        names = ", ".join(methods) or "none yet"
        raise InputError(f"--reference {reference}", "unknown method", f"choose one of {names}")


def _write_tables(store: ResultStore, folder: Path) -> None:
    """Write the rows of each suite as `SUITE.csv`."""
    for name in store.suites:
        table = store.table(name).drop(columns="forecasts")
        table.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")


def write_results(results: Sequence[SuiteResult], about: dict[str, str], path: Path) -> None:
    """Write the data of tables and figures as compressed JSON, small enough to commit."""
    suites = [
        asdict(each) | {"summary": each.summary.to_csv(index=False, float_format="%.7g", lineterminator="\n")}
        for each in results
    ]
    text = json.dumps({"about": about, "suites": suites}, ensure_ascii=False)
    write_file(path, gzip.compress(text.encode(), mtime=0))


def read_results(path: Path) -> tuple[list[SuiteResult], dict[str, str]]:
    """Read the output of `write_results`: the suites, and the code and machine that made them."""
    pandas = import_pandas()
    known = json.loads(gzip.decompress(path.read_bytes()))
    suites = []
    for suite in known["suites"]:
        summary = pandas.read_csv(
            io.StringIO(suite["summary"]),
            keep_default_na=False,
            na_values={n: [""] for n in ("value", "low", "high")},
        )
        suites.append(SuiteResult(**suite | {"summary": summary}))
    return suites, known["about"]


def _write_page(results: Sequence[SuiteResult], about: dict[str, str], folder: Path, command: str) -> None:
    """Write `index.html`, which needs no other file, and each suite's figures as SVG and PNG."""
    from markdown_it import MarkdownIt

    def keep(suite: str, figure: Figure) -> str:
        (folder / suite).mkdir(exist_ok=True)
        file = folder / suite / f"{figure.name}.svg"
        figure.save(file.with_name(f"{figure.name}.png"))
        figure.save(file)
        return f"data:image/svg+xml;base64,{base64.b64encode(file.read_bytes()).decode()}"

    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    reader.validateLink = lambda url: url.startswith("data:image/svg+xml;")  # type: ignore[method-assign]
    text = reader.render(_markdown(results, about, command, keep))
    write_file(folder / "index.html", PAGE.format(body=text).encode())


def write_document(results: Sequence[SuiteResult], about: dict[str, str], path: Path, command: str) -> None:
    """Write a Markdown document, and its figures into a folder of its name beside it."""
    folder = path.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)

    def keep(suite: str, figure: Figure) -> str:
        figure.save(folder / f"{suite}-{figure.name}.svg")
        return f"{folder.name}/{suite}-{figure.name}.svg"

    write_file(path, _markdown(results, about, command, keep).encode())


def _markdown(
    results: Sequence[SuiteResult], about: dict[str, str], command: str, keep: Callable[[str, Figure], str]
) -> str:
    """The report; `keep` stores a figure of a suite and returns its place."""
    names = ", ".join(result.name for result in results)
    blocks = [_plain(f"# Benchmark: {names}")]
    blocks.append(f"Run by {_plain(describe_provenance(about))}. This page is generated by `{command}`.")
    for result in results:
        for block in _suite(result):
            if isinstance(block, Figure):
                caption = _plain(block.caption)
                block = f"![{caption}]({keep(result.name, block)})\n\n*{caption}*"
            blocks.append(block)
    blocks.append("## How to read it")
    blocks += [n.format(confidence=100.0 * CONFIDENCE, resamples=RESAMPLES, bins=BINS) for n in NOTES]
    return "\n\n".join(blocks) + "\n"


def _suite(result: SuiteResult) -> Iterator[str | Figure]:
    """The parts of a suite's report, from top to bottom."""
    known, summary = SUITES.get(result.name), result.summary
    conditions = summary["condition"].nunique()
    measures = result.measures
    main, heading = next(iter(measures.items()))
    yield f"## {_plain(result.name)}"
    failed = f"{len(result.failures)} failed" if result.failures else "none failed"
    yield _plain(
        f"{known.what if known else ''} {count_of(result.episodes, 'episode')} of "
        f"{count_of(summary['method'].nunique(), 'method')} in {count_of(result.scenes, 'scene')} with "
        f"{count_of(result.seeds, 'seed')}; {failed}."
    )
    if result.planned > result.episodes:
        missing = count_of(result.planned - result.episodes, "episode")
        yield f"Not finished: {missing} of {result.planned:,} remain."
    if conditions > 1:
        yield draw_conditions(summary, main, heading)
    for (condition, family), group in summary.groupby(["condition", "family"], sort=False):
        if family and conditions > 1:
            continue
        only = f", {family} scenes only" if family else ""
        yield f"### {_plain(f'{result.name}: {condition}{only}')}"
        if conditions == 1:
            yield from draw_group(group, main, heading, result.reference)
        shown = {main: heading} if family or conditions > 1 else measures
        yield from _tables(group, shown, result.reference)
    if result.failures:
        yield _table("Failed episodes", ("method", "condition", "scene", "seed", "error"), result.failures)


def _tables(group: pd.DataFrame, measures: Mapping[str, str], reference: str) -> Iterator[str]:
    """Tables of the methods under one condition, each a part of the summary."""
    texts = [_text(*row) for row in group[["quantity", "value", "low", "high"]].itertuples(index=False)]
    cells = group.assign(text=texts).pivot(index="method", columns=["quantity", "at"], values="text")
    cells = cells.reindex(group["method"].unique())
    main = next(iter(measures))
    last = max(group["at"][group["quantity"] == main], default=0)

    def by_view(quantity: str) -> dict[Column, str]:
        views = sorted({view for view in (1, 2, 3, 5, 10, last) if 0 < view <= last})
        return {(quantity, view): f"view {view:.0f}" for view in views}

    tables: dict[str, Mapping[Column, str]] = {
        f"{heading} after each view: mean and interval": by_view(measure) | COUNTS
        for measure, heading in measures.items()
    }
    title = f"{measures[main]} minus that of {reference}, paired"
    tables[title] = by_view(f"{main} difference") | PAIRED
    tables["Share of the gap closed"] = by_view("gap")
    if not group["family"].iloc[0]:
        tables |= {heading: by_view(quantity) for quantity, heading in CALIBRATION.items()}
    if main == "f1":
        for at in sorted(group["at"][group["quantity"] == "share"].unique(), reverse=True):
            tables[f"Until F1 reaches {at:.2f}"] = {(name, at): text for name, text in TO_THRESHOLD.items()}
    for title, columns in tables.items():
        used = [column for column in columns if column in cells]
        if used and used[0] == next(iter(columns)):
            lines = cells[used].dropna(subset=used[:1]).fillna("–").itertuples(name=None)
            yield _table(title, ("method", *(columns[column] for column in used)), lines)


def _table(title: str, head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = ["| " + " | ".join(_plain(cell) for cell in line) + " |" for line in (head, *lines)]
    rows.insert(1, "| --- " * len(head) + "|")
    return "\n".join([f"**{_plain(title)}.**", "", *rows])


def _text(quantity: str, value: float, low: float, high: float) -> str:
    """A value with its interval, in the decimals of its quantity; bold if it is a difference other than 0."""
    if quantity == "share":
        return f"{100.0 * value:.0f} %"
    if quantity == "brier gain":
        text = f"{100.0 * value:.0f} %" if math.isfinite(value) else "–"
        return f"{text} [{100.0 * low:.0f}, {100.0 * high:.0f}]" if math.isfinite(low + high) else text
    digits, sign = DIGITS.get(quantity, 3), "+" if quantity.endswith(" difference") else ""

    def number(value: float) -> str:
        if math.isinf(value):
            return "not reached"
        text = f"{value:{sign}.{digits}f}"
        return text.replace("-", "−") if float(text) else text.lstrip("+-")

    if math.isnan(value):
        return "–"
    if math.isnan(low) or math.isinf(low):
        return number(value)
    text = f"{number(value)} [{number(low)}, {number(high)}]"
    return f"**{text}**" if sign and (low > 0.0 or high < 0.0) else text


def _plain(text: str) -> str:
    """Text escaped for Markdown, except bold figures."""
    return re.sub(r"([\\_<>|~]|\](?=[(\[]))", r"\\\1", " ".join(text.split()))


# Figures


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """A figure: name of its file without suffix, caption, height [in], and the function that draws it."""

    name: str
    caption: str
    height: float
    plot: Callable[[Any], None]

    def save(self, path: Path) -> None:
        """Write it as SVG or PNG, by the suffix, without author and date."""
        from matplotlib import style
        from matplotlib.figure import Figure as Drawing

        metadata = {"Date": None, "Creator": None} if path.suffix == ".svg" else {"Software": None}
        with style.context(["default", STYLE | {"svg.hashsalt": self.name}]):
            drawing = Drawing(figsize=(7.2, self.height), facecolor="white", layout="constrained")
            self.plot(drawing)
            drawing.savefig(path, dpi=160, metadata=metadata)


def draw_group(group: pd.DataFrame, measure: str, heading: str, reference: str) -> Iterator[Figure]:
    """Draw a measure, such as `f1`, of the methods under one condition, in all scenes or one family's."""
    family = group["family"].iloc[0]
    scenes = f"{family or 'all'} scenes"
    curves, path = curves_of(group, measure), curves_of(group, "path")
    if curves:
        caption = f"{heading} after each view: mean over {scenes}, with intervals."
        yield _figure(f"{measure} over views {family}", caption, 14, partial(_lines, curves, None, heading))
    if curves and path and measure == "f1":
        caption = f"{heading} over path length, with a mark for each view: mean over {scenes}."
        yield _figure(f"f1 over path {family}", caption, 14, partial(_lines, curves, path, heading))
    if differences := curves_of(group, f"{measure} difference"):
        label = f"{heading} minus that of {reference}"
        caption = f"{label} in {scenes}, paired: mean and interval. Pale: the interval includes 0."
        plot = partial(_rows, differences, label, zero=True)
        yield _figure(f"{measure} differences {family}", caption, len(differences), plot)
    panels = {view: curves_of(group, f"reliability {view}").get(reference) for view in (1, 2, 3, 5)}
    shown = {view: curve for view, curve in panels.items() if curve is not None}
    if shown and not family:
        numbers = {view: curves_of(group, f"supports {view}")[reference] for view in shown}
        caption = f"Reliability of {reference}: share of supports of a probability that are true, with "
        caption += "intervals. A larger mark stands for more supports. On the line, probabilities are right."
        yield _figure("reliability", caption, 6, partial(_reliability, shown, numbers))


def draw_conditions(summary: pd.DataFrame, measure: str, heading: str) -> Figure:
    """Draw a measure under each condition, one method below the other."""
    curves = {
        f"{condition}: {method}": curve
        for condition, group in conditions_of(summary)
        for method, curve in curves_of(group, measure).items()
    }
    caption = f"{heading} under each condition: mean over scenes, with intervals."
    return _figure(f"{measure} by condition", caption, len(curves), partial(_rows, curves, heading))


def conditions_of(summary: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Each condition, and the rows of all its scenes together."""
    yield from summary[summary["family"] == ""].groupby("condition", sort=False)


def curves_of(group: pd.DataFrame, quantity: str) -> Curves:
    """Value, low and high by view of each method that has this quantity."""
    rows = group[group["quantity"] == quantity]
    return {str(method): own.set_index("at") for method, own in rows.groupby("method", sort=False)}


def _figure(name: str, caption: str, rows: int, plot: Callable[[Any], None]) -> Figure:
    name = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")
    return Figure(name, caption, 0.9 + 0.22 * max(rows, 2), plot)


def _lines(curves: Curves, path: Curves | None, label: str, figure: Any) -> None:
    """Plot a line for each curve, over views or path length."""
    axes = figure.subplots()
    for index, (method, curve) in enumerate(curves.items()):
        turn, place = divmod(index, len(COLOURS))
        look = {"color": COLOURS[place], "marker": MARKERS[place], "linestyle": DASHES[turn % len(DASHES)]}
        # Side by side, so that intervals of one view do not hide each other.
        at = curve.index + 0.4 * ((index + 0.5) / len(curves) - 0.5)
        errors = {"yerr": _interval(curve)}
        if path is not None:
            at, errors["xerr"] = path[method]["value"], _interval(path[method])
        axes.errorbar(at, curve["value"], elinewidth=0.9, label=method, **errors, **look)
    axes.set(ylabel=label, xlabel="path over the floor [m]" if path else "views")
    axes.set_ylim(None, min(1.0, axes.get_ylim()[1]))
    axes.xaxis.get_major_locator().set_params(integer=path is None)
    figure.legend(loc="outside right center")


def _rows(curves: Curves, label: str, figure: Any, *, zero: bool = False) -> None:
    """Plot a panel for up to four views, with a row for each curve."""
    last = max(curve.index.max() for curve in curves.values())
    views = sorted({view for view in (2, 3, 5, 10, last) if view <= last})[-4:]
    panels = figure.subplots(1, len(views), sharex=True, sharey=True, squeeze=False)[0]
    for panel, view in zip(panels, views, strict=True):
        for y, curve in enumerate(curves.values()):
            row = curve[curve.index == view]
            pale = zero and bool(((row["low"] <= 0.0) & (row["high"] >= 0.0)).any())
            look = {"marker": "o", "elinewidth": 0.9, "alpha": 0.4 if pale else 1.0}
            panel.errorbar(row["value"], [y] * len(row), xerr=_interval(row), color=COLOURS[0], **look)
        if zero:
            panel.axvline(0.0, color="#5d666f", linewidth=0.9, zorder=1)
        panel.set_title(f"view {view:.0f}", fontsize=9.0)
    panels[0].set(ylim=(len(curves) - 0.5, -0.5))
    panels[0].set_yticks(range(len(curves)), list(curves))
    figure.supxlabel(label, fontsize=9.0)


def _reliability(curves: dict[int, pd.DataFrame], numbers: dict[int, pd.DataFrame], figure: Any) -> None:
    """Plot a panel for each view: share of true supports over probability."""
    panels = figure.subplots(1, len(curves), sharex=True, sharey=True, squeeze=False)[0]
    for panel, (view, curve) in zip(panels, curves.items(), strict=True):
        number = numbers[view]["value"]
        panel.plot((0.0, 1.0), (0.0, 1.0), color="#5d666f", linewidth=0.9, zorder=1)
        look = {"color": COLOURS[0], "clip_on": False}
        panel.errorbar(curve.index, curve["value"], _interval(curve), fmt="none", elinewidth=0.9, **look)
        panel.scatter(curve.index, curve["value"], 12.0 + 100.0 * number / number.sum(), zorder=3, **look)
        panel.set_title(f"view {view}, {number.sum():,.0f} supports", fontsize=9.0)
        panel.set_aspect("equal")
    panels[0].set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), ylabel="share of true supports")
    figure.supxlabel("probability", fontsize=9.0)


def _interval(curve: pd.DataFrame) -> Any:
    """Extent of the interval below and above each value (2, N)."""
    return np.abs([curve["value"] - curve["low"], curve["high"] - curve["value"]])
