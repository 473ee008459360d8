"""The cell file (cell.yaml): every field has a unit, bounds and a sentence; unknown keys are errors."""

from binpick.settings.cell import AravisCameras, CameraAddress, Cell, FileCameras, ModbusSettings, Publish, RestSettings
from binpick.settings.file import load, parse, schema
from binpick.settings.job import Job, resolve
from binpick.settings.recipe import Bin, Limits, PartSize, Pose, Reach, Recipe, SegmentSettings
from binpick.settings.shape import Body, Box, Cylinder, Mesh
from binpick.settings.stereo import PRESETS, Bm, Hybrid, Matcher, Onnx, Sgbm, StereoSettings
from binpick.settings.tool import Cup, Fingers, SuctionTool, Tool, TwoFingerTool

__all__ = [
    "PRESETS", "AravisCameras", "Bin", "Bm", "Body", "Box", "CameraAddress", "Cell", "Cup", "Cylinder", "FileCameras",
    "Fingers", "Hybrid", "Job", "Limits", "Matcher", "Mesh", "ModbusSettings", "Onnx", "PartSize", "Pose", "Publish", "Reach",
    "Recipe", "RestSettings", "SegmentSettings", "Sgbm", "StereoSettings", "SuctionTool", "Tool", "TwoFingerTool", "load",
    "parse", "resolve", "schema",
]
