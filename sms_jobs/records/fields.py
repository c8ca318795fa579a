"""Fields over a camera's image: phase, shape, regions, displacement, strain, and the meshes made of them.

Fields are component-first: a vector over an image is (3, rows, columns), a packed symmetric tensor
(6, rows, columns) in the order of `SYMMETRIC`. Values are NaN where `reason` is not `Reason.VALID`.

`axes` are X, Y, Z of the world or of the plane of an image, as everything in the archive has them, or x, y, z
of the specimen, where somebody asks for a record along these.

`sigma_calibration` is no part of the covariance or sigma beside it; None is not known, never none: where the
calibration states no covariance, or where there is no calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Reasons, Singles
from sms_jobs.records.quantity import IMAGE, STRAIN_COMPONENTS, SYMMETRIC, UNIT, XYZ, Axes, LengthUnit, array
from sms_jobs.records.views import view_of

Axis = tuple[float, float, float]

VECTOR_IMAGE = ("component", *IMAGE)
ORIENTED_IMAGE = ("orientation", *IMAGE)
RETURNS_IMAGE = ("orientation", "return", *IMAGE)
POINTS = ("point",)
_RESOLUTION = "spatial resolution: period of a wave of which 90 % of the amplitude is left"
_FROM_CALIBRATION = "standard deviation from the calibration alone, whose errors all pixels share"


@dataclass(frozen=True)
class PhaseMaps:
    """What temporal unwrapping or ranging says of every pixel, for each fringe orientation.

    Grey levels are those at exposure 1. Where that is the only exposure, `exposure` is None.
    """

    orientations_rad: tuple[float, ...]
    omega: Floats = array("rad", "phase gradient per fringe, -pi .. pi across the projector", ORIENTED_IMAGE)
    omega_sigma: Singles = array("rad", "standard deviation of the phase gradient", ORIENTED_IMAGE)
    modulation: Singles = array("count", "fringe modulation", ORIENTED_IMAGE)
    phase_error: Singles = array(
        "rad", "rms residual of the phase against the fringe density", ORIENTED_IMAGE
    )
    mean_intensity: Singles = array("count", "texture averaged over all fringe frames")
    exposure: Singles | None = array(
        "1", "exposure that was chosen, in units of the camera's own", default=None
    )

    @classmethod
    def unset(
        cls, orientations_rad: tuple[float, ...], rows: int, columns: int, bracketed: bool = False
    ) -> PhaseMaps:
        """Return maps to be filled; the mean intensity is 0, to be added to."""
        shape = (len(orientations_rad), rows, columns)
        sigma, modulation, error = (np.empty(shape, np.float32) for _ in range(3))
        mean = np.zeros((rows, columns), np.float32)
        exposure = np.empty((rows, columns), np.float32) if bracketed else None
        return cls(orientations_rad, np.empty(shape), sigma, modulation, error, mean, exposure)


@dataclass(frozen=True)
class ReturnMaps:
    """Every return that ranging found in a pixel, strongest first, and which of them were paired.

    NaN behind the last return of a pixel. The label counts the combinations, the last orientation's return
    fastest: of two orientations with two returns 1 is (1, 1), 2 (1, 2), 3 (2, 1) and 4 (2, 2).
    """

    orientations_rad: tuple[float, ...]
    label: NDArray[np.uint16] = array("1", "chosen combination of returns, 0 for none")
    margin: Singles = array("1", "log-likelihood of the chosen combination above that of any other place")
    omega: Singles = array("rad", "phase gradient per fringe, -pi .. pi across the projector", RETURNS_IMAGE)
    omega_sigma: Singles = array("rad", "standard deviation of the phase gradient", RETURNS_IMAGE)
    amplitude: Singles = array("count", "fringe modulation of the return", RETURNS_IMAGE)

    @classmethod
    def unset(cls, orientations_rad: tuple[float, ...], returns: int, rows: int, columns: int) -> ReturnMaps:
        """Return maps to be filled."""
        image, shape = (rows, columns), (len(orientations_rad), returns, rows, columns)
        omega, sigma, amplitude = (np.empty(shape, np.float32) for _ in range(3))
        label, margin = np.empty(image, np.uint16), np.empty(image, np.float32)
        return cls(orientations_rad, label, margin, omega, sigma, amplitude)


@dataclass(frozen=True)
class Surface:
    """What every pixel of a view's camera sees: a point of the world, or of the plane of the image.

    In the world a position is (X, Y, Z) in mm. A camera alone knows its image as a plane: x points to the
    right and y up, from the middle of the first pixel, in mm where the size of a pixel is known and in px
    elsewhere; there is no Z, and no covariance, since a pixel is where it is.

    Attributes
    ----------
    mm_per_px
        Size of a pixel in the plane; None in the world, and where it is not known.
    subset_radius_px
        Distance over which errors of positions go together, where they come from matches between cameras;
        0 where they are independent from pixel to pixel.
    texture_part
        What the texture hides within pixels: it counts for each point, and cancels in a mean over several,
        but for those at its rim. None is none.
    resolution_px
        Period in the image of a wave of shape of which 90 % of the amplitude is left, where positions come
        from matches between cameras; None where each pixel is measured by itself.
    shape_order, own_noise, noise_part
        Where positions come from matches between cameras; None elsewhere. The first is that of the subsets'
        deformation. The second is one standard deviation, positive away from the camera, for noise that moves
        the matches along the columns and for noise that moves them along the rows: a match in time has the
        same noise. The third is by the images' noise; the rest is what subsets cannot follow, which two
        recordings have in common only where nothing has moved.
    """

    view: str
    unit: LengthUnit
    position: Floats = array(UNIT, "position", VECTOR_IMAGE, XYZ)
    reason: Reasons = array("bit", "why a pixel has no value, 0 where it has one")
    covariance: Singles | None = array(
        f"{UNIT}^2",
        "covariance of the position, from the images' noise",
        VECTOR_IMAGE,
        SYMMETRIC,
        default=None,
    )
    ray_gap: Singles | None = array(
        "mm", "distance between the camera's and its partner's ray at closest approach", default=None
    )
    mm_per_px: float | None = None
    subset_radius_px: int = 0
    sigma_calibration: Singles | None = array(UNIT, _FROM_CALIBRATION, VECTOR_IMAGE, XYZ, default=None)
    texture_part: Singles | None = array(
        "1", "part of the covariance that cancels where neighbouring pixels are averaged", default=None
    )
    axes: Axes = "XYZ"
    resolution_px: float | None = None
    shape_order: int | None = None
    own_noise: Singles | None = array(
        "mm",
        "how far the noise of the camera's own image moves the position along its ray",
        VECTOR_IMAGE,
        ("x", "y"),
        default=None,
    )
    noise_part: Singles | None = array("1", "part of the covariance that is the images' noise", default=None)

    @property
    def camera(self) -> str:
        """The camera whose pixels these are."""
        return view_of(self.view).camera

    @property
    def has_depth(self) -> bool:
        """Whether it lies in space, not in the plane of an image."""
        return len(self.position) == len(XYZ)


@dataclass(frozen=True)
class Region:
    """One continuous piece of surface in a label map.

    Attributes
    ----------
    label, area, centroid
        Its number, its size in px, and its middle (x, y) in px.
    piece_of
        The first of the pieces into which one region of the reference has come apart; None for a region that
        is whole.
    """

    label: int
    area: int
    centroid: tuple[float, float]
    piece_of: int | None = None


@dataclass(frozen=True)
class Regions:
    """Continuous pieces of surface, found in measured shape; label 0 is none of them."""

    regions: tuple[Region, ...]
    labels: NDArray[np.int32] = array("1", "region label, by descending area")


@dataclass(frozen=True)
class ImageMatches:
    """Sample points of the reference texture and where they are found in the deformed one."""

    x: Floats = array("px", "column in the reference image", POINTS)
    y: Floats = array("px", "row in the reference image", POINTS)
    region: NDArray[np.int32] = array("1", "region label", POINTS)
    u: Floats = array("px", "displacement along the columns", POINTS)
    v: Floats = array("px", "displacement along the rows", POINTS)
    gradient: Floats = array(
        "1",
        "gradient of the image displacement",
        ("component", "point"),
        ("du/dx", "du/dy", "dv/dx", "dv/dy"),
    )
    sigma_u: Singles = array("px", "standard deviation of u", POINTS)
    sigma_v: Singles = array("px", "standard deviation of v", POINTS)
    score: Singles = array("1", "zero-normalised cross-correlation, 1 for a perfect match", POINTS)
    iterations: NDArray[np.int32] = array("1", "Gauss-Newton iterations", POINTS)
    reason: Reasons = array("bit", "why a point has no value, 0 where it has one", POINTS)
    steps: NDArray[np.int32] | None = array(
        "1",
        "correlations whose displacements add up to this one, 1 for the reference itself, 0 for none",
        POINTS,
        default=None,
    )
    subset_radius: NDArray[np.int32] | None = array(
        "px", "radius of the subset that was taken, where that was chosen", POINTS, default=None
    )
    shape_order: NDArray[np.int32] | None = array(
        "1", "order of its deformation, where that was chosen", POINTS, default=None
    )


@dataclass(frozen=True)
class PlacesSeen:
    """Where another camera sees what each pixel of the reference camera sees at the same time.

    Attributes
    ----------
    reference_blur_px, blur_px
        By how much the lens of the reference camera, and of this one, blurs its image, as a standard
        deviation in px; 0 where it has not been seen.
    """

    camera: str
    shift: Singles = array(
        "px",
        "place in the camera's image less the pixel's own; NaN where it does not see the point",
        VECTOR_IMAGE,
        ("x", "y"),
    )
    reference_blur_px: float = 0.0
    blur_px: float = 0.0


@dataclass(frozen=True)
class DisplacementField:
    """Displacement of the material point seen by each pixel of the reference image.

    Errors of neighbouring pixels go together: those of shape over `averaging_radius_px`, those of the match
    over `subset_radius_px`; 0 where they are independent. The part of the covariance that is bias goes
    together over as much as a gauge, and no mean makes it less. Frame and unit are those of the surface: in
    the plane of an image there is no displacement along Z.

    The spatial resolution is that of whole subsets: in the image as the median, `resolution_px`, and on the
    surface at each pixel, in the direction in which a pixel covers most of it.

    Attributes
    ----------
    match_radius_px, match_order, match_margin_px
        Of the subsets that were matched in time, of their deformation, and of the rim of regions of which
        they use nothing. `subset_radius_px` is the larger of that radius and that of the subsets of which
        shape was made. None where that is not told.
    """

    view: str
    reference_state: str
    unit: LengthUnit
    displacement: Floats = array(UNIT, "displacement", VECTOR_IMAGE, XYZ)
    covariance: Singles = array(f"{UNIT}^2", "covariance of the displacement", VECTOR_IMAGE, SYMMETRIC)
    image_displacement: Floats = array("px", "displacement in the image", VECTOR_IMAGE, ("u", "v"))
    reason: Reasons = array("bit", "why a pixel has no value, 0 where it has one")
    averaging_radius_px: float = 0.0
    subset_radius_px: int = 0
    bias: Singles | None = array(
        f"{UNIT}^2",
        "part of the covariance that is no noise: what the images have against the displacement",
        VECTOR_IMAGE,
        SYMMETRIC,
        default=None,
    )
    sigma_calibration: Singles | None = array(UNIT, _FROM_CALIBRATION, VECTOR_IMAGE, XYZ, default=None)
    axes: Axes = "XYZ"
    resolution_px: float | None = None
    resolution: Singles | None = array(UNIT, _RESOLUTION, default=None)
    match_radius_px: int | None = None
    match_order: int | None = None
    match_margin_px: int | None = None


StrainMeasure = Literal["green-lagrange", "small"]


@dataclass(frozen=True)
class StrainField:
    """In-plane strain at each pixel of the reference image.

    The frame at a point lies in the tangent plane of the reference surface: x is the specimen's x axis
    projected onto that plane, z the outward normal (towards the camera), y completes it. In the plane of an
    image x points to the right and y up. The gauge length is in `unit`. The spatial resolution is that of
    gauge and displacement together, told as that of a displacement is.

    Attributes
    ----------
    x_axis
        The vector that is projected, in the frame of the surface; None where nobody has said it.
    square_px
        Side in px of the square of pixels over which strain was taken, whose side is the gauge length where a
        pixel has its median size; None for a disc.
    bias
        What strain is off by that bends within a gauge length; no mean makes it less. None where it has not
        been looked for.
    """

    measure: StrainMeasure
    unit: LengthUnit
    gauge_length: float
    strain: Floats = array("1", "strain", VECTOR_IMAGE, STRAIN_COMPONENTS)
    sigma: Singles = array("1", "standard deviation of the strain", VECTOR_IMAGE, STRAIN_COMPONENTS)
    principal: Floats = array("1", "principal strains, larger first", VECTOR_IMAGE, ("first", "second"))
    von_mises: Floats = array("1", "equivalent strain after von Mises")
    reason: Reasons = array("bit", "why a pixel has no value, 0 where it has one")
    sigma_calibration: Singles | None = array(
        "1", _FROM_CALIBRATION, VECTOR_IMAGE, STRAIN_COMPONENTS, default=None
    )
    x_axis: Axis | None = None
    resolution_px: float | None = None
    resolution: Singles | None = array(UNIT, _RESOLUTION, default=None)
    bias: Singles | None = array(
        "1",
        "part of sigma that is no noise: strain that bends within the gauge length",
        VECTOR_IMAGE,
        STRAIN_COMPONENTS,
        default=None,
    )
    square_px: int | None = None


@dataclass(frozen=True)
class MergedField:
    """Surface and displacement as one camera sees them, all its views taken together; in `unit`.

    Its spatial resolution is that of the coarsest of the views that measured.
    """

    camera: str
    views: tuple[str, ...]
    unit: LengthUnit
    discrepancy_rms: float
    displacement: Floats = array(UNIT, "displacement", VECTOR_IMAGE, XYZ)
    position: Floats = array(UNIT, "position at the reference state", VECTOR_IMAGE, XYZ)
    covariance: Singles = array(f"{UNIT}^2", "covariance of the displacement", VECTOR_IMAGE, SYMMETRIC)
    contributors: NDArray[np.uint8] = array("1", "number of views that gave a value")
    reason: Reasons = array("bit", "why a pixel has no value, 0 where it has one")
    discrepancy: Singles | None = array(
        UNIT, "rms distance between the displacements of the views", default=None
    )
    mm_per_px: float | None = None
    sigma_calibration: Singles | None = array(UNIT, _FROM_CALIBRATION, VECTOR_IMAGE, XYZ, default=None)
    axes: Axes = "XYZ"
    resolution_px: float | None = None
    resolution: Singles | None = array(UNIT, _RESOLUTION, default=None)

    @property
    def has_depth(self) -> bool:
        """Whether it lies in space, not in the plane of an image."""
        return len(self.position) == len(XYZ)


@dataclass(frozen=True)
class Mesh:
    """Triangles over measured points, with values at the points.

    Where the points are pixels, `cameras[camera[k]]` is what saw vertex k, at (column, row) `pixel[:, k]`.
    In the plane of an image vertices have no Z. `strain_axis` is the x axis of strain among the values, as
    in `StrainField`.
    """

    value_names: tuple[str, ...]
    value_units: tuple[str, ...]
    vertices: Floats = array(UNIT, "position at the reference state", ("vertex", "component"), XYZ)
    faces: NDArray[np.int32] = array(
        "1", "vertex indices, counter-clockwise seen from outside", ("face", "corner")
    )
    values: Floats = array("mixed", "values at the vertices, see value_names", ("value", "vertex"))
    unit: LengthUnit = "mm"
    cameras: tuple[str, ...] = ()
    camera: NDArray[np.uint8] | None = array(
        "1", "which of the cameras saw the vertex", ("vertex",), default=None
    )
    pixel: NDArray[np.int32] | None = array(
        "px", "where it saw the vertex", ("component", "vertex"), ("column", "row"), default=None
    )
    strain_axis: Axis | None = None
    axes: Axes = "XYZ"

    @property
    def has_depth(self) -> bool:
        """Whether it lies in space, not in the plane of an image."""
        return bool(self.vertices.shape[1] == len(XYZ))

    def value(self, name: str) -> Any:
        """Return one of the values, (vertices,); raise `InvalidInput` for one that it has not got."""
        if name not in self.value_names:
            raise InvalidInput(f"the mesh has no '{name}'; it has {', '.join(self.value_names) or 'none'}")
        return self.values[self.value_names.index(name)]

    def with_value(self, name: str, unit: str, values: Floats) -> Mesh:
        """Return it with one value more, (vertices,)."""
        return replace(
            self,
            value_names=(*self.value_names, name),
            value_units=(*self.value_units, unit),
            values=np.concatenate([self.values, values[None]]),
        )
