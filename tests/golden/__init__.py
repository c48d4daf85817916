"""Every error line that a user can meet: a module an area, which provokes each by the least bad input; errors.txt is what they say."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "campaign"))  # its tables of bad inputs are areas too
