"""Orders, and what came of them, as the documents that `--json` writes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from caryatid.manipulation.dismantling import Taken
from caryatid.manipulation.order import Order, TakeStep


def order_record(order: Order) -> dict[str, Any]:
    """An order: its steps, whether it is safe, and why not."""
    return {
        "steps": [_step(step) for step in order.steps],
        "safe": order.safe,
        "refusal": order.refusal or None,
    }


def dismantling_record(order: Order, taken: Sequence[Taken], left: Sequence[str]) -> dict[str, Any]:
    """What came of an order.

    Args:
        order: The order.
        taken: Each of its steps, done.
        left: Names of the bodies that nobody took.
    """
    steps = [
        _step(t.step) | {"body": t.body, "held": list(t.held), "ok": t.ok, "disturbed": list(t.disturbed)}
        for t in taken
    ]
    return {
        "success": succeeded(taken, left),
        "steps": steps,
        "left": list(left),
        "safe": order.safe,
        "refusal": order.refusal or None,
    }


def succeeded(taken: Sequence[Taken], left: Sequence[str]) -> bool:
    """Everything was taken and nothing disturbed."""
    return not left and all(t.ok for t in taken)


def _step(step: TakeStep) -> dict[str, Any]:
    return {
        "object": step.object_id,
        "hold": list(step.hold),
        "safe": step.safe,
        "risk": step.risk,
        "why": step.why,
    }
