"""The splats and twins of other folders, too."""

import sys
from pathlib import Path

for folder in ("splat", "splat/compose", "nerf"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))
