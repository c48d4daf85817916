"""Files of plain arrays (.npz), read without running code."""

from __future__ import annotations

import zipfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

MOST_BYTES = 1 << 30  # of all arrays: hours of a robot's motion


def read_arrays(file: Path) -> dict[str, Any]:
    """What the .npz ``file`` holds. Raises ValueError for a file that is missing, damaged or something else."""
    try:
        with zipfile.ZipFile(file) if zipfile.is_zipfile(file) else nullcontext() as parts:
            if parts and (size := sum(part.file_size for part in parts.infolist())) > MOST_BYTES:
                raise ValueError(f"it unpacks to {size >> 20} MiB; {MOST_BYTES >> 20} are the most")
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except TypeError:
        raise ValueError("it is one array, no archive of them") from None
    except Exception as error:  # numpy's, zipfile's and zlib's, by how it is broken
        raise ValueError(" ".join(str(error).split())[:200]) from None
