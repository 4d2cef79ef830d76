"""Results on disk: an SQLite file that takes one finished episode a transaction."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from caryatid.benchmark.records import MEASURES, Episode, Member, Outcome, Record, ViewRow
from caryatid.errors import InputError

FORMAT = "2"
"""Version of the tables below."""

_TABLES = f"""
CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE episodes (key TEXT PRIMARY KEY, episode TEXT NOT NULL, error TEXT);
CREATE TABLE views (
    key TEXT NOT NULL REFERENCES episodes, view INTEGER NOT NULL,
    {", ".join(f"{name} REAL NOT NULL" for name in MEASURES)}, PRIMARY KEY (key, view)
);
CREATE TABLE members (
    suite TEXT NOT NULL, position INTEGER NOT NULL, key TEXT NOT NULL, episode TEXT NOT NULL,
    method TEXT NOT NULL, condition TEXT NOT NULL, family TEXT NOT NULL, PRIMARY KEY (suite, position)
);
"""


class ResultStore:
    """What was asked for and what is done, safe at any moment: what is being run is either whole or absent.

    Args:
        path: SQLite file; made if missing.
        fingerprint: Of the code that adds episodes; None reads only.
        about: What is told of the code and machine beside, kept where the file is new.

    Raises:
        InputError: The file is missing, no result store, or was made by another version.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        fingerprint: str | None = None,
        about: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        if fingerprint is None and not self.path.is_file():
            raise InputError(self.path, "there is no result store", "run a suite first: --suite NAME")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(self.path, isolation_level=None, timeout=30.0)
        except (OSError, sqlite3.Error) as error:
            raise InputError(self.path, f"cannot be opened ({error})", "choose another folder") from None
        try:
            self._prepare(fingerprint, about or {})
        except sqlite3.DatabaseError as error:
            self._database.close()
            raise InputError(self.path, f"is no result store ({error})", "choose another folder") from None
        except InputError:
            self._database.close()
            raise
        self._fingerprint = fingerprint or self.about()["fingerprint"]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Be the only run on this file, till the end or till death; others may read it meanwhile.

        Raises:
            InputError: Another run is on it.
        """
        path = self.path.with_name(f"{self.path.name}-run")
        lock = sqlite3.connect(path, isolation_level=None, timeout=0.0)
        try:
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.OperationalError as error:
                busy = error.sqlite_errorcode == sqlite3.SQLITE_BUSY
                reason = "another run is under way" if busy else f"cannot be locked ({error})"
                raise InputError(self.path, reason, "wait for its end, or choose another --out") from None
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
        finally:
            lock.close()

    def about(self) -> dict[str, str]:
        """Fingerprint, format and what else was told of code and machine."""
        return dict(self._database.execute("SELECT name, value FROM about ORDER BY name"))

    def suites(self) -> list[str]:
        """Names of the suites that were asked for."""
        rows = self._database.execute("SELECT suite FROM members GROUP BY suite ORDER BY min(rowid)")
        return [name for (name,) in rows]

    def plan(self, suite: str, members: Sequence[Member]) -> list[Episode]:
        """Remember what a suite consists of, in place of what it consisted of before.

        Args:
            suite: Its name.
            members: Its episodes.

        Returns:
            Those that are not done, each once, in order.
        """
        rows = [
            (suite, i, m.episode.key(self._fingerprint), _dump(m.episode), m.method, m.condition, m.family)
            for i, m in enumerate(members)
        ]
        with _transaction(self._database):
            self._database.execute("DELETE FROM members WHERE suite = ?", (suite,))
            self._database.executemany("INSERT INTO members VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
        done = {key for (key,) in self._database.execute("SELECT key FROM episodes")}
        wanted = {row[2]: m.episode for row, m in zip(rows, members, strict=True)}
        return [episode for key, episode in wanted.items() if key not in done]

    def add(self, episode: Episode, outcome: Outcome) -> None:
        """Keep what an episode gave, in one transaction; one that is there already stays as it is."""
        key = episode.key(self._fingerprint)
        with _transaction(self._database):
            row = (key, _dump(episode), outcome.error)
            if self._database.execute("INSERT OR IGNORE INTO episodes VALUES (?, ?, ?)", row).rowcount == 0:
                return
            places = ", ".join("?" * (2 + len(MEASURES)))
            views = [(key, r.view, *(getattr(r, name) for name in MEASURES)) for r in outcome.rows]
            self._database.executemany(f"INSERT INTO views VALUES ({places})", views)

    def forget_failures(self) -> None:
        """Forget the episodes that failed, so that they are run again."""
        with _transaction(self._database):
            self._database.execute("DELETE FROM episodes WHERE error IS NOT NULL")

    def records(self, suite: str) -> list[Record]:
        """What is done of a suite, in its order."""
        errors = dict(self._database.execute("SELECT key, error FROM episodes"))
        rows: dict[str, list[ViewRow]] = {}
        for key, *values in self._database.execute("SELECT * FROM views ORDER BY key, view"):
            rows.setdefault(key, []).append(ViewRow(*values))
        members = self._database.execute(
            "SELECT key, episode, method, condition, family FROM members WHERE suite = ? ORDER BY position",
            (suite,),
        )
        return [
            Record(
                Member(_load(episode), method, condition, family),
                Outcome(tuple(rows.get(key, ())), errors[key]),
            )
            for key, episode, method, condition, family in members
            if key in errors
        ]

    def planned(self, suite: str) -> int:
        """How many episodes a suite consists of."""
        counted = self._database.execute("SELECT count(*) FROM members WHERE suite = ?", (suite,))
        (count,) = counted.fetchone()
        return int(count)

    def _prepare(self, fingerprint: str | None, about: Mapping[str, str]) -> None:
        """Make the tables where there are none; refuse those of another version."""
        with _transaction(self._database):
            tables = {
                name
                for (name,) in self._database.execute("SELECT name FROM sqlite_master WHERE type='table'")
            }
            if not tables and fingerprint is not None:
                for statement in _TABLES.split(";"):
                    self._database.execute(statement)
                told = {**about, "format": FORMAT, "fingerprint": fingerprint}
                self._database.executemany("INSERT INTO about VALUES (?, ?)", told.items())
            elif "about" not in tables:
                raise InputError(self.path, "is no result store", "choose another folder")
        told = self.about()
        if told.get("format") != FORMAT:
            raise InputError(
                self.path,
                f"has format {told.get('format')}, this caryatid reads {FORMAT}",
                "choose another folder, or use the caryatid that made it",
            )
        if fingerprint not in (None, told["fingerprint"]):
            raise InputError(
                self.path,
                f"was made by other code ({_named(told)}), whose figures do not compare with this one's",
                "choose another --out; leave --suite out to draw what it holds",
            )


@contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    """A transaction that is written whole or not at all."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        database.execute("ROLLBACK")
        raise
    database.execute("COMMIT")


def _named(about: Mapping[str, str]) -> str:
    return " ".join(about[name] for name in ("caryatid", "commit", "fingerprint") if name in about)


def _dump(episode: Episode) -> str:
    return json.dumps(asdict(episode), sort_keys=True, ensure_ascii=False)


def _load(text: str) -> Episode:
    values: dict[str, Any] = json.loads(text)
    values["settings"] = tuple(values["settings"])
    return Episode(**{f.name: values[f.name] for f in fields(Episode)})
