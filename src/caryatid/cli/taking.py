"""What `caryatid order` and `caryatid dismantle` print."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from caryatid.cli.consoles import result_console
from caryatid.manipulation.dismantling import Taken, succeeded
from caryatid.manipulation.order import Order


def print_order(order: Order, title: str, goal: str | None) -> None:
    """Print an order as a table, and why it is not safe where it is not.

    Args:
        order: The order.
        title: Of what.
        goal: The object it is to get at, or None where everything goes.
    """
    what = "a safe order" if order.safe else "no safe order"
    table = _table(f"{title}: {what}" + (f" to get at {goal}" if goal else ""), "take", "hold", "why")
    for number, step in enumerate(order.steps, start=1):
        mark = "" if step.safe else "! "
        table.add_row(str(number), step.object_id, ", ".join(step.hold), Text(mark + step.why))
    console = result_console()
    console.print(table)
    if order.refusal:
        console.print(Text(order.refusal))


def print_dismantling(order: Order, taken: Sequence[Taken], left: Sequence[str], title: str) -> None:
    """Print what came of an order as a table.

    Args:
        order: The order.
        taken: What came of each step.
        left: What was not taken.
        title: Heading of the table.
    """
    well = "all taken, nothing disturbed" if succeeded(taken, left) else "not without harm"
    if left and all(t.ok for t in taken):
        well = f"nothing disturbed, but {', '.join(left)} left"
    table = _table(f"{title}: {well}", "take", "body", "hold", "disturbed", "why")
    for number, t in enumerate(taken, start=1):
        table.add_row(
            str(number),
            t.step.object_id,
            t.body or "nothing there",
            ", ".join(t.held),
            ", ".join(t.disturbed) or "–",
            Text(t.step.why),
        )
    console = result_console()
    console.print(table)
    if order.refusal:
        console.print(Text(order.refusal))


def _table(title: str, *columns: str) -> Table:
    table = Table(title=Text(title), title_justify="left")
    table.add_column("", justify="right")
    for column in columns:
        table.add_column(column)
    return table
