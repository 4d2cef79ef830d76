"""Golden runs: what the command line writes for a dozen scenes and recordings, kept as `golden/runs.json`.

`python tests/golden_runs.py` compares every byte with a file of hashes from the same machine, which
`--renew FILE` writes; `--renew` without FILE renews the golden graphs that `test_golden.py` compares.
OpenBLAS uses the same kernels on every processor with AVX2 (see `conftest.py`).
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")  # before NumPy is loaded, as in conftest.py

import numpy as np

HERE = Path(__file__).parent
SHARED = HERE.parents[1] / "shared"
GOLDEN = HERE / "golden" / "runs.json"
EXPORTS = ("xml", "urdf", "glb", "dot")


@dataclass(frozen=True)
class Run:
    """One golden run.

    Attributes:
        command: Words of the command line, without `--out`; `SHARED` stands for the folder of shared data.
        exports: Whether `order` and `export` are run on it, and `evaluate` where its ground truth is known.
        slow: Whether it is left to the slow tests.
    """

    command: str
    exports: bool = False
    slow: bool = True

    @property
    def available(self) -> bool:
        """Whether its data is there."""
        return "SHARED" not in self.command or SHARED.is_dir()


RUNS = {
    "bridge-labels": Run("explore bridge --views 4 --noise carmine", exports=True, slow=False),
    "clutter-auto": Run("explore clutter --views 4 --noise carmine --segmentation auto", exports=True),
    "plank-labels": Run("explore leaning_plank --views 3 --noise none --planner paper --seed 3", slow=False),
    "dense-auto": Run("explore dense-12-0 --views 4 --noise carmine --segmentation auto --no-early-stop"),
    "packed-auto": Run("explore packed-20-0 --views 3 --noise carmine --segmentation auto --no-early-stop"),
    "clutter-paper": Run("explore clutter --views 3 --preset paper --noise carmine --seed 1", slow=False),
    "pile-sg": Run("explore pile-8-3 --views 3 --noise carmine --fusion sg", slow=False),
    "tower-pc-auto": Run(
        "explore tower --views 3 --noise none --segmentation auto --fusion pc --planner occlusion-aware"
    ),
    "house-labels": Run("explore SHARED/scenes/house02_7/scene.xml --views 3 --noise carmine", exports=True),
    "ycb-auto": Run("explore SHARED/scenes/ycb03_7/scene.xml --views 3 --noise carmine --segmentation auto"),
    "frame-auto": Run("extract SHARED/data/mosd/learn22 --segmentation auto", exports=True),
    "frame-labels": Run("extract SHARED/data/mosd/test43 --segmentation labels"),
    "kitchen-auto": Run("extract SHARED/data/redkitchen --segmentation auto"),
    "cloud-labels": Run("extract SHARED/data/clouds/learn22.pcd --segmentation labels --label-divisor 10"),
}


def execute(name: str, folder: Path) -> dict[str, bytes]:
    """Run one of `RUNS` in a folder; return what it and the commands after it wrote, by name."""
    run = RUNS[name]
    out = folder / name
    words = [word.replace("SHARED", str(SHARED)) for word in run.command.split()]
    _call(*words, "--out", out, "--no-report", "--quiet")
    written = {str(f.relative_to(out)): f.read_bytes() for f in sorted(out.rglob("graph.json"))}
    if run.exports:
        written["order.json"] = _call("order", out, "--json")
        for suffix in EXPORTS:
            target = folder / f"{name}.{suffix}"
            _call("export", out, "--out", target, "--quiet")
            written[f"export.{suffix}"] = target.read_bytes()
        if words[0] == "explore" and "SHARED" in run.command:
            written["evaluate.json"] = _call("evaluate", out, Path(words[1]).parent, "--json")
    return written


def summary(graph: bytes) -> dict[str, Any]:
    """What a golden graph says: shapes with sizes and places to 0.1 mm, and supports, sure or doubtful."""
    document = json.loads(graph)
    return {
        "objects": {
            o["id"]: {
                "shape": o["shape"],
                "size": [round(v, 4) for v in _sizes(o["size"])],
                "centre": [round(row[3], 4) for row in o["T_world_object"][:3]],
            }
            for o in document["objects"]
        },
        "supports": sorted(
            [s["supporter"], s["supported"], s["kind"], s.get("probability", s["certain"]) >= 0.9]
            for s in document["supports"]
        ),
    }


def _sizes(size: Any) -> list[float]:
    if isinstance(size, dict) and "parts" in size:
        return np.ptp(np.concatenate(size["parts"]), axis=0).tolist()
    return list(size.values()) if isinstance(size, dict) else list(size)


def _call(*words: object) -> bytes:
    from caryatid import cli

    stdout = io.StringIO()
    with contextlib.redirect_stdout(stdout):
        status = cli.main([str(word) for word in words])
    if status not in (0, cli.NOT_SAFE):
        raise RuntimeError(f"{' '.join(map(str, words))}: exit status {status}")
    return stdout.getvalue().encode()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("hashes", type=Path, nargs="?", help="file of hashes to compare with")
    parser.add_argument("--renew", action="store_true", help="write the hashes, or the golden graphs")
    parser.add_argument("--only", nargs="*", help="names of runs")
    arguments = parser.parse_args()
    hashes: dict[str, str] = {}
    graphs: dict[str, Any] = {}
    for name, run in RUNS.items():
        if not run.available or (arguments.only and name not in arguments.only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            written = execute(name, Path(folder))
        hashes |= {f"{name}/{k}": hashlib.sha256(v).hexdigest() for k, v in written.items()}
        graphs[name] = summary(written["graph.json"])
    if arguments.hashes is None:
        if arguments.renew:
            graphs = json.loads(GOLDEN.read_text(encoding="utf-8")) | graphs
            GOLDEN.write_text(json.dumps(graphs, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        else:
            print(json.dumps(hashes, indent=1))
        return 0
    if arguments.renew:
        arguments.hashes.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
        return 0
    before = json.loads(arguments.hashes.read_text(encoding="utf-8"))
    if arguments.only:
        before = {k: v for k, v in before.items() if k.split("/")[0] in arguments.only}
    differing = sorted(k for k in before.keys() | hashes.keys() if before.get(k) != hashes.get(k))
    print("\n".join(f"differs: {name}" for name in differing) or f"{len(hashes)} files, all equal")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
