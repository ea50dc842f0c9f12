"""`python -m spacesim.cli`."""

import sys

from spacesim.cli import main

sys.exit(main())
