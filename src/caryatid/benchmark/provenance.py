"""Which code on which machine made a result; nothing of who ran it or where it lies."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Self

UNKNOWN = "unknown"
"""Where something cannot be found out."""
LIBRARIES = ("numpy", "scipy", "numba", "mujoco", "shapely", "networkx")
"""Whose versions figures may depend on."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """Which code on which machine.

    Attributes:
        version: Of caryatid.
        commit: Of its sources, or `unknown` where they are in no repository.
        dirty: Whether the sources differ from the commit.
        python: Version of Python.
        platform: Operating system and architecture.
        processor: Model of the processor.
        cores: Logical cores.
        libraries: Names and versions of the libraries figures may depend on, as `numpy 2.4, scipy 1.17`.
    """

    version: str
    commit: str
    dirty: bool
    python: str
    platform: str
    processor: str
    cores: int
    libraries: str

    def as_strings(self) -> dict[str, str]:
        """Names and values, to be kept beside a result."""
        return {f.name: str(getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def from_strings(cls, known: Mapping[str, str]) -> Self:
        """Read what `as_strings` gave; what is missing is unknown, what else there is is left alone."""

        def said(name: str) -> str:
            return known.get(name, UNKNOWN)

        return cls(
            version=said("version"),
            commit=said("commit"),
            dirty=said("dirty") == "True",
            python=said("python"),
            platform=said("platform"),
            processor=said("processor"),
            cores=int(known.get("cores", "0")),
            libraries=said("libraries"),
        )

    @property
    def code(self) -> str:
        """The code, in words."""
        changed = ", with changes that are in no commit" if self.dirty else ""
        return f"caryatid {self.version}, commit {self.commit[:12]}{changed}"

    @property
    def machine(self) -> str:
        """The machine, in words."""
        cores = f"{self.cores} cores" if self.cores else "cores unknown"
        return f"{self.processor}, {cores}, {self.platform}, Python {self.python}; {self.libraries}"


def collect_provenance() -> Provenance:
    """Ask the package, git and the operating system."""
    package = Path(__file__).parents[1]
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = _git(package, "rev-parse", "HEAD") if tracked else None
    changed = _git(package, "status", "--porcelain", "--", ".") if commit else None
    return Provenance(
        version=_version("caryatid"),
        commit=commit or UNKNOWN,
        dirty=bool(changed),
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        processor=_processor(),
        cores=os.cpu_count() or 0,
        libraries=", ".join(f"{name} {_version(name)}" for name in LIBRARIES),
    )


def _git(folder: Path, *arguments: str) -> str | None:
    """What git says, or None where there is no git or it refuses."""
    command = ["git", "-C", str(folder), *arguments]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=30.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return said.stdout.strip()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return UNKNOWN


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return " ".join(value.split())
    except OSError:
        pass
    return platform.processor() or UNKNOWN
