"""A humanoid whose module also breaks what the node calls for the id `broken`, as a mistake in code would."""

from __future__ import annotations

from typing import Any

from caryatid.robots import HUMANOID, find_robot
from caryatid.scene import Scene

make = find_robot(HUMANOID)


def _broken(work: Any) -> Any:
    def call(*given: Any, goal: str | None = None, **options: Any) -> Any:
        if goal == "broken" or "broken" in given[1:]:
            raise KeyError("broken")
        return work(*given, **({} if goal is None else {"goal": goal}), **options)

    return call


Scene.order = _broken(Scene.order)  # type: ignore[method-assign]
Scene.removed = _broken(Scene.removed)  # type: ignore[method-assign]
