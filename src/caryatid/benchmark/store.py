"""Results on disk: a log with a line per finished episode, and the code behind them."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from caryatid.benchmark.episodes import MEASURES, Episode, Outcome
from caryatid.errors import InputError, needs_extra
from caryatid.io.json_files import parse_json
from caryatid.io.staging import Log
from caryatid.runtime import LIBRARIES

if TYPE_CHECKING:
    import pandas as pd

RESULTS = "results.jsonl"
"""Name of the result file in the folder of a benchmark."""
FORMAT = "4"


@dataclass(frozen=True, slots=True)
class Member:
    """An episode of a suite: the method and condition it is compared as, and the kind of its scene."""

    episode: Episode
    method: str
    condition: str
    family: str


@dataclass(frozen=True, slots=True)
class _Plan:
    """A line with the members of a suite."""

    suite: str
    members: list[Member]


@dataclass(frozen=True, slots=True)
class _Done:
    """A line with the result of an episode."""

    key: str
    rows: tuple[dict[str, int | float | list[list[float | bool]] | None], ...]
    error: str | None


class ResultStore:
    """Planned and finished episodes: a `Log`.

    Args:
        path: Its file; created by a writer.
        fingerprint: Of the code that adds episodes; None only reads. Only one writer is admitted.
        about: Further facts about code and machine, kept if the file is new.

    Raises:
        InputError: The file is missing, not a result file or made by other code, or another run is writing.
    """

    def __init__(
        self, path: Path, fingerprint: str | None = None, about: Mapping[str, str] | None = None
    ) -> None:
        self.path = path
        self.suites: dict[str, list[Member]] = {}
        self.outcomes: dict[str, Outcome] = {}
        if fingerprint is None and not path.is_file():
            raise InputError(path, "the file is missing", "run a suite first: --suite NAME")
        with ExitStack() as failure:
            self._log = failure.enter_context(Log(path, "result file", write=fingerprint is not None))
            code = {"format": FORMAT, "fingerprint": fingerprint}
            if fingerprint is not None and next(iter(self._log), None) is None:
                self._log.append({"about": {**(about or {}), **code}})
            self.about = self._read()
            if fingerprint is not None and not code.items() <= self.about.items():
                told = (self.about.get(name, "") for name in ("version", "commit", "fingerprint"))
                names = " ".join(filter(None, told))
                reason = f"results are not comparable, because the code differs ({names})"
                remedy = "choose another --out, or omit --suite to draw them anyway"
                raise InputError(path, reason, remedy)
            failure.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._log.close()

    def plan(self, suite: str, members: Sequence[Member], *, retry: bool = False) -> list[Episode]:
        """Record the members of a suite, instead of an earlier plan.

        Returns:
            The episodes that are missing (with `retry` also those that failed), each once, in order.
        """
        if self.suites.get(suite) != list(members):
            self._log.append({"suite": suite, "members": [asdict(m) for m in members]})
            self.suites[suite] = list(members)
        known = {key for key, outcome in self.outcomes.items() if outcome.error is None or not retry}
        wanted = {self._key(m.episode): m.episode for m in members}
        return [episode for key, episode in wanted.items() if key not in known]

    def add(self, episode: Episode, outcome: Outcome) -> None:
        """Append the result of an episode; an earlier success stays."""
        key = self._key(episode)
        self._log.append(
            {"key": key, "episode": asdict(episode), "rows": outcome.rows, "error": outcome.error}
        )
        self._keep(key, outcome)

    def table(self, suite: str) -> pd.DataFrame:
        """Finished episodes of a suite: a row per view, in order; one row with the error if it failed.

        Raises:
            InputError: pandas is not installed.
        """
        rows: list[dict[str, Any]] = []
        for member in self.suites.get(suite, ()):
            if outcome := self.outcomes.get(self._key(member.episode)):
                known = asdict(member)
                known |= known.pop("episode") | {"error": outcome.error}
                known["settings"] = json.dumps(member.episode.settings, ensure_ascii=False)
                rows += [known | row for row in outcome.rows or ({},)]
        about = ("method", "condition", "family", *Episode.__slots__)
        columns = [*about, "view", *MEASURES, "forecasts", "error"]
        table = import_pandas().DataFrame(rows, columns=columns)
        try:
            return table.astype({"view": "Int64", "error": "string", **dict.fromkeys(MEASURES, "float64")})
        except (ValueError, TypeError):
            raise InputError(self.path, "is not a result file", "choose another folder") from None

    def _key(self, episode: Episode) -> str:
        return episode.key(self.about["fingerprint"])

    def _keep(self, key: str, outcome: Outcome) -> None:
        if key not in self.outcomes or self.outcomes[key].error is not None:
            self.outcomes[key] = outcome

    def _read(self) -> dict[str, str]:
        """Read all lines; return the first one, about code and machine."""
        try:
            lines = iter(self._log)
            about = parse_json(dict[str, dict[str, str]], next(lines), self.path)["about"]
            if "fingerprint" not in about:
                raise LookupError
            for line in lines:
                if "suite" in line:
                    plan = parse_json(_Plan, line, self.path)
                    self.suites[plan.suite] = plan.members
                else:
                    done = parse_json(_Done, line, self.path)
                    self._keep(done.key, Outcome(done.rows, done.error))
            return about
        except (LookupError, StopIteration, InputError):
            raise InputError(self.path, "is not a result file", "choose another folder") from None


def import_pandas() -> Any:
    """Import pandas.

    Raises:
        InputError: It is not installed.
    """
    with needs_extra("benchmark", "benchmark"):
        import pandas
    return pandas


def collect_provenance() -> dict[str, str]:
    """Code and machine: version, commit, libraries and processor, but nothing about the user."""
    package = Path(__file__).parents[1]
    tracked = _git(package, "ls-files", "__init__.py")
    processors = Path("/proc/cpuinfo")
    model = processors.is_file() and re.search(r"model name\s*:\s*(.*)", processors.read_text("utf-8"))
    return {
        "version": version("caryatid"),
        "commit": (tracked and _git(package, "rev-parse", "HEAD")) or "unknown",
        "dirty": str(bool(tracked and _git(package, "status", "--porcelain", "--", "."))),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": " ".join(model[1].split()) if model else platform.processor() or "unknown",
        "cores": str(os.cpu_count() or "unknown"),
        "libraries": ", ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


def describe_provenance(about: Mapping[str, str]) -> str:
    """Code and machine in one sentence."""
    known = defaultdict(lambda: "unknown", about)
    changed = ", with uncommitted changes" if about.get("dirty") == "True" else ""
    return (
        f"caryatid {known['version']}, commit {known['commit'][:12]}{changed}, on {known['processor']}, "
        f"{known['cores']} cores, {known['platform']}, Python {known['python']}; {about.get('libraries', '')}"
    )


def _git(folder: Path, *arguments: str) -> str:
    """Output of git; empty without git or on failure."""
    try:
        return subprocess.run(
            ["git", "-C", folder, *arguments], capture_output=True, text=True, timeout=30.0, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
