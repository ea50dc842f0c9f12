"""`python -m spacesim`: the command line, where the folder of scripts is on no path."""

import sys

from spacesim.cli import main

sys.exit(main())
