"""What light does that the virtual rig leaves out: it goes through a lens that is out of focus."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sms_jobs.bench.witness.fringes import DIRECT, Effects
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.campaigns import Made, top_hat_bending

_RAYS = 5
STATE = "S03"


@dataclass(frozen=True)
class Effect:
    """One way of light, by itself, and what it is in words."""

    name: str
    effects: Effects
    told: str


EFFECTS = (
    Effect("direct", replace(DIRECT, rays=_RAYS), "paint alone before a pin-hole"),
    Effect(
        "defocus",
        Effects(lens_mm=(40.0, 2200.0), rays=_RAYS),
        "a lens of 40 mm in focus at 2.2 m, the hat at 2.5 m: discs of 2 px",
    ),
)


def halved_hat() -> Made:
    """Return the demo's top hat before cameras of half as many pixels, its speckles as many pixels large."""
    calibration, campaign = top_hat_bending("hat", "small")
    scene = campaign.scene
    assert scene is not None
    assert scene.speckle is not None
    rig = replace(scene.rig, sensors=tuple(map(_halved, scene.rig.sensors)))
    larger = replace(scene.speckle, diameter_mm=2.0 * scene.speckle.diameter_mm)
    seen = replace(scene, rig=rig, speckle=larger)
    return replace(calibration, rig=rig), replace(campaign, scene=seen)


def _halved(sensor: Sensor) -> Sensor:
    """Return a camera whose pixels are twice as large; projectors stay."""
    if sensor.role is not Role.CAMERA:
        return sensor
    lens = sensor.intrinsics
    coarse = replace(
        lens,
        fx=lens.fx / 2.0,
        fy=lens.fy / 2.0,
        cx=(lens.cx + 0.5) / 2.0 - 0.5,
        cy=(lens.cy + 0.5) / 2.0 - 0.5,
    )
    return replace(sensor, columns=sensor.columns // 2, rows=sensor.rows // 2, intrinsics=coarse)
