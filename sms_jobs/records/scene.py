"""What stands in front of a virtual rig: surface, speckle, light, noise, and how it deforms.

Material points are named by their place in the specimen's own frame at rest: x along its length, y across,
z outwards (towards the sensors), origin at its middle, in mm. `placement` brings that frame into the world.
The classes only describe; `sms_jobs.virtual_rig` gives them their geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.sensors import Rig
from sms_jobs.records.views import View

Vector: TypeAlias = tuple[float, float, float]

AT_ORIGIN = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Plane:
    """A flat rectangular plate."""

    width_mm: float
    height_mm: float
    shape: Literal["plane"] = "plane"


@dataclass(frozen=True)
class Cylinder:
    """Part of a cylinder about an axis along y, its crest at the origin, convex towards the sensors."""

    radius_mm: float
    width_mm: float
    height_mm: float
    shape: Literal["cylinder"] = "cylinder"


@dataclass(frozen=True)
class Sphere:
    """The cap of a sphere that is at most `cap_angle_rad` from its pole; the pole is at the origin."""

    radius_mm: float
    cap_angle_rad: float = 1.2
    shape: Literal["sphere"] = "sphere"


@dataclass(frozen=True)
class PlateWithHoleAndStep:
    """A plate with a round hole and, beside it, a raised flat step (thesis section 4.6)."""

    width_mm: float
    height_mm: float
    hole_centre_mm: tuple[float, float]
    hole_radius_mm: float
    step_centre_mm: tuple[float, float]
    step_size_mm: tuple[float, float]
    step_height_mm: float
    shape: Literal["plate-with-hole-and-step"] = "plate-with-hole-and-step"


@dataclass(frozen=True)
class TopHat:
    """A sheet bent along four lines parallel to y into a top-hat profile (thesis section 5.3.1).

    Base, side, top, side, base; two round holes in the top, on its centre line x = 0. The middle of the
    depth is at z = 0.
    """

    width_mm: float = 500.0
    height_mm: float = 500.0
    depth_mm: float = 100.0
    top_width_mm: float = 200.0
    side_width_mm: float = 50.0
    """Width of each side section as seen from the front: its slope is depth over this."""
    hole_radius_mm: float = 25.0
    hole_offset_mm: float = 130.0
    """Distance of each hole's centre from the middle, along y."""
    shape: Literal["top-hat"] = "top-hat"


@dataclass(frozen=True)
class Stud:
    """A short round post on a face of a panel, along z: the head of a bolt, or a sensor."""

    centre_mm: tuple[float, float]
    level_mm: float
    """Height of the face that it stands on."""
    radius_mm: float
    height_mm: float


@dataclass(frozen=True)
class TieRod:
    """A round rod across a panel, along y, that hides what is behind it and casts a shadow."""

    x_mm: float
    z_mm: float
    radius_mm: float
    length_mm: float


@dataclass(frozen=True)
class StiffenedPanel:
    """A flat skin with a stringer of T profile along x, whose foot lies on it (thesis section 6.3.1).

    The skin is at z = 0; the foot's top is at its thickness, and the web stands on its middle line y = 0.
    Studs stand on skin or foot, and a tie rod may run across.
    """

    width_mm: float
    height_mm: float
    foot_width_mm: float
    foot_thickness_mm: float
    web_height_mm: float
    web_thickness_mm: float
    studs: tuple[Stud, ...] = ()
    rod: TieRod | None = None
    shape: Literal["stiffened-panel"] = "stiffened-panel"


@dataclass(frozen=True)
class PlateAndMirror:
    """A diffuse plate and a mirror that meet in a V along y (thesis section 7.3.1).

    The hinge is the y axis, the V opens towards z, the plate is on the side of negative x. Light that
    reaches the plate by way of the mirror is a second return in the same pixel.
    """

    plate_width_mm: float
    height_mm: float
    opening_angle_rad: float
    mirror_reflectance: float = 0.5
    mirror_width_mm: float = 200.0
    shape: Literal["plate-and-mirror"] = "plate-and-mirror"


Surface: TypeAlias = (
    Plane
    | Cylinder
    | Sphere
    | PlateWithHoleAndStep
    | TopHat
    | StiffenedPanel
    | PlateAndMirror
    | CircleBoard
    | DotCylinder
    | Chessboard
    | BallBar
)
"""A calibration artefact stands in its own frame, see `sms_jobs.records.artefacts`."""


@dataclass(frozen=True)
class Rigid:
    """A rotation about the specimen's origin (rotation vector, rad), then a translation (mm)."""

    rotation_rad: Vector = (0.0, 0.0, 0.0)
    translation_mm: Vector = (0.0, 0.0, 0.0)
    motion: Literal["rigid"] = "rigid"


@dataclass(frozen=True)
class UniaxialStrain:
    """Uniform strain along x with contraction across: d = (e x, -nu e y, -nu e z)."""

    strain: float
    poisson_ratio: float = 0.3
    motion: Literal["uniaxial-strain"] = "uniaxial-strain"


@dataclass(frozen=True)
class MidPointBending:
    """Clamped at all edges, pushed out along z at the middle by `deflection_mm`.

    d_z = deflection f(x / width) f(y / height), f(s) = 1 - 12 s^2 + 16 |s|^3 for |s| <= 1/2, the
    deflection line of a beam clamped at both ends under a load at its middle.
    """

    deflection_mm: float
    width_mm: float
    height_mm: float
    motion: Literal["mid-point-bending"] = "mid-point-bending"


@dataclass(frozen=True)
class HalvesApart:
    """The halves x < 0 and x > 0 move apart by `gap_mm` in all, each by half of it."""

    gap_mm: float
    motion: Literal["halves-apart"] = "halves-apart"


@dataclass(frozen=True)
class Disbond:
    """What lies on a skin lifts off it along z over a length: a stringer whose bond has opened (section 6.3).

    Material above z = `level_mm`, the top of the stringer's foot, moves by d_z = gap f(x / length)
    (1 + tilt y), f as of `MidPointBending`; the skin, at z = 0, stays, and the foot's sides between them
    stretch. The lift must nowhere be negative: tilt times half the width is at most 1.
    """

    gap_mm: float
    length_mm: float
    tilt_per_mm: float
    level_mm: float
    motion: Literal["disbond"] = "disbond"


@dataclass(frozen=True)
class StringerCrack:
    """A stiffened skin under load along x, behind which a stringer has cracked (section 6.2).

    d_x = e x (1 + t y) + e r w I B, d_y = -nu e (y + t y^2 / 2) - e t x^2 / 2, d_z = bulge S B: a strain e
    that grows across the skin by t, and is larger by the part r where the stringer along y = `stringer_mm`
    carries nothing. With s = (x - tip) / w that is from S(s) = (1 + tanh s) / 2 on, whose integral is I(s) =
    (s + ln(2 cosh s)) / 2, and about the stringer, by B = exp(-(y - stringer)^2 / (2 width^2)). The crack
    comes from large x as far as its tip.
    """

    strain: float
    poisson_ratio: float
    slope_per_mm: float
    """t: by which part of it the strain grows per mm along y."""
    tip_mm: float
    fade_mm: float
    """w: over which the strain changes at the tip."""
    stringer_mm: float
    width_mm: float
    relief: float
    """r: the part that the cracked stringer no longer takes."""
    bulge_mm: float
    """How far the skin comes out where nothing holds it."""
    motion: Literal["stringer-crack"] = "stringer-crack"


@dataclass(frozen=True)
class PanTilt:
    """The rotation of a pan-tilt stage about its origin, where its axes meet: R~ of thesis Eq. (2.3).

    The pan axis is x; the tilt axis, which is y at home, turns with it.
    """

    pan_rad: float = 0.0
    tilt_rad: float = 0.0
    motion: Literal["pan-tilt"] = "pan-tilt"


@dataclass(frozen=True)
class Bow:
    """A plate that is bowed along x and y, and twisted: d_z = x_mm u^2 + y_mm v^2 + twist_mm u v.

    u and v run from -1 to 1 over `half_width_mm` and `half_height_mm` from `centre_mm`.
    """

    x_mm: float
    y_mm: float
    twist_mm: float
    centre_mm: tuple[float, float]
    half_width_mm: float
    half_height_mm: float
    motion: Literal["bow"] = "bow"


Deformation: TypeAlias = (
    Rigid | PanTilt | UniaxialStrain | MidPointBending | HalvesApart | Disbond | StringerCrack | Bow
)


def refuse_inside_out(deformation: Deformation) -> None:
    """Raise `InvalidInput` for a strain by which no length is left of a specimen: at -1 it is 0 long."""
    if not isinstance(deformation, UniaxialStrain | StringerCrack):
        return
    strain, ratio = deformation.strain, deformation.poisson_ratio
    for axis, along, given in (
        ("x", strain, f"strain = {strain}"),
        ("y", -ratio * strain, f"strain = {strain} with poisson_ratio = {ratio}"),
    ):
        if along <= -1.0:
            raise InvalidInput(
                f"{given} turns the specimen inside out: along {axis} it is strained by {along:.6g}, and "
                "should be by more than -1, at which nothing is left of its length"
            )


@dataclass(frozen=True)
class Speckle:
    """A printed speckle pattern: dark blobs on a bright ground, fixed to the material.

    Attributes
    ----------
    diameter_mm
        Mean diameter of a speckle.
    dark, bright
        Diffuse reflectance of paint and ground, 0 .. 1.
    seed
        Of the pattern.
    """

    diameter_mm: float
    dark: float = 0.25
    bright: float = 0.85
    seed: int = 1


@dataclass(frozen=True)
class Gloss:
    """A highlight beside the diffuse light: strength (n . h)^exponent, h half way between both directions.

    Attributes
    ----------
    strength
        Of the highlight's middle, in units of a perfectly diffuse white surface that faces the projector, or
        the lamp where there is none.
    exponent
        The higher, the smaller the highlight.
    """

    strength: float
    exponent: float


@dataclass(frozen=True)
class CameraResponse:
    """How a camera turns light into grey levels.

    Attributes
    ----------
    bits
        8, 12 or 16.
    exposure
        Grey level, as a fraction of full scale, of a perfectly diffuse white surface that faces a
        projector at full brightness, or the lamp, where the specimen stands.
    full_well
        Electrons at full scale: sets the shot noise.
    read_noise
        Standard deviation in electrons.
    blur_px
        Standard deviation of the lens's Gaussian blur.
    ambient
        Light that comes neither from the projector nor from the lamp, as a fraction of `exposure`.
    """

    bits: Literal[8, 12, 16] = 12
    exposure: float = 0.8
    full_well: float = 30_000.0
    read_noise: float = 10.0
    blur_px: float = 0.5
    ambient: float = 0.02


@dataclass(frozen=True)
class ProjectorResponse:
    """How a projector turns pixel values into light.

    Attributes
    ----------
    gamma
        Exponent of its response; 1 is linear.
    defocus_px
        Standard deviation, in projector pixels, of its Gaussian defocus: lowers the modulation of dense
        fringes.
    visibility
        V of thesis Eq. (1.16).
    """

    gamma: float = 1.0
    defocus_px: float = 0.0
    visibility: float = 1.0


@dataclass(frozen=True)
class Scene:
    """A virtual rig and what stands in front of it.

    Attributes
    ----------
    rig
        The cameras and projectors as they truly are, whatever a calibration says of them.
    surface, speckle
        The specimen; None for an unmarked surface.
    gloss
        How it shines; None for a surface that is diffuse alone.
    placement
        Brings the specimen's frame into the world: X_world = rotation @ x_specimen + translation.
    camera, projector
        Responses, the same for every camera and every projector.
    seed
        Of the noise.
    lamp_mm
        Where in the world the lamp stands that lights what a camera sees without a projector, mm; None for
        the middle of all cameras, from where no shadow falls on what they see together.
    board_bow_mm
        By how much the ends of a board's points stand out along x and y, and its corners by twist, in mm: how
        the boards of a session truly are, whatever it is told of their flatness.
    """

    rig: Rig
    surface: Surface
    speckle: Speckle | None = None
    placement: Pose = AT_ORIGIN
    camera: CameraResponse = CameraResponse()
    projector: ProjectorResponse = ProjectorResponse()
    seed: int = 0
    gloss: Gloss | None = None
    lamp_mm: Vector | None = None
    board_bow_mm: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Simulation:
    """How a simulated measurement came about: enough to know the exact truth behind it.

    Attributes
    ----------
    scene
        The virtual rig and its specimen.
    camera, projector
        Names of the sensors that measured; without a projector, None, a lamp is on.
    deformation
        What had been done to the specimen, in order.
    state
        Label of the load state. With the scene's seed and the names of the sensors it seeds the noise, so
        that two recordings of one thing differ in their noise.
    """

    scene: Scene
    camera: str
    projector: str | None
    deformation: tuple[Deformation, ...]
    state: str = ""

    @classmethod
    def of(
        cls, scene: Scene, view: View, deformation: tuple[Deformation, ...], state: str = ""
    ) -> Simulation:
        """Return what the reference camera of a view records."""
        return cls(scene, view.camera, view.projector if view.projectors else None, deformation, state)
