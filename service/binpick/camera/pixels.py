"""A camera's pixels as the 8-bit grey that the matcher reads: the upper eight bits of deeper ones, colour by its weights."""

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick.data import Image
from binpick.errors import PairRefused
from binpick.settings.cell import PixelFormat

CODES: dict[str, int] = {"Mono8": 0x01080001, "Mono10": 0x01100003, "Mono10p": 0x010A0046, "Mono12": 0x01100005,
                         "Mono12p": 0x010C0047, "Mono12Packed": 0x010C0006, "BayerRG8": 0x01080009}
"""GigE Vision's and GenICam's numbers (Pixel Format Naming Convention 2.1); the second byte is the bits of a pixel."""


def size_bytes(pixel_format: PixelFormat, width: int, height: int) -> int:
    """Of an image."""
    return -(-width * height * (CODES[pixel_format] >> 16 & 0xFF) // 8)


def grey(data: bytes, code: int, wanted: PixelFormat, width: int, height: int) -> Image:
    """The image, not copied when it is grey of 8 bits already. Raises PairRefused for another format or too few bytes."""
    if code != CODES[wanted]:
        names = {number: name for name, number in CODES.items()}
        raise PairRefused(f"the image came as {names.get(code, hex(code))}, not as {wanted}")
    size = size_bytes(wanted, width, height)
    if len(data) < size:
        raise PairRefused(f"the image has {len(data)} bytes, not {size} ({width}x{height} pixels of {wanted})")
    raw = np.frombuffer(data, np.uint8, size)
    if wanted == "BayerRG8":
        return np.asarray(cv2.cvtColor(raw.reshape(height, width), cv2.COLOR_BayerRGGB2GRAY), np.uint8)
    return _upper(raw, wanted)[:width * height].reshape(height, width)


def _upper(raw: UInt8[np.ndarray, "n"], wanted: str) -> UInt8[np.ndarray, "m"]:
    """The upper eight bits of every pixel, and of what fills the last group up."""
    match wanted:
        case "Mono10":
            return (raw.view("<u2") >> 2).astype(np.uint8)
        case "Mono12":
            return (raw.view("<u2") >> 4).astype(np.uint8)
        case "Mono12p":           # two pixels in three bytes, the lowest bits first
            low, middle, high = _columns(raw, 3)
            return np.stack((low >> 4 | middle << 4, high), axis=1).reshape(-1)
        case "Mono12Packed":      # GigE Vision's own: the first and the last byte are the upper bits
            high, _, second = _columns(raw, 3)
            return np.stack((high, second), axis=1).reshape(-1)
        case "Mono10p":           # four pixels in five bytes, the lowest bits first
            columns = _columns(raw, 5)
            return np.stack([columns[i] >> (2 + 2 * i) | columns[i + 1] << (6 - 2 * i) for i in range(4)], axis=1).reshape(-1)
    return raw


def _columns(raw: UInt8[np.ndarray, "n"], count: int) -> UInt8[np.ndarray, "count m"]:
    """Groups of `count` bytes, the last one filled up."""
    return np.pad(raw, (0, -raw.size % count)).reshape(-1, count).T
