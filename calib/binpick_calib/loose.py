"""Loose parameters: camera matrices, distortion and the step between two cameras, as OpenCV's users keep them in files."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError
from binpick.rig import Rig, RigCamera
from binpick_calib import plausible

Found = dict[str, Float[np.ndarray, "..."]]
MATRIX = r"(?:camera_?matrix|intrinsics?|mtx|k|m|cam(?:era)?_?k)"
DISTORTION = r"(?:dist(?:ortion)?(?:_?coeff?(?:icient)?s?)?|d)"
SIDE = r"_?(left|right|l|r|[012])"


def rig_of(paths: Iterable[Path], image_size_px: tuple[int, int], unit_m: float, created: str) -> Rig:
    """The rig of what the files hold: two camera matrices, two distortions, R and T (x_right = R x_left + T, `unit_m` each).

    Raises InputError for what is missing, unknown or implausible.
    """
    found = _sorted_out(dict(entry for path in paths for entry in _entries(path)))
    missing = [name for name in ("K left", "K right", "D left", "D right", "R", "T") if name not in found]
    if missing:
        raise InputError(f"not found in the files: {', '.join(missing)}; they are known by names such as "
                         "M1 M2 D1 D2 R T, cameraMatrixL distL, mtx_left dist_left, K1 D1")
    for name, sizes in (("K left", (9,)), ("K right", (9,)), ("R", (9, 3)), ("T", (3,)), ("D left", (4, 5, 8, 12, 14)),
                        ("D right", (4, 5, 8, 12, 14))):
        if found[name].size not in sizes or not np.isfinite(found[name]).all():
            raise InputError(f"{name} has {found[name].size} numbers or some that are not finite; {sizes[0]} are expected")
    R = found["R"].reshape(3, 3) if found["R"].size == 9 else cv2.Rodrigues(found["R"].reshape(3))[0]
    T_right_left = geometry.make(R, found["T"].reshape(3) * unit_m)
    if not geometry.is_rigid(T_right_left, 1e-4):
        raise InputError("R is not a rotation: its columns are not of length 1 and square to each other")
    rig = Rig(image_size_px=image_size_px, created=created, cameras=tuple(
        RigCamera.model_validate({"name": side, "K": found[f"K {side}"].reshape(3, 3).tolist(),
                                  "distortion": found[f"D {side}"].ravel().tolist(), "T_cam_rig": T.tolist()})
        for side, T in (("left", np.eye(4)), ("right", T_right_left))))
    wrong = plausible.faults(rig)
    if wrong:
        raise InputError(". ".join(wrong))
    return rig


def _entries(path: Path) -> Iterator[tuple[str, Float[np.ndarray, "..."]]]:
    """Every array of a file by its name: that of the file for .npy, else its key."""
    try:
        if path.suffix == ".npy":
            yield path.stem, np.asarray(np.load(path, allow_pickle=False), dtype=float)
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                yield from ((key, np.asarray(archive[key], dtype=float)) for key in archive.files
                            if archive[key].dtype.kind in "fiu")
        elif path.suffix in (".yml", ".yaml", ".xml"):
            yield from _storage(path)
        else:
            raise InputError(f"{path}: known are .npy, .npz, .yml, .yaml and .xml")
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except (OSError, ValueError, cv2.error, SystemError) as error:
        raise InputError(f"{path}: cannot be read as OpenCV or numpy parameters") from error


def _storage(path: Path) -> Iterator[tuple[str, Float[np.ndarray, "..."]]]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    root = storage.root()
    for key in root.keys():    # noqa: SIM118 - a FileNode is no dict
        node = root.getNode(key)
        matrix = node.mat() if node.isMap() else None
        if matrix is not None:
            # one file for each camera: then the side is in its name, and the key is the same in both
            yield (key if re.fullmatch(f"(?:{MATRIX}|{DISTORTION}){SIDE}|r|t", key.lower()) else f"{key}_{_side(path)}",
                   np.asarray(matrix, dtype=float))
    storage.release()


def _side(path: Path) -> str:
    told = re.search(r"left|right", path.stem.lower())
    return told[0] if told else ""


def _sorted_out(entries: Found) -> Found:
    """The entries that mean something, by what they mean. Numbers count from 0 or from 1."""
    named: dict[tuple[str, str], Float[np.ndarray, "..."]] = {}
    sorted_out: Found = {}
    for name, array in entries.items():
        plain = name.lower().strip("_")
        if re.fullmatch(r"r(?:ot(?:ation)?)?(?:_?matrix)?", plain):
            sorted_out["R"] = array
        elif re.fullmatch(r"t(?:rans(?:lation)?)?(?:_?vec(?:tor)?)?", plain):
            sorted_out["T"] = array
        for what, pattern in (("K", MATRIX), ("D", DISTORTION)):
            told = re.fullmatch(f"{pattern}{SIDE}", plain)
            if told:
                named[what, told[1]] = array
    from_zero = ("K", "0") in named
    left, right = (("left", "l", "0"), ("right", "r", "1")) if from_zero else (("left", "l", "1"), ("right", "r", "2"))
    for (what, side), array in named.items():
        if side in left or side in right:
            sorted_out[f"{what} {'left' if side in left else 'right'}"] = array
    return sorted_out
