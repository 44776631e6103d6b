"""Probability maps for image viewers (PNG): white where free, black where occupied, a cool tint where not observed.

The PGM of a map in mode raw contains occupancy in percent, of 255 levels, so that viewers show it nearly black.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .output_folder import output_errors
from .panels import UNKNOWN_COLOUR

STEPS, UNKNOWN_INDEX = 254, 255


def write_png(path: Path, probability: NDArray[np.float32]) -> None:
    """Write a map as an image with one pixel for each cell, with a palette.

    Parameters
    ----------
    path : Path
    probability : float32, shape (height, width)
        Of an obstacle, NaN where unknown; row 0 has the smallest y.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    height, width = probability.shape
    steps = np.rint(np.nan_to_num(probability) * STEPS)
    pixels = np.where(np.isnan(probability), UNKNOWN_INDEX, steps).astype(np.uint8)[::-1]
    # every row begins with the number of its filter, 0 for none
    rows = np.hstack([np.zeros((height, 1), np.uint8), pixels])
    grey = 255 - np.rint(np.arange(STEPS + 1) * 255 / STEPS).astype(np.uint8)
    palette = np.repeat(grey, 3).tobytes() + bytes.fromhex(UNKNOWN_COLOUR[1:])
    parts = {
        b'IHDR': struct.pack('>IIBBBBB', width, height, 8, 3, 0, 0, 0),
        b'PLTE': palette,
        b'IDAT': zlib.compress(rows.tobytes(), 6),
        b'IEND': b'',
    }
    with output_errors(path), path.open('wb') as file:
        file.write(b'\x89PNG\r\n\x1a\n')
        for name, data in parts.items():
            file.write(struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(name + data)))
