"""`caryatid order`: a safe order to take the objects of a run away."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from caryatid.cli.options import SAID, ModellingCommand


@dataclass(frozen=True, kw_only=True)
class Order(ModellingCommand):
    """Find a safe order to take everything away, or to get at one object.

    Each lift is rehearsed in physics on the extracted shapes, and on others as likely, before it is chosen.
    Where no order is safe, it says which objects stand in one another's way, and gives the least risky one.

    To try:
      caryatid order run
      caryatid order run --goal o3
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, as explore and extract write it."""
    goal: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="ID"), SAID] = None
    """Get at this object only, and take no more than has to go before it."""
    hands: Literal[1, 2] = 2
    """With 2 another hand may hold one object while the first lifts one."""

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.progress import Progress
        from caryatid.cli.taking import print_order
        from caryatid.io.json_files import json_text
        from caryatid.io.runs import read_run
        from caryatid.manipulation.order import order_record, plan_order
        from caryatid.runtime.interrupts import interruptible
        from caryatid.runtime.threads import cores

        progress = Progress(self.general.quiet or self.general.json)
        config = self.modelling.settings()
        graph = read_run(self.run).graph
        with interruptible(), progress.working("rehearsing"):
            order = plan_order(
                graph, config, goal=self.goal, hands=self.hands, seed=self.modelling.seed, threads=cores()
            )
        if self.general.json:
            sys.stdout.write(json_text(order_record(order)))
        else:
            print_order(order, f"{self.run}", self.goal)
        return 0
