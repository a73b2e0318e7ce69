"""FLIP: how different two pictures look to somebody who flips between them.

Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images", and 2021 for high
dynamic range; the arithmetic is OpenImageIO's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from volcli.images.library import pixels_of


def flip(
    reference: NDArray[np.float32], test: NDArray[np.float32], *, path: Path = Path("FLIP")
) -> tuple[NDArray[np.float32], str]:
    """How different two pictures look, pixel by pixel, at 67 pixels a degree.

    Parameters
    ----------
    reference, test
        (h, w, 3), linear, finite.
    path
        For the message if it fails.

    Returns
    -------
    errors : (h, w) float32
        From 0, the same, to 1.
    kind : str
        ``LDR-FLIP`` where both lie in [0, 1], else ``HDR-FLIP``.
    """
    import OpenImageIO as oiio

    bright = max(float(reference.max(initial=0)), float(test.max(initial=0))) > 1
    a, b = (oiio.ImageBuf(np.ascontiguousarray(p, np.float32)) for p in (reference, test))
    found = oiio.ImageBufAlgo.FLIP_diff(a, b, hdr=int(bright))
    return pixels_of(path, found)[..., 0], "HDR-FLIP" if bright else "LDR-FLIP"
