"""A guard: what the watchdog starts a cycle from, as plain values that a recording and the daemon's file keep."""

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from binpick.errors import InputError
from binpick.rig import Rig
from binpick.rigcheck import correction as corrections
from binpick.rigcheck.correction import Correction
from binpick.rigcheck.drift import Level, Limits, Watch
from binpick.rigcheck.marks import Reference
from binpick.settings.cell import ReferenceMarks, Watchdog


class Guard(BaseModel):
    """Settings, what earlier cycles said, where the marks were, and the correction in force, all of one rig file."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")

    format: Literal["binpick-watchdog"] = "binpick-watchdog"
    version: Literal[1] = 1
    rig_sha256: str
    watchdog: Watchdog = Watchdog()
    marks: ReferenceMarks | None = None
    reference: Reference | None = None
    watch: Watch = Watch()
    correction: Correction | None = None

    def for_rig(self, rig: Rig) -> "Guard":
        """The same for another rig file: what was found of the old one says nothing of it."""
        if rig.sha256 == self.rig_sha256:
            return self
        return self.model_copy(update={"rig_sha256": rig.sha256, "watch": Watch(), "correction": None})

    @property
    def limits(self) -> Limits:
        """Of the verdict."""
        return Limits(warn_px=self.watchdog.warn_px, fault_px=self.watchdog.fault_px)

    @property
    def unusable(self) -> str:
        """Why configured marks cannot be compared, and what to do; "" when they can, or are not configured."""
        how = 'send POST /v1/calibration/verify {"store_marks": true} while the calibration is known to be good'
        if self.marks is None:
            return ""
        if self.reference is None:
            return f"the reference marks are not stored yet: {how}"
        if self.reference.rig_sha256 != self.rig_sha256:
            return f"the reference marks were stored with another rig file: {how}"
        if self.reference.family != self.marks.family:
            return f"the reference marks were stored as {self.reference.family}, not {self.marks.family}: {how}"
        return ""

    @property
    def level(self) -> Literal["ok", "warn", "fault"]:
        """The verdict so far; a rig that is corrected is never simply well."""
        if self.watch.level is Level.FAULT:
            return "fault"
        return "warn" if self.watch.level is Level.WARN or self.correction is not None else "ok"

    def rig(self, rig: Rig) -> Rig:
        """The rig as a cycle uses it."""
        return rig if self.correction is None else corrections.corrected(rig, self.correction.rotation_rad)

    def seen(self, watch: Watch, rig: Rig) -> "Guard":
        """After a cycle with the rig file `rig`; corrected from the next cycle on, where that is allowed and proved.

        By rows alone only a drift that is not yet a fault is taken out: what moved a camera by more than that has turned it
        about the axis that rows do not see as well.
        """
        after = self.model_copy(update={"watch": watch})
        limits = self.limits
        off = watch.off_px >= limits.warn_px or abs(watch.depth_m) >= limits.warn_m
        proved = watch.level is Level.WARN or (watch.level is Level.FAULT and np.isfinite(watch.depth_m))
        if not (self.watchdog.self_correct and off and proved):
            return after
        try:
            _, correction = corrections.applied(rig, watch.rotation_rad, self.correction)
        except InputError:                     # too much for a drift: the verdict stands
            return after
        return after.model_copy(update={"correction": correction, "watch": Watch(cycles=watch.cycles)})


def started(rig: Rig, watchdog: Watchdog, marks: ReferenceMarks | None, kept: Guard | None = None) -> Guard:
    """The guard of a daemon that starts, from what an earlier one has kept."""
    guard = kept.for_rig(rig) if kept is not None else Guard(rig_sha256=rig.sha256)
    return guard.model_copy(update={"watchdog": watchdog, "marks": marks})
