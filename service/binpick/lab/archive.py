"""What a long run leaves on disk: finished sheets, named by all that they rest on, and pictures, named by what they show."""

import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from platformdirs import user_cache_path
from pydantic import TypeAdapter

import binpick
from binpick.data import Image, Light
from binpick.rig import Rig
from binpick.sim import exam
from binpick.sim.world import WorldScene

HOME = Path(binpick.__file__).parent
RENDERERS = ("sim", "geometry", "data.py", "rig.py")
"""The sources that decide what a picture shows."""
LIBRARIES = ("numpy", "opencv-contrib-python-headless", "open3d-cpu", "mujoco", "scipy")
"""Whatever they compute may change with their versions."""
FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
"""Sensor noise does not shrink any further."""
Sheet = TypeVar("Sheet")


@dataclass(frozen=True, slots=True)
class Archive:
    """A folder of `sheets` and `pictures`; None keeps nothing. Files appear whole or not at all."""

    folder: Path | None = None

    def sheet(self, kind: type[Sheet], facts: Mapping[str, Any], make: Callable[[], Sheet]) -> Sheet:
        """The sheet that was made of these facts, of this exam and by these sources, or a new one; `kind` is a dataclass."""
        if self.folder is None:
            return make()
        rests_on = {**facts, "exam": exam.sha256(), "sources": sources(), "libraries": libraries()}
        path = self.folder / "sheets" / f"{_name(rests_on)}.json"
        adapter = TypeAdapter(kind)
        if path.exists():
            return adapter.validate_python(json.loads(path.read_bytes())["sheet"])
        sheet = make()
        _write(path, json.dumps({"rests_on": rests_on, "sheet": adapter.dump_python(sheet)}, indent=1).encode())
        return sheet

    def picture(self, rig: Rig, scene: WorldScene, camera: int, light: Light, shot: int, expose: Callable[[], Image]) -> Image:
        """What a camera took of this scene in this light, or takes now."""
        if self.folder is None:
            return expose()
        shows = {"rig": rig.model_dump(mode="json"), "scene": scene.digest, "seed": scene.seed, "camera": camera,
                 "light": asdict(light), "shot": shot, "exam": exam.sha256(), "sources": sources(RENDERERS),
                 "libraries": libraries()}
        path = self.folder / "pictures" / f"{_name(shows)}.png"
        if path.exists():
            kept: Image | None = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
            if kept is not None:
                return kept
        image = expose()
        _write(path, cv2.imencode(".png", image, FAST)[1].tobytes())
        return image


NOWHERE = Archive()


def default() -> Path:
    """The folder in the user's cache."""
    return user_cache_path("binpick") / "bench"


@functools.cache
def sources(of: Iterable[str] = (".",)) -> str:
    """Names the installed package's sources, or some of its folders and modules."""
    digest = hashlib.sha256()
    chosen = [[HOME / name] if name.endswith(".py") else sorted((HOME / name).rglob("*.py")) for name in of]
    for path in itertools.chain(*chosen):
        digest.update(str(path.relative_to(HOME)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def libraries() -> str:
    """Names the versions of what computes; an absent one has none."""
    found = {dist.metadata["Name"]: dist.version for dist in metadata.distributions() if dist.metadata["Name"] in LIBRARIES}
    return " ".join(f"{name} {found.get(name, '-')}" for name in LIBRARIES)


def _name(facts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".part")
    unfinished.write_bytes(content)
    unfinished.replace(path)
