"""How disparity is found: a matcher, what confirms it, and the named presets."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from binpick.settings.base import Strict


class Costs(Strict):
    """What OpenCV's semi-global matcher weighs."""

    block_px: Annotated[int, Field(ge=1, le=11)] = 5
    """Side of the matched block, odd, px; above 11 OpenCV's result has artefacts."""
    p1: Annotated[int, Field(ge=1, le=20000)] = 200
    """Penalty for a disparity step of 1 px between neighbours."""
    p2: Annotated[int, Field(ge=2, le=20000)] = 800
    """Penalty for a larger step; above p1. Near 32767 OpenCV's 16-bit sums overflow, and every pixel is wrong."""
    uniqueness_percent: Annotated[int, Field(ge=0, le=50)] = 5
    """How much better the best match must be than the second best."""

    @model_validator(mode="after")
    def _sound(self) -> "Costs":
        if self.block_px % 2 == 0:
            raise ValueError("block_px must be odd")
        if self.p2 <= self.p1:
            raise ValueError("p2 must be larger than p1")
        return self


class Sgbm(Costs):
    """Semi-global matching at full resolution."""

    kind: Literal["sgbm"] = "sgbm"
    mode: Literal["3way", "sgbm", "hh", "hh4"] = "3way"
    """Paths the costs run along: 3 (on all cores), 5, 8 or 4 (on one core)."""


class Hybrid(Costs):
    """Semi-global matching on images shrunk by two; planes carry what is found to every pixel."""

    kind: Literal["hybrid"] = "hybrid"

    @property
    def shrunk(self) -> Sgbm:
        """What searches the shrunk images."""
        return Sgbm.model_validate(self.model_dump(exclude={"kind"}))


class Bm(Strict):
    """Block matching: the fastest, and the first to give up where there is little texture."""

    kind: Literal["bm"] = "bm"
    block_px: Annotated[int, Field(ge=5, le=51)] = 15
    """Side of the matched block, odd, px."""
    texture_threshold: Annotated[int, Field(ge=0, le=10000)] = 10
    """Least sum of gradients in a block that is matched at all."""
    uniqueness_percent: Annotated[int, Field(ge=0, le=50)] = 10
    """How much better the best match must be than the second best."""

    @model_validator(mode="after")
    def _sound(self) -> "Bm":
        if self.block_px % 2 == 0:
            raise ValueError("block_px must be odd")
        return self


class Onnx(Strict):
    """A stereo network of your own, run on the CPU; needs `pip install binpick[onnx]`."""

    kind: Literal["onnx"] = "onnx"
    model: Path
    """The .onnx file: two float32 images [1, 1 or 3, H, W] in, grey levels 0 to 255, left first; one disparity map out, px."""


Matcher = Annotated[Sgbm | Hybrid | Bm | Onnx, Field(discriminator="kind")]


class StereoSettings(Strict):
    """How disparity is found; the bin gives window and range."""

    matcher: Matcher = Sgbm()
    """Which matcher, and its settings."""
    prefilter: Literal["none", "gaussian", "clahe", "bilateral"] = "none"
    """What is done to both images before matching: Gaussian blur, local contrast equalisation, or a bilateral filter."""
    wls_lambda: Annotated[float, Field(ge=1, le=100000)] = 8000.0
    """Smoothness of the filled map."""
    wls_sigma_color: Annotated[float, Field(ge=0.1, le=10)] = 1.2
    """How strongly the filled map respects edges of the image."""
    max_risk: Annotated[float, Field(gt=0, le=1)] = 0.49
    """Probability of an error beyond 1 px up to which a match counts as measured."""
    speckle_px: Annotated[int, Field(ge=0, le=5000)] = 100
    """Islands of fewer pixels do not count as measured."""


PRESETS = {
    "quality": StereoSettings(matcher=Sgbm(block_px=3, p1=48, p2=280, uniqueness_percent=15)),
    "fast": StereoSettings(matcher=Hybrid(block_px=3, p1=60, p2=400, uniqueness_percent=0), max_risk=0.56),
}
"""What `stereo: quality` and `--preset` mean; fitted on the exam's tuning seeds."""


def _named(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value not in PRESETS:
        raise ValueError(f"there is no preset {value!r}; there are {', '.join(PRESETS)}, or give the settings themselves")
    return PRESETS[value]


PresetName = Literal["quality", "fast"]
Stereo = Annotated[StereoSettings, BeforeValidator(_named, json_schema_input_type=PresetName | StereoSettings)]
"""Settings, or the name of a preset."""
