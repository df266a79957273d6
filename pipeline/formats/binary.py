"""Headerless files of fixed records of float64, as the POS world exchanges them.

Functions
---------
read_records, write_records     a numpy structured array, bit for bit
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError


def read_records(path: Path, dtype: np.dtype[Any], name: str) -> NDArray[Any]:
    """Records (n,) of `dtype`; raises InputError for an unreadable, empty or cut file of the format `name`."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            path, "file", f"cannot be read ({error.strerror})", "correct the name or its permissions"
        ) from error
    size = dtype.itemsize
    if not content:
        raise InputError(path, "file", "is empty", f"an {name} has {size} bytes a record")
    if len(content) % size:
        raise InputError(
            path,
            f"record {len(content) // size}",
            f"is cut: {len(content)} bytes are no multiple of {size}",
            f"the file is truncated or no {name}: copy it again",
        )
    return np.frombuffer(content, dtype).copy()


def write_records(records: NDArray[Any], dtype: np.dtype[Any], path: Path, name: str) -> None:
    """Write records (n,) of `dtype`; what `read_records` gave comes out bit for bit."""
    if records.dtype != dtype or records.ndim != 1:
        raise ValueError(f"records must be (n,) of the {name} dtype, not {records.shape} of {records.dtype}")
    path.write_bytes(records.tobytes())
