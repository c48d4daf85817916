"""Files of plain arrays (.npz), read without running code."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np


def read_arrays(file: Path) -> dict[str, Any]:
    """What the .npz ``file`` holds. Raises ValueError for a file that is missing, damaged or something else."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except TypeError:
        raise ValueError("it is one array, no archive of them") from None
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(str(error)) from None
