"""`python -m caryatid`."""

import sys

from caryatid.cli import main

sys.exit(main())
