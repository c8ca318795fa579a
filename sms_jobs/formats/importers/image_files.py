"""One image file as grey levels: PNG, TIFF, BMP, JPEG, PNM, and raw sensor data.

A file is read as a whole or refused; nothing is guessed about a damaged one.
"""

from __future__ import annotations

import hashlib
import io
import re
import stat
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from math import log2
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sms_jobs.errors import InvalidInput

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".dib", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm"})
RAW_SUFFIXES = frozenset({".raw", ".bin", ".gray", ".grey"})
LARGEST_BYTES = 1 << 30
LARGEST_PIXELS = 1 << 27
LARGEST_SIDE = 1 << 16

_FORMATS = ("PNG", "TIFF", "BMP", "DIB", "JPEG", "PPM")
_GREY_16 = ("I;16", "I;16L", "I;16B", "I;16N")
_WEIGHTS = np.array([0.299, 0.587, 0.114])  # of red, green and blue: ITU-R BT.601
_RAW = re.compile(r"(\d{1,6})x(\d{1,6})x(\d{1,2})(?:\+(\d{1,9}))?(be|le)?")
_BITS_PER_SAMPLE = 258  # a tag of TIFF
_ORIENTATION = 274  # a tag of TIFF, and of EXIF
_TURNED_BACK: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    2: lambda levels: levels[:, ::-1],
    3: lambda levels: levels[::-1, ::-1],
    4: lambda levels: levels[::-1],
    5: lambda levels: levels.swapaxes(0, 1),
    6: lambda levels: np.rot90(levels),
    7: lambda levels: levels[::-1, ::-1].swapaxes(0, 1),
    8: lambda levels: np.rot90(levels, -1),
}
"""What leads from an image as it is to be shown to the pixels of the sensor, by orientation."""
_PNG_COLOUR = (2, 4, 6)  # kinds of PNG with more than one channel


def is_raw(name: str) -> bool:
    """Say whether a file of that name has pixels alone, without a word on how many."""
    return Path(name).suffix.lower() in RAW_SUFFIXES


@dataclass(frozen=True)
class RawFormat:
    """How raw files are laid out: rows of pixels, top to bottom, one or two bytes a pixel."""

    columns: int
    rows: int
    bits: int
    header_bytes: int = 0
    big_endian: bool = False

    @classmethod
    def parse(cls, text: str) -> RawFormat:
        """Read `1280x1024x12`, with `+HEADER_BYTES` and `be` behind it where needed."""
        found = _RAW.fullmatch(text)
        if found is None:
            raise InvalidInput(
                f"raw files are described as in 1280x1024x12, columns x rows x bits, with +512 for a header "
                f"of 512 bytes and be for big-endian behind it, not '{text}'"
            )
        columns, rows, bits = (int(found[i]) for i in (1, 2, 3))
        if not (1 <= bits <= 16 and 0 < columns <= LARGEST_SIDE and 0 < rows <= LARGEST_SIDE):
            raise InvalidInput(
                f"raw files may have 1 to 16 bits and 1 to {LARGEST_SIDE} columns and rows, not '{text}'"
            )
        return cls(columns, rows, bits, int(found[4] or 0), found[5] == "be")

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one pixel in the file."""
        return np.dtype("u1") if self.bits <= 8 else np.dtype(">u2" if self.big_endian else "<u2")

    def said_of(self, names: Iterable[str]) -> dict[str, dict[str, int | bool]]:
        """Return what makes another image of the same bytes, for a hash; nothing where no file is raw."""
        return {"raw": asdict(self)} if any(is_raw(name) for name in names) else {}

    @property
    def size_bytes(self) -> int:
        """Of a whole file."""
        return self.header_bytes + self.columns * self.rows * self.dtype.itemsize


@dataclass(frozen=True)
class ImageFacts:
    """What an image file is.

    Attributes
    ----------
    sha256
        Of its bytes.
    rows, columns
        In pixels.
    dtype
        uint8 or uint16.
    highest, at_highest
        The highest grey level in it, and the part of the pixels that have it.
    lowest_bits
        How many of the lowest bits are 0 in every pixel; 16 for a black image.
    remarks
        What was done to it: colours turned to grey, transparency left out.
    """

    sha256: str
    rows: int
    columns: int
    dtype: str
    highest: int
    at_highest: float
    lowest_bits: int
    remarks: tuple[str, ...] = ()


def read_image(path: Path, raw: RawFormat | None = None) -> tuple[NDArray[Any], ImageFacts]:
    """Return grey levels, (rows, columns) in uint8 or uint16, and what the file is.

    Colour becomes grey by 0.299 R + 0.587 G + 0.114 B, rounded to whole levels; transparency is left out. An
    orientation that a camera noted (EXIF) is not followed: pixels are those of the sensor.

    Raises
    ------
    InvalidInput
        It is no regular file, no image, damaged or cut short, larger than allowed, or of a kind that is no
        measurement: several pages, more than 16 bits, floating point.
    """
    content = _content(path)
    digest = hashlib.sha256(content).hexdigest()
    remarks: list[str] = []
    if is_raw(path.name):
        grey = _raw_levels(path, content, raw)
    else:
        grey, remarks = _decoded(path, content)
    bits, highest = int(np.bitwise_or.reduce(grey, axis=None)), int(grey.max())
    facts = ImageFacts(
        digest,
        grey.shape[0],
        grey.shape[1],
        grey.dtype.name,
        highest,
        np.count_nonzero(grey == highest) / grey.size,
        16 if not bits else int(log2(bits & -bits)),
        tuple(remarks),
    )
    return grey, facts


def _content(path: Path) -> bytes:
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise InvalidInput(f"{path.name} is no regular file")
        if about.st_size > LARGEST_BYTES:
            raise InvalidInput(
                f"{path.name} has {about.st_size} bytes, an image may have {LARGEST_BYTES}: crop or split it"
            )
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path.name} cannot be read: {error.strerror}") from error
    if not content:
        raise InvalidInput(f"{path.name} is empty: copy it again")
    return content


def _raw_levels(path: Path, content: bytes, raw: RawFormat | None) -> NDArray[Any]:
    if raw is None:
        raise InvalidInput(
            f"{path.name} is raw data: give its columns, rows and bits as `raw`, for example 1280x1024x12"
        )
    if len(content) != raw.size_bytes:
        raise InvalidInput(
            f"{path.name} has {len(content)} bytes, but {raw.columns} x {raw.rows} px of {raw.bits} bits "
            f"with {raw.header_bytes} bytes before them are {raw.size_bytes}: correct `raw`, or copy it again"
        )
    levels = np.frombuffer(content, raw.dtype, offset=raw.header_bytes).reshape(raw.rows, raw.columns)
    highest = int(levels.max())
    if highest >= 1 << raw.bits:
        raise InvalidInput(
            f"{path.name} has grey level {highest}, above the {(1 << raw.bits) - 1} of {raw.bits} bits: "
            "correct the bits or the byte order in `raw`"
        )
    return levels.astype(np.uint8 if raw.bits <= 8 else np.uint16)


def _decoded(path: Path, content: bytes) -> tuple[NDArray[Any], list[str]]:
    try:
        with warnings.catch_warnings():
            # Limits are checked below; what else it warns of is no fault of the pixels.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
                _check_size(path, image)
                deep, turned = _is_deep(image, content), _orientation(image)
                image.load()  # raises where the data end too soon
                mode = image.mode
                levels = None if deep else _levels(path, image)
                tiff = image.format == "TIFF"
    except InvalidInput:
        raise
    except Image.DecompressionBombError:
        raise InvalidInput(_too_large(path)) from None
    except Exception as error:  # noqa: BLE001 - decoders raise anything on damaged files
        reason = re.sub(r"<[^>]*>|\s+", " ", str(error)).strip()[:120] or type(error).__name__
        raise InvalidInput(
            f"{path.name} is no image, or is damaged ({reason}): copy it again, or take it out of the folder"
        ) from None
    if levels is None:
        levels = _deep_levels(path, content)
    if turned in _TURNED_BACK and tiff:
        levels = np.ascontiguousarray(_TURNED_BACK[turned](levels))  # both readers turn TIFF, and no other
    grey, remarks = _as_grey(levels, mode)
    if turned in _TURNED_BACK:
        remarks.append("the orientation that files note is not followed: pixels are those of the sensor")
    return grey, remarks


def _orientation(image: Any) -> int | None:
    """Return how an image is to be turned when it is shown; None where that is not said, or not readable."""
    try:
        found = image.getexif().get(_ORIENTATION)
    except Exception:  # noqa: BLE001 - readers raise anything on damaged notes, and pixels do not need them
        return None
    return found if isinstance(found, int) else None


def _check_size(path: Path, image: Any) -> None:
    columns, rows = image.size
    if columns * rows > LARGEST_PIXELS or max(columns, rows) > LARGEST_SIDE:
        raise InvalidInput(_too_large(path))
    pages = getattr(image, "n_frames", 1)
    if pages > 1:
        raise InvalidInput(f"{path.name} has {pages} pages: split it into one file a frame")


def _too_large(path: Path) -> str:
    return (
        f"{path.name} is larger than the {LARGEST_PIXELS >> 20} Mpx or {LARGEST_SIDE} px a side that an "
        "image may have: crop it"
    )


def _is_deep(image: Any, content: bytes) -> bool:
    """Tell images whose levels Pillow would change: colours of 16 bits, which it would cut to 8, and PNM of
    another highest level than 255, whose levels it would scale to 8 or 16 bits.
    """
    if image.format == "PPM":
        return any(tile.codec_name in ("ppm", "ppm_plain") and tile.args[1] != 255 for tile in image.tile)
    if image.format == "PNG":
        return content[24] == 16 and content[25] in _PNG_COLOUR
    if image.format == "TIFF":
        bits = image.tag_v2.get(_BITS_PER_SAMPLE, ())
        bits = bits if isinstance(bits, tuple) else (bits,)
        return len(bits) > 1 and max(bits) > 8
    return False


def _levels(path: Path, image: Any) -> NDArray[Any]:
    """Return the pixels of a loaded image, (rows, columns) or (rows, columns, channels)."""
    if image.mode == "1":
        image = image.convert("L")
    elif image.mode in ("P", "PA", "RGBX"):
        image = image.convert("RGB")
    if image.mode in _GREY_16:
        return np.asarray(image).astype(np.uint16)
    if image.mode in ("L", "LA", "RGB", "RGBA"):
        return np.array(image)
    if image.mode == "I":
        levels = np.asarray(image)
        if levels.min() >= 0 and levels.max() <= 65_535:
            return levels.astype(np.uint16)
    raise InvalidInput(
        f"{path.name} has pixels of the kind '{image.mode}': save it with 8 or 16 bits of grey or colour"
    )


def _deep_levels(path: Path, content: bytes) -> NDArray[Any]:
    import cv2

    digits = content[:2] in (b"P2", b"P3")
    if digits:
        content += b"\n"  # without which OpenCV does not read the last number
    levels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    # Of levels written in digits OpenCV stretches up to 8 bits.
    if levels is None or levels.dtype not in ((np.uint16,) if digits else (np.uint8, np.uint16)):
        raise InvalidInput(f"{path.name} has levels that cannot be read: save it as 16-bit grey PNG")
    if levels.ndim == 3 and levels.shape[2] >= 3:
        levels[..., :3] = levels[..., 2::-1]
    return np.asarray(levels)


def _as_grey(levels: NDArray[Any], mode: str) -> tuple[NDArray[Any], list[str]]:
    """Return grey levels, and what was done for them."""
    if levels.ndim == 2:
        return levels, ["a black-and-white image has two grey levels"] if mode == "1" else []
    channels, remarks = levels.shape[2], []
    if channels in (2, 4):
        remarks.append("transparency is left out")
        levels = levels[..., : channels - 1]
    if levels.shape[2] == 1:
        return np.ascontiguousarray(levels[..., 0]), remarks
    if (levels[..., 0] == levels[..., 1]).all() and (levels[..., 1] == levels[..., 2]).all():
        # Grey that was saved as colour keeps its levels exactly.
        return np.ascontiguousarray(levels[..., 0]), remarks
    grey = np.rint(levels @ _WEIGHTS).astype(levels.dtype)
    return grey, [*remarks, "colours become grey by 0.299 R + 0.587 G + 0.114 B"]
