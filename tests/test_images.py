"""Images: what is written is what is read, what is lost is said, and failures leave no trace."""

import importlib.util
import os
import resource
import stat
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from volcli import images
from volcli.errors import NonFiniteError, OutputError, UsageError
from volcli.images import store
from volcli.images.color import linear_from_space

JOB = '[density]\nfile = "smöke.vdb"\ngrid = "density"\n' + "# 0123456789\n" * 5000


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def raw(path: Path) -> tuple[np.ndarray, Any]:
    """Pixels as the file holds them, in the file's type, and OpenImageIO's spec."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    assert source, oiio.geterror()
    spec = source.spec()
    pixels = source.read_image(0, 0, 0, spec.nchannels, spec.format)
    source.close()
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels), spec


def save(path: Path, pixels: np.ndarray, names: str = "", **attributes: Any) -> Path:
    """Write (h, w, c) pixels with plain OpenImageIO, as another program would."""
    kind = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}[pixels.dtype.name]
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, kind)
    if names:
        spec.channelnames = tuple(names)
    for name, value in attributes.items():
        spec.attribute(name.replace("_", ":", 1), value)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None, oiio.geterror()
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    assert output.close()
    return path


def png_chunks(path: Path) -> list[tuple[bytes, bytes]]:
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, offset = [], 8
    while offset < len(data):
        length, kind = struct.unpack(">I4s", data[offset : offset + 8])
        body = data[offset + 8 : offset + 8 + length]
        (crc,) = struct.unpack(">I", data[offset + 8 + length : offset + 12 + length])
        assert crc == zlib.crc32(kind + body)
        chunks.append((kind, body))
        offset += 12 + length
    return chunks


def exr_header(path: Path) -> dict[str, tuple[str, bytes]]:
    """Attribute name -> (type, bytes), read from the file itself and not by OpenImageIO."""
    data = path.read_bytes()
    assert data[:4] == b"\x76\x2f\x31\x01"
    header, offset = {}, 8
    while data[offset]:
        end = data.index(b"\0", offset)
        name, offset = data[offset:end].decode(), end + 1
        end = data.index(b"\0", offset)
        kind, offset = data[offset:end].decode(), end + 1
        (length,) = struct.unpack("<i", data[offset : offset + 4])
        header[name] = (kind, data[offset + 4 : offset + 4 + length])
        offset += 4 + length
    return header


def exr_channels(path: Path) -> list[tuple[str, int]]:
    """(name, pixel type) in the order of the file; type 2 is 32-bit float."""
    _, body = exr_header(path)["channels"]
    found, offset = [], 0
    while body[offset]:
        end = body.index(b"\0", offset)
        found.append((body[offset:end].decode(), struct.unpack("<i", body[end + 1 : end + 5])[0]))
        offset = end + 17
    return found


@contextmanager
def files_no_longer_than(size: int) -> Iterator[None]:
    """Writes beyond `size` bytes fail, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# -- the sRGB curve -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("linear", "srgb"),
    [
        (0.0, 0.0),
        (0.0031308, 0.04045),
        (0.001, 0.01292),
        (0.18, 0.4613561295004),
        (0.21404114048223255, 0.5),
        (0.5, 0.7353569830524495),
        (1.0, 1.0),
    ],
)
def test_the_srgb_curve_passes_through_its_known_values(linear: float, srgb: float) -> None:
    assert images.srgb_from_linear(linear) == pytest.approx(srgb, abs=1e-6)
    assert images.linear_from_srgb(srgb) == pytest.approx(linear, abs=1e-6)


def test_the_srgb_curve_is_undone_by_its_inverse_for_every_16_bit_code() -> None:
    codes = np.arange(65536) / 65535
    back = images.srgb_from_linear(images.linear_from_srgb(codes))
    np.testing.assert_allclose(back, codes, atol=4e-8)


def test_the_srgb_curve_keeps_float32_and_shape() -> None:
    encoded = images.srgb_from_linear(np.full((2, 3), 0.5, np.float32))
    assert encoded.dtype == np.float32
    assert encoded.shape == (2, 3)


# -- EXR ------------------------------------------------------------------------------------------


def test_exr_gives_back_every_channel_bit_by_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    names = ["transmittance.Y", "Z", "A", "optical_depth.Y", "B", "G", "R"]
    channels = {name: rng.normal(size=(33, 17)).astype(np.float32) for name in names}
    images.write_exr(tmp_path / "a.exr", channels, {})
    read, _ = images.read_exr(tmp_path / "a.exr")
    assert set(read) == set(names)
    for name in names:
        assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read[name], channels[name])


def test_exr_larger_than_one_block_of_the_check_is_read_back_whole(tmp_path: Path) -> None:
    ramp = np.arange(600 * 3, dtype=np.float32).reshape(600, 3)
    images.write_exr(tmp_path / "a.exr", {"Y": ramp}, {})
    np.testing.assert_array_equal(images.read_exr(tmp_path / "a.exr")[0]["Y"], ramp)


def test_other_programs_find_the_layers_under_their_names(tmp_path: Path) -> None:
    one = np.ones((2, 3), np.float32)
    names = ["R", "G", "B", "A", "Z", "transmittance.Y", "optical_depth.Y"]
    images.write_exr(tmp_path / "a.exr", dict.fromkeys(names, one), {})
    assert exr_channels(tmp_path / "a.exr") == [(name, 2) for name in sorted(names)]
    _, spec = raw(tmp_path / "a.exr")
    assert spec.channelnames[:4] == ("R", "G", "B", "A")
    assert spec.channelnames[spec.alpha_channel] == "A"
    assert spec.channelnames[spec.z_channel] == "Z"


def test_exr_says_that_it_is_zip_compressed_linear_rec709(tmp_path: Path) -> None:
    images.write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 3))}, {})
    header = exr_header(tmp_path / "a.exr")
    assert header["compression"] == ("compression", b"\x03")
    assert header["colorInteropID"] == ("string", b"lin_rec709_scene")
    kind, body = header["chromaticities"]
    assert kind == "chromaticities"
    np.testing.assert_allclose(
        struct.unpack("<8f", body), [0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329], rtol=1e-6
    )


def test_exr_keeps_nan_inf_and_signed_zero(tmp_path: Path) -> None:
    z = np.array([[np.nan, np.inf, -np.inf, -0.0, 1e-45]], np.float32)
    images.write_exr(tmp_path / "a.exr", {"Z": z}, {})
    read = images.read_exr(tmp_path / "a.exr")[0]["Z"]
    assert read.tobytes() == z.tobytes()


def test_arrays_of_any_dtype_and_memory_order_are_written_the_right_way_round(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    plain = rng.random((4, 7)).astype(np.float32)
    variants: dict[str, Any] = {
        "R": np.asfortranarray(plain),
        "G": plain.astype(np.float64),
        "B": np.repeat(plain, 2, axis=1)[:, ::2],
        "A": plain[::-1][::-1],
        "Z": plain.T.copy().T,
        "byteorder.Y": plain.astype(">f4"),
    }
    images.write_exr(tmp_path / "a.exr", variants, {})
    read, _ = images.read_exr(tmp_path / "a.exr")
    for name in variants:
        np.testing.assert_array_equal(read[name], plain, err_msg=name)


def test_values_beyond_float32_become_inf(tmp_path: Path) -> None:
    images.write_exr(tmp_path / "a.exr", {"Y": np.array([[1e300, -1e300]])}, {})
    np.testing.assert_array_equal(images.read_exr(tmp_path / "a.exr")[0]["Y"], [[np.inf, -np.inf]])


@pytest.mark.parametrize(
    "channels",
    [
        {},
        {"R": np.ones((2, 3)), "G": np.ones((3, 2))},
        {"R": np.ones((2, 3, 1))},
        {"R": np.ones((0, 3))},
    ],
)
def test_exr_refuses_channels_that_make_no_image(tmp_path: Path, channels: Any) -> None:
    with pytest.raises(ValueError, match=r"a\.exr"):
        images.write_exr(tmp_path / "a.exr", channels, {})
    assert list(tmp_path.iterdir()) == []


# -- headers --------------------------------------------------------------------------------------


def test_exr_keeps_text_ints_and_floats_in_its_header(tmp_path: Path) -> None:
    attributes: dict[str, Any] = {
        "Software": "volcli 0.1.0",
        "volcli:job": JOB,
        "volcli:rays": 2**31 - 1,
        "volcli:cells": 10**12,
        "volcli:seconds": 0.125,
        "volcli:numpy_int": np.int64(-5),
        "volcli:numpy_float": np.float32(0.1),
        "volcli:an_attribute_whose_name_is_longer_than_31_bytes": "x",
        "volcli:empty": "",
    }
    images.write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 2))}, attributes)
    _, read = images.read_exr(tmp_path / "a.exr")
    assert read["volcli:job"] == JOB
    assert read["Software"] == "volcli 0.1.0"
    assert read["volcli:rays"] == 2**31 - 1
    assert read["volcli:cells"] == "1000000000000"
    assert read["volcli:seconds"] == 0.125
    assert read["volcli:numpy_int"] == -5
    assert read["volcli:numpy_float"] == np.float32(0.1)
    assert read["volcli:an_attribute_whose_name_is_longer_than_31_bytes"] == "x"


def test_png_keeps_text_and_numbers_as_text_chunks(tmp_path: Path) -> None:
    attributes: dict[str, Any] = {
        "Software": "volcli",
        "volcli:job": JOB,
        "volcli:rays": 12,
        "volcli:s": 0.1,
    }
    images.write_png(tmp_path / "a.png", np.ones((2, 2, 4)), attributes)
    texts = dict(
        body.split(b"\0", 1) for kind, body in png_chunks(tmp_path / "a.png") if kind == b"tEXt"
    )
    assert texts[b"volcli:job"].decode() == JOB
    assert texts[b"volcli:rays"] == b"12"
    assert texts[b"volcli:s"] == b"0.1"
    _, spec = raw(tmp_path / "a.png")
    assert spec.getattribute("volcli:job") == JOB
    assert spec.getattribute("Software") == "volcli"


@pytest.mark.parametrize("value", [None, True, (1, 2), [1.0], b"x", 1j, np.ones(3)])
def test_attributes_of_other_types_are_refused(tmp_path: Path, value: Any) -> None:
    one = np.ones((2, 2, 4))
    with pytest.raises(TypeError, match="volcli:x"):
        images.write_exr(tmp_path / "a.exr", {"Y": one[..., 0]}, {"volcli:x": value})
    with pytest.raises(TypeError, match="volcli:x"):
        images.write_png(tmp_path / "a.png", one, {"volcli:x": value})
    with pytest.raises(TypeError, match="volcli:x"):
        images.write_map(tmp_path / "b.png", one[..., 0], {"volcli:x": value}, name="depth")
    assert list(tmp_path.iterdir()) == []


def test_text_that_the_header_cannot_keep_is_an_error_and_not_cut_short(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="did not keep 'volcli:x'"):
        images.write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 2))}, {"volcli:x": "a\0b"})
    assert list(tmp_path.iterdir()) == []


def test_equal_input_gives_equal_bytes_at_any_time(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rgba = rng.random((40, 30, 4)).astype(np.float32)
    attributes: dict[str, Any] = {"Software": "volcli", "volcli:job": JOB, "volcli:s": 1.5}

    def write(folder: Path) -> dict[str, bytes]:
        folder.mkdir()
        images.write_exr(folder / "a.exr", {"R": rgba[..., 0], "Z": rgba[..., 1]}, attributes)
        images.write_png(folder / "a.png", rgba, attributes)
        images.write_png(folder / "b.png", rgba, attributes, bits=16)
        images.write_map(folder / "c.png", rgba[..., 0], attributes, name="depth")
        return {file.name: file.read_bytes() for file in folder.iterdir()}

    first = write(tmp_path / "first")
    time.sleep(1.1)  # dates in headers have a resolution of one second
    assert write(tmp_path / "second") == first
    assert b"capDate" not in first["a.exr"]


def test_the_order_of_the_channels_does_not_change_the_file(tmp_path: Path) -> None:
    a, b = np.zeros((2, 2)), np.ones((2, 2))
    images.write_exr(tmp_path / "a.exr", {"R": a, "transmittance.Y": b}, {})
    images.write_exr(tmp_path / "b.exr", {"transmittance.Y": b, "R": a}, {})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


# -- PNG ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 16])
def test_png_holds_srgb_of_the_colour_divided_by_alpha(tmp_path: Path, bits: int) -> None:
    full = 2**bits - 1
    colour = np.array([0.0, 0.002, 0.18, 0.5, 0.999, 1.0])
    rgba = np.empty((3, 6, 4))
    for row, alpha in enumerate((1.0, 0.5, 0.2)):
        rgba[row, :, :3] = (colour * alpha)[:, None]
        rgba[row, :, 3] = alpha
    assert images.write_png(tmp_path / "a.png", rgba, {}, bits=bits) == []
    pixels, spec = raw(tmp_path / "a.png")
    assert spec.channelnames == ("R", "G", "B", "A")
    assert pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    encoded = np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    for channel in range(3):
        np.testing.assert_allclose(
            pixels[..., channel], np.tile(encoded * full, (3, 1)), atol=0.51 if bits == 8 else 0.55
        )
    np.testing.assert_allclose(pixels[..., 3], [[full] * 6, [full / 2] * 6, [full / 5] * 6], atol=1)


def test_every_8_bit_code_survives_decoding_and_encoding(tmp_path: Path) -> None:
    codes = np.arange(256).reshape(16, 16)
    rgba = np.ones((16, 16, 4))
    rgba[..., :3] = images.linear_from_srgb(codes / 255)[..., None]
    images.write_png(tmp_path / "a.png", rgba, {})
    np.testing.assert_array_equal(raw(tmp_path / "a.png")[0], np.repeat(codes[..., None], 3, 2))


def test_png_declares_srgb(tmp_path: Path) -> None:
    images.write_png(tmp_path / "a.png", np.ones((2, 2, 4)), {})
    assert b"sRGB" in [kind for kind, _ in png_chunks(tmp_path / "a.png")]


def test_an_opaque_png_has_three_channels(tmp_path: Path) -> None:
    rgba = np.full((2, 3, 4), 0.5)
    rgba[..., 3] = 1
    images.write_png(tmp_path / "a.png", rgba, {})
    assert raw(tmp_path / "a.png")[1].channelnames == ("R", "G", "B")
    rgba[1, 2, 3] = 0.9
    images.write_png(tmp_path / "b.png", rgba, {})
    assert raw(tmp_path / "b.png")[1].channelnames == ("R", "G", "B", "A")


@pytest.mark.filterwarnings("error")
def test_transparent_pixels_are_black_without_warnings(tmp_path: Path) -> None:
    rgba = np.zeros((2, 2, 4))
    rgba[0, 0] = 1e-42  # a subnormal opacity
    assert images.write_png(tmp_path / "a.png", rgba, {}) == []
    assert raw(tmp_path / "a.png")[0][0, 1].tolist() == [0, 0, 0, 0]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("pixel", "words"),
    [
        ([0.5, 0, 0, 0], "hold light where opacity is 0"),
        ([2, 0, 0, 1], "are brighter than 1"),
        ([0.3, 0, 0, 0.2], "are brighter than 1"),
        ([1e30, 0, 0, 1e-20], "are brighter than 1"),
        ([0, 0, 0, 1.5], "are brighter than 1"),
        ([-0.1, 0, 0, 1], "are negative"),
    ],
)
def test_what_png_cannot_hold_is_told_in_one_line(
    tmp_path: Path, pixel: list[float], words: str
) -> None:
    rgba = np.full((2, 3, 4), 0.25)
    rgba[1, 1] = pixel
    (warning,) = images.write_png(tmp_path / "a.png", rgba, {})
    assert words in warning
    assert "1 of 6 pixels" in warning
    assert "a.png" in warning
    assert "\n" not in warning


def test_of_light_that_png_cannot_hold_it_is_told_how_much(tmp_path: Path) -> None:
    rgba = np.zeros((1, 4, 4))
    rgba[0, 0] = [3, 0, 0, 0]  # fire without smoke
    rgba[0, 1] = [1, 1, 0, 0.5]  # brighter than 1 where it is seen: 1 of 2 is kept
    rgba[0, 2] = [0.5, 0.5, 0, 1]
    alone, clipped = images.write_png(tmp_path / "a.png", rgba, {})
    assert "1 of 4 pixels hold light where opacity is 0" in alone
    assert "(50 % of the picture's light)" in alone
    assert "1 of 4 pixels are brighter than 1" in clipped
    assert "(16.7 % of the picture's light)" in clipped
    rgba[0, 3] = [1e-5, 0, 0, 0]
    rgba[0, :2] = 0
    (little,) = images.write_png(tmp_path / "a.png", rgba, {})
    assert "(less than 0.1 % of the picture's light)" in little


def test_rounding_of_opaque_white_is_not_called_clipping(tmp_path: Path) -> None:
    opacity = -np.expm1(-np.geomspace(1e-6, 30, 4000)).astype(np.float32).reshape(40, 100)
    rgba = np.repeat(np.nextafter(opacity, np.float32(2))[..., None], 4, axis=2)
    rgba[..., 3] = opacity
    assert images.write_png(tmp_path / "a.png", rgba, {}, bits=16) == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_png_refuses_pixels_that_are_not_numbers(tmp_path: Path, value: float) -> None:
    rgba = np.full((4, 5, 4), 0.5)
    rgba[3, 2, 1] = value
    with pytest.raises(NonFiniteError, match=r"1 of 20 pixels \(the first at x=2, y=3\)"):
        images.write_png(tmp_path / "a.png", rgba, {})
    assert list(tmp_path.iterdir()) == []


def test_png_refuses_other_depths_and_shapes(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bits must be 8 or 16"):
        images.write_png(tmp_path / "a.png", np.ones((2, 2, 4)), {}, bits=12)
    for shape in ((2, 2, 3), (2, 2), (0, 2, 4)):
        with pytest.raises(ValueError, match="height, width, 4"):
            images.write_png(tmp_path / "a.png", np.ones(shape), {})


def test_png_takes_fortran_order_float64_and_strided_pixels(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rgba = rng.random((6, 5, 4)).astype(np.float32)
    rgba[..., 3] = 1
    images.write_png(tmp_path / "a.png", rgba, {})
    images.write_png(tmp_path / "b.png", np.asfortranarray(rgba.astype(np.float64)), {})
    images.write_png(tmp_path / "c.png", np.repeat(rgba, 2, axis=0)[::2], {})
    expected = (tmp_path / "a.png").read_bytes()
    assert (tmp_path / "b.png").read_bytes() == expected
    assert (tmp_path / "c.png").read_bytes() == expected


# -- maps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["transmittance", "opacity"])
def test_unit_maps_are_linear_grey_of_16_bits(tmp_path: Path, name: str) -> None:
    values = np.array([[0, 0.25, 0.5], [0.75, 1.0, 1 + 1e-7]])
    assert images.write_map(tmp_path / "a.png", values, {}, name=name) == (0.0, 1.0)
    pixels, spec = raw(tmp_path / "a.png")
    assert spec.channelnames == ("Y",)
    assert pixels[..., 0].tolist() == [[0, 16384, 32768], [49151, 65535, 65535]]
    assert spec.getattribute("volcli:map") == name
    assert (b"gAMA", struct.pack(">I", 100000)) in png_chunks(tmp_path / "a.png")


def test_unbounded_maps_are_scaled_and_say_by_how_much(tmp_path: Path) -> None:
    values = np.array([[2.0, 4.0], [6.0, 10.0]])
    assert images.write_map(tmp_path / "a.png", values, {}, name="optical_depth") == (2.0, 10.0)
    pixels, spec = raw(tmp_path / "a.png")
    lo = float(spec.getattribute("volcli:map_lo"))
    hi = float(spec.getattribute("volcli:map_hi"))
    assert (lo, hi) == (2.0, 10.0)
    np.testing.assert_allclose(lo + pixels[..., 0] / 65535 * (hi - lo), values, atol=8 / 65535)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("values", "span", "codes"),
    [
        ([[1.0, np.inf], [3.0, 2.0]], (1.0, 3.0), [[0, 65535], [65535, 32768]]),
        ([[5.0, np.inf], [5.0, 5.0]], (5.0, 5.0), [[0, 65535], [0, 0]]),
        ([[np.inf, np.inf]], (0.0, 0.0), [[65535, 65535]]),
        ([[-3e38, 3e38]], (-3e38, 3e38), [[0, 65535]]),
    ],
)
def test_infinite_depth_is_white_and_outside_the_range(
    tmp_path: Path, values: Any, span: tuple[float, float], codes: Any
) -> None:
    got = images.write_map(tmp_path / "a.png", np.array(values), {}, name="depth")
    assert got == pytest.approx(span)
    assert raw(tmp_path / "a.png")[0][..., 0].tolist() == codes


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("depth", np.nan),
        ("depth", -np.inf),
        ("opacity", np.nan),
        ("transmittance", np.inf),
    ],
)
def test_a_png_map_refuses_what_it_would_hide_and_exr_keeps_it(
    tmp_path: Path, name: str, value: float
) -> None:
    values = np.array([[0.5, value]], np.float32)
    with pytest.raises(NonFiniteError, match="x=1, y=0"):
        images.write_map(tmp_path / "a.png", values, {}, name=name)
    assert images.write_map(tmp_path / "a.exr", values, {}, name=name) == (0.0, 1.0)
    channels, attributes = images.read_exr(tmp_path / "a.exr")
    assert list(channels) == ["Y"]
    np.testing.assert_array_equal(channels["Y"], values)
    assert attributes["volcli:map"] == name


def test_an_opacity_beyond_one_is_not_clipped_in_silence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="opacity must lie in"):
        images.write_map(tmp_path / "a.png", np.array([[0.5, 1.01]]), {}, name="opacity")


# -- reading --------------------------------------------------------------------------------------


def test_reading_names_the_file_that_is_missing_or_no_image(tmp_path: Path) -> None:
    (tmp_path / "junk.exr").write_text("no image")
    (tmp_path / "junk.txt").write_text("no image")
    for name in ("missing.exr", "junk.exr", "junk.txt", "."):
        for read in (images.read_exr, images.read_background):
            with pytest.raises(UsageError) as caught:
                read(tmp_path / name)
            assert str(tmp_path / name) in str(caught.value)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_truncated_file_is_called_damaged(
    tmp_path: Path, rng: np.random.Generator, name: str
) -> None:
    rgba = rng.random((64, 64, 4))
    if name == "a.exr":
        images.write_exr(tmp_path / name, {c: rgba[..., i] for i, c in enumerate("RGBA")}, {})
    else:
        images.write_png(tmp_path / name, rgba, {})
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(UsageError, match=name):
        images.read_background(tmp_path / name)


def test_read_exr_refuses_other_formats(tmp_path: Path) -> None:
    images.write_png(tmp_path / "a.png", np.ones((2, 2, 4)), {})
    with pytest.raises(UsageError, match="is png, not EXR"):
        images.read_exr(tmp_path / "a.png")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_background_of_integers_is_decoded_from_srgb(tmp_path: Path, dtype: Any) -> None:
    full = np.iinfo(dtype).max
    codes = np.linspace(0, full, 12).astype(dtype).reshape(2, 2, 3)
    background = images.read_background(save(tmp_path / "a.png", codes), (2, 2))
    assert background.dtype == np.float32
    assert background.shape == (2, 2, 4)
    s = codes / full
    np.testing.assert_allclose(
        background[..., :3],
        np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4),
        atol=1e-6,
    )
    assert (background[..., 3] == 1).all()


@pytest.mark.parametrize("name", ["a.tif", "a.bmp", "a.ppm", "a.tga"])
def test_integers_that_name_no_colour_space_are_srgb(tmp_path: Path, name: str) -> None:
    codes = np.full((2, 2, 3), 128, np.uint8)
    background = images.read_background(save(tmp_path / name, codes), (2, 2))
    np.testing.assert_allclose(background[..., :3], 0.2158605, atol=1e-6)


@pytest.mark.parametrize("name", ["a.exr", "a.tif", "a.pfm", "a.hdr"])
def test_a_background_of_floats_is_taken_as_linear(tmp_path: Path, name: str) -> None:
    rgb = np.array([[[4, 0.5, 0.25], [0.5, 1, 2]]], np.float32)
    background = images.read_background(save(tmp_path / name, rgb), (2, 1))
    np.testing.assert_allclose(background[..., :3], rgb, rtol=0.01 if name == "a.hdr" else 0)


def test_a_background_in_another_known_colour_space_is_converted(tmp_path: Path) -> None:
    rgb = np.full((2, 2, 3), 0.5, np.float32)
    rgb[..., 1:] = 0
    path = save(tmp_path / "a.exr", rgb, oiio_ColorSpace="lin_ap1_scene")
    background = images.read_background(path)
    # The first column of the matrix from ACEScg to Rec.709.
    np.testing.assert_allclose(
        background[0, 0, :3], [0.5 * 1.70505, 0.5 * -0.13026, 0.5 * -0.02400], atol=1e-4
    )


def test_a_colour_space_whose_name_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the name of its colour space is no text"):
        linear_from_space(tmp_path / "a.exr", np.ones((2, 2, 3), np.float32), "s\udce9", False)


def test_a_background_of_grey_is_expanded(tmp_path: Path) -> None:
    grey = np.full((2, 3, 1), 51, np.uint8)
    background = images.read_background(save(tmp_path / "a.png", grey), (3, 2))
    assert background.shape == (2, 3, 4)
    np.testing.assert_allclose(background[..., :3], 0.0331048, atol=1e-6)
    grey_alpha = np.full((2, 3, 2), 0.25, np.float32)
    background = images.read_background(save(tmp_path / "b.exr", grey_alpha, "YA"), (3, 2))
    np.testing.assert_array_equal(background, np.full((2, 3, 4), 0.25))


def test_a_background_with_unassociated_alpha_is_decoded_before_it_is_multiplied(
    tmp_path: Path,
) -> None:
    codes = np.array([[[128, 64, 255, 51], [255, 255, 255, 0]]], np.uint8)
    path = save(tmp_path / "a.png", codes, oiio_UnassociatedAlpha=1)
    background = images.read_background(path, (2, 1))
    expected = images.linear_from_srgb(codes[0, 0, :3] / 255) * 0.2
    np.testing.assert_allclose(background[0, 0], [*expected, 0.2], atol=1e-6)
    assert background[0, 1].tolist() == [0, 0, 0, 0]


def test_a_background_of_premultiplied_srgb_is_divided_by_alpha_before_decoding(
    tmp_path: Path,
) -> None:
    codes = np.array([[[51, 102, 0, 102], [0, 0, 0, 0]]], np.uint8)
    background = images.read_background(save(tmp_path / "a.tif", codes), (2, 1))
    straight = images.linear_from_srgb(np.array([0.5, 1.0, 0.0]))
    np.testing.assert_allclose(background[0, 0], [*(straight * 0.4), 0.4], atol=1e-6)
    assert background[0, 1].tolist() == [0, 0, 0, 0]


def test_a_background_of_linear_premultiplied_light_is_kept_as_it_is(tmp_path: Path) -> None:
    rgba = np.array([[[2, 0.5, 0.1, 0.25], [0.5, 0, 0, 0]]], np.float32)
    background = images.read_background(save(tmp_path / "a.exr", rgba), (2, 1))
    np.testing.assert_array_equal(background, rgba)


def test_a_picture_read_as_background_is_the_picture_that_was_written(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rgba = rng.random((9, 8, 4)).astype(np.float32)
    rgba[..., :3] *= rgba[..., 3:]
    extra = {"Z": rgba[..., 0], "transmittance.Y": 1 - rgba[..., 3]}
    images.write_exr(
        tmp_path / "a.exr", {**{c: rgba[..., i] for i, c in enumerate("RGBA")}, **extra}, {}
    )
    images.write_png(tmp_path / "a.png", rgba, {}, bits=16)
    np.testing.assert_array_equal(images.read_background(tmp_path / "a.exr"), rgba)
    np.testing.assert_allclose(images.read_background(tmp_path / "a.png"), rgba, atol=3e-5)


@pytest.mark.parametrize("size", [(3, 2), (16, 16), (40, 33), (1, 1)])
def test_a_resized_background_keeps_a_constant(tmp_path: Path, size: tuple[int, int]) -> None:
    rgba = np.broadcast_to(np.array([3.0, 0.5, 0.25, 1.0], np.float32), (10, 16, 4))
    path = save(tmp_path / "a.exr", rgba)
    background = images.read_background(path, size)
    assert background.shape == (size[1], size[0], 4)
    np.testing.assert_allclose(background, np.broadcast_to(rgba[0, 0], background.shape), rtol=1e-6)


@pytest.mark.parametrize("size", [(8, 4), (64, 9)])
def test_a_resized_background_keeps_a_ramp_and_does_not_ring_around_a_sun(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    ramp = np.broadcast_to(np.arange(32, dtype=np.float32)[None, :, None], (8, 32, 3))
    background = images.read_background(save(tmp_path / "a.exr", ramp), size)
    expected = (np.arange(size[0]) + 0.5) * 32 / size[0] - 0.5
    edge = size[0] // 8
    np.testing.assert_allclose(background[0, edge:-edge, 0], expected[edge:-edge], atol=1e-3)
    sun = np.zeros((8, 32, 3), np.float32)
    sun[4, 16] = 1e5
    background = images.read_background(save(tmp_path / "b.exr", sun), size)
    assert background[..., :3].min() >= 0
    assert background[..., :3].max() <= 1e5 * (1 + 1e-6)


def test_a_background_without_alpha_stays_exactly_opaque_when_resized(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", np.full((7, 5, 3), 200, np.uint8))
    assert (images.read_background(path, (13, 3))[..., 3] == 1).all()


def test_a_background_is_turned_upright(tmp_path: Path) -> None:
    rgb = np.zeros((2, 3, 3), np.float32)
    rgb[0, 0] = 1  # stored top left; orientation 6 turns it clockwise to the top right
    background = images.read_background(save(tmp_path / "a.tif", rgb, Orientation=6))
    assert background.shape == (3, 2, 4)
    assert background[0, 1, 0] == 1
    assert background[..., 0].sum() == 1


def test_a_cropped_exr_keeps_its_place_in_the_background(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(2, 1, 3, oiio.FLOAT)
    spec.x, spec.y = 1, 2
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, 4, 3
    output = oiio.ImageOutput.create("exr")
    assert output is not None
    path = tmp_path / "a.exr"
    assert output.open(str(path), spec)
    assert output.write_image(np.ones((1, 2, 3), np.float32))
    assert output.close()
    background = images.read_background(path)
    assert background.shape == (3, 4, 4)
    assert background[..., 0].tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 1, 0]]


def test_a_background_that_holds_no_colour_or_no_numbers_is_refused(tmp_path: Path) -> None:
    two = {"transmittance.Y": np.ones((2, 2)), "Z": np.ones((2, 2))}
    images.write_exr(tmp_path / "a.exr", two, {})
    with pytest.raises(UsageError, match=r"a\.exr: no channels R, G, B or Y; it has: Z, trans"):
        images.read_background(tmp_path / "a.exr")
    images.write_exr(tmp_path / "b.exr", {"Y": np.array([[1, np.inf]])}, {})
    with pytest.raises(UsageError, match=r"b\.exr: 1 of 2 pixels \(the first at x=1, y=0\)"):
        images.read_background(tmp_path / "b.exr")


# -- where a result may go ------------------------------------------------------------------------


def test_an_output_that_can_be_written_is_accepted_and_nothing_is_touched(tmp_path: Path) -> None:
    images.check_output(tmp_path / "a.exr")
    images.check_output(str(tmp_path / "a.PNG"), overwrite=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out.xyz", "out", "out.jpg", ".exr"])
def test_an_unknown_format_is_a_usage_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"unknown image format .*; use \.exr or \.png"):
        images.check_output(tmp_path / name)


def test_an_impossible_output_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "old.exr").write_text("")
    os.mkfifo(tmp_path / "pipe.exr")
    cases = {
        "missing/a.exr": "does not exist; create it first",
        "file/a.exr": "is not a folder",
        "folder.exr": "is a folder",
        "pipe.exr": "is not a regular file",
        "old.exr": "already exists",
        "n" * 300 + ".exr": "File name too long",
        "nul\0.exr": "null",
    }
    for name, words in cases.items():
        with pytest.raises(OutputError, match=words) as caught:
            images.check_output(tmp_path / name, overwrite=False)
        assert str(tmp_path / name) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_folder_without_permission_to_write_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(OutputError, match="is not writable"):
        images.check_output(tmp_path / "a.exr")


def test_writers_make_the_same_checks(tmp_path: Path) -> None:
    one = np.ones((2, 2))
    with pytest.raises(OutputError, match="does not exist"):
        images.write_exr(tmp_path / "missing" / "a.exr", {"Y": one}, {})
    with pytest.raises(UsageError, match=r"extension must be \.exr"):
        images.write_exr(tmp_path / "a.png", {"Y": one}, {})
    with pytest.raises(UsageError, match=r"extension must be \.png"):
        images.write_png(tmp_path / "a.exr", np.ones((2, 2, 4)), {})
    with pytest.raises(UsageError, match="unknown image format"):
        images.write_map(tmp_path / "a.jpg", one, {}, name="depth")


def test_nothing_is_overwritten_unless_allowed(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    images.write_exr(path, {"Y": np.zeros((2, 2))}, {}, overwrite=False)
    with pytest.raises(OutputError, match="already exists"):
        images.write_exr(path, {"Y": np.ones((2, 2))}, {}, overwrite=False)
    assert images.read_exr(path)[0]["Y"].max() == 0
    images.write_exr(path, {"Y": np.ones((2, 2))}, {})
    assert images.read_exr(path)[0]["Y"].min() == 1
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appears_while_writing_is_not_overwritten_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    path = tmp_path / "a.exr"
    monkeypatch.setattr(store, "_sync", lambda file: path.write_text("faster"))
    if not links:

        def refuse(*_: object) -> None:
            raise PermissionError("no hard links here")

        monkeypatch.setattr(Path, "hardlink_to", refuse)
    with pytest.raises(OutputError, match="already exists"):
        images.write_exr(path, {"Y": np.ones((2, 2))}, {}, overwrite=False)
    assert path.read_text() == "faster"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_system_without_hard_links_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("no hard links here")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    images.write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 2))}, {}, overwrite=False)
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


# -- whole or not at all --------------------------------------------------------------------------


def write_noise(path: Path) -> None:
    rgba = np.random.default_rng(3).random((200, 200, 4)).astype(np.float32)
    if path.suffix == ".exr":
        images.write_exr(path, {c: rgba[..., i] for i, c in enumerate("RGBA")}, {"volcli:job": JOB})
    else:
        images.write_png(path, rgba, {"volcli:job": JOB}, bits=16)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
@pytest.mark.parametrize("size", [0, 100, 5000, 70_000, 140_000])
def test_a_disk_that_fills_up_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, name: str, size: int
) -> None:
    path = tmp_path / name
    path.write_text("old")
    with files_no_longer_than(size), pytest.raises(OutputError) as caught:
        write_noise(path)
    assert str(path) in str(caught.value)
    assert "check the free space" in str(caught.value)
    assert ".volcli-" not in str(caught.value)  # nobody asked for that file
    assert "\n" not in str(caught.value)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    write_noise(path)
    assert images.read_background(path).shape == (200, 200, 4)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty"])
def test_a_file_that_does_not_read_back_as_written_never_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, damage: str
) -> None:
    path = tmp_path / name
    path.write_text("old")
    encode = store._encode

    def damaged(file: Path, *rest: Any) -> None:
        encode(file, *rest)
        data = bytearray(file.read_bytes())
        if damage == "flipped":
            data[len(data) // 2 + 20_000] ^= 0xFF
        file.write_bytes({"cut": data[:-5000], "flipped": data, "empty": bytearray()}[damage])

    monkeypatch.setattr(store, "_encode", damaged)
    with pytest.raises(OutputError, match=name):
        write_noise(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_sound_file_with_one_other_pixel_never_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    encode = store._encode

    def altered(
        file: Path, file_format: str, names: list[str], pixels: np.ndarray, *rest: Any
    ) -> None:
        pixels = pixels.copy()
        pixels[-1, -1, 0] += 1
        encode(file, file_format, names, pixels, *rest)

    monkeypatch.setattr(store, "_encode", altered)
    with pytest.raises(OutputError, match="read back with other pixels"):
        write_noise(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("step", ["_encode", "_check", "_sync", "move_into_place"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_at_any_step_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, error: BaseException
) -> None:
    path = tmp_path / "a.exr"
    path.write_text("old")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(store, step, fail)
    expected = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected) as caught:
        write_noise(path)
    if expected is OutputError:
        assert "No space left on device" in str(caught.value)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("overwrite", [True, False])
@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_permissions_follow_the_umask(tmp_path: Path, umask: int, overwrite: bool) -> None:
    before = os.umask(umask)
    try:
        one = np.ones((2, 2, 4))
        images.write_exr(tmp_path / "a.exr", {"Y": one[..., 0]}, {}, overwrite=overwrite)
        images.write_png(tmp_path / "a.png", one, {}, overwrite=overwrite)
    finally:
        os.umask(before)
    for file in tmp_path.iterdir():
        assert stat.S_IMODE(file.stat().st_mode) == 0o666 & ~umask


def test_a_symbolic_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "a.exr").symlink_to(tmp_path / "disk" / "real.exr")
    images.write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 2))}, {})
    assert (tmp_path / "a.exr").is_symlink()
    assert images.read_exr(tmp_path / "disk" / "real.exr")[0]["Y"].min() == 1
    assert [file.name for file in (tmp_path / "disk").iterdir()] == ["real.exr"]


@pytest.mark.parametrize("stem", ["n" * 251, "with space", "räuchlein", "%04d", "a#b"])
def test_unusual_names_are_just_names(tmp_path: Path, stem: str) -> None:
    for suffix in (".exr", ".PNG"):
        path = tmp_path / (stem + suffix)
        if suffix == ".exr":
            images.write_exr(path, {"Y": np.ones((2, 2))}, {})
        else:
            images.write_png(path, np.ones((2, 2, 4)), {})
        assert images.read_background(path).shape == (2, 2, 4)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_relative_path_needs_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    images.write_exr("a.exr", {"Y": np.ones((2, 2))}, {})
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_importing_the_module_does_not_import_openimageio() -> None:
    assert importlib.util.find_spec("OpenImageIO") is not None
    code = "import sys, volcli.images; sys.exit('OpenImageIO' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
