"""Pixel formats: how many bits a pixel takes on the wire, and 8-bit images packed that way (GenICam PFNC 2.1)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8, UInt16

from binpick.data import Image

Bytes = UInt8[np.ndarray, "_"]
Words = UInt16[np.ndarray, "_"]
FORMATS = {
    "Mono8": 0x01080001, "Mono10": 0x01100003, "Mono10p": 0x010A0046, "Mono12": 0x01100005, "Mono12p": 0x010C0047,
    "Mono12Packed": 0x010C0006, "BayerRG8": 0x01080009}
NAMES = {number: name for name, number in FORMATS.items()}


@dataclass(frozen=True, slots=True)
class Payload:
    """An image as it goes out; `format` is its number."""

    width: int
    height: int
    format: int
    data: Bytes


def size(width: int, height: int, number: int) -> int:
    """Bytes of an image."""
    return -(-width * height * bits(number) // 8)


def bits(number: int) -> int:
    """Of a pixel: PFNC writes them into the number."""
    return number >> 16 & 0xFF


def pack(image: Image, number: int) -> Payload:
    """Bits beyond the image's eight repeat its highest ones, so that white stays white."""
    height, width = image.shape
    return Payload(width, height, number, _pack(np.ascontiguousarray(image).reshape(-1), NAMES[number]))


def _pack(flat: Bytes, name: str) -> Bytes:
    if bits(FORMATS[name]) == 8:
        return flat
    wide = flat.astype(np.uint16)
    ten, twelve = wide << 2 | wide >> 6, wide << 4 | wide >> 4
    match name:
        case "Mono10":
            return ten.astype("<u2").view(np.uint8)
        case "Mono12":
            return twelve.astype("<u2").view(np.uint8)
        case "Mono10p":
            a, b, c, d = _dealt(ten, 4)
            return _woven([a, a >> 8 | b << 2, b >> 6 | c << 4, c >> 4 | d << 6, d >> 2], flat.size * 10)
        case "Mono12p":
            a, b = _dealt(twelve, 2)
            return _woven([a, a >> 8 | b << 4, b >> 4], flat.size * 12)
    a, b = _dealt(twelve, 2)       # Mono12Packed
    return _woven([a >> 4, a & 15 | b << 4, b >> 4], flat.size * 12)


def _dealt(values: Words, hands: int) -> list[Words]:
    """Every `hands`-th pixel, from each of the first ones; zeros where there is none."""
    whole = np.append(values, np.zeros(-values.size % hands, np.uint16))
    return [whole[first::hands] for first in range(hands)]


def _woven(columns: list[Words], bits: int) -> Bytes:
    """The lower 8 bits of each column, in turns."""
    return np.stack(columns, axis=1).astype(np.uint8).reshape(-1)[:-(-bits // 8)]
