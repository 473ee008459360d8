"""Suction grasps: where every lip of the tool lies on one part within its compliance, on measured points only."""

from collections import Counter

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from binpick import threads
from binpick.data import Grasp, Segments
from binpick.grasp import bars, sigma
from binpick.grasp.seal import Seal, on_one_part, seal
from binpick.grasp.spots import Patch, centred, frames, long_axis, patches, spacing, spots
from binpick.settings import SuctionTool

STAND_OUT_M = 0.0015
"""What stands out further than this beside the lip keeps the cup from closing."""
SEAL_SHARE = 0.95
"""The measured surface may use this share of the compliance."""
CENTRINGS = 3
"""So many times cups are moved to the middle of what they see of the part: what they see moves along, and of several cups only
those near an edge say something."""
FLAT_RAD, CURVED_RAD = 0.08, 0.16
"""Normals under the lips that turn by less are noise, by more a curve (tuning seeds: 97 % of flat faces below 0.09, 95 % of the
cylinders above): only on a curve does the middle of a lip lie above the plane. In between it counts in part."""

ON_THE_SIDE = float(np.cos(np.radians(25)))
"""A lip on a bar's side, not on its end."""


def candidates(segments: Segments, tool: SuctionTool, sigma_z_m: Float32[np.ndarray, "h w"],
               ) -> tuple[list[Grasp], dict[str, int]]:
    """All grasps whose lips seal and whose tilt the tool allows, and how many spots fell out for which reason.

    Qualities are 0 until ranked. The pose's z points into the part, x along the part's longest extent; a tool of several cups
    is also tried a quarter turn from there, each turn being a spot of its own.
    """
    spacing_m = spacing(segments)
    at, narrow = spots(segments, min(cup.radius_m for cup in tool.cups), spacing_m)
    at, T_bin_spot = _turned(segments, at, tool)
    reasons = Counter(spots=len(at) + narrow, rim_not_on_one_part=narrow)
    if not len(at):
        return [], reasons
    # parts do not need each other; two halves, however many threads there are, so that nothing depends on their number
    half = segments.parts[at[:, 0], at[:, 1]] % 2
    halves = [np.flatnonzero(half == which) for which in (0, 1)]
    with threads.pool("seal") as pool:
        tried = list(pool.map(lambda some: _tried(segments, at[some], T_bin_spot[some], tool, spacing_m, sigma_z_m), halves))
    for _, _, more in tried:
        reasons.update(more)
    whose = np.concatenate([some[chosen] for some, (chosen, _, _) in zip(halves, tried, strict=True)])
    grasps = [grasp for _, found, _ in tried for grasp in found]
    return [grasps[i] for i in np.argsort(whose).tolist()], reasons


def _tried(segments: Segments, at: Int32[np.ndarray, "n 2"], T_bin_spot: Float64[np.ndarray, "n 4 4"], tool: SuctionTool,
           spacing_m: float, sigma_z_m: Float32[np.ndarray, "h w"],
           ) -> tuple[Int64[np.ndarray, "k"], list[Grasp], dict[str, int]]:
    """Which spots seal, the grasps there, and how many fell out for which reason."""
    patch = patches(segments, at, T_bin_spot, tool.cups, spacing_m)
    for _ in range(CENTRINGS):
        patch, T_bin_spot = centred(patch, T_bin_spot)
    held = np.flatnonzero(on_one_part(patch))
    reasons = {"rim_not_on_one_part": len(at) - len(held)}
    at, T_bin_spot, patch = at[held], T_bin_spot[held], patch.take(held)
    fit = seal(patch)
    limit_m = SEAL_SHARE * tool.compliance_m
    sealed = (np.maximum(fit.deviation_m, fit.bend_m) <= limit_m) & (fit.stand_out_m <= STAND_OUT_M)
    normal = fit.normal_bin(T_bin_spot)
    upright = np.arccos(np.clip(normal[:, 2], -1, 1)) <= tool.max_tilt_rad
    reasons |= {"no_seal": int((~sealed).sum()), "tilt": int((sealed & ~upright).sum())}
    chosen = np.flatnonzero(sealed & upright)
    grasps = _grasps(chosen, segments, at, fit, patch, normal, T_bin_spot, tool, sigma_z_m)
    return held[chosen], grasps, reasons | {"sealed": len(grasps)}


def _turned(segments: Segments, at: Int32[np.ndarray, "n 2"], tool: SuctionTool,
            ) -> tuple[Int32[np.ndarray, "m 2"], Float64[np.ndarray, "m 4 4"]]:
    """Spots and their frames, z along the normal; with several cups x along the part's longest extent, and square to it."""
    origin, normal = (field[at[:, 0], at[:, 1]].astype(np.float64) for field in (segments.xyz, segments.normal))
    if len(tool.cups) == 1:
        along = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        return at, frames(normal, along, origin)
    along = _long_axes(segments, segments.parts[at[:, 0], at[:, 1]])
    both = [frames(normal, hint, origin) for hint in (along, np.cross(normal, along))]
    return np.concatenate([at, at]), np.concatenate(both)


def _long_axes(segments: Segments, part: Int32[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
    labels, whose = np.unique(part, return_inverse=True)
    axes = np.array([long_axis(segments.part_points[label]) for label in labels.tolist()]).reshape(-1, 3)
    return axes[whose]


def _grasps(chosen: Int64[np.ndarray, "n"], segments: Segments, at: Int32[np.ndarray, "m 2"], fit: Seal, patch: Patch,
            normal: Float64[np.ndarray, "m 3"], T_bin_spot: Float64[np.ndarray, "m 4 4"], tool: SuctionTool,
            sigma_z_m: Float32[np.ndarray, "h w"]) -> list[Grasp]:
    """The chosen spots as grasps."""
    part = segments.parts[at[chosen, 0], at[chosen, 1]]
    T, upwards, under, place = T_bin_spot[chosen], normal[chosen], fit.under[chosen], patch.place[chosen]
    curved = np.clip((_turn(segments, upwards, under, place) - FLAT_RAD) / (CURVED_RAD - FLAT_RAD), 0, 1)
    origin = T[:, :3, 3] + T[:, :3, 2] * (fit.level_m[chosen] + curved * fit.centre_m[chosen])[:, None]
    upwards = _off_axis(segments, part, curved > 0, origin, upwards, tool)
    hint = _long_axes(segments, part) if len(tool.cups) == 1 else T[:, :3, 0]
    T_bin_tcp = frames(-upwards, hint, origin)
    sigma_px_m = _mean(sigma_z_m.ravel().take(place).astype(np.float64), under)
    off = sigma.of_cups(sigma_px_m, fit.rms_m[chosen], fit.support[chosen], curved, fit.room[chosen] < 1, tool.cups)
    return [
        Grasp(T_bin_tcp=T_bin_tcp[n], tool=tool.number, part_id=label, open_m=0.0, close_m=0.0, quality=0.0,
              seal_m=float(fit.bend_m[i]), room=float(fit.room[i]), sigma_xy_m=float(off.xy_m[n]), sigma_z_m=float(off.z_m[n]),
              sigma_tilt_rad=float(off.tilt_rad[n]))
        for n, (i, label) in enumerate(zip(chosen.tolist(), part.tolist(), strict=True))]


def _off_axis(segments: Segments, part: Int32[np.ndarray, "n"], curved: Bool[np.ndarray, "n"],
              origin: Float64[np.ndarray, "n 3"], normal: Float64[np.ndarray, "n 3"], tool: SuctionTool,
              ) -> Float64[np.ndarray, "n 3"]:
    """The normals, but on round bars away from the bar's axis, as far as the tool may tilt.

    A plane under the lip leans a third too little there.
    """
    normal, fields = normal.copy(), [field.reshape(-1, 3) for field in (segments.xyz, segments.normal)]
    for label in np.unique(part[curved]).tolist():
        mine = np.flatnonzero(segments.parts == label)
        if (found := bars.bar(*(field[mine].astype(np.float64) for field in fields))) is not None:
            away = found.outwards(origin)
            lips = (part == label) & (np.einsum("nc,nc->n", away, normal) > ON_THE_SIDE)
            lips &= away[:, 2] >= np.cos(tool.max_tilt_rad)
            normal[lips] = away[lips]
    return normal


def _turn(segments: Segments, normal: Float64[np.ndarray, "n 3"], under: np.ndarray, place: Int64[np.ndarray, "n k"],
          ) -> Float64[np.ndarray, "n"]:
    """How far the measured normals under the lips turn away from the plane's, rms, radians."""
    each = segments.normal.reshape(-1, 3).take(place, axis=0).astype(np.float64)
    cosine = np.einsum("nkc,nc->nk", each, normal)
    turn: Float64[np.ndarray, "n"] = np.sqrt(_mean(np.arccos(np.clip(cosine, -1, 1)) ** 2, under))
    return turn


def _mean(values: Float64[np.ndarray, "n k"], of: np.ndarray) -> Float64[np.ndarray, "n"]:
    """Over each row's selected values that are known; 0 where there are none."""
    known = of & np.isfinite(values)
    mean: Float64[np.ndarray, "n"] = np.where(known, values, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return mean
