"""Run folders: whole or not there at all."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import refusal, step_of

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Sphere
from caryatid.graph import SceneObject, SupportGraph
from caryatid.io.staging import recover, write_file
from caryatid.sensing.views import View
from caryatid.steps import RunWriter, read_run

T = transforms.rigid(np.eye(3), (0.1, 0.2, 1.5))
K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
ABOUT = {"source": "tower", "seed": 7, "options": {}}
LABELS = np.zeros((6, 8), np.int32)
LABELS[2:4, 1:3], LABELS[5] = 300, 65535


def graph(count=1):
    shapes = [Sphere(transforms.rigid(np.eye(3), (0.1 * k, 0, 0)), 0.05) for k in range(1, count + 1)]
    return SupportGraph(tuple(SceneObject(f"o{k}", k, shape) for k, shape in enumerate(shapes, start=1)))


def step(count=1, labels=LABELS, name="a"):
    return step_of(graph(count), labels, name)


def writer(folder, seed=7):
    return RunWriter(folder, Config(), ABOUT | {"seed": seed})


def scored(f1):
    return {"f1": f1, "precision": 0.5, "recall": 0.5}


def write_run(folder, views=2, seed=7, labels=LABELS):
    view = View(np.ones((6, 8), np.float32), K, T)
    with writer(folder, seed) as run:
        for index in range(views):
            run.add(
                replace(step(index + 1, labels, f"scene/{index:06d}"), view=view), scored(np.float64(0.25))
            )
        run.files["report.html"] = "<html>σ</html>".encode()


def test_a_run_is_read_back_and_laid_out_as_documented(tmp_path):
    folder = tmp_path / "deep" / "RUN"
    write_run(folder)
    run = read_run(folder)
    assert run.record["seed"] == 7
    assert run.record["scores"] == [scored(0.25)] * 2
    assert run.record["settings"]["active"]["max_views"] == Config().active.max_views
    assert [told["view"] for told in run.record["steps"]] == [0, 0]
    assert "caryatid" in run.record["versions"]
    assert [len(v.graph.objects) for v in run.views] == [1, 2]
    assert len(run.graph.objects) == 2
    assert [view.name for view in run.views] == ["scene/000000", "scene/000001"]
    assert np.allclose(run.views[1].record["T_world_camera"], T)
    assert np.allclose(run.views[1].record["K"], K)
    assert (run.views[1].load_labels() == LABELS).all()
    assert (folder / "report.html").read_text(encoding="utf-8") == "<html>σ</html>"
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    of_each = ["graph.json", "labels.png", "view.json", "step.npz"]
    views = {f"views/{n}/{name}" for n in ("00", "01") for name in of_each}
    assert files == {"graph.json", "report.html", "run.json"} | views
    assert [p.name for p in tmp_path.iterdir()] == ["deep"]


def test_the_same_run_gives_the_same_bytes(tmp_path):
    """All but the date."""
    for name in ("a", "b"):
        write_run(tmp_path / name)
        record = tmp_path / name / "run.json"
        record.write_text(re.sub(r'"date": "[^"]*"', "", record.read_text()))
    for path in (tmp_path / "a").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


@pytest.mark.parametrize(
    ("error", "views"), [(RuntimeError, 1), (SystemExit, 1), (KeyboardInterrupt, 0), (None, 0)]
)
def test_a_run_that_fails_or_has_no_views_leaves_nothing(tmp_path, error, views):
    with nullcontext() if error is None else pytest.raises(error), writer(tmp_path / "new" / "RUN") as run:
        for _ in range(views):
            run.add(step())
        assert not (tmp_path / "new/RUN").exists()
        if error:
            raise error
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_run_is_kept_with_the_views_done(tmp_path, monkeypatch):
    write = Path.write_bytes

    def interrupt(path, data):
        if path.name == "view.json" and path.parent.name == "01":
            raise KeyboardInterrupt
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", interrupt)
    with pytest.raises(KeyboardInterrupt, match="1 view is kept"):
        write_run(tmp_path / "RUN")
    run = read_run(tmp_path / "RUN")
    assert run.record["interrupted"]
    assert [view.name for view in run.views] == ["scene/000000"]
    assert len(run.graph.objects) == len(run.views[0].graph.objects) == 1
    assert not (tmp_path / "RUN/views/01").exists()


def test_labels_beyond_16_bits_are_refused(tmp_path):
    for bad in (-1, 65536):
        with pytest.raises(InputError, match="labels are not all within"), writer(tmp_path / "RUN") as run:
            run.add(step(labels=np.full((2, 2), bad)))
    assert list(tmp_path.iterdir()) == []


def test_an_older_run_is_replaced_at_the_end_and_not_before(tmp_path):
    write_run(tmp_path / "RUN", views=3, seed=1)
    with writer(tmp_path / "RUN", seed=2) as run:
        run.add(step())
        assert read_run(tmp_path / "RUN").record["seed"] == 1
    assert read_run(tmp_path / "RUN").record["seed"] == 2
    assert not (tmp_path / "RUN/views/02").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["RUN"]


@pytest.mark.parametrize("same_id", [False, True])
def test_what_a_killed_process_left_is_recovered_or_removed(tmp_path, same_id):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    pid = os.getpid() if same_id else dead.pid
    write_run(tmp_path / "RUN", views=1, seed=1)
    (tmp_path / "RUN").rename(tmp_path / f".partial-RUN-{pid}-0123abcd-replaced")
    (tmp_path / f".partial-RUN-{pid}-0123abcd").mkdir()
    (tmp_path / f".partial-RUN-{os.getppid()}-0123abcd").mkdir()
    assert read_run(tmp_path / "RUN").record["seed"] == 1
    left = {"RUN", f".partial-RUN-{os.getppid()}-0123abcd"}
    assert {p.name for p in tmp_path.iterdir()} == left
    (tmp_path / f".partial-RUN-{pid}-4567cdef").mkdir()
    (tmp_path / f".partial-a.pdf-{pid}-0123abcd").touch()
    with writer(tmp_path / "RUN", seed=2) as run:
        recover(tmp_path / "RUN")
        run.add(step())  # into the folder that this process is writing
        write_file(tmp_path / "a.pdf", b"%PDF")
    assert {p.name for p in tmp_path.iterdir()} == left | {"a.pdf"}


@pytest.mark.parametrize("name", ["run.json", "thesis.tex", "views/notes.txt"])
def test_a_folder_that_holds_what_no_run_wrote_is_never_touched(tmp_path, name):
    path = tmp_path / "thesis" / name
    if "views" in name:
        write_run(tmp_path / "thesis")
    path.parent.mkdir(exist_ok=True)
    path.write_text('{"format": "something else"}')
    with refusal(tmp_path / "thesis", f"contains other files ({name})"):
        writer(tmp_path / "thesis")
    assert path.read_text() == '{"format": "something else"}'
    assert [p.name for p in tmp_path.iterdir()] == ["thesis"]


def test_files_and_empty_folders_in_the_way(tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match="not a directory"):
        writer(tmp_path / "file")
    with pytest.raises(InputError, match="file/RUN"):
        writer(tmp_path / "file" / "RUN")
    assert (tmp_path / "file").read_text() == "kept"
    (tmp_path / "loop").symlink_to("loop")
    with refusal("loop", "not a directory"):
        writer(tmp_path / "loop")
    with refusal("loop/RUN", "cannot be written"):
        writer(tmp_path / "loop/RUN")
    (tmp_path / "RUN").mkdir()
    write_run(tmp_path / "RUN")
    assert len(read_run(tmp_path / "RUN").views) == 2


@pytest.mark.parametrize(
    ("code", "said", "name"),
    [
        (errno.ENOSPC, "the disk is full", "labels.png"),
        (errno.EROFS, "read-only", "view.json"),
        (errno.EIO, "cannot be written", "run.json"),
    ],
)
def test_a_full_or_read_only_disk_is_a_clear_error_and_nothing_is_left(
    tmp_path, monkeypatch, code, said, name
):
    write = Path.write_bytes

    def refuse(path, data):
        if path.name == name:
            write(path, data[: len(data) // 2])
            raise OSError(code, os.strerror(code))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with refusal(tmp_path / "RUN", said):
        write_run(tmp_path / "RUN")
    assert list(tmp_path.iterdir()) == []


RECORD = ABOUT | {"format": "caryatid/run", "version": 2, "views": 2}


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("run.json", b'{"format": "other"}', "'format' is \"other\": must be 'caryatid/run'"),
        ("run.json", {"version": 3}, "must be 2; run"),
        ("run.json", {"views": 0}, "'views' is 0"),
        ("run.json", {"source": None}, "'source' is null"),
        ("run.json", {"source": 3}, "'source' is 3"),
        ("run.json", {"seed": "x"}, "'seed' is \"x\""),
        ("run.json", {"options": []}, "'options' is []"),
        ("run.json", {"warnings": [1]}, "warnings: '0' is 1"),
        ("run.json", {"date": 2026}, "'date' is 2026"),
        ("run.json", {"scores": [{}, {}]}, "scores.0: the key 'f1' is missing"),
        ("run.json", {"scores": [scored(1.0)]}, "the number of scores, 1"),
        ("views/01/graph.json", b"{}", "'format' is missing"),
        ("views/01/graph.json", None, "missing"),
        ("views/01/view.json", b"{}", "'name' is missing"),
        ("views/01/labels.png", None, "missing"),
        ("views/01/labels.png", b"text", "not an image"),
        ("views/01/labels.npy", b"\x93NUMPY\x01\x00", "labels.npy"),
    ],
)
def test_a_broken_run_is_refused(tmp_path, name, content, said):
    write_run(tmp_path / "RUN")
    path = tmp_path / "RUN" / name
    if isinstance(content, dict):
        content = json.dumps(RECORD | content).encode()
    path.unlink() if content is None else path.write_bytes(content)
    with refusal(tmp_path / "RUN", said):
        view = read_run(tmp_path / "RUN").views[1]
        assert view.name
        assert view.graph
        view.load_labels()
