"""The command line: `caryatid COMMAND …`; errors end here, in one line."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console

from caryatid.errors import CaryatidError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 1 bad input or failed work, 2 usage."""
    import tyro

    from caryatid.commands.demo import Demo
    from caryatid.commands.evaluate import Evaluate
    from caryatid.commands.explore import Explore
    from caryatid.commands.extract import Extract
    from caryatid.commands.show_config import ShowConfig

    arguments = list(sys.argv[1:] if arguments is None else arguments)
    command = tyro.extras.subcommand_cli_from_dict(
        {
            "demo": Demo,
            "explore": Explore,
            "extract": Extract,
            "evaluate": Evaluate,
            "config": ShowConfig,
        },
        prog="caryatid",
        description="Look around a cluttered table until it is known what holds up what.",
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        status: int = command()
    except KeyboardInterrupt:
        return 130
    except (CaryatidError, OSError) as error:
        if command.debug:
            raise
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"error: {error}", markup=False)
        return 1
    return status


if __name__ == "__main__":
    sys.exit(main())
