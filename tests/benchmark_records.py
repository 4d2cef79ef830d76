"""Records of episodes that never ran, for the tests of what is made of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.benchmark.records import Episode, Member, Outcome, Record, ViewRow

METHODS = ("support", "paper", "random", "ring", "oracle")


def make_row(view, f1, path=0.0, planning=0.2, **measures):
    edge = measures.pop("edge_f1", max(0.0, f1 - 0.05))
    return ViewRow(
        view=view, precision=f1, recall=f1, f1=f1, vertex_precision=f1, vertex_recall=f1, vertex_f1=f1,
        edge_precision=edge, edge_recall=edge, edge_f1=edge, mean_iou=measures.pop("mean_iou", 0.8),
        angle=path / 1.5, path=path, planning_seconds=planning if view > 1 else 0.0, perception_seconds=0.4,
        **measures,
    )  # fmt: skip


def make_record(
    f1: Sequence[float] = (),
    path: Sequence[float] | None = None,
    *,
    method="support",
    scene="dense-10-1",
    seed=0,
    condition="carmine, labels",
    family="dense",
    views=None,
    error=None,
):
    """One episode with these F1 and paths; half a metre a view where no path is given."""
    path = [0.5 * v for v in range(len(f1))] if path is None else path
    rows = tuple(make_row(v, *both) for v, both in enumerate(zip(f1, path, strict=True), start=1))
    episode = Episode(scene=scene, seed=seed, planner=method, views=views or max(len(f1), 1))
    return Record(Member(episode, method, condition, family), Outcome(rows, error))


def make_suite(
    methods: Sequence[str] = METHODS, *, scenes=12, seeds=2, views=5, condition="carmine, labels", rng=None
):
    """Dense and piled scenes: the later a method, the slower it rises and the further it goes."""
    rng = rng or np.random.default_rng(0)
    records = []
    hardness = rng.normal(0.0, 0.06, scenes)
    for place, method in enumerate(methods):
        for scene in range(scenes):
            family = "dense" if scene % 3 else "pile"
            for seed in range(seeds):
                rate = 0.55 + 0.8 / (1.0 + place)
                level = 0.96 - 0.012 * place - (0.03 if family == "dense" else 0.0)
                rise = level - (level - 0.6 + hardness[scene]) * np.exp(-rate * np.arange(views))
                f1 = np.clip(rise + rng.normal(0.0, 0.03, views), 0.0, 1.0)
                steps = rng.gamma(4.0, 0.2 + 0.04 * place, views)
                path = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
                name = f"{family}-{10 + scene % 5}-{scene}"
                record = make_record(
                    f1.tolist(), path.tolist(), method=method, scene=name, seed=seed, family=family,
                    condition=condition,
                )  # fmt: skip
                slow = tuple(
                    make_row(
                        r.view, r.f1, r.path, 10.0 ** (-3 + 4 * place / len(methods)) * rng.lognormal(0, 0.4)
                    )
                    for r in record.outcome.rows
                )
                records.append(Record(record.member, Outcome(slow)))
    return records
