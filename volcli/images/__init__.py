"""Arrays to EXR and PNG files and back: encodings, headers, and writes that succeed whole or not
at all.

Pixels are (height, width[, channels]) arrays, row 0 at the top. Colour is premultiplied and
scene-linear with Rec.709 primaries, float32, except inside PNG files, which hold sRGB with
unassociated alpha. This is the only package that imports OpenImageIO, and it does so inside the
functions that need it. It knows nothing of volumes, jobs or rendering.

paths.py        where an image may be written
write.py        colour, channels and maps to EXR and PNG
store.py        pixels to a file, whole or not at all
read.py         an EXR's channels and header; the stored pixels of any image
channels.py     the channels of any image, one plane each, for looking at
background.py   any image as premultiplied, scene-linear colour
flip.py         how different two pictures look
color.py        colour spaces to linear
pixels.py       arrays alone: rounding, scaling, counting what cannot be shown
library.py      OpenImageIO's way of opening and of failing
"""

from volcli.images.background import read_background
from volcli.images.channels import Channels, read_channels
from volcli.images.flip import flip
from volcli.images.paths import check_output
from volcli.images.read import read_exr
from volcli.images.write import layer_channels, write_exr, write_map, write_png
from volcli.srgb import linear_from_srgb, srgb_from_linear

__all__ = [
    "Channels",
    "check_output",
    "flip",
    "layer_channels",
    "linear_from_srgb",
    "read_background",
    "read_channels",
    "read_exr",
    "srgb_from_linear",
    "write_exr",
    "write_map",
    "write_png",
]
