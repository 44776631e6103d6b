"""Portable grey maps (PGM), the images of map_server."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from .output_folder import output_errors

_GAP = rb'(?:\s|#[^\n]*\n)+'
_HEADER = re.compile(rb'(P[25])' + _GAP + rb'(\d+)' + _GAP + rb'(\d+)' + _GAP + rb'(\d+)\s')


def write_pgm(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write a binary (P5) PGM.

    Parameters
    ----------
    path : Path
    pixels : uint8, shape (height, width)
        Row 0 is the top of the image.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    height, width = pixels.shape
    with output_errors(path), path.open('wb') as file:
        file.write(f'P5\n{width} {height}\n255\n'.encode())
        file.write(np.ascontiguousarray(pixels).tobytes())


def read_pgm(path: Path) -> NDArray[np.float64]:
    """Return the brightness of each pixel from 0 (black) to 1, shape (height, width), row 0 at the top.

    Raises
    ------
    InputError
        If the file cannot be read, is not a binary (P5) or plain (P2) PGM, or is cut short.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f'{path} cannot be read: {error.strerror}') from error
    header = _HEADER.match(data)
    if header is None:
        raise InputError(f'{path} is not a PGM image (P5 or P2); convert it, for example with ImageMagick')
    width, height, top = (int(v) for v in header.groups()[1:])
    if not 0 < top < 65536 or not width * height:
        raise InputError(f'{path}: a PGM image of {width} x {height} pixels and {top} grey levels is not possible')
    try:
        if header[1] == b'P5':
            kind = np.dtype('u1' if top < 256 else '>u2')
            values = np.frombuffer(data, kind, width * height, header.end())
        else:
            text = re.sub(rb'#[^\n]*', b'', data[header.end() :]).split()
            values = np.array(text[: width * height], np.int64)
        return values.reshape(height, width) / top
    except ValueError as error:
        raise InputError(f'{path} is damaged or cut short: {width} x {height} pixels were expected') from error
