"""`python -m caryatid`."""

from caryatid.cli import run_from_shell

run_from_shell()
