"""Bruker OPUS files → `Bench`: the interferogram of both scan directions and the vendor's spectrum of the same scans.

    dx = 1/(2·HFL),   opd = dx·(sample − ZPD of the first scan)

HFL is the high folding limit. A file of both directions holds forward and backward scans end to end in the order of
time, so the backward half is turned here: both then run along the same OPD (seen in measured files by the shape of the
burst, whose sign may still differ). OPUS counts in cm-1; the record in m-1.

References
----------
.. [1] J. Duran, brukeropus (MIT), the reader that is used here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Bench

Array = NDArray[np.float64]

Channel = Literal["sample", "reference"]

# Interferogram, spectrum and parameters of each channel, as brukeropus names them.
CHANNELS: dict[Channel, tuple[str, str, str]] = {
    "sample": ("igsm", "sm", "params"),
    "reference": ("igrf", "rf", "rf_params"),
}
# APF and PHZ codes → our names; an unknown code keeps its own, so that who reads the record can say what is unknown.
APODIZATION = {
    "BX": "boxcar",
    "TR": "triangle",
    "HG": "happ-genzel",
    "B3": "blackman-harris-3",
    "B4": "blackman-harris-4",
    "NBW": "norton-beer-weak",
    "NBM": "norton-beer-medium",
    "NBS": "norton-beer-strong",
}
PHASE_CORRECTION = {"ML": "mertz", "PW": "power", "FM": "forman", "NO": "none"}
PER_CM = 100.0  # m-1


def read_opus(path: Path, channel: Channel = "sample") -> Bench:
    """The interferogram (scan, sample) of one channel of an OPUS file with the vendor's spectrum and parameters.

    Needs the extra `opus`. Raises InputError where the package is missing or the file is no OPUS file, is damaged or
    holds no interferogram of that channel. Without the vendor's spectrum the record has no reference.
    """
    data = _open(path)
    interferogram, spectrum, block = CHANNELS[channel]
    parameters = getattr(data, block)
    series = getattr(data, interferogram) if interferogram in data.data_keys else None
    if series is None:
        found = ", ".join(data.all_data_keys) or "nothing"
        raise InputError(
            path,
            f"block '{interferogram}'",
            f"there is no {channel} interferogram (the file holds {found})",
            "have OPUS save interferograms with the spectra",
        )
    scans = _scans(np.asarray(series.y, np.float64), parameters, path)
    limit = _number(parameters, "hfl", path)
    if (_optional(parameters, "lfl") or 0.0) != 0.0:
        raise InputError(
            path, "parameter LFL", "is not zero: the scan is undersampled", "measure with a low folding limit of 0"
        )
    deviation = np.abs(scans[0] - scans[0].mean())
    opd = (np.arange(scans.shape[1]) - int(np.argmax(deviation))) / (2.0 * limit * PER_CM)
    wavenumber = reference = None
    if spectrum in data.data_keys:
        wavenumber, reference = _spectrum(getattr(data, spectrum), path)
    zero_filling, resolution, phase = (_optional(parameters, key) for key in ("zff", "res", "phr"))
    return Bench(
        scans,
        opd,
        wavenumber,
        reference,
        _code(parameters, "apf", APODIZATION),
        _code(parameters, "phz", PHASE_CORRECTION),
        None if zero_filling is None else int(zero_filling),
        None if resolution is None else resolution * PER_CM,
        None if phase is None else phase * PER_CM,
    )


def _open(path: Path) -> Any:
    try:
        from brukeropus import read_opus as read
    except ImportError as error:
        raise InputError(
            path, "file", "OPUS files need the package brukeropus", 'install it with: pip install "tsmftis[opus]"'
        ) from error
    if not path.is_file():
        raise InputError(path, "file", "does not exist", "correct the name")
    try:
        data = read(str(path))
    except Exception as error:  # a third party's parser: whatever it raises, the file's bytes are the cause
        raise InputError(
            path, "file", f"is a damaged OPUS file ({type(error).__name__})", "it may be truncated: copy it again"
        ) from error
    if not data.is_opus:
        raise InputError(
            path, "file", "is not an OPUS file (its first bytes are not 0A 0A FE FE)", "name an OPUS file, often *.0"
        )
    return data


def _scans(values: Array, parameters: Any, path: Path) -> Array:
    """Split a forward-and-backward record into (scan, sample), the backward scan turned to run along the same OPD."""
    if values.size < 16 or not np.isfinite(values).all():
        raise InputError(path, "interferogram", "is damaged or has fewer than 16 samples", "copy the file again")
    good = [_optional(parameters, key) for key in ("gfw", "gbw")]
    if None in good:
        both = str(getattr(parameters, "aqm", "")).strip().upper() in ("DD", "SD")
    else:
        both = all(count is not None and count > 0 for count in good)
    if not both:
        return values[None, :]
    if values.size % 2:
        raise InputError(
            path, "interferogram", f"has {values.size} samples, not the same for both directions", "copy the file again"
        )
    forward, backward = values.reshape(2, -1)
    return np.stack([forward, backward[::-1]])


def _spectrum(block: Any, path: Path) -> tuple[Array, Array]:
    """Wavenumber [m-1], increasing, and the vendor's spectrum."""
    if str(getattr(block.params, "dxu", "WN")) != "WN":
        raise InputError(
            path,
            "spectrum",
            f"is against '{block.params.dxu}', not wavenumber",
            "have OPUS store it against wavenumber",
        )
    wavenumber, values = np.asarray(block.x, np.float64) * PER_CM, np.asarray(block.y, np.float64)
    if wavenumber.size != values.size or not np.isfinite(values).all():
        raise InputError(path, "spectrum", "is damaged", "copy the file again")
    order = np.argsort(wavenumber)
    return wavenumber[order], values[order]


def _code(parameters: Any, key: str, names: dict[str, str]) -> str | None:
    code = getattr(parameters, key, None)
    if code is None:
        return None
    return names.get(str(code).strip().upper(), f"opus:{code}")


def _optional(parameters: Any, key: str) -> float | None:
    value = getattr(parameters, key, None)
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError):
        return None


def _number(parameters: Any, key: str, path: Path) -> float:
    value = _optional(parameters, key)
    if value is None or not value > 0.0:
        raise InputError(
            path,
            f"parameter {key.upper()}",
            "is missing or not positive",
            "the sampling is unknown without it: export the file again",
        )
    return value
