"""Check that an installed caryatid works without extras; run this with its Python, in an empty folder."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import time
from importlib.metadata import version
from pathlib import Path


def caryatid(*words: str) -> str:
    """Run the installed command as a shell would, and return its output."""
    command = Path(sysconfig.get_path("scripts")) / "caryatid"
    done = subprocess.run([command, *words], capture_output=True, text=True, check=False)
    if done.returncode != 0 or "Traceback" in done.stderr:
        sys.exit(f"caryatid {' '.join(words)}: status {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done.stdout


def check(true: bool, what: str) -> None:
    """Exit with a message unless a condition is true."""
    if not true:
        sys.exit(what)


def main() -> None:
    """Try everything, and print the durations as JSON."""
    times: dict[str, float] = {}
    begun = time.monotonic()

    def lap(name: str) -> None:
        times[name] = time.monotonic() - begun - sum(times.values())

    import caryatid as package

    home = Path(package.__file__).parent
    check(home.is_relative_to(Path(sys.prefix).resolve()), f"caryatid was imported from {home}")
    check(all(getattr(package, name) is not None for name in package.__all__), "a public name is missing")
    check((home / "py.typed").exists(), "py.typed is missing")
    told = caryatid("--version")
    check(told == f"caryatid {version('caryatid')}\n", f"--version says {told}")
    check("explore" in caryatid("--help"), "--help does not list the commands")
    lap("start")
    caryatid("demo", "--scene", "tower", "--views", "2", "--out", "run")
    check(len(Path("run/report.html").read_text()) > 10_000, "the report is empty")
    lap("demo")
    graph = json.loads(caryatid("extract", "sample-cloud", "--out", "cloud", "--json"))["graph"]
    check(len(graph["objects"]) > 3 and len(graph["supports"]) > 2, "too little was found in the cloud")
    lap("extract")
    order = json.loads(caryatid("order", "run", "--set", "rehearsal.draws=2", "--risk", "0.2", "--json"))
    check(len(order["steps"]) > 0, "no removal order was found")
    for ending in ("xml", "urdf", "glb", "json", "dot"):
        file = f"scene.{ending}"
        caryatid("export", "run", "--out", file)
        check(Path(file).stat().st_size > 100, f"{file} is empty")
    caryatid("session", "new", "table")
    check("complete" in caryatid("completion", "bash"), "shell completion is missing")
    print(json.dumps({"python": sys.version.split()[0], "seconds": times}))


if __name__ == "__main__":
    main()
